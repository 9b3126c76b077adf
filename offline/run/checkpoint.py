"""Results of a training run on disk, so that a killed run goes on where it stopped.

Each result is a file of its own, written aside and moved into place: whatever the moment of
a kill, a result is there or it is not.  The folder is named by a hash of everything the results
depend on, so stale ones are never read.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import shutil
from pathlib import Path
from typing import Any

from palpate.shared.scene import Extrusion, Scene

CODE = ("offline", "shared")


def content_key(scene: Scene) -> str:
    """Hash of the scene, the files it names and the code that trains it."""
    root = Path(__file__).parents[2]
    sha = hashlib.sha256(scene.text.encode())
    if isinstance(scene.geometry, Extrusion) and scene.folder is not None:
        sha.update((scene.folder / scene.geometry.section).read_bytes())
    for package in CODE:
        for source in sorted((root / package).rglob("*.py")):
            sha.update(source.read_bytes())
    return sha.hexdigest()[:16]


class Checkpoint:
    """Named results of one training run.

    Parameters
    ----------
    folder : Path
        Where runs of this artifact keep their results.
    key : str
        From ``content_key``; results of other keys are removed.
    """

    def __init__(self, folder: Path, key: str) -> None:
        self.key = key
        self._parent = folder
        self._folder = folder / key
        if folder.is_dir():
            for other in folder.iterdir():
                if other != self._folder:
                    shutil.rmtree(other)
        self._folder.mkdir(parents=True, exist_ok=True)

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.pickle"

    def __contains__(self, name: str) -> bool:
        return self._path(name).is_file()

    def load(self, name: str) -> Any:
        """Read a result that is there."""
        return pickle.loads(self._path(name).read_bytes())

    def store(self, name: str, result: object) -> Path:
        """Keep a result; return where, for workers to read it with ``pickle``."""
        path = self._path(name)
        temporary = path.with_suffix(".part")
        with temporary.open("wb") as file:
            pickle.dump(result, file)
            file.flush()
            os.fsync(file.fileno())
        return temporary.replace(path)

    def remove(self) -> None:
        """Forget everything: the artifact is written."""
        shutil.rmtree(self._parent)
