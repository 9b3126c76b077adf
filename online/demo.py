"""A first look: a pad of tissue that is there is served, and other scenes train beside it."""

import filecmp
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
from palpate.shared.files import write_whole

TRAINED = Path(__file__).parent / "trained"
"""Artifacts that come with Palpate, to look at before any is trained."""

NICE = 19
"""How far the trainings beside it stand back for the service."""


def demo(settings: Settings, first: str, beside: Sequence[str], browser: bool) -> None:
    """Serve the ``first`` scene, trained if needed, until a signal says to end; open its page.

    Scenes ``beside`` it are trained meanwhile and served when they are there.  Raises
    `PalpateError` if the first one cannot be trained; it has said why.
    """
    came = _came(settings.artifacts / f"{first}.h5")
    if not came and subprocess.run(_training(first, settings.artifacts)).returncode:
        raise PalpateError(f"scene {first!r} cannot be trained")
    trainings = [_train(scene, settings.artifacts) for scene in beside]

    def stop() -> None:
        for training in trainings:
            training.terminate()

    try:
        serve(settings, _show if browser else lambda _: None, stop)
    finally:
        stop()


def _came(path: Path) -> bool:
    """Whether an artifact is as it came with Palpate, put there if there is none."""
    trained = TRAINED / path.name
    if not trained.exists():
        return False
    if not path.exists():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, trained.read_bytes())
        except OSError as error:
            raise PalpateError(f"{error.filename}: {error.strerror}") from None
    return filecmp.cmp(trained, path, shallow=False)


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
