"""Galerkin methods: the full model in the span of a basis, summed over the points of a cubature.

The mechanics are those of the artifact's local models (``reduced.problem``, ``reduced.past``) with
other modes and points, under a dead load: equilibrium is sought with the inverse tangent that
secants make up, from rest on elastic tissue and from the last answer on tissue that remembers.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from palpate.offline.fem.problem import FullProblem
from palpate.offline.fem.terms import Past
from palpate.offline.methods.method import Answer, Case, Method
from palpate.shared.arrays import Array, Field, Ints
from palpate.shared.compiled import bind, bind_compiled, room
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.tensors import SYMMETRIC
from palpate.shared.mechanics.viscosity import step_weights
from palpate.shared.reduced.corrections import Secants, forget_secants
from palpate.shared.reduced.past import (
    Elastic,
    Memory,
    Remembering,
    opened,
    remembering,
    set_step,
)
from palpate.shared.reduced.points import (
    LANES,
    Points,
    increments,
    linearise,
    nonlinear_stress,
    superpose,
)
from palpate.shared.reduced.press import ROUND_OFF, SMALLEST_TARGET
from palpate.shared.reduced.problem import Problem, Work, newton_method
from palpate.shared.reduced.terms import Dead

TOLERANCE = 1e-4
"""Residual at equilibrium relative to load and past, in the energy norm: the solver's share of the
error, small beside that of any basis here.  Single precision ends at about 1e-6."""

MAX_ITERATIONS = 400


class Cubature(NamedTuple):
    """Quadrature points (c,), counted element by element, and their weights (c,) mm^3."""

    points: Ints
    weights: Array


class Content(NamedTuple):
    """A reduced model in memory, with room for r modes."""

    points: Points
    past: Any  # Elastic or Remembering
    load: Dead
    secants: Secants
    work: Work
    modes: Array  # (3 nodes, r) mm
    q: Array  # (r,) coordinates of the answer
    newton: Array  # (4, r)


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
def stress_points(content, q):
    """Write the stress of the points at coordinates ``q``; return the smallest det F."""
    points, work = content.points, content.work
    superpose(points.gradients, q, work.H)
    nonlinear_stress(work.H, points.weights, points.law, work.J, work.part, work.linear, work.P)
    return work.J.min()


@njit(cache=True, error_model="numpy", nogil=True)
def linearise_points(content, state, products):
    """Write the change of the points' stress with every mode (r, 9 c), at ``work.H``."""
    points = content.points
    linearise(content.work.H, points.weights, points.law, state)
    increments(points.law, state, points.gradients, products)


@njit(cache=True, error_model="numpy", nogil=True)
def _step(content, nodes, forces, accurate):
    """Go to the end of a time step, whether it is found; the past is advanced if it is."""
    points, past, load, secants = content.points, content.past, content.load, content.secants
    q, work = content.q, content.newton
    reduce_load(content.modes, nodes, forces, load.f)
    past.begin_step(points.law.mu, 0, 0)
    problem = bind_compiled(Problem(points, past, load, secants, content.work))
    size = past.external_force(load.f, secants.external, secants.origin)
    past.last_answer(0, q)
    target = max(accurate * size, SMALLEST_TARGET)
    status, _, _, _ = newton_method(
        problem, q, work, target, np.inf, MAX_ITERATIONS, True, ROUND_OFF
    )
    if status == newton.CONVERGED:
        past.end_step(points, content.work, 0, q, False)
        return True
    forget_secants(secants.inverse, secants.origin)
    return False


class Galerkin(Method):
    """One basis for the whole surface; not to be shared by threads.

    The state is the coordinates of the modes, in time the record of what the tissue remembers
    (``reduced.past``), which starts with them.

    Parameters
    ----------
    basis : ndarray, shape (free dofs, m), mm
        Orthonormal in the energy at rest.
    cubature : Cubature, optional
        Every quadrature point if absent, which in time it must be.
    accurate : float
        See ``TOLERANCE``.
    """

    def __init__(
        self,
        problem: FullProblem,
        basis: Array,
        cubature: Cubature | None = None,
        in_time: bool = False,
        accurate: float = TOLERANCE,
    ) -> None:
        model, m = problem.model, basis.shape[1]
        cubature = cubature or Cubature(np.arange(model.weights.size), model.weights.ravel())
        self.points, self._accurate = cubature.points, accurate
        super().__init__(problem, m, f"{m} modes, {len(self.points)} points")
        rows, count = -(-m // 4) * 4, -(-len(self.points) // LANES) * LANES
        fill = (0, count - len(self.points))
        points = Points(
            gradients=np.zeros((rows, 9 * count), np.float32),
            steps=np.ones(rows, np.float32),
            weights=np.pad(cubature.weights, fill),
            law=model.point_law.at(np.divmod(np.pad(self.points, fill), model.weights.shape[1])),
        )
        past: Elastic | Remembering = Elastic()
        if in_time:
            past = remembering(np.zeros((1, rows, rows), np.float32), len(model.prony), count)
        self.content = Content(
            points=points,
            past=past,
            load=Dead(np.zeros(rows)),
            secants=Secants(np.eye(rows), np.full((2, rows), np.nan), *np.zeros((2, rows))),
            work=room(Work, r=rows, c=count),
            modes=np.zeros((3 * len(model.mesh.nodes), rows)),
            q=np.zeros(rows),
            newton=np.zeros((4, rows)),
        )
        self._bound = bind(self.content)
        self.adopt(basis)

    def adopt(self, basis: Array) -> None:
        """Take another basis of no more modes."""
        model, m, content = self.problem.model, basis.shape[1], self.content
        content.modes[model.free, :m] = basis
        content.modes[:, m:] = 0.0
        self.write_gradients(content.modes[:, :m], content.points.gradients)
        if content.past.in_time:
            soft = basis.T @ (model.deviatoric_stiffness @ basis)
            content.past.deviatoric[0, :m, :m] = soft

    def write_gradients(self, functions: Array, out: Field) -> None:
        """Write the gradients of displacements (3 nodes, m) mm at the points, in tiles."""
        model, m = self.problem.model, functions.shape[1]
        elements, own, nodes, _ = model.gradients.shape
        slopes = model.gradients.swapaxes(2, 3).reshape(elements, 3 * own, nodes)
        moved = functions.reshape(-1, 3, m)[model.connectivity].reshape(elements, nodes, 3 * m)
        at_points = (slopes @ moved).reshape(-1, 3, 3, m)[self.points].swapaxes(1, 2)
        filled = np.zeros((out.shape[1] // 9, 3, 3, m), np.float32)
        filled[: len(self.points)] = at_points
        tiles = filled.reshape(-1, LANES, 9, m).transpose(3, 0, 2, 1)
        out[:m], out[m:] = tiles.reshape(m, -1), 0.0

    def at_rest(self) -> Array | None:
        """See ``Method``; the next search knows no secants."""
        secants, past = self.content.secants, self.content.past
        forget_secants(secants.inverse, secants.origin)
        if not past.in_time:
            return None
        record = np.zeros_like(past.records[0])
        self.opened(record).share[-1] = 1.0
        return record

    def step(self, state: Array | None, case: Case, dt: float = 0.0) -> Answer:
        """See ``Method``."""
        past, found = self.content.past, self.content.q
        if past.in_time:
            times = step_weights(self.problem.model.prony, dt)
            set_step(past, times)
            found = past.records[0]
            found[:] = state
        else:
            self.at_rest()
        converged = _step(self._bound, case.nodes, case.forces, self._accurate)
        return Answer(found.copy() if converged else state, converged)

    def field(self, state: Array) -> Array:
        """See ``Method``."""
        modes = self.content.modes
        return (modes @ state[: modes.shape[1]]).reshape(-1, 3)

    def opened(self, record: Array) -> Memory:
        """Views of a record."""
        points = self.content.points
        sizes = len(self.problem.model.prony), len(points.gradients), len(points.weights)
        memory: Memory = opened(record, *sizes)
        return memory

    def past(self, state: Array) -> Past | None:
        """See ``Method``; without the means that only energies need."""
        if not self.content.past.in_time:
            return None
        elements, own = self.problem.model.weights.shape
        histories = self.opened(state).points
        terms = len(histories)
        tiles = histories.reshape(terms, -1, SYMMETRIC, LANES).transpose(0, 1, 3, 2)
        points = tiles.reshape(terms, -1, SYMMETRIC)[:, : elements * own].astype(float)
        return Past(self.field(state), points.reshape(terms, elements, own, SYMMETRIC))


class GalerkinAtHand(Galerkin):
    """A basis made for each case while the user waits, with every quadrature point.

    ``space`` gives the basis (free dofs, <= size) of a case; the state is it and the coordinates.
    """

    def __init__(self, problem: FullProblem, size: int, space: Callable[[Case], Array]) -> None:
        super().__init__(problem, np.zeros((len(problem.model.free), size)))
        self._space, self.label = space, f"{size} vectors of the load at hand"

    def step(self, state: Any, case: Case, dt: float = 0.0) -> Answer:
        """See ``Method``."""
        if not case.forces.any():
            return Answer(None)
        basis = self._space(case)
        self.adopt(basis)
        answer = super().step(None, case)
        if not answer.converged:
            return Answer(state, False)
        return Answer((basis, answer.state[: basis.shape[1]]))

    def field(self, state: Any) -> Array:
        """See ``Method``."""
        basis, q = state
        u = np.zeros(self.problem.mesh.nodes.size)
        u[self.problem.model.free] = basis @ q
        return u.reshape(-1, 3)
