"""Results of a training run on disk, so that a killed run goes on where it stopped.

Each result is an HDF5 file of its own, written aside and moved into place: whatever the moment of
a kill, a result is there or it is not.  The folder is named by a hash of everything the results
depend on, so stale ones are never read.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import shutil
from collections.abc import Mapping
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

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
        return self._folder / f"{name}.h5"

    def load(self, name: str) -> dict[str, NDArray[np.generic]] | None:
        """Arrays of a result, None if it is not there."""
        path = self._path(name)
        if not path.is_file():
            return None
        with h5py.File(path, "r") as file:
            return {key: value[()] for key, value in file.items()}

    def store(self, name: str, arrays: Mapping[str, NDArray[np.generic]]) -> None:
        """Keep a result."""
        path = self._path(name)
        temporary = path.with_suffix(".part")
        with h5py.File(temporary, "w") as file:
            for key, value in arrays.items():
                file[key] = value
        with temporary.open("rb") as written:
            os.fsync(written.fileno())
        temporary.replace(path)

    def share(self, name: str, value: object) -> Path:
        """Write a value where workers can read it, with ``pickle``; return its path."""
        path = self._folder / f"{name}.pickle"
        path.write_bytes(pickle.dumps(value))
        return path

    def remove(self) -> None:
        """Forget everything: the artifact is written."""
        shutil.rmtree(self._parent)
