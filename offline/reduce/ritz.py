"""Reduced spaces: nonlinear Ritz vectors of pressed footprints, the common basis of a region.

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

The vectors of all footprints of a region are compressed to one basis.
"""

import itertools
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.model import FullModel
from palpate.offline.fem.problem import FullProblem
from palpate.offline.reduce.sampling import tangents
from palpate.shared.arrays import Array, Field, Numbers
from palpate.shared.geometry.surface import Surface
from palpate.shared.scene import SceneError

RITZ_VECTORS = 19
SECOND_STEP, THIRD_STEP = 0.01, 0.03
"""Largest nodal displacement (mm) at which the internal force is differenced."""

FILL = 1e-13
"""Energy of what fills up modes, relative to that of the vectors: just above round-off."""

TANGENTIAL = 0.6
"""Weight of tangential against normal load in the Ritz vectors: about sin 30 degrees and some."""

POINTS_IN_BASIS = 50
"""Footprints all of whose Ritz vectors make up a basis; of further ones only the linear do."""

RESOLUTION = 2e-6
"""Displacement (mm) that a step of a stored mode amounts to where the mode is at work: a mode of
small amplitude is stored in coarse steps, which compress well."""


@dataclass(frozen=True)
class Footprint:
    """Where and how hard the endoscope presses."""

    point: Array  # (3,) mm
    normal: Array  # (3,) outward
    pressure: float  # kPa, scale of the load

    @classmethod
    def of(cls, surface: Surface, point: Array, limits: Array) -> Self:
        """At a point near the surface, with the load range ``limits`` at its vertices."""
        x, normal, _, fields = surface.locate(point, limits)
        return cls(x, normal, float(fields[0]))

    @property
    def loads(self) -> Array:
        """The three loads (rows, kPa) whose Ritz vectors are taken."""
        frame = np.array([self.normal, *tangents(self.normal)])
        frame[1:] *= TANGENTIAL
        return self.pressure * frame

    def series(self, vectors: Array, loads: Array) -> tuple[Array, Array, Array]:
        """Displacements (n, k) under ``loads`` (n, 3) kPa of first, second and third order in them.

        ``vectors`` (k, 19) are coefficients of its ``ritz_vectors``: forms in the load, given by
        their values on lattices.
        """
        t = np.asarray(np.linalg.solve(self.loads.T, loads.T).T, float)
        second, third = _form(t, 2), _form(t, 3)
        return t @ vectors[:, :3].T, second @ vectors[:, 3:9].T, third @ vectors[:, 9:].T


def ritz_vectors(model: FullModel, loads: Array) -> Array:
    """Nonlinear Ritz vectors (free dofs, k) mm of some load directions.

    They are of first, second (over 2!) and third order (over 3!): 3 + 6 + 10 of three directions.
    ``loads`` (free dofs, d) mN, a column per direction, are scaled to the loads expected.
    """
    first = model.solve_linear(loads)
    second_at, third_at = (_lattice(order, loads.shape[1]) for order in (2, 3))
    second = model.solve_linear(
        np.stack([-_even_part(model, a, SECOND_STEP) for a in second_at @ first.T], axis=1)
    )
    # the second-order vector of any direction follows from those: a quadratic form
    paths = zip(third_at @ first.T, _form(third_at, 2) @ second.T, strict=True)
    third = model.solve_linear(
        np.stack([-_odd_part(model, a, b, THIRD_STEP) for a, b in paths], axis=1)
    )
    return np.hstack([first, second / 2, third / 6])


def _lattice(order: int, variables: int) -> Array:
    """Directions on which every form of this order is determined."""
    points = [p for p in itertools.product(range(order + 1), repeat=variables) if sum(p) == order]
    return np.array(points, dtype=float) / order


def _monomials(t: Array, degree: int) -> Array:
    """All monomials of a degree in the columns of t (n, variables)."""
    factors = itertools.combinations_with_replacement(range(t.shape[1]), degree)
    return np.stack([t[:, list(f)].prod(axis=1) for f in factors], axis=1)


def _form(t: Array, degree: int) -> Array:
    """Weights (n, k) of a form's values on its lattice in those at t (n, variables)."""
    at = _monomials(_lattice(degree, t.shape[1]), degree)
    return np.asarray(np.linalg.solve(at.T, _monomials(t, degree).T).T, float)


def _even_part(model: FullModel, a: Array, step: float) -> Array:
    """``R''[a, a]`` by central differences along ``s a``."""
    h = step / np.abs(model.filled(a)).max()
    return (model.internal_free(h * a) + model.internal_free(-h * a)) / h**2


def _odd_part(model: FullModel, a: Array, b: Array, step: float) -> Array:
    """``R'''[a, a, a] + 3 R''[a, b]``: third derivative along ``s a + s^2 b / 2``."""
    h = step / np.abs(model.filled(a)).max()
    curve = h * h / 2 * b
    odd = (model.internal_free(h * a + curve) - model.internal_free(curve - h * a)) / 2
    return 6 * (odd - h * (model.rest_stiffness @ a)) / h**3


def energy_pod(model: FullModel, vectors: Array, size: int) -> tuple[Array, Array]:
    """Proper orthogonal decomposition of vectors (free dofs, k) mm in the energy at rest.

    Returns modes (free dofs, <= size), ``modes.T @ K @ modes = I``, fewer if the vectors have no
    more to give, and eigenvalues (k,) of the Gram matrix, descending.
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


def whole_numbers(modes: Array, orthonormal: Field) -> tuple[NDArray[np.int16], Field]:
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

    Raises
    ------
    SceneError
        If the basis has fewer modes than that.
    """
    if size > len(coefficients):
        raise SceneError(
            f"training.size.modes: at most {len(coefficients)} here, which is what the Ritz "
            f"vectors of a region have to give, not {size}"
        )
    gram = coefficients @ coefficients.T
    filled = np.arange(size)
    gram[filled, filled] += FILL * np.trace(gram)
    Q = np.linalg.eigh(gram)[1]
    return np.ascontiguousarray(Q[:, : -size - 1 : -1])


@dataclass(frozen=True)
class Region:
    """Basis of a region, and what local models learn from."""

    nodes: Numbers  # (n,) of its window, of the whole body
    basis: NDArray[np.int16]  # (M, 3 n) in steps, less what the modes of the body do there
    steps: Field  # (M,) mm
    far: Field  # (M, G), what the modes of the body do everywhere
    orthonormal: Field  # (M, M) columns, in the basis: orthonormal in energy at rest
    ritz: Field  # (k, M, 19 or more) in those, of the relaxed tissue last

    def truncate(self, modes: int) -> Self:
        """The leading modes; ``orthonormal`` is triangular, so its leading block stays right."""
        basis, steps, far = self.basis[:modes], self.steps[:modes], self.far[:modes]
        block, ritz = self.orthonormal[:modes, :modes], self.ritz[:, :modes]
        return replace(self, basis=basis, steps=steps, far=far, orthonormal=block, ritz=ritz)

    def states(self, model: FullModel) -> Array:
        """Its modes (free dofs + G, M) as states of its model."""
        far = self.far.T.astype(float)
        near = (self.basis[:, model.free] * self.steps[:, None]).T
        return np.vstack([near + model.body @ far, far])


def region(problem: FullProblem, footprints: list[Footprint], modes: int) -> Region:
    """Basis of a region and the Ritz vectors of footprints in it."""
    model = problem.model
    vectors = np.stack([_ritz(problem, footprint) for footprint in footprints], axis=1)
    first = np.arange(vectors.shape[2]) % RITZ_VECTORS < 3
    apart = -(-len(footprints) // POINTS_IN_BASIS)
    linear, rest = vectors[:, :, first], vectors[:, ::apart, ~first]
    wanted = [part.reshape(len(vectors), -1) for part in (linear, rest)]
    basis, _ = energy_pod(model, np.hstack(wanted), modes)
    vectors = vectors.reshape(len(vectors), -1)
    amplitude = np.sqrt(np.mean(((model.rest_stiffness @ basis).T @ vectors) ** 2, axis=1))
    far = basis[len(model.free) :]
    near = basis[: len(model.free)] - model.body @ far
    largest = np.abs(near).max(axis=0)
    steps = np.clip(RESOLUTION / amplitude, largest / np.iinfo(np.int16).max, largest / 100)
    stored = np.zeros((len(steps), 3 * len(problem.mesh.nodes)), np.int16)
    stored[:, model.free] = np.round(near / steps).T
    own = Region(
        nodes=problem.nodes,
        basis=stored,
        steps=steps.astype(np.float32),
        far=far.T.astype(np.float16, order="C").astype(np.float32),
        orthonormal=np.empty((0, 0), np.float32),
        ritz=np.empty((0, 0, 0), np.float32),
    )
    # rounding costs the modes their orthonormality: give it back by a change of coordinates
    rounded = own.states(model)
    stiff = model.rest_stiffness @ rounded
    L = np.linalg.cholesky(rounded.T @ stiff)
    ritz = np.linalg.solve(L, stiff.T @ vectors).reshape(len(steps), len(footprints), -1)
    return replace(
        own,
        orthonormal=np.linalg.inv(L).T.astype(np.float32),
        ritz=np.moveaxis(ritz, 1, 0).astype(np.float32),
    )


def _ritz(problem: FullProblem, footprint: Footprint) -> Array:
    """Nonlinear Ritz vectors, and those of the relaxed tissue if time changes it."""
    nodal, _ = problem.unit_load(footprint.point)
    loads = (nodal[:, None, None] * footprint.loads.T).reshape(-1, 3)[problem.model.free]
    models = [problem.model, problem.model.relaxed] if problem.model.prony else [problem.model]
    return np.hstack([ritz_vectors(model, loads) for model in models])
