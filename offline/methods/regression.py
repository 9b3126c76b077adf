"""Methods that solve nothing: the linear response, and regression on full solutions."""

import itertools
from collections.abc import Callable

import numpy as np
from scipy.interpolate import RBFInterpolator

from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.methods.galerkin import reduce_load
from palpate.offline.methods.method import Answer, Case, Method, Snapshots
from palpate.offline.reduce.ritz import energy_pod
from palpate.shared.arrays import Array

Interpolant = Callable[[Array], Array]
"""Values (q, m) at features (q, 7) of loads."""

KERNELS = ("linear", "thin_plate_spline", "cubic")

LENGTHS = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Millimetres on the surface that weigh as much as a unit of direction, or of median pressure."""

HELD_BACK = 5  # one in this many samples is held back to choose kernel and lengths by


def compliance(problem: FullProblem) -> Array:
    """Modes (free dofs, m) of the linear responses to whatever can load the surface.

    All of them hold every response exactly, and the leading ones the smooth responses to
    footprints.  Since they are orthonormal in the energy at rest, ``V V^T f`` is the best
    approximation of ``K^-1 f`` in them: a query needs nothing else.
    """
    model, boundary = problem.model, problem.body.boundary
    radius = problem.scene.endoscope.radius
    covered = [problem.surface.project(x)[2] <= radius for x in boundary.points]
    loaded = np.flatnonzero(np.isin(model.free // 3, boundary.nodes[covered]))
    unit = np.zeros((len(model.free), len(loaded)))
    unit[loaded, np.arange(len(loaded))] = 1.0
    return energy_pod(model, model.solve_linear(unit), len(loaded))[0]


class _InModes(Method):
    """Whatever gives coordinates of modes (free dofs, m) mm, which are the state."""

    def __init__(self, problem: FullProblem, basis: Array, label: str) -> None:
        super().__init__(problem, basis.shape[1], label)
        self._modes = np.zeros((problem.mesh.nodes.size, self.unknowns))
        self._modes[problem.model.free] = basis

    def field(self, state: Array) -> Array:
        """See ``Method``."""
        return (self._modes @ state).reshape(-1, 3)


class Linear(_InModes):
    """Superposition of compressed nodal compliances, the leading modes of ``compliance``.

    It answers every load, and cannot tell when its answer is wrong.
    """

    def __init__(self, problem: FullProblem, basis: Array) -> None:
        super().__init__(problem, basis, f"{basis.shape[1]} modes")

    def step(self, state: Array | None, case: Case, dt: float = 0.0) -> Answer:
        """See ``Method``."""
        q = np.empty(self.unknowns)
        reduce_load(self._modes, case.nodes, case.forces, q)
        return Answer(q)


def interpolant(
    features: Array, values: Array, kernel: str, lengths: tuple[float, float]
) -> Interpolant:
    """Interpolate values (k, m) per unit of pressure, which removes the main trend.

    Lengths are millimetres that weigh as much as a unit of direction, and of median pressure.
    """
    scales = np.repeat([1.0, *lengths], [3, 3, 1])
    scales[-1] /= np.median(features[:, -1])
    scaled = features * scales
    # on a flat surface a coordinate never changes, and polynomials in it cannot be told apart
    _, spread, axes = np.linalg.svd(scaled - scaled.mean(axis=0), full_matrices=False)
    axes = scales[:, None] * axes[spread > 1e-6 * spread[0]].T
    found = RBFInterpolator(features @ axes, values / features[:, -1:], kernel=kernel, degree=1)
    return lambda asked: np.asarray(asked[:, -1:] * found(asked @ axes))


def fit_interpolant(features: Array, values: Array) -> Interpolant:
    """Interpolant with the kernel and lengths of least error on samples held back."""
    back = np.arange(len(features)) % HELD_BACK == 0

    def error(choice: tuple[str, tuple[float, float]]) -> float:
        off = interpolant(features[~back], values[~back], *choice)(features[back]) - values[back]
        return float(np.mean(np.linalg.norm(off, axis=1) / np.linalg.norm(values[back], axis=1)))

    choices = itertools.product(KERNELS, itertools.product(LENGTHS, LENGTHS))
    return interpolant(features, values, *min(choices, key=error))


class Regression(_InModes):
    """Coordinates of POD modes by radial basis functions of the load; no mechanics.

    It refuses several contacts and answers every single one.
    """

    def __init__(self, problem: FullProblem, basis: Array, snapshots: Snapshots) -> None:
        label = f"{basis.shape[1]} modes of {len(snapshots.loads)} samples"
        super().__init__(problem, basis, label)
        model = problem.model
        coordinates = snapshots.displacements[:, model.free] @ (model.rest_stiffness @ basis)
        given = np.array([_features(load) for load in snapshots.loads])
        self._interpolant = fit_interpolant(given, coordinates)

    def step(self, state: Array | None, case: Case, dt: float = 0.0) -> Answer:
        """See ``Method``."""
        if len(case.contacts) != 1:
            return Answer(state, False, refused=True)
        return Answer(self._interpolant(_features(case.contacts[0])[None])[0])


def _features(load: Load) -> Array:
    """Contact point (mm), direction and pressure (kPa), (7,)."""
    return np.array([*load.position, *load.direction, load.pressure])
