"""Files that scenes name: whether they may be read at all, and what reading them needs."""

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from palpate.shared.arrays import Array
from palpate.shared.errors import PalpateError
from palpate.shared.scene import SceneError

MOST_BYTES = 500_000_000
"""Of a file that is read."""

SMALLEST, LARGEST = 1.0, 1000.0
"""Sizes of a body, mm."""


def require(module: str) -> Any:
    """Return a module of the extra ``anatomy``, or say how to install it."""
    try:
        return import_module(module)
    except ImportError as error:
        raise PalpateError(
            f"bodies from files need {module}: pip install 'palpate[anatomy]'"
        ) from error


def first_line(error: BaseException) -> str:
    """What a library's reader says of a file, in a few words."""
    return (str(error) or type(error).__name__).splitlines()[0][:80]


def checked(folder: Path | None, name: str, key: str, kinds: tuple[str, ...]) -> Path:
    """Path of a file that a scene names by a key; raise `SceneError` if it cannot be read."""
    if folder is None:
        raise SceneError(f"{key}: the scene's folder is not known")
    path = folder / name
    if not path.name.lower().endswith(kinds):
        raise SceneError(f"{key}: {path} must end in {' or '.join(kinds)}")
    if not path.is_file():
        raise SceneError(f"{key}: {path} is not there, or no file")
    size = path.stat().st_size
    if not 0 < size <= MOST_BYTES:
        few = "is empty" if size == 0 else f"has {size / 1e6:.0f} MB"
        raise SceneError(
            f"{key}: {path} {few}; files of up to {MOST_BYTES // 1_000_000} MB are read: "
            "save the body alone, with fewer triangles or cells"
        )
    return path


def refuse_size(path: Path, points: Array, unit: str) -> None:
    """Refuse points (n, 3) mm that are not finite, or no body's in the unit that is said."""
    if not np.isfinite(points).all():
        lost = np.sum(~np.isfinite(points).all(axis=1))
        raise SceneError(
            f"{path}: {lost} of {len(points)} points have coordinates that are not finite; "
            "remove them and save the file anew"
        )
    sizes = np.ptp(points, axis=0)
    if not SMALLEST <= sizes.max() <= LARGEST:
        body = " x ".join(f"{size:.3g}" for size in sizes)
        other = "a smaller" if sizes.max() > LARGEST else "a larger"
        raise SceneError(
            f"{path}: a body of {body} mm if lengths are in {unit}, but bodies are "
            f"{SMALLEST:g} to {LARGEST:g} mm large: state {other} geometry.unit, or scale the file"
        )
