"""Galerkin models: a basis and a cubature, solved from rest in compiled code.

The mechanics are those of the artifact's local models, ``reduced.press.LocalSystem``, with other
modes and points: linear elasticity is exact, for the modes are orthonormal in its energy, and only
what the tissue law adds to it is summed over the points.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from palpate.offline.fem.model import POINTWISE, FullModel
from palpate.offline.methods.method import Answer, Case
from palpate.shared.compiled import bind
from palpate.shared.mechanics import newton
from palpate.shared.reduced.press import LANES, ROUND_OFF, STATE, TILE, LocalSystem, descend

Array = NDArray[np.float64]
Field = NDArray[np.float32]

TOLERANCE = 1e-4
"""Residual at equilibrium relative to the load, in the energy norm: the solver's share of the
error, small beside that of any basis here."""

KEEP_TANGENT = 0.3
"""A factorised tangent serves while it contracts the residual by this factor."""

MAX_ITERATIONS = 60


@njit(cache=True, error_model="numpy", nogil=True, fastmath={"contract", "reassoc"})
def point_gradients(connectivity, gradients, points, modes, out):
    """Displacement gradients of modes at quadrature points, in the tiles of ``reduced.press``.

    Parameters
    ----------
    connectivity : ndarray, shape (e, n), int32
    gradients : ndarray, shape (e, q, n, 3), 1/mm
    points : ndarray, shape (c,), int
        Quadrature points, counted element by element.
    modes : ndarray, shape (3 nodes, m), mm
    out : ndarray, shape (>= m, 9 c), float32, 1/mm
        With ``c`` filled up to whole tiles; what fills up is left alone.
    """
    m = modes.shape[1]
    tile = np.zeros((9 * LANES, m))
    for first in range(0, len(points), LANES):
        tile[:] = 0.0
        for lane in range(min(LANES, len(points) - first)):
            e, q = divmod(points[first + lane], gradients.shape[1])
            for a in range(connectivity.shape[1]):
                for i in range(3):
                    mode = modes[3 * connectivity[e, a] + i]
                    for j in range(3):
                        slope, row = gradients[e, q, a, j], tile[(3 * i + j) * LANES + lane]
                        for k in range(m):
                            row[k] += slope * mode[k]
        start = 9 * first
        for k in range(m):
            for c in range(9 * LANES):
                out[k, start + c] = tile[c, k]


@dataclass(frozen=True)
class Cubature:
    """Quadrature points (c,), counted element by element, and their weights (c,) mm^3."""

    points: NDArray[np.int64]
    weights: Array

    @classmethod
    def full(cls, model: FullModel) -> Cubature:
        """Every point with its own weight."""
        return cls(np.arange(model.weights.size), model.weights.ravel())


class Content(NamedTuple):
    """A reduced model in memory."""

    system: LocalSystem
    modes: Array  # (3 nodes, m) mm
    q: Array  # (m,) answer
    newton: Array  # (4, m)


@njit(cache=True, error_model="numpy", nogil=True)
def reduce_load(modes, nodes, forces, load):
    """``load = modes^T f``: nodal forces (k, 3) on nodes (k,), modes (3 n, m)."""
    load[:] = 0.0
    for a in range(len(nodes)):
        for i in range(3):
            force, mode = forces[a, i], modes[3 * nodes[a] + i]
            for k in range(len(load)):
                load[k] += force * mode[k]


@njit(cache=True, error_model="numpy", nogil=True)
def _solve(content, nodes, forces):
    """Equilibrium from rest: (status, iterations), and ``q``."""
    system, q, work = content.system, content.q, content.newton
    reduce_load(content.modes, nodes, forces, system.load)
    # at rest the residual is the load's negative and the tangent the identity
    q[:] = 0.0
    np.negative(system.load, work[0])
    system.factor[:] = 0.0
    for i in range(len(q)):
        system.factor[i, i] = 1.0
    target = max(TOLERANCE * math.sqrt(np.dot(system.load, system.load)), 1e-12)
    status, iterations, _, _ = descend(
        system, q, work, 0.0, 1.0, target, KEEP_TANGENT, MAX_ITERATIONS, True, ROUND_OFF
    )
    return status, iterations


class GalerkinModel:
    """The full model in the span of modes that can be exchanged; not to be shared by threads.

    Parameters
    ----------
    model : FullModel
    size : int
        Most modes.
    cubature : Cubature

    Raises
    ------
    ValueError
        If the points of an element cannot be summed one by one.
    """

    def __init__(self, model: FullModel, size: int, cubature: Cubature) -> None:
        if model.element not in POINTWISE:
            raise ValueError(f"{model.element}: its points share a dilatation")
        self.points = cubature.points
        self._model = model
        element = self.points // model.weights.shape[1]
        rows, count = -(-size // 4) * 4, -(-len(self.points) // LANES) * LANES
        fill = (0, count - len(self.points))
        entries = TILE // LANES * count
        self.content = Content(
            system=LocalSystem(
                gradients=np.zeros((rows, entries), np.float32),
                weights=np.pad(cubature.weights, fill),
                mu=np.pad(model.mu[element], fill),
                lam=np.pad(model.lam[element], fill),
                load=np.zeros(rows),
                H=np.zeros(entries, np.float32),
                P=np.zeros(entries, np.float32),
                J=np.zeros(count),
                trace=np.zeros(count),
                linear=np.zeros(count),
                state=np.zeros(STATE * count, np.float32),
                increments=np.zeros((rows, entries), np.float32),
                tangent=np.zeros((rows, rows)),
                factor=np.zeros((rows, rows)),
            ),
            modes=np.zeros((3 * len(model.mesh.nodes), rows)),
            q=np.zeros(rows),
            newton=np.zeros((4, rows)),
        )
        self._bound = bind(self.content)

    def adopt(self, basis: Array) -> None:
        """Take a basis (free dofs, <= size) that is orthonormal in the energy at rest."""
        model, m = self._model, basis.shape[1]
        modes, gradients = self.content.modes, self.content.system.gradients
        modes[model.free, :m] = basis
        modes[:, m:] = 0.0
        gradients[m:] = 0.0
        point_gradients(
            model.connectivity, model.gradients, self.points, modes[:, :m].copy(), gradients
        )

    def solve(self, case: Case) -> tuple[bool, int]:
        """Whether there is an equilibrium, left in ``content.q``, and the iterations made."""
        status, iterations = _solve(self._bound, case.nodes, case.forces)
        return status == newton.CONVERGED, iterations


class Galerkin:
    """A basis for the whole surface; see ``offline.methods.method``.

    Parameters
    ----------
    family, label : str
    model : FullModel
    basis : ndarray, shape (free dofs, m), mm
    cubature : Cubature
    """

    def __init__(
        self, family: str, label: str, model: FullModel, basis: Array, cubature: Cubature
    ) -> None:
        self.family, self.label, self.unknowns = family, label, basis.shape[1]
        self.reduced = GalerkinModel(model, self.unknowns, cubature)
        self.reduced.adopt(basis)

    def solve(self, case: Case) -> Answer:
        """Solve from rest; the state is the modes' coordinates."""
        converged, iterations = self.reduced.solve(case)
        return Answer(self.reduced.content.q.copy(), converged, converged, iterations)

    def displacement(self, answer: Answer) -> Array:
        """Nodal displacement (n, 3) mm."""
        return (self.reduced.content.modes @ answer.state).reshape(-1, 3)


class GalerkinAtHand:
    """A basis made for each case while the user waits, with every quadrature point.

    Parameters
    ----------
    family, label : str
    model : FullModel
        Of its own: the rest stiffness stays factorised only while nobody else solves with it.
    size : int
        Most vectors of a basis.
    space : callable
        Gives the basis (free dofs, <= size) of a case.
    """

    def __init__(
        self,
        family: str,
        label: str,
        model: FullModel,
        size: int,
        space: Callable[[Case], Array],
    ) -> None:
        self.family, self.label, self.unknowns = family, label, size
        self.reduced = GalerkinModel(model, size, Cubature.full(model))
        self._space, self._free = space, model.free

    def solve(self, case: Case) -> Answer:
        """Build the basis and solve from rest; the state is basis and coordinates."""
        basis = self._space(case) if case.forces.any() else np.empty((len(self._free), 0))
        self.reduced.adopt(basis)
        converged, iterations = self.reduced.solve(case)
        q = self.reduced.content.q[: basis.shape[1]].copy()
        return Answer((basis, q), converged, converged, iterations)

    def displacement(self, answer: Answer) -> Array:
        """Nodal displacement (n, 3) mm."""
        basis, q = answer.state
        u = np.zeros(len(self.reduced.content.modes))
        u[self._free] = basis @ q
        return u.reshape(-1, 3)
