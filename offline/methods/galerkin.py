"""Galerkin methods: one basis for the whole surface, or one made for each load; also in time."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from palpate.offline.fem.model import History
from palpate.offline.methods.galerkin_model import (
    MAX_ITERATIONS,
    TOLERANCE,
    Content,
    Cubature,
    GalerkinModel,
    reduce_load,
)
from palpate.offline.methods.method import Answer, Case, Memoryless, Method
from palpate.offline.reduce.viscous import deviatoric_stiffness
from palpate.offline.run.workshop import Workshop
from palpate.shared.compiled import bind, bind_compiled
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.tensors import SYMMETRIC
from palpate.shared.mechanics.viscosity import step_weights
from palpate.shared.reduced.corrections import Secants, forget_secants
from palpate.shared.reduced.past import (
    Memory,
    Remembering,
    begin_step,
    end_step,
    last_answer,
    opened,
    remembering,
)
from palpate.shared.reduced.points import LANES
from palpate.shared.reduced.press import ROUND_OFF, SMALLEST_TARGET, external_force
from palpate.shared.reduced.problem import Problem, descend

Array = NDArray[np.float64]
Field = NDArray[np.float32]


class Galerkin(Memoryless):
    """One basis for the whole surface; the state is the modes' coordinates.

    Parameters
    ----------
    workshop : Workshop
    basis : ndarray, shape (free dofs, m), mm
        Orthonormal in the energy at rest.
    cubature : Cubature, optional
        Every quadrature point if absent.
    """

    def __init__(self, workshop: Workshop, basis: Array, cubature: Cubature | None = None) -> None:
        model, m = workshop.model, basis.shape[1]
        cubature = cubature or Cubature.full(model)
        super().__init__(workshop, m, f"{m} modes, {len(cubature.points)} points")
        self.reduced = GalerkinModel(model, m, cubature)
        self.reduced.adopt(basis)

    def step(self, state: Array | None, case: Case, dt: float = 0.0) -> Answer:
        """See ``Method``."""
        converged, iterations = self.reduced.solve(case)
        found = self.reduced.content.q.copy() if converged else state
        return Answer(found, converged, converged, iterations)

    def field(self, state: Array) -> Array:
        """See ``Memoryless``."""
        return self.reduced.displacement(state)


class GalerkinAtHand(Memoryless):
    """A basis made for each case while the user waits, with every quadrature point.

    The state is the basis and the coordinates in it.

    Parameters
    ----------
    workshop : Workshop
    size : int
        Most vectors of a basis.
    space : callable
        Gives the basis (free dofs, <= size) of a case.
    """

    def __init__(self, workshop: Workshop, size: int, space: Callable[[Case], Array]) -> None:
        super().__init__(workshop, size, f"{size} vectors of the load at hand")
        self.reduced = GalerkinModel(workshop.model, size, Cubature.full(workshop.model))
        self._space, self._free = space, workshop.model.free

    def step(self, state: tuple[Array, Array] | None, case: Case, dt: float = 0.0) -> Answer:
        """See ``Method``."""
        basis = self._space(case) if case.forces.any() else np.empty((len(self._free), 0))
        self.reduced.adopt(basis)
        converged, iterations = self.reduced.solve(case)
        if not converged:
            return Answer(state, False, False, iterations)
        q = self.reduced.content.q[: basis.shape[1]].copy()
        return Answer((basis, q), True, True, iterations)

    def field(self, state: tuple[Array, Array]) -> Array:
        """See ``Memoryless``."""
        basis, q = state
        u = np.zeros(self.workshop.mesh.nodes.size)
        u[self._free] = basis @ q
        return u.reshape(-1, 3)


# --- in time -------------------------------------------------------------------------------------


class _Stepper(NamedTuple):
    """A Galerkin model with its past, and working memory of a step."""

    content: Content
    past: Remembering
    secants: Secants


@njit(cache=True, error_model="numpy", nogil=True)
def _step(stepper, nodes, forces, accurate):
    """Go to the end of a time step: (status, iterations); the record is advanced if it is found."""
    content, past, secants = stepper.content, stepper.past, stepper.secants
    whole, q = content.problem, content.q
    reduce_load(content.modes, nodes, forces, whole.load.f)
    term = bind_compiled(begin_step(past, whole.points.mu, 0, 0))
    problem = bind_compiled(Problem(whole.points, term, whole.load, secants, whole.work))
    size = external_force(term, whole.load.f, secants.external, secants.origin)
    last_answer(past, 0, q)
    energy, smallest = newton.potential(problem, q, content.newton[0])
    status, iterations, _, _ = descend(
        problem, q, content.newton, energy, smallest, max(accurate * size, SMALLEST_TARGET),
        np.inf, MAX_ITERATIONS, True, ROUND_OFF,
    )  # fmt: skip
    if status == newton.CONVERGED:
        end_step(past, whole.points, whole.work, 0, q)
    else:
        forget_secants(secants.inverse, secants.origin)
    return status, iterations


class GalerkinInTime(Method):
    """One basis for the whole surface of visco-elastic tissue, with every quadrature point.

    A step is that of the artifact's local models (``reduced.problem``, ``reduced.past``) with other
    modes and points; what the tissue remembers is kept at every quadrature point.  The state is the
    record of it.

    Parameters
    ----------
    workshop : Workshop
    basis : ndarray, shape (free dofs, m), mm
        Orthonormal in the energy at rest.
    accurate : float
        Residual at equilibrium relative to load and past; single precision ends at about 1e-6.
    """

    def __init__(self, workshop: Workshop, basis: Array, accurate: float = TOLERANCE) -> None:
        model, m = workshop.model, basis.shape[1]
        self._workshop, self._accurate = workshop, accurate
        cubature = Cubature.full(model)
        self.unknowns, self.label = m, f"{m} modes, {len(cubature.points)} points"
        self._reduced = GalerkinModel(model, m, cubature)
        self._reduced.adopt(basis)
        points = self._reduced.content.problem.points
        rows, count = len(points.gradients), len(points.weights)
        deviatoric = np.zeros((1, rows, rows), np.float32)
        deviatoric[0, :m, :m] = basis.T @ (deviatoric_stiffness(model) @ basis)
        self._sizes = len(model.prony), rows, count
        self._past = remembering(deviatoric, len(model.prony), count)
        self._secants = Secants(
            np.eye(rows), np.full((2, rows), np.nan), np.zeros(rows), np.zeros(rows)
        )
        self._bound = bind(_Stepper(self._reduced.content, self._past, self._secants))

    def at_rest(self) -> Array:
        """See ``Method``; the next search knows no secants."""
        forget_secants(self._secants.inverse, self._secants.origin)
        record = np.zeros_like(self._past.records[0])
        self.opened(record).share[-1] = 1.0
        return record

    def step(self, state: Array, case: Case, dt: float = 0.0) -> Answer:
        """See ``Method``."""
        for own, weights in zip(
            self._past.time, step_weights(self._workshop.model.prony, dt), strict=True
        ):
            own[:] = weights
        self._past.records[0] = state
        status, iterations = _step(self._bound, case.nodes, case.forces, self._accurate)
        if status != newton.CONVERGED:
            return Answer(state, False, False, iterations)
        return Answer(self._past.records[0].copy(), True, True, iterations)

    def displacement(self, state: Array) -> Array:
        """See ``Method``."""
        return self._reduced.displacement(self.opened(state).q)

    def von_mises(self, state: Array) -> Array:
        """See ``Method``."""
        return self._workshop.von_mises_after(self.history(state))

    def opened(self, state: Array) -> Memory:
        """Views of the record."""
        memory: Memory = opened(state, *self._sizes)
        return memory

    def history(self, state: Array) -> History:
        """The state as the full model's history, without the means that only energies need."""
        elements, own = self._workshop.model.weights.shape
        histories = self.opened(state).points
        terms = len(histories)
        tiles = histories.reshape(terms, -1, SYMMETRIC, LANES).transpose(0, 1, 3, 2)
        points = tiles.reshape(terms, -1, SYMMETRIC)[:, : elements * own].astype(float)
        return History(self.displacement(state), points.reshape(terms, elements, own, SYMMETRIC))
