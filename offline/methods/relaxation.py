"""Relaxation: how surgical trainers bring a mesh of points to rest under a load.

Trainers step a damped motion, explicitly or, since Baraff & Witkin (SIGGRAPH 1998), implicitly with
conjugate gradients, until it comes to rest.  The position at rest depends on neither mass nor
damping, so here they are left out: an implicit step of infinite length is a step of Newton's
method.  Preconditioned conjugate gradients solve its linear system inexactly (Dembo, Eisenstat &
Steihaug 1982; Nocedal & Wright, Numerical Optimization, algorithm 7.1), and a line search on the
potential shortens the step.  Only 3 x 3 blocks are factorised.

Points are numbered with the free ones first; vectors over points are (3, ...), axis by axis, and
the tangent is one 3 x 3 tensor for each point and each of its neighbours: first neighbours of all
points, then second ones, and so on, so that vector instructions take many points at a time.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from palpate.offline.fem.problem import FullProblem
from palpate.offline.methods.lattice import Ints
from palpate.offline.methods.method import Answer, Case, Method
from palpate.offline.methods.tetrahedra import Tetrahedra, edges_of
from palpate.offline.reduce.sampling import random_points
from palpate.shared.mechanics.tensors import cofactor, det, load, scale, store

Array = NDArray[np.float64]

TOLERANCE = 3e-3
"""Residual relative to the load: on the turbinate, displacements are then within 1 % in the median,
2 % at the 95th percentile, of those at rest; the models themselves are off by ten times more."""

MAX_STEPS = 100
MAX_ITERATIONS = 20_000
"""Of conjugate gradients, over all steps."""

SUFFICIENT_DECREASE = 1e-4
SMALLEST_STEP = 1e-4
ROUND_OFF = 1e-12
"""Relative error with which a potential is known."""

LOADS, RESIDUAL = 24, 1e-3
"""Small loads by which a body's stiffness is fitted, and the residual of its answers to them."""


class Rest(NamedTuple):
    """Where a relaxation ended."""

    displacement: Array  # (3, m) mm, of all points; clamped ones stay
    residual: float  # over the load, in the Euclidean norm of the free points' forces
    converged: bool
    iterations: int  # of conjugate gradients


class Relaxed(Method):
    """An elastic body of points at the corners of tetrahedra, relaxed from rest under each load.

    The state is the displacement (3, m) mm of the points.

    Parameters
    ----------
    elements : ndarray, shape (t, 4), int
        Tetrahedra whose edges join the points that act on each other.

    Attributes
    ----------
    stencil : Stencil
        Holds the tangent.
    forcing : float
        By how much conjugate gradients lower the residual before the tangent is taken anew.
    """

    forcing: float

    def __init__(self, problem: FullProblem, mesh: Tetrahedra, elements: Ints, label: str) -> None:
        super().__init__(problem, 3 * mesh.free, label)
        self.mesh = mesh
        self.stencil = Stencil(edges_of(elements), len(mesh.nodes), mesh.free)
        self._load = np.zeros((3, len(mesh.nodes)))

    @abstractmethod
    def internal(self, displacement: Array, force: Array) -> float:
        """Write the internal force (3, m) mN of a displacement (3, m) mm; return energy, mN mm."""

    @abstractmethod
    def linearise(self, displacement: Array) -> None:
        """Bring the stencil's tangent up to a displacement (3, m) mm."""

    def step(self, state: Array | None, case: Case, dt: float = 0.0) -> Answer:
        """See ``Method``."""
        self.mesh.load(case, self._load)
        rest = relax(self, self._load, TOLERANCE)
        found = rest.displacement if rest.converged else state
        return Answer(found, rest.converged, rest.iterations)

    def field(self, state: Array) -> Array:
        """See ``Method``."""
        return self.mesh.displacement(state)

    def stiffening(self) -> float:
        """Factor on the body's stiffness with which it best answers small loads all over it.

        It minimises the sum of squared differences from the full model, over loads and nodes.
        """
        model, mesh = self.problem.model, self.mesh
        rng = np.random.default_rng(self.problem.scene.seed)
        self.linearise(np.zeros((3, len(mesh.nodes))))
        own, step = np.zeros((3, len(mesh.nodes))), np.zeros((3, mesh.free))
        both, square = 0.0, 0.0
        for point in random_points(self.problem.surface, LOADS, rng):
            weights, normal = self.problem.unit_load(point)
            load = -weights[:, None] * normal
            wanted = np.zeros(load.size)
            wanted[model.free] = model.solve_linear(load.ravel()[model.free])
            force = np.ascontiguousarray((mesh.carrier.T @ load)[: mesh.free].T)
            self.stencil.solve(force, RESIDUAL, own.size, step)
            own[:, : mesh.free] = step
            found = mesh.displacement(own).ravel()
            both += float(found @ wanted)
            square += float(found @ found)
        return square / both


class Stencil:
    """Tangent stiffness (mN/mm) of f free points, kept by neighbours, and its linear solver.

    Parameters
    ----------
    edges : ndarray, shape (e, 2), int
        Pairs of points that act on each other, each once.
    points, free : int
        Points m, and how many of them, from the first, are free.

    Attributes
    ----------
    neighbours : ndarray, shape (w, f), uint32
        Row 0: the point itself.
    lengths : ndarray, shape (w,), int
        How many of the points, from the first, a row concerns: few where the points with many
        neighbours come first.
    tensors : ndarray, shape (w, 9, f), float32
        One 3 x 3 tensor, row-major, for each of those.
    """

    def __init__(self, edges: Ints, points: int, free: int) -> None:
        self.points, self.free = points, free
        ends = np.concatenate([edges, edges[:, ::-1]])
        ends = ends[np.all(ends < free, axis=1)]
        ends = ends[np.lexsort((ends[:, 1], ends[:, 0]))]
        row = ends[:, 0]
        rank = 1 + np.arange(len(row)) - np.searchsorted(row, row)
        width = 1 + int(rank.max(initial=0))
        self.neighbours = np.tile(np.arange(free, dtype=np.uint32), (width, 1))
        self.neighbours[rank, row] = ends[:, 1]
        self.lengths = np.full(width, free)
        for w in range(1, width):
            self.lengths[w] = 1 + row[rank == w].max()
        self.tensors = np.zeros((width, 9, free), np.float32)
        self._keys, self._ranks = row * points + ends[:, 1], rank
        self._inverse = np.zeros((9, free), np.float32)
        self._work = np.zeros((5, 3, free), np.float32)
        self._double = np.zeros((3, 3, free))

    def ranks(self, pairs: Ints) -> NDArray[np.int32]:
        """Row of ``neighbours`` (k,) where each point of pairs (k, 2) keeps its partner.

        -1 where one of the two is clamped; 0 for a free point with itself.
        """
        a, b = pairs.T
        at = np.searchsorted(self._keys, a * self.points + b)
        rank = np.append(self._ranks, 0)[at]
        rank[a == b] = 0
        rank[(a >= self.free) | (b >= self.free)] = -1
        return rank.astype(np.int32)

    def prepare(self) -> None:
        """Invert the diagonal tensors, which precondition the solver; after every new tangent."""
        invert_diagonal(self.tensors[0], self._inverse)

    def apply(self, displacement: Array, force: Array) -> float:
        """Write the tangent times a displacement (3, m) to the free points of a force (3, m).

        Returns
        -------
        energy : float, mN mm
            Half of the work they do.
        """
        x, y, near = self._double
        x[:] = displacement[:, : self.free]
        product(self.neighbours, self.lengths, self.tensors, x, y, near)
        force[:, : self.free] = y
        return 0.5 * float(np.vdot(x, y))

    def solve(self, load: Array, fraction: float, most: int, out: Array) -> int:
        """Solve for a displacement by conjugate gradients; return the iterations made.

        Parameters
        ----------
        load : ndarray, shape (3, f), mN
        fraction : float
            Of the load that may be left as residual.
        most : int
            Iterations.
        out : ndarray, shape (3, f), mm, out
            A descent direction even where the tangent is not definite.
        """
        return conjugate_gradients(
            self.neighbours, self.lengths, self.tensors, self._inverse, load, fraction, most, out,
            self._work,
        )  # fmt: skip


@np.errstate(over="ignore", invalid="ignore")
def relax(body: Relaxed, load: Array, tolerance: float) -> Rest:
    """Bring a body to rest under a dead load (3, m) mN, from no displacement.

    It counts as at rest with a residual of ``tolerance``; see ``Rest``.
    """
    free = body.stencil.free
    u, trial, step = np.zeros_like(load), np.zeros_like(load), np.zeros((3, free))
    force, trial_force = np.zeros_like(load), np.zeros_like(load)
    scale = float(np.linalg.norm(load[:, :free]))
    potential, norm, iterations = 0.0, scale, 0
    residual = load[:, :free].copy()
    for _ in range(MAX_STEPS):
        if not norm > tolerance * scale:
            break
        body.linearise(u)
        fraction = max(body.forcing, 0.5 * tolerance * scale / norm)
        most = MAX_ITERATIONS - iterations
        iterations += body.stencil.solve(residual, fraction, most, step)
        slope, length = float(np.vdot(residual, step)), 1.0
        while length > SMALLEST_STEP:
            np.multiply(step, length, out=trial[:, :free])
            trial += u
            trial_potential = body.internal(trial, trial_force) - float(np.vdot(load, trial))
            allowed = ROUND_OFF * abs(potential) - SUFFICIENT_DECREASE * length * slope
            if trial_potential - potential <= allowed:
                break
            length *= 0.5
        else:
            break
        u, trial, force, trial_force = trial, u, trial_force, force
        potential = trial_potential
        np.subtract(load[:, :free], force[:, :free], out=residual)
        norm = float(np.linalg.norm(residual))
    left = norm / scale if scale else 0.0
    return Rest(u, left, left <= tolerance, iterations)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def product(neighbours, lengths, tensors, x, y, near):
    """Write ``y``, the tangent times ``x`` (both (3, f)), with scratch ``near`` (3, f).

    The other arguments are those of ``Stencil``.
    """
    y[:] = 0.0
    for w in range(len(lengths)):
        for axis in range(3):
            _take(lengths[w], neighbours[w], x[axis], near[axis])
        for axis in range(3):
            rows = tensors[w, 3 * axis], tensors[w, 3 * axis + 1], tensors[w, 3 * axis + 2]
            _add_row(lengths[w], rows, near[0], near[1], near[2], y[axis])


@njit(cache=True, nogil=True, error_model="numpy")
def _take(count, indices, x, out):
    for i in range(count):
        out[i] = x[indices[i]]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _add_row(count, rows, x0, x1, x2, y):
    a, b, c = rows
    for i in range(count):
        y[i] += a[i] * x0[i] + b[i] * x1[i] + c[i] * x2[i]


@njit(cache=True, nogil=True, error_model="numpy")
def invert_diagonal(tensors, inverse):
    """Invert symmetric tensors (9, f); one that is not positive definite counts by its trace."""
    f, flat, out = tensors.shape[1], tensors.reshape(-1), inverse.reshape(-1)
    for i in range(f):
        T = load(flat, i, f)
        C = cofactor(T)
        J = det(T, C)
        if T[0] > 0.0 and C[8] > 0.0 and J > 0.0:
            store(scale(1.0 / J, C), out, i, f)
        else:
            inverse[:, i] = 0.0
            inverse[0, i] = inverse[4, i] = inverse[8, i] = 3.0 / (
                abs(T[0]) + abs(T[4]) + abs(T[8])
            )


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _precondition(inverse, r, z):
    """Write ``z = inverse r`` and return ``r . z``; ``inverse`` (9, f), the others (3, f)."""
    z[:] = 0.0
    for axis in range(3):
        rows = inverse[3 * axis], inverse[3 * axis + 1], inverse[3 * axis + 2]
        _add_row(r.shape[1], rows, r[0], r[1], r[2], z[axis])
    return np.dot(r.reshape(-1), z.reshape(-1))


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def conjugate_gradients(neighbours, lengths, tensors, inverse, load, fraction, most, out, work):
    """Preconditioned conjugate gradients; see ``Stencil.solve``.  Work (5, 3, f) is float32."""
    r, z, p, q, near = work[0], work[1], work[2], work[3], work[4]
    scale = np.abs(load).max()
    out[:] = 0.0
    if not scale > 0.0:
        return 0
    # the same as plain vectors
    rs, zs, ps, qs = r.reshape(-1), z.reshape(-1), p.reshape(-1), q.reshape(-1)
    x, f = out.reshape(-1), load.reshape(-1)
    for i in range(len(f)):
        rs[i] = f[i] / scale
    ps[:] = 0.0
    target = fraction * fraction * np.dot(rs, rs)
    rho, before = _precondition(inverse, r, z), np.float32(1.0)
    for iteration in range(most):
        turn = rho / before if iteration else np.float32(0.0)
        for i in range(len(ps)):
            ps[i] = zs[i] + turn * ps[i]
        product(neighbours, lengths, tensors, p, q, near)
        curvature = np.dot(ps, qs)
        if not curvature > 0.0:
            if iteration == 0:
                x += scale * ps
            return iteration + 1
        alpha = rho / curvature
        for i in range(len(x)):
            x[i] += scale * alpha * ps[i]
            rs[i] -= alpha * qs[i]
        if not np.dot(rs, rs) > target:
            return iteration + 1
        before = rho
        rho = _precondition(inverse, r, z)
    return most
