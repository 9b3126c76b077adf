"""Discrete empirical interpolation of the internal force (Chaturantabut & Sorensen 2010).

Theory.  What the tissue law adds to the force of linear elasticity, ``N(u) = R(u) - K u``, is
approximated by force modes ``U`` (free dofs, k), fitted to its values at ``p`` sampled dofs ``P``:

    V^T N(V q)  ~  V^T U (P^T U)^+ P^T N(V q)  =  W^T N(V q).

``W`` (free dofs, m) has rows only at sampled dofs, so only elements that touch those are summed: it
is a Petrov-Galerkin method with the test functions ``W``.  They are not the trial functions ``V``:
the tangent ``I + W^T N'(V q) V`` is unsymmetric, there is no potential to descend, and nothing
keeps Newton's method from running away.

With ``p = k`` the fit interpolates.  With more dofs than modes it is one of least squares (gappy
POD: Everson & Sirovich 1995), the known cure for the noise that interpolation amplifies
(Peherstorfer, Drmac & Gugercin 2020), which fails a little less often, no more; what cures that is
a cubature of positive weights (``offline.methods.cubatures``).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

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
from palpate.shared.compiled import bind
from palpate.shared.reduced.points import STATE, project

Array = NDArray[np.float64]

MAX_ITERATIONS = 60


class Samples(NamedTuple):
    """Where the internal force is sampled, and how its modes are fitted to the samples."""

    dofs: NDArray[np.int64]  # (p,) rows of the force modes
    fit: NDArray[np.floating]  # (k, p) coefficients of the modes per sampled value, (P^T U)^+


def force_modes(model: FullModel, displacements: Array, size: int) -> Array:
    """Main directions (free dofs, <= size) of ``N(u)`` at displacements (k, free dofs) mm.

    Displacements that invert an element are left out.
    """
    forces, force = [], np.zeros(3 * len(model.mesh.nodes))
    full = np.zeros_like(force)
    for u in displacements:
        full[model.free] = u
        if model.internal(full, force)[1] > 0.0:
            forces.append(force[model.free] - model.rest_stiffness @ u)
    U, amplitudes, _ = np.linalg.svd(np.stack(forces, axis=1), full_matrices=False)
    return U[:, : min(size, int((amplitudes > 1e-12 * amplitudes[0]).sum()))]


def sample(modes: Array, per_mode: int) -> Samples:
    """Greedy choice of dofs: for each force mode in turn, where those before it fit it worst.

    With one dof per mode (free dofs, k) that is the discrete empirical interpolation.
    """
    chosen: list[int] = []
    for k in range(modes.shape[1]):
        fit = np.linalg.pinv(modes[chosen, :k])
        missed = np.abs(modes[:, k] - modes[:, :k] @ (fit @ modes[chosen, k]))
        missed[chosen] = -1.0
        chosen += np.argsort(-missed, kind="stable")[:per_mode].tolist()
    dofs = np.unique(chosen)
    return Samples(dofs, np.linalg.pinv(modes[dofs]))


class _Content(NamedTuple):
    trial: Content
    test: NDArray[np.float32]  # (r, 9 c) gradients of the test functions, in tiles
    state: NDArray[np.float32]  # scratch of ``linearise_points``
    products: NDArray[np.float32]  # (r, 9 c)


@njit(cache=True, error_model="numpy", nogil=True)
def _newton(content, nodes, forces):
    """Plain Newton's method from rest: (converged, iterations), and ``q``."""
    trial, test = content.trial, content.test
    q, f, residual = trial.q, trial.load.f, trial.newton[0]
    reduce_load(trial.modes, nodes, forces, f)
    q[:] = f
    target = max(TOLERANCE * math.sqrt(np.dot(f, f)), 1e-12)
    for iteration in range(1, MAX_ITERATIONS):
        if not stress_points(trial, q) > 0.0:
            return False, iteration
        project(test, trial.work.P, residual)
        for i in range(len(q)):
            residual[i] += q[i] - f[i]
        if math.sqrt(np.dot(residual, residual)) <= target:
            return True, iteration
        linearise_points(trial, content.state, content.products)
        tangent = np.dot(test, content.products.T).astype(np.float64)
        for i in range(len(q)):
            tangent[i, i] += 1.0
        q -= np.linalg.solve(tangent, residual)
    return False, MAX_ITERATIONS


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
        test = np.zeros_like(points.gradients)
        if functions is None:
            test[:] = points.gradients
        else:
            self.gradients_of(functions, test)
        scratch = np.empty(STATE * len(points.weights), np.float32), np.empty_like(test)
        self._plain = bind(_Content(self.content, test, *scratch))

    def step(self, state: Array | None, case: Case, dt: float = 0.0) -> Answer:
        """See ``Method``."""
        try:
            converged, iterations = _newton(self._plain, case.nodes, case.forces)
        except np.linalg.LinAlgError:  # a singular tangent, or none that is finite
            converged, iterations = False, MAX_ITERATIONS
        return Answer(self.state if converged else state, converged, iterations)


class Deim(PlainNewton):
    """Internal force interpolated by its modes (free dofs, k) in a basis for the whole surface."""

    def __init__(self, problem: FullProblem, basis: Array, modes: Array, samples: Samples) -> None:
        model, dofs = problem.model, problem.model.free[samples.dofs]
        touched = np.isin(model.connectivity, dofs // 3).any(axis=1)
        own = np.arange(model.weights.shape[1])
        points = (len(own) * np.flatnonzero(touched)[:, None] + own).ravel()
        functions = np.zeros((3 * len(model.mesh.nodes), basis.shape[1]))
        functions[dofs] = (basis.T @ modes @ samples.fit).T
        cubature = Cubature(points, model.weights.ravel()[points])
        super().__init__(problem, basis, cubature, functions)
        self.label = f"{basis.shape[1]} modes, {len(dofs)} sampled dofs"
