"""The part of a body round a region, whose cost does not know how large the body is.

Far from where it is pressed a body moves smoothly and turns so little that it is linear.  So a
region has every node where it is pressed and where the body turns along, its *window*, and beyond
only a few smooth *modes of the body*, which all regions share:

    u = sum_g a_g b_g + w,     w = 0 at all nodes of elements outside the window.

That is a space of finite element functions, and everything is Galerkin's method in it: with ``a``
eliminated, energy and force of the modes ``b`` outside are one small matrix.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import polar
from scipy.sparse import block_diag, csr_matrix
from scipy.spatial import cKDTree

from palpate.offline.fem.linear_solver import SparseSolver, sparse_solver
from palpate.offline.fem.model import FullModel
from palpate.offline.fem.problem import FullProblem
from palpate.offline.reduce.ritz import Footprint
from palpate.offline.reduce.sampling import farthest
from palpate.offline.run.workers import read_result
from palpate.shared.arrays import Array, Field, Flags, Numbers
from palpate.shared.local_models import Mesh

NONLINEAR = 1e-3
"""Displacement gradient of an element times its displacement over the largest, from which on it
belongs to a window: what linear elasticity makes of a rotation is off by about that."""

REACH = 3.0
"""Radii of the endoscope from its footprints within which an element belongs to a window, too."""

WHOLE = 0.6
"""Share of the elements from which on a window is the whole body: it saves nothing."""

PROBES = 12
"""Footprints of a region that its window is found with."""

SPACING = 2.3
"""Distance of the footprints whose responses are the modes of the body, in radii: of responses of
a strip at rest they miss less than .4 % (``tests/offline/reduce/test_window.py``)."""

NOTHING = 1e-7
"""Energy of a body mode outside a window, relative to the whole, that is none."""


class BodyModes(NamedTuple):
    """Modes of the whole body, orthonormal but for rounding."""

    values: NDArray[np.int16]  # (G, 3 n) in steps
    steps: Field  # (G,) mm
    products: Array  # (G, G), in energy at rest
    relaxed: Array  # (G, G), the same of the relaxed tissue


def body_modes(problem: FullProblem, points: Array) -> BodyModes:
    """What loads at points (k, 3) of the surface do: far away others do much the same.

    The orthonormal vectors nearest to these (Loewdin) are as large only where each load is, so that
    they are stored in half the bytes of the same space's principal modes.
    """
    model = problem.model
    units = [
        np.einsum("n,ij->nij", problem.unit_load(point)[0], np.eye(3)).reshape(-1, 3)[model.free]
        for point in points
    ]
    nearest, _ = polar(np.hstack([model.solve_linear(unit) for unit in units]))
    return stored_modes(problem, nearest)


def stored_modes(problem: FullProblem, kept: Array) -> BodyModes:
    """Modes (free dofs, G) mm of the body as they are stored."""
    model, nodes = problem.model, problem.mesh.nodes
    steps = (np.abs(kept).max(axis=0) / np.iinfo(np.int16).max).astype(np.float32)
    values = np.zeros((len(steps), nodes.size), np.int16)
    values[:, model.free] = np.rint(kept / steps).T
    stored = (values * steps[:, None])[:, model.free].T.astype(float)
    products = [stored.T @ (m.rest_stiffness @ stored) for m in (model, model.relaxed)]
    return BodyModes(values, steps, *products)


@dataclass
class WindowModel(FullModel):
    """The full model of a window.

    Its states ``[u, a]`` (free dofs + G, k) are displacements in the window and what the body modes
    do everywhere; loads act in the window.
    """

    body: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (free dofs, G) mm, modes
    inner: Flags = field(default_factory=lambda: np.zeros(0, bool))  # (free dofs,), where w is
    products: tuple[Array, Array] = (np.zeros((0, 0)), np.zeros((0, 0)))

    @cached_property
    def relaxed(self) -> FullModel:
        """See ``FullModel``."""
        if not self.prony:
            return self
        own = super().relaxed
        assert isinstance(own, WindowModel)
        own.products = self.products[::-1]
        return own

    @cached_property
    def _near(self) -> csr_matrix:
        return self.stiffness(np.zeros(3 * len(self.mesh.nodes)))

    @cached_property
    def _far(self) -> Array:
        """Stiffness (G, G) of the body modes outside the window."""
        return self.products[0] - self.body.T @ (self._near @ self.body)

    @cached_property
    def rest_stiffness(self) -> csr_matrix:
        """Stiffness at rest of states."""
        return csr_matrix(block_diag([self._near, self._far]))

    @cached_property
    def _eliminated(self) -> tuple[SparseSolver, Array, Array]:
        """Solver of w alone, body modes (free dofs, G) with w in balance, and their compliance."""
        inside = np.flatnonzero(self.inner)
        own = csr_matrix(self._near[inside][:, inside])
        own.sort_indices()
        solver = sparse_solver(own)
        solver.factorise(own.data)
        coupling = np.asarray((self._near @ self.body)[inside])
        moved = solver.solve(coupling)
        stiffness, V = np.linalg.eigh(self.products[0] - coupling.T @ moved)
        kept = stiffness > NOTHING * np.abs(np.diag(self.products[0])).max()
        V = V[:, kept] / np.sqrt(stiffness[kept])
        balanced = self.body.copy()
        balanced[inside] -= moved
        return solver, balanced, V @ V.T

    def solve_linear(self, loads: Array) -> Array:
        """Linear response to forces on states, or in the window alone."""
        n = len(self.free)
        solver, balanced, compliance = self._eliminated
        on_body = balanced.T @ loads[:n]
        if len(loads) > n:
            on_body += loads[n:]
        a = compliance @ on_body
        u = balanced @ a
        u[self.inner] += solver.solve(loads[:n][self.inner])
        return np.concatenate([u, a])

    def internal_free(self, u: Array) -> Array:
        """Internal force of a state; outside the window it is linear."""
        n = len(self.free)
        return np.concatenate([super().internal_free(u[:n]), self._far @ u[n:]])

    def paired_forces(self, states: Array, one: Array, other: Array, sign: float) -> Array:
        """See ``FullModel``; of states, linear outside the window."""
        n = len(self.free)
        near = super().paired_forces(states[:, :n], one, other, sign)
        return np.hstack([near, (one + sign * other) @ states[:, n:] @ self._far])

    def filled(self, u: Array) -> Array:
        """Displacement in the window (3 nodes,) mm of a state."""
        return super().filled(u[: len(self.free)])


def part_of(mesh: Mesh, elements: Numbers) -> tuple[Mesh, Numbers, Flags]:
    """Mesh of some elements, its nodes' (n,) numbers in the whole, and which others share."""
    inside = np.zeros(len(mesh.nodes), bool)
    inside[mesh.elements[elements]] = True
    border = np.zeros(len(mesh.nodes), bool)
    border[np.delete(mesh.elements, elements, axis=0)] = True
    number = np.cumsum(inside) - 1
    faces = inside[mesh.faces].all(axis=1)
    part = Mesh(
        nodes=mesh.nodes[inside],
        elements=number[mesh.elements[elements]].astype(np.int32),
        faces=number[mesh.faces[faces]].astype(np.int32),
        clamped=mesh.clamped[inside],
        accessible=mesh.accessible[faces],
        regions=None if mesh.regions is None else mesh.regions[elements],
    )
    return part, np.flatnonzero(inside).astype(np.int32), border[inside]


class WindowProblem(FullProblem):
    """The full problem of a window of another one, round points (k, 3) of its surface."""

    def __init__(self, whole: FullProblem, elements: Numbers, body: BodyModes) -> None:
        self.scene, self.elements = whole.scene, elements
        self.mesh, self.nodes, border = part_of(whole.mesh, elements)
        free = np.repeat(~self.mesh.clamped, 3)
        values = body.values.reshape(-1, len(whole.mesh.nodes), 3)[:, self.nodes]
        values = values.reshape(-1, free.size)
        self.model = WindowModel(
            self.mesh,
            self.scene.tissue,
            body=(values[:, free] * body.steps[:, None]).T.astype(float),
            inner=np.repeat(~border, 3)[free],
            products=(body.products, body.relaxed),
        )
        self.surface = whole.surface
        self._nodal = np.zeros(len(self.mesh.nodes))


def window_elements(problem: FullProblem, footprints: Sequence[Footprint]) -> Numbers:
    """Elements (e,) of the window of a region with these footprints."""
    model, mesh, reach = problem.model, problem.mesh, REACH * problem.scene.endoscope.radius
    points = np.array([pressed.point for pressed in footprints])
    away, _ = cKDTree(points).query(mesh.nodes, distance_upper_bound=reach)
    inside = np.isfinite(away)[mesh.elements].any(axis=1)
    for i in farthest(points, min(PROBES, len(points))):
        nodal, _ = problem.unit_load(points[i])
        loads = (nodal[:, None, None] * footprints[i].loads.T).reshape(-1, 3)[model.free]
        for u in model.solve_linear(loads).T:
            moved = model.filled(u).reshape(-1, 3)[mesh.elements]
            slopes = np.einsum("eai,eqaj->eqij", moved, model.gradients)
            most = np.linalg.norm(moved, axis=2).max(axis=1)
            turned = np.linalg.norm(slopes, axis=(2, 3)).max(axis=1)
            inside |= most * turned > NONLINEAR * most.max()
    inside |= inside.mean() > WHOLE
    return np.flatnonzero(inside).astype(np.int32)


@lru_cache(maxsize=1)
def window(problem: FullProblem, path: Path, region: int) -> FullProblem:
    """Window of a region; ``path`` is a pickle of the body modes and all windows' elements."""
    body, elements = read_result(path)
    if len(elements[region]) == len(problem.mesh.elements):
        return problem
    return WindowProblem(problem, elements[region], body)


def in_window(problem: FullProblem, path: Path, region: int, task: Any, *arguments: Any) -> Any:
    """Result of a task in the window of a region; for ``run.workers``."""
    return task(window(problem, path, region), *arguments)
