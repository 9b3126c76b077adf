"""The full model in the span of a basis, summed over the points of a cubature, in compiled code.

The mechanics are those of the artifact's local models (``reduced.problem``) with other modes and
points, under a dead load; the equilibrium is found by Newton's method with a tangent that is formed
and factorised.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from palpate.offline.fem.model import POINTWISE, FullModel
from palpate.offline.methods.method import Case
from palpate.shared.compiled import bind
from palpate.shared.mechanics import newton
from palpate.shared.reduced.corrections import Tangent
from palpate.shared.reduced.points import (
    LANES,
    STATE,
    TILE,
    Points,
    increments,
    linearise,
    nonlinear_stress,
    superpose,
)
from palpate.shared.reduced.press import ROUND_OFF
from palpate.shared.reduced.problem import Problem, descend
from palpate.shared.reduced.terms import Dead, Elastic
from palpate.shared.reduced.workspace import new_work

Array = NDArray[np.float64]
Field = NDArray[np.float32]

TOLERANCE = 1e-4
"""Residual at equilibrium relative to the load, in the energy norm: the solver's share of the
error, small beside that of any basis here."""

KEEP_TANGENT = 0.3
"""A factorised tangent serves while it contracts the residual by this factor."""

MAX_ITERATIONS = 60


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

    problem: Problem
    modes: Array  # (3 nodes, m) mm
    q: Array  # (m,) coordinates of the answer
    newton: Array  # (4, m)


@njit(cache=True, error_model="numpy", nogil=True, fastmath={"contract", "reassoc"})
def point_gradients(connectivity, gradients, points, modes, out):
    """Displacement gradients of modes at quadrature points, in the tiles of ``reduced.points``.

    Parameters
    ----------
    connectivity : ndarray, shape (e, n), int32
    gradients : ndarray, shape (e, q, n, 3), 1/mm
    points : ndarray, shape (c,), int
        Quadrature points, counted element by element.
    modes : ndarray, shape (3 nodes, m), mm
    out : ndarray, shape (>= m, 9 c), float32, 1/mm
        With ``c`` filled up to whole tiles; what fills up is not written.
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
def stress_points(problem, q):
    """Write the stress of the points at coordinates ``q``; return the smallest det F."""
    points, work = problem.points, problem.work
    superpose(points.gradients, q, work.H)
    nonlinear_stress(
        work.H, points.weights, points.mu, points.lam, work.J, work.trace, work.linear, work.P
    )
    return work.J.min()


@njit(cache=True, error_model="numpy", nogil=True)
def linearise_points(problem):
    """Write the change of the points' stress with every mode, at the gradients ``work.H``."""
    points, tangent = problem.points, problem.correction
    linearise(problem.work.H, points.weights, points.mu, points.lam, tangent.state)
    increments(tangent.state, points.gradients, tangent.products)


@njit(cache=True, error_model="numpy", nogil=True)
def _solve(content, nodes, forces):
    """Equilibrium from rest: (status, iterations), and ``content.q``."""
    problem, q, work = content.problem, content.q, content.newton
    load, factor = problem.load.f, problem.correction.factor
    reduce_load(content.modes, nodes, forces, load)
    # at rest the residual is the load's negative and the tangent the identity
    q[:] = 0.0
    np.negative(load, work[0])
    factor[:] = 0.0
    for i in range(len(q)):
        factor[i, i] = 1.0
    target = max(TOLERANCE * math.sqrt(np.dot(load, load)), 1e-12)
    status, iterations, _, _ = descend(
        problem, q, work, 0.0, 1.0, target, KEEP_TANGENT, MAX_ITERATIONS, True, ROUND_OFF
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
        points = Points(
            gradients=np.zeros((rows, entries), np.float32),
            steps=np.ones(rows, np.float32),
            weights=np.pad(cubature.weights, fill),
            mu=np.pad(model.mu[element], fill),
            lam=np.pad(model.lam[element], fill),
        )
        tangent = Tangent(
            points=points,
            state=np.zeros(STATE * count, np.float32),
            units=np.zeros((9, 0), np.float32),
            moduli=np.zeros((9, 0), np.float32),
            products=np.zeros((rows, entries), np.float32),
            bulk=np.zeros((rows, rows)),
            formed=np.full(2 * rows + 1, np.inf),
            lag=0.0,
            whole=np.zeros((rows, rows)),
            factor=np.zeros((rows, rows)),
        )
        self.content = Content(
            problem=Problem(
                points, Elastic(), Dead(np.zeros(rows)), tangent, new_work(rows, count)
            ),
            modes=np.zeros((3 * len(model.mesh.nodes), rows)),
            q=np.zeros(rows),
            newton=np.zeros((4, rows)),
        )
        self._bound = bind(self.content)

    def adopt(self, basis: Array) -> None:
        """Take a basis (free dofs, <= size) that is orthonormal in the energy at rest."""
        model, m = self._model, basis.shape[1]
        modes, gradients = self.content.modes, self.content.problem.points.gradients
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

    def displacement(self, q: Array) -> Array:
        """Nodal displacement (n, 3) mm of coordinates."""
        return (self.content.modes @ q).reshape(-1, 3)
