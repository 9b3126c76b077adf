"""Methods that solve nothing: the linear response, and regression on full solutions."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from palpate.offline.fem.model import FullModel
from palpate.offline.methods.galerkin import reduce_load
from palpate.offline.methods.method import Answer, Case
from palpate.offline.reduce.ritz import energy_pod
from palpate.offline.run.workshop import Load
from palpate.offline.studies.baselines import HELD_BACK, KERNELS, LENGTHS

Array = NDArray[np.float64]


def compliance(model: FullModel, nodes: NDArray[np.integer]) -> Array:
    """Modes (free dofs, <= 3 k) of the linear responses to forces on nodes (k,), main ones first.

    All of them hold every response exactly, and few hold the smooth ones that footprints cause.
    Being orthonormal in the energy at rest they are also all that a query needs: ``V V^T f`` is the
    best that they can make of ``K^-1 f``.
    """
    loaded = np.flatnonzero(np.isin(model.free // 3, nodes))
    unit = np.zeros((len(model.free), len(loaded)))
    unit[loaded, np.arange(len(loaded))] = 1.0
    return energy_pod(model, model.solve_linear(unit), len(loaded))[0]


class Linear:
    """Superposition of compressed nodal compliances; see ``offline.methods.method``.

    It has an answer to any load, and no way to tell that it is wrong.

    Parameters
    ----------
    model : FullModel
    basis : ndarray, shape (free dofs, m), mm
        Of ``compliance``.
    """

    family = "linear"

    def __init__(self, model: FullModel, basis: Array) -> None:
        self.unknowns = basis.shape[1]
        self.label = f"{self.unknowns} modes"
        self._modes = np.zeros((3 * len(model.mesh.nodes), self.unknowns))
        self._modes[model.free] = basis

    def solve(self, case: Case) -> Answer:
        """Coordinates of the linear response."""
        q = np.empty(self.unknowns)
        reduce_load(self._modes, case.nodes, case.forces, q)
        return Answer(q, True, True)

    def displacement(self, answer: Answer) -> Array:
        """Nodal displacement (n, 3) mm."""
        return (self._modes @ answer.state).reshape(-1, 3)


# --- radial basis functions ----------------------------------------------------------------------

_DEGREE = {"linear": 1, "thin_plate_spline": 2, "cubic": 3}
"""Power of the distance in a kernel of ``scipy.interpolate.RBFInterpolator``."""


@njit(cache=True, error_model="numpy", nogil=True)
def _kernel(squared, degree):
    """Kernel at a squared distance: -r, r^2 log r or r^3, conditionally positive definite."""
    if degree == 1:
        return -np.sqrt(squared)
    if degree == 2:
        return 0.5 * squared * np.log(squared) if squared > 0.0 else 0.0
    return squared * np.sqrt(squared)


@njit(cache=True, error_model="numpy", nogil=True)
def _kernels(x, centres, degree, out):
    """Kernels (k,) round every centre (k, d) at x (d,), then 1 and x."""
    k, d = centres.shape
    for i in range(k):
        squared = 0.0
        for j in range(d):
            squared += (x[j] - centres[i, j]) ** 2
        out[i] = _kernel(squared, degree)
    out[k] = 1.0
    out[k + 1 :] = x


@njit(cache=True, error_model="numpy", nogil=True)
def _evaluate(features, axes, centres, degree, coefficients, basis, values):
    """Interpolated values (m,) per pressure, times the pressure ``features[-1]``."""
    _kernels(np.dot(features, axes), centres, degree, basis)
    np.dot(basis, coefficients, values)
    values *= features[-1]


class Interpolant:
    """Values (k, m) per pressure at features (k, 7), by kernels and a linear polynomial.

    Parameters
    ----------
    features : ndarray, shape (k, 7)
        Contact point (mm), direction, pressure (kPa).
    values : ndarray, shape (k, m)
        Interpolated per pressure: that takes the main trend off the kernels.
    kernel : {"linear", "thin_plate_spline", "cubic"}
    lengths : (float, float)
        Millimetres that weigh as much as a unit of direction, and of median pressure.
    """

    def __init__(
        self, features: Array, values: Array, kernel: str, lengths: tuple[float, float]
    ) -> None:
        scales = np.repeat([1.0, *lengths], [3, 3, 1])
        scales[-1] /= np.median(features[:, -1])
        scaled = features * scales
        # on a flat surface a coordinate never changes, and polynomials in it cannot be told apart
        _, spread, axes = np.linalg.svd(scaled - scaled.mean(axis=0), full_matrices=False)
        self._axes = scales[:, None] * axes[spread > 1e-6 * spread[0]].T
        self._degree = _DEGREE[kernel]
        self._centres = features @ self._axes
        k, d = self._centres.shape
        system = np.zeros((k + d + 1, k + d + 1))
        for x, row in zip(self._centres, system, strict=False):
            _kernels(x, self._centres, self._degree, row)
        system[k:, :k] = system[:k, k:].T
        wanted = np.vstack([values / features[:, -1:], np.zeros((d + 1, values.shape[1]))])
        self._coefficients = np.linalg.solve(system, wanted)
        self._basis, self._values = np.empty(k + d + 1), np.empty(values.shape[1])

    def __call__(self, features: Array) -> Array:
        """Values (m,) at features (7,)."""
        _evaluate(
            features,
            self._axes,
            self._centres,
            self._degree,
            self._coefficients,
            self._basis,
            self._values,
        )
        return self._values.copy()


def fit_interpolant(features: Array, values: Array) -> Interpolant:
    """Interpolant of the kernel and lengths that serve best on samples held back."""
    back = np.arange(len(features)) % HELD_BACK == 0

    def error(kernel: str, lengths: tuple[float, float]) -> float:
        trial = Interpolant(features[~back], values[~back], kernel, lengths)
        guess = np.array([trial(x) for x in features[back]])
        off = np.linalg.norm(guess - values[back], axis=1)
        return float(np.mean(off / np.linalg.norm(values[back], axis=1)))

    choices = itertools.product(KERNELS, itertools.product(LENGTHS, LENGTHS))
    return Interpolant(features, values, *min(choices, key=lambda choice: error(*choice)))


class Regression:
    """Coordinates of POD modes by radial basis functions in the load; no mechanics.

    For a single contact; it refuses several.  It has an answer to any load.

    Parameters
    ----------
    model : FullModel
    basis : ndarray, shape (free dofs, m), mm
        Orthonormal in the energy at rest.
    loads : sequence of Load
    displacements : ndarray, shape (k, 3 n), mm
        Of the full model under the loads.
    """

    family = "regression"

    def __init__(
        self, model: FullModel, basis: Array, loads: Sequence[Load], displacements: Array
    ) -> None:
        self.unknowns = basis.shape[1]
        self.label = f"{self.unknowns} modes of {len(loads)} samples"
        self._basis, self._free = basis, model.free
        self._nodes = len(model.mesh.nodes)
        coordinates = displacements[:, model.free] @ (model.rest_stiffness @ basis)
        given = np.array([_features(load) for load in loads])
        self._interpolant = fit_interpolant(given, coordinates)

    def solve(self, case: Case) -> Answer:
        """Interpolate; the state is the modes' coordinates."""
        if len(case.contacts) != 1:
            return Answer(np.zeros(self.unknowns), False, False, refused=True)
        return Answer(self._interpolant(_features(case.contacts[0])), True, True)

    def displacement(self, answer: Answer) -> Array:
        """Nodal displacement (n, 3) mm."""
        u = np.zeros(3 * self._nodes)
        u[self._free] = self._basis @ answer.state
        return u.reshape(-1, 3)


def _features(load: Load) -> Array:
    """Contact point (mm), direction and pressure (kPa), (7,)."""
    return np.array([*load.position, *load.direction, load.pressure])
