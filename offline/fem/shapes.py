"""Shapes of bodies: the unit cube mapped onto them.

A shape places a grid of the cube, three rising arrays of parameters, in the body; those through a
section may be others at each place along it.  Every mesh of a body, coarse or fine, uniform or
graded, is such a grid: every other parameter is a corner of elements, those between are half-way.
"""

from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np

from palpate.offline.fem.section import Section, map_section, read_outline
from palpate.shared.arrays import Array
from palpate.shared.scene import Block, Extrusion, Scene, SceneError


class Shape(Protocol):
    """The unit cube mapped onto a body."""

    def grid(self, u: Array, v: Array, w: Array) -> Array:
        """Points (a, b, c, 3) mm of a grid of parameters (a,), (b,) and (c,) or (a, c)."""

    def at(self, parameters: Array) -> Array:
        """Points (..., 3) mm of parameters (..., 3)."""


class BlockShape:
    """A box: parameters along x, y, z."""

    def __init__(self, geometry: Block) -> None:
        self._size = np.array(geometry.size)

    def grid(self, u: Array, v: Array, w: Array) -> Array:
        """See ``Shape``."""
        third = np.atleast_2d(w)[:, None]
        grid = np.broadcast_arrays(u[:, None, None], v[:, None], third)
        return np.stack(grid, axis=-1) * self._size

    def at(self, parameters: Array) -> Array:
        """See ``Shape``."""
        return parameters * self._size


class ExtrusionShape:
    """A section along y: parameters along the section, along y, through it; right-handed so."""

    def __init__(self, geometry: Extrusion, folder: Path) -> None:
        self._section = _section(folder / geometry.section, geometry.corners)
        self._length = geometry.length

    def grid(self, u: Array, v: Array, w: Array) -> Array:
        """See ``Shape``."""
        plane = self._section(*np.broadcast_arrays(u[:, None], w))
        points = np.empty((len(plane), len(v), plane.shape[1], 3))
        points[..., [0, 2]] = plane[:, None]
        points[..., 1] = self._length * v[:, None]
        return points

    def at(self, parameters: Array) -> Array:
        """See ``Shape``."""
        plane = self._section(parameters[..., 0], parameters[..., 2])
        return np.stack([plane[..., 0], self._length * parameters[..., 1], plane[..., 1]], axis=-1)


@lru_cache(maxsize=8)
def _section(path: Path, corners: tuple[tuple[float, float], ...]) -> Section:
    return map_section(read_outline(path), corners)


def shape_of(scene: Scene) -> Shape:
    """Shape of the body of a scene.

    Raises
    ------
    SceneError
        If the section cannot be read or mapped.
    """
    geometry = scene.lattice
    if isinstance(geometry, Block):
        return BlockShape(geometry)
    if scene.folder is None:
        raise SceneError("geometry.section: the scene's folder is not known")
    return ExtrusionShape(geometry, scene.folder)
