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
from collections.abc import Sequence
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

SOFT = 4
"""Directions of a region that every local model has: those that move the body most for their
energy, as a body swings that hangs from a lip.  Least energy of what is missed lets them go: what
72 modes miss of displacement on ``turbinate-mri`` falls from .88 to .67 % in the mean."""

TANGENTIAL = 0.6
"""Weight of tangential against normal load in the Ritz vectors: about sin 30 degrees and some."""

ABREAST = 8
"""Footprints whose linear responses are found together: more gain no more."""

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
    return path_derivatives(model, loads.T[None])[0][0].T


def path_derivatives(model: FullModel, loads: Array) -> tuple[Array, Array]:
    """Ritz vectors (f, k, n) mm of f footprints, and the forces (f, k, n) mN that they answer to.

    Each linear response takes the factor of the stiffness through the processor, so all are asked
    for together.  ``loads`` are (f, d, free dofs) mN; see ``ritz_vectors``.
    """
    beyond = model.body.shape[1]
    loads = np.pad(loads, ((0, 0), (0, 0), (0, beyond)))
    first = _responses(model, loads)
    even = np.array([_even_parts(model, one) for one in first])
    second = _responses(model, even)
    odd = np.array([_odd_parts(model, *one) for one in zip(loads, first, second, strict=True)])
    third = _responses(model, odd)
    vectors = np.concatenate([first, second / 2, third / 6], axis=1)
    return vectors, np.concatenate([loads, even / 2, odd / 6], axis=1)


def _responses(model: FullModel, forces: Array) -> Array:
    """Linear responses (f, k, n) mm to forces (f, k, n) mN."""
    return model.solve_linear(forces.reshape(-1, forces.shape[2]).T).T.reshape(forces.shape)


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


def _even_parts(model: FullModel, first: Array) -> Array:
    """``-R''[a, a]`` (k, n) by central differences along ``s a``, ``a`` on the lattice."""
    along = _lattice(2, len(first))
    h = SECOND_STEP / _largest(model, along @ first)
    steps = h[:, None] * along
    return model.paired_forces(first, steps, -steps, 1.0) / -(h**2)[:, None]


def _odd_parts(model: FullModel, loads: Array, first: Array, second: Array) -> Array:
    """``-R'''[a, a, a] - 3 R''[a, b]`` (k, n): third derivatives along ``s a + s^2 b / 2``.

    The second-order vector ``b`` of any ``a`` is a quadratic form, given on its lattice.
    """
    along = _lattice(3, len(first))
    h = THIRD_STEP / _largest(model, along @ first)
    steps, curves = h[:, None] * along, (h**2 / 2)[:, None] * _form(along, 2)
    odd = model.paired_forces(
        np.vstack([first, second]), np.hstack([steps, curves]), np.hstack([-steps, curves]), -1.0
    )
    return 6 * (steps @ loads - odd / 2) / (h**3)[:, None]


def _largest(model: FullModel, states: Array) -> Array:
    """Largest displacements (k,) mm of states (k, n)."""
    return np.abs(states[:, : len(model.free)]).max(axis=1)


def energy_pod(model: FullModel, vectors: Array, size: int) -> tuple[Array, Array]:
    """Proper orthogonal decomposition of vectors (free dofs, k) mm in the energy at rest.

    Returns modes (free dofs, <= size), ``modes.T @ K @ modes = I``, fewer if the vectors have no
    more to give, and eigenvalues (k,) of the Gram matrix, descending.
    """
    modes, energies = _leading(vectors.T, (model.rest_stiffness @ vectors).T, size)
    # once more against round-off: the Gram matrix squares the condition number
    gram = modes @ (model.rest_stiffness @ modes.T)
    L = np.linalg.cholesky(gram)
    return np.asarray(np.linalg.solve(L, modes).T), energies


def _leading(vectors: Array, forces: Array, size: int) -> tuple[Array, Array]:
    """Modes (<= size, n) and energies (k,) of ``energy_pod``, of vectors (k, n).

    ``forces`` (k, n) do as much work on any vector as the rest stiffness times these vectors.
    """
    energies, Q = np.linalg.eigh(vectors @ forces.T)
    energies, Q = energies[::-1], Q[:, ::-1]
    kept = min(size, int((energies > 1e-12 * energies[0]).sum()))
    modes: Array = (Q[:, :kept] / np.sqrt(energies[:kept])).T @ vectors
    return modes, np.asarray(energies)


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


def local_modes(coefficients: Array, soft: Field, size: int) -> Array:
    """Leading directions (M, size) of vectors given by coefficients (M, k) in an orthonormal basis.

    Directions ``soft`` (M, s) lead them.  Where the vectors run out, the leading modes of the basis
    fill up.

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
    most = np.trace(gram)
    gram += most * (soft @ soft.T)
    gram[filled, filled] += FILL * most
    Q = np.linalg.eigh(gram)[1]
    return np.ascontiguousarray(Q[:, : -size - 1 : -1])


@dataclass(frozen=True)
class Region:
    """Basis of a region, and what local models learn from."""

    nodes: Numbers  # (n,) of its window, of the whole body
    basis: NDArray[np.int16]  # (M, 3 n) in steps, less what the modes of the body do there
    steps: Field  # (M,) mm
    shares: NDArray[np.int16]  # (M, G) in steps, what the modes of the body do everywhere
    share_steps: Field  # (M,)
    orthonormal: Field  # (M, M) columns, in the basis: orthonormal in energy at rest
    soft: Field  # (M, SOFT) in those, which move the body most for their energy
    ritz: Field  # (k, M, 19 or more) in those, of the relaxed tissue last

    def truncate(self, modes: int) -> Self:
        """The leading modes; ``orthonormal`` is triangular, so its leading block stays right."""
        return replace(
            self,
            basis=self.basis[:modes],
            steps=self.steps[:modes],
            shares=self.shares[:modes],
            share_steps=self.share_steps[:modes],
            orthonormal=self.orthonormal[:modes, :modes],
            soft=self.soft[:modes],
            ritz=self.ritz[:, :modes],
        )

    def states(self, model: FullModel) -> Array:
        """Its modes (free dofs + G, M) as states of its model."""
        far = (self.shares * self.share_steps[:, None]).T.astype(float)
        near = (self.basis[:, model.free] * self.steps[:, None]).T
        return np.vstack([near + model.body @ far, far])


def region(problem: FullProblem, footprints: list[Footprint], modes: int) -> Region:
    """Basis of a region and the Ritz vectors of footprints in it."""
    model = problem.model
    vectors, forces = (part.reshape(-1, part.shape[-1]) for part in _ritz(problem, footprints))
    basis, energies = _leading(vectors, forces, modes)
    amplitude = np.sqrt(energies[: len(basis)] / len(energies))
    far = basis[:, len(model.free) :]
    near = basis[:, : len(model.free)] - far @ model.body.T
    largest, most = np.abs(near).max(axis=1), np.iinfo(np.int16).max
    steps = np.clip(RESOLUTION / amplitude, largest / most, largest / 100)
    # no value of a body mode is larger than 1, so that a step of it moves no node by more
    share_steps = np.maximum(steps, np.abs(far).max(axis=1, initial=0.0) / most)
    stored = np.zeros((len(steps), 3 * len(problem.mesh.nodes)), np.int16)
    stored[:, model.free] = np.round(near / steps[:, None])
    own = Region(
        nodes=problem.nodes,
        basis=stored,
        steps=steps.astype(np.float32),
        shares=np.rint(far / share_steps[:, None]).astype(np.int16),
        share_steps=share_steps.astype(np.float32),
        orthonormal=np.empty((0, 0), np.float32),
        soft=np.empty((0, 0), np.float32),
        ritz=np.empty((0, 0, 0), np.float32),
    )
    # rounding costs the modes their orthonormality: give it back by a change of coordinates
    rounded = own.states(model)
    L = np.linalg.cholesky(rounded.T @ (model.rest_stiffness @ rounded))
    ritz = np.linalg.solve(L, rounded.T @ forces.T)
    ritz = ritz.reshape(len(steps), len(footprints), -1)
    orthonormal, moved = np.linalg.inv(L).T, rounded[: len(model.free)]
    volumes = np.repeat(problem.nodal_volumes, 3)[model.free]
    gram = orthonormal.T @ (moved.T @ (volumes[:, None] * moved)) @ orthonormal
    return replace(
        own,
        orthonormal=orthonormal.astype(np.float32),
        soft=np.linalg.eigh(gram)[1][:, : -SOFT - 1 : -1].astype(np.float32),
        ritz=np.moveaxis(ritz, 1, 0).astype(np.float32),
    )


def _ritz(problem: FullProblem, footprints: Sequence[Footprint]) -> tuple[Array, Array]:
    """``path_derivatives`` of footprints, and those of the relaxed tissue if time changes it.

    Their forces are those of the tissue at once.
    """
    model = problem.model
    models = [model, model.relaxed] if model.prony else [model]
    states = len(model.free) + model.body.shape[1]
    vectors, forces = np.empty((2, len(footprints), RITZ_VECTORS * len(models), states))
    for start in range(0, len(footprints), ABREAST):
        some = slice(start, start + ABREAST)
        nodal = np.array([problem.unit_load(pressed.point)[0] for pressed in footprints[some]])
        rows = np.array([pressed.loads for pressed in footprints[some]])
        loads = np.einsum("fn,fdi->fdni", nodal, rows).reshape(*rows.shape[:2], -1)[..., model.free]
        for i, one in enumerate(models):
            own = some, slice(RITZ_VECTORS * i, RITZ_VECTORS * (i + 1))
            vectors[own], forces[own] = path_derivatives(one, loads)
            if one is not model:
                flat = vectors[own].reshape(-1, states)
                forces[own] = (model.rest_stiffness @ flat.T).T.reshape(forces[own].shape)
    return vectors, forces
