"""Meshes of one body: where the nodes of one lie in every other.

Those of a block or an extrusion are grids of one map (``fem.shapes``), so a node is found by its
parameters.  Those of a body from a file divide one base mesh (``bodies.refine``), in whose elements
a node is found.
"""

from functools import cached_property
from typing import Protocol

import numpy as np

from palpate.offline.bodies.mesh import mesh_of, refined_body
from palpate.offline.bodies.refine import Refined
from palpate.offline.fem.mesh import (
    Ticks,
    accessible_surface,
    build_mesh,
    cells_of,
    parameters_of,
    ticks_of,
)
from palpate.shared.anatomy import FileBody
from palpate.shared.arrays import Array, Ints, Numbers
from palpate.shared.geometry.elements import kind_of
from palpate.shared.geometry.surface import Surface
from palpate.shared.local_models import Mesh
from palpate.shared.scene import Scene


class BodyMesh(Protocol):
    """A mesh of a body, whose parts are made when they are first asked for."""

    @property
    def mesh(self) -> Mesh:
        """The mesh itself."""

    @property
    def sites(self) -> Array:
        """Where in the body its nodes lie, (n, ...)."""

    @property
    def surface(self) -> Surface | None:
        """The surface that can be touched, if it is not that of the mesh's own faces."""

    def at(self, sites: Array, field: Array) -> Array:
        """A nodal field (n, ...) of this mesh at sites (k, ...) of another one."""


class LatticeMesh:
    """A lattice of hexahedra; sites are parameters (n, 3)."""

    surface: Surface | None = None

    def __init__(self, scene: Scene, ticks: Ticks) -> None:
        self._scene, self._ticks = scene, ticks

    @cached_property
    def mesh(self) -> Mesh:
        """See ``BodyMesh``."""
        return build_mesh(self._scene, self._ticks)

    @cached_property
    def sites(self) -> Array:
        """See ``BodyMesh``."""
        return parameters_of(self._scene, self._ticks)

    def at(self, sites: Array, field: Array) -> Array:
        """See ``BodyMesh``."""
        return interpolated(self._ticks, self.mesh.elements, sites, field)


class NestedMesh:
    """Tetrahedra that divide those of the base mesh; sites are those of ``Refined``."""

    def __init__(self, scene: Scene, refined: Refined) -> None:
        self._scene, self._refined = scene, refined
        self.sites = refined.sites

    @cached_property
    def mesh(self) -> Mesh:
        """See ``BodyMesh``."""
        return mesh_of(self._scene, self._refined)

    @cached_property
    def surface(self) -> Surface | None:
        """See ``BodyMesh``."""
        return accessible_surface(self.mesh, self._scene)

    def at(self, sites: Array, field: Array) -> Array:
        """See ``BodyMesh``."""
        return self._refined.at(sites, field)


def own_mesh(scene: Scene) -> BodyMesh:
    """The mesh that a scene is trained on."""
    if isinstance(scene.geometry, FileBody):
        return NestedMesh(scene, refined_body(scene))
    return LatticeMesh(scene, ticks_of(scene.lattice))


def interpolated(grid: Ticks, elements: Numbers, parameters: Array, field: Array) -> Array:
    """A nodal field (n, ...) of a lattice of elements at parameters (k, 3) of the body."""
    first, second, third = grid
    t, u, v = parameters.T
    i, along = _cell(np.broadcast_to(first, (len(t), len(first))), t)
    j, across = _cell(np.broadcast_to(second, (len(t), len(second))), u)
    rows = np.broadcast_to(third, (len(first), third.shape[-1]))
    share = (along[:, None] + 1.0) / 2.0
    k, through = _cell((1.0 - share) * rows[i] + share * rows[i + 1], v)
    nodes = elements[np.ravel_multi_index((i, j, k), cells_of(grid))]
    N, _ = kind_of(elements).shape(np.column_stack([along, across, through]))
    return np.einsum("ka,ka...->k...", N, field[nodes])


def _cell(ticks: Array, at: Array) -> tuple[Ints, Array]:
    """Between which of its ticks (k, n) each of values (k,) lies, and where: -1 to 1."""
    cell = np.clip(np.sum(ticks <= at[:, None], axis=1) - 1, 0, ticks.shape[1] - 2)
    low, high = (np.take_along_axis(ticks, cell[:, None] + n, axis=1)[:, 0] for n in (0, 1))
    return cell, 2.0 * (at - low) / (high - low) - 1.0
