"""Reduced spaces: nonlinear Ritz vectors of pressed footprints and their compression.

Theory.  Let ``u(t)`` be the equilibrium under the load ``sum_i t_i f_i`` (three directions of one
footprint).  Differentiating ``R(u(t)) = sum t_i f_i`` at rest gives vectors that all cost one
back-substitution with the rest stiffness:

    K u_i   = f_i
    K u_ij  = -R''[u_i, u_j]
    K u_ijk = -R'''[u_i, u_j, u_k] - R''[u_i, u_jk] - R''[u_j, u_ik] - R''[u_k, u_ij]

The 3 + 6 + 10 vectors span what the equilibrium does under that footprint in any direction, to
third order in the load: load-dependent Ritz vectors carried into the nonlinear range (cf. Idelsohn
& Cardona 1985, path derivatives).  Second and third order vectors enter through the derivatives
along the lines ``t = s d`` of as many directions ``d`` as there are vectors.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.model import FullModel
from palpate.offline.reduce.sampling import tangents

Array = NDArray[np.float64]

RITZ_VECTORS = 19
SECOND_STEP, THIRD_STEP = 0.01, 0.03
"""Largest nodal displacement (mm) at which the internal force is differenced."""


def _lattice(order: int) -> Array:
    """Directions on which every form of this order in three variables is determined."""
    points = [p for p in itertools.product(range(order + 1), repeat=3) if sum(p) == order]
    return np.array(points, dtype=float) / order


FILL = 1e-13
"""Energy of what fills up modes, relative to that of the vectors: just above round-off."""

TANGENTIAL = 0.6
"""Weight of tangential against normal load in the Ritz vectors: about sin 30 degrees and some."""


@dataclass(frozen=True)
class Footprint:
    """Where and how hard the endoscope presses for Ritz vectors.

    Attributes
    ----------
    point, normal : ndarray, shape (3,)
        mm, and outward normal.
    pressure : float, kPa
        Scale of the load.
    """

    point: Array
    normal: Array
    pressure: float

    @property
    def loads(self) -> Array:
        """The three loads (rows, kPa) whose Ritz vectors are taken."""
        frame = np.array([self.normal, *tangents(self.normal)])
        frame[1:] *= TANGENTIAL
        return self.pressure * frame

    def path_derivatives(self, vectors: Array, loads: Array) -> tuple[Array, Array, Array]:
        """First, second and third derivative (n, k) along the paths to ``loads`` (n, 3) kPa.

        ``vectors`` (k, 19) are coefficients of its ``ritz_vectors``: forms in the load, given by
        their values on lattices.
        """
        t = _solve(self.loads.T, loads.T).T
        second = _solve(_monomials(_lattice(2), 2).T, _monomials(t, 2).T)
        third = _solve(_monomials(_lattice(3), 3).T, _monomials(t, 3).T)
        first = vectors[:, :3] @ t.T
        return first.T, 2 * (vectors[:, 3:9] @ second).T, 6 * (vectors[:, 9:] @ third).T


def ritz_vectors(model: FullModel, loads: Array) -> Array:
    """Nonlinear Ritz vectors of a footprint's three load directions.

    Parameters
    ----------
    model : FullModel
    loads : ndarray, shape (free dofs, 3), mN
        One column per direction, scaled to the loads expected.

    Returns
    -------
    vectors : ndarray, shape (free dofs, 19), mm
        3 of first, 6 of second (over 2!), 10 of third order (over 3!).
    """
    first = model.solve_linear(loads)
    second_at, third_at = _lattice(2), _lattice(3)
    paths = first @ second_at.T
    second = model.solve_linear(
        np.stack([-_even_part(model, a, SECOND_STEP) for a in paths.T], axis=1)
    )
    # the second-order vector of any direction follows from those six: a quadratic form
    forms = np.linalg.solve(_monomials(second_at, 2).T, _monomials(third_at, 2).T).T
    rows = [
        -_odd_part(model, a, b, THIRD_STEP)
        for a, b in zip((first @ third_at.T).T, (second @ forms.T).T, strict=True)
    ]
    third = model.solve_linear(np.stack(rows, axis=1))
    return np.hstack([first, second / 2, third / 6])


def path_vectors(model: FullModel, load: Array) -> Array:
    """First three derivatives (free dofs, 3) of the equilibrium along the path of a load (mN)."""
    first = model.solve_linear(load[:, None])[:, 0]
    second = model.solve_linear(-_even_part(model, first, SECOND_STEP)[:, None])[:, 0]
    third = model.solve_linear(-_odd_part(model, first, second, THIRD_STEP)[:, None])[:, 0]
    return np.stack([first, second, third], axis=1)


def _solve(A: Array, B: Array) -> Array:
    return np.asarray(np.linalg.solve(A, B), dtype=float)


def _monomials(t: Array, degree: int) -> Array:
    """All monomials of a degree in three variables: (k, 3) to (k, 6) or (k, 10)."""
    factors = itertools.combinations_with_replacement(range(3), degree)
    return np.stack([t[:, list(f)].prod(axis=1) for f in factors], axis=1)


def _even_part(model: FullModel, a: Array, step: float) -> Array:
    """``R''[a, a]`` by central differences along ``s a``."""
    h = step / np.abs(a).max()
    return (model.internal_free(h * a) + model.internal_free(-h * a)) / h**2


def _odd_part(model: FullModel, a: Array, b: Array, step: float) -> Array:
    """``R'''[a, a, a] + 3 R''[a, b]``: third derivative along ``s a + s^2 b / 2``."""
    h = step / np.abs(a).max()
    curve = h * h / 2 * b
    odd = (model.internal_free(h * a + curve) - model.internal_free(curve - h * a)) / 2
    return 6 * (odd - h * (model.rest_stiffness @ a)) / h**3


def energy_pod(model: FullModel, vectors: Array, size: int) -> tuple[Array, Array]:
    """Proper orthogonal decomposition in the energy of the rest state.

    Parameters
    ----------
    vectors : ndarray, shape (free dofs, k), mm
    size : int
        Modes wanted; fewer come back if the vectors have no more to give.

    Returns
    -------
    modes : ndarray, shape (free dofs, <= size)
        ``modes.T @ K @ modes = I``.
    energies : ndarray, shape (k,)
        Eigenvalues of the Gram matrix, descending.
    """
    gram = vectors.T @ (model.rest_stiffness @ vectors)
    energies, Q = np.linalg.eigh(gram)
    energies, Q = energies[::-1], Q[:, ::-1]
    kept = min(size, int((energies > 1e-12 * energies[0]).sum()))
    modes = vectors @ (Q[:, :kept] / np.sqrt(energies[:kept]))
    # once more against round-off: the Gram matrix squares the condition number
    gram = modes.T @ (model.rest_stiffness @ modes)
    L = np.linalg.cholesky(gram)
    return np.linalg.solve(L, modes.T).T, energies


def whole_numbers(
    modes: Array, orthonormal: NDArray[np.float32]
) -> tuple[NDArray[np.int16], NDArray[np.float32]]:
    """Modes (M, r) in the basis of a region as whole numbers, and the mix (r, r) they want.

    The columns of ``whole @ mix`` are orthonormal, as reduced models take for granted: a mode that
    is off by some ten-thousandths bends soft ones, which move far at little energy, by ten times
    that.  ``orthonormal`` (M, M) holds orthonormal modes, as columns in the basis.
    """
    largest = np.maximum(np.abs(modes).max(axis=0), np.finfo(np.float32).tiny)
    whole = np.rint(modes * (np.iinfo(np.int16).max / largest)).astype(np.int16)
    R = np.linalg.qr(np.linalg.solve(orthonormal.astype(float), whole), mode="r")
    R *= np.sign(np.diag(R))[:, None]
    return whole, np.linalg.inv(R).astype(np.float32)


def local_modes(coefficients: Array, size: int) -> Array:
    """Leading directions (M, size) of vectors given by coefficients (M, k) in an orthonormal basis.

    Where the vectors run out, the leading modes of the basis fill up.
    """
    gram = coefficients @ coefficients.T
    filled = np.arange(size)
    gram[filled, filled] += FILL * np.trace(gram)
    Q = np.linalg.eigh(gram)[1]
    return np.ascontiguousarray(Q[:, : -size - 1 : -1])
