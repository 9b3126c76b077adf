"""A first look: tissue that trains in a minute is served, and other scenes train beside it."""

import os
import subprocess
import sys
import threading
import webbrowser
from collections.abc import Sequence
from pathlib import Path

import click

from palpate.online.serve.process import serve
from palpate.online.settings import Settings
from palpate.shared.errors import PalpateError

NICE = 19
"""How far the trainings beside it stand back for the service."""


def demo(settings: Settings, first: str, beside: Sequence[str], browser: bool) -> None:
    """Train the ``first`` scene if needed and serve it until a signal says to end; open its page.

    Scenes ``beside`` it are trained meanwhile and served when they are there.  Raises
    `PalpateError` if the first one cannot be trained; it has said why.
    """
    if subprocess.run(_training(first, settings.artifacts)).returncode:
        raise PalpateError(f"scene {first!r} cannot be trained")
    trainings = [_train(scene, settings.artifacts) for scene in beside]

    def stop() -> None:
        for training in trainings:
            training.terminate()

    try:
        serve(settings, _show if browser else lambda _: None, stop)
    finally:
        stop()


def _training(scene: str, artifacts: Path) -> list[str]:
    command = "from palpate.shared.cli import main; main()"
    return [sys.executable, "-c", command, "train", scene, "--out", str(artifacts / f"{scene}.h5")]


def _train(scene: str, artifacts: Path) -> subprocess.Popen[bytes]:
    """Begin to train a scene, whose progress goes into a log beside its artifact."""
    log = artifacts / f"{scene}.log"
    click.echo(f"Training {scene} meanwhile; what it says goes into {log}")
    back = (lambda: os.nice(NICE)) if hasattr(os, "nice") else None
    with log.open("wb") as said:
        command = _training(scene, artifacts)
        return subprocess.Popen(command, stdout=said, stderr=said, preexec_fn=back)


def _show(url: str) -> None:
    """Open a page without waiting for the browser."""
    threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()
