"""Galerkin's method with few points: empirical cubatures, and interpolation of the internal force.

Cubatures are points and weights, fitted as those of the artifact (``reduce.cubature``):

- by point (ECM: Hernandez, Caicedo & Ferrer 2017): few points of positive weight;
- by element (ECSW: Farhat, Avery, Chapman & Cortial 2014): few elements, whose points all get the
  element's weight.

Discrete empirical interpolation (Chaturantabut & Sorensen 2010).  What the tissue law adds to the
force of linear elasticity, ``N(u) = R(u) - K u``, is approximated by force modes ``U`` (free dofs,
k), fitted to its values at ``p`` sampled dofs ``P``:

    V^T N(V q)  ~  V^T U (P^T U)^+ P^T N(V q)  =  W^T N(V q).

``W`` (free dofs, m) has rows only at sampled dofs, so only elements that touch those are summed: it
is a Petrov-Galerkin method with the test functions ``W``.  They are not the trial functions ``V``:
the tangent ``I + W^T N'(V q) V`` is unsymmetric, there is no potential to descend, and nothing
keeps Newton's method from running away.

With ``p = k`` the fit interpolates.  With more dofs than modes it is one of least squares (gappy
POD: Everson & Sirovich 1995), the known cure for the noise that interpolation amplifies
(Peherstorfer, Drmac & Gugercin 2020), which fails a little less often, no more; what cures that is
a cubature of positive weights.
"""

import math
from collections.abc import Iterable
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numba import njit

from palpate.offline.fem.model import FullModel
from palpate.offline.fem.problem import FullProblem
from palpate.offline.methods.galerkin import (
    TOLERANCE,
    Content,
    Cubature,
    Galerkin,
    linearise_points,
    reduce_load,
    stress_points,
)
from palpate.offline.methods.method import Answer, Case
from palpate.offline.reduce.cubature import by_point, compress, nonnegative, training_forces
from palpate.shared.arrays import Array, Field, Ints
from palpate.shared.compiled import bind
from palpate.shared.reduced.points import STATE, Points, project

LOOKS, RESPONSES = 16, 20
"""Random combinations of the modes' forces in one state, which are fitted instead of the forces,
and random displacements in which the points shall be as stiff as linear elasticity."""

EQUATIONS = 2  # equations kept for every cubature point, or element, allowed
MAX_ITERATIONS = 60


def contributions(reduced: Galerkin, cases: Iterable[Case], rng: np.random.Generator) -> Field:
    """What every point adds to the sums (points, sums) that a cubature has to reproduce.

    They are forces in and off equilibria of cases, those that have one, weighted with the square
    root of the compliance, relative to the answer: an error of their sum is then a relative error
    of displacement in the energy norm.
    """
    states, content, points = [], bind(reduced.content), reduced.content.points
    tangent, products = _scratch(points), np.empty_like(points.gradients)
    for answer in map(reduced.solve, cases):
        if answer.converged:
            q = answer.state
            stress_points(content, q)
            linearise_points(content, tangent, products)
            L = np.linalg.cholesky(np.eye(len(q)) + points.gradients @ products.T)
            states.append((q, np.linalg.inv(L.T) / np.linalg.norm(q), None))
    law = points.weights, points.law
    return training_forces(by_point(points.gradients), law, states, LOOKS, RESPONSES, rng)


def fit_cubature(
    model: FullModel,
    forces: Field,
    most: int,
    rng: np.random.Generator,
    by_element: bool = False,
) -> Cubature:
    """Cubature of at most ``most`` points, or elements: all their points, one factor each."""
    own = model.weights.shape[1] if by_element else 1
    sums = forces[: model.weights.size].reshape(-1, own, forces.shape[1]).sum(axis=1)
    size = min(EQUATIONS * most, *sums.shape)
    chosen, factors = nonnegative(*compress(sums, size, rng), most)
    points = (own * chosen[:, None] + np.arange(own)).ravel()
    return Cubature(points, np.repeat(factors, own) * model.weights.ravel()[points])


def force_modes(model: FullModel, displacements: Array, size: int) -> Array:
    """Main directions (free dofs, <= size) of ``N(u)`` at displacements (k, free dofs) mm.

    Displacements that invert an element are left out.
    """
    forces, force = [], np.zeros(3 * len(model.mesh.nodes))
    for u in displacements:
        if model.internal(model.filled(u), force)[1] > 0.0:
            forces.append(force[model.free] - model.rest_stiffness @ u)
    U, amplitudes, _ = np.linalg.svd(np.stack(forces, axis=1), full_matrices=False)
    return U[:, : min(size, int((amplitudes > 1e-12 * amplitudes[0]).sum()))]


def sample(modes: Array, per_mode: int) -> Ints:
    """Greedy choice of dofs: for each force mode in turn, where those before it fit it worst.

    With one dof per mode (free dofs, k) that is the discrete empirical interpolation.
    """
    chosen: list[int] = []
    for k in range(modes.shape[1]):
        fit = np.linalg.pinv(modes[chosen, :k])
        missed = np.abs(modes[:, k] - modes[:, :k] @ (fit @ modes[chosen, k]))
        missed[chosen] = -1.0
        chosen += np.argsort(-missed, kind="stable")[:per_mode].tolist()
    return np.unique(chosen)


class _Content(NamedTuple):
    trial: Content
    test: Field  # (r, 9 c) gradients of the test functions, in tiles
    state: Field  # scratch of ``linearise_points``
    products: Field  # (r, 9 c)


def _scratch(points: Points) -> Field:
    return np.empty(STATE * len(points.weights), np.float32)


@njit(cache=True, error_model="numpy", nogil=True)
def _newton(content, nodes, forces):
    """Plain Newton's method from rest: whether it converges, and ``q``."""
    trial, test = content.trial, content.test
    q, f, residual = trial.q, trial.load.f, trial.newton[0]
    reduce_load(trial.modes, nodes, forces, f)
    q[:] = f
    target = max(TOLERANCE * math.sqrt(np.dot(f, f)), 1e-12)
    for _ in range(MAX_ITERATIONS):
        if not stress_points(trial, q) > 0.0:
            return False
        project(test, trial.work.P, residual)
        residual += q - f
        if math.sqrt(np.dot(residual, residual)) <= target:
            return True
        linearise_points(trial, content.state, content.products)
        tangent = np.eye(len(q)) + np.dot(test, content.products.T)
        q -= np.linalg.solve(tangent, residual)
    return False


class PlainNewton(Galerkin):
    """A reduced model by Newton's method without a line search: every step is taken whole.

    Without test functions (3 nodes, m) mm it is Galerkin's method.
    """

    def __init__(
        self,
        problem: FullProblem,
        basis: Array,
        cubature: Cubature | None = None,
        functions: Array | None = None,
    ) -> None:
        super().__init__(problem, basis, cubature)
        self.label, points = "no line search", self.content.points
        test, products = points.gradients, np.empty_like(points.gradients)
        if functions is not None:
            test = np.empty_like(test)
            self.write_gradients(functions, test)
        self._plain = bind(_Content(self.content, test, _scratch(points), products))

    def step(self, state: Array | None, case: Case, dt: float = 0.0) -> Answer:
        """See ``Method``."""
        found = False
        with suppress(np.linalg.LinAlgError):  # a singular tangent, or none that is finite
            found = _newton(self._plain, case.nodes, case.forces)
        return Answer(self.content.q.copy() if found else state, found)


class Deim(PlainNewton):
    """Internal force interpolated by its modes (free dofs, k) at sampled dofs, see ``sample``."""

    def __init__(self, problem: FullProblem, basis: Array, modes: Array, sampled: Ints) -> None:
        model, dofs = problem.model, problem.model.free[sampled]
        touched = np.isin(model.connectivity, dofs // 3).any(axis=1)
        points = np.flatnonzero(np.repeat(touched, model.weights.shape[1]))
        functions = np.zeros((3 * len(model.mesh.nodes), basis.shape[1]))
        functions[dofs] = (basis.T @ modes @ np.linalg.pinv(modes[sampled])).T
        cubature = Cubature(points, model.weights.ravel()[points])
        super().__init__(problem, basis, cubature, functions)
        self.label = f"{basis.shape[1]} modes, {len(dofs)} sampled dofs"
