"""How far trainings are: what each tells in its own folder, for the service to show."""

import json
import time
from pathlib import Path
from typing import NamedTuple

from palpate.shared.files import open_regular, write_whole

FILE = "progress.json"

SILENT = 900.0
"""Seconds after which a training that says nothing has been killed: some tasks take minutes."""


class Progress(NamedTuple):
    """How far a training is."""

    scene: str
    stage: str
    done: int  # tasks of the stage
    of: int
    share: float  # of the whole training, about
    seconds_left: float | None  # None while nobody knows


def training_folder(artifact: Path) -> Path:
    """Folder where the training of an artifact keeps its results until it is written."""
    return artifact.parent / f".{artifact.stem}.training"


def tell(folder: Path, progress: Progress) -> None:
    """Tell how far the training that works in a folder is."""
    write_whole(folder / FILE, json.dumps(progress._asdict()).encode())


def trainings(directory: Path) -> list[Progress]:
    """How far those are whose artifacts will be in a directory."""
    found = []
    for path in sorted(directory.glob(f".*.training/{FILE}")):
        try:
            if time.time() - path.stat().st_mtime < SILENT:
                with open_regular(path) as file:
                    found.append(Progress(**json.load(file)))
        except (OSError, ValueError, TypeError):  # it has just ended, or is something else
            continue
    return found
