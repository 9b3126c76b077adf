"""Bases that a reduced model can be built on, all orthonormal in the energy of the rest state.

Every space spans displacements (free dofs, m) with ``V^T K V = I``, ``K`` the rest stiffness, so
that ``V^T f`` are the coordinates of the linear response in it.  ``modal``, ``krylov`` and ``pod``
are the MOD, RITZ and POD of Radermacher & Reese.  In a quasi-static body the mass has one effect
only: it makes a sequence of ever shorter waves out of one load.
"""

from typing import Literal

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import LinearOperator, eigsh

from palpate.offline.fem.model import FullModel
from palpate.offline.reduce.ritz import energy_pod, ritz_vectors
from palpate.shared.arrays import Array
from palpate.shared.geometry.elements import kind_of
from palpate.shared.geometry.quadrature import volume_quadrature

Inner = Literal["energy", "euclidean"]

EXHAUSTED = 1e-10
"""A vector adds only round-off to a space if it adds less than this share of its own energy."""

MASS_POINTS = 3
"""Points along an axis: with 2, the mass of a hex20 would have rank 24 instead of 60."""


def mass(model: FullModel) -> csr_matrix:
    """Consistent mass (free dofs, free dofs) mm^3 of unit density."""
    elements, used = model.mesh.elements, model.slots >= 0
    kind = kind_of(elements)
    N, _ = kind.shape(kind.rule(MASS_POINTS)[0])
    _, weights = volume_quadrature(model.mesh.nodes, elements, MASS_POINTS)
    blocks = np.kron(np.einsum("eq,qa,qb->eab", weights, N, N), np.eye(3))
    return model.matrix(np.bincount(model.slots[used], blocks[used]).astype(float))


def modal(model: FullModel, size: int) -> Array:
    """Linear eigenmodes (free dofs, size), lowest frequency first.

    Lanczos on ``K^-1 M`` (shift and invert about zero) with the model's own factorisation.
    """
    M, K = mass(model), model.rest_stiffness
    inverse = LinearOperator(K.shape, matvec=model.solve_linear, dtype=float)
    start = np.ones(len(model.free))  # the default is random
    squares, modes = eigsh(K, size, M=M, sigma=0.0, OPinv=inverse, v0=start)
    ascending = np.argsort(squares)
    # eigsh makes them orthonormal in M
    return np.ascontiguousarray(modes[:, ascending] / np.sqrt(squares[ascending]))


def krylov(model: FullModel, M: csr_matrix, loads: Array, size: int) -> Array:
    """Load-dependent vectors (free dofs, <= size): one block of loads, moment after moment.

    The space is ``K^-1 F, (K^-1 M) K^-1 F, (K^-1 M)^2 K^-1 F, ...`` of loads ``F`` (free dofs, b);
    whole blocks are nested.  For a single load that is Wilson's sequence of Ritz vectors (Wilson,
    Yuan & Dickens 1982); for a block, the Krylov space that matches the moments of the frequency
    response about zero (Bai 2002).
    """
    V, KV = np.empty((len(loads), 0)), np.empty((len(loads), 0))
    KX = loads
    while KX.shape[1] and V.shape[1] < size:
        X, KX = _orthonormal(V, KV, model.solve_linear(KX), KX)
        V, KV = np.hstack([V, X]), np.hstack([KV, KX])
        KX = M @ X
    return np.ascontiguousarray(V[:, :size])


def _orthonormal(V: Array, KV: Array, X: Array, KX: Array) -> tuple[Array, Array]:
    """What ``X`` adds to ``V``, orthonormal in K, and K times that.

    A block Gram-Schmidt process, done twice against round-off.
    """
    lengths = np.sqrt(np.sum(X * KX, axis=0))
    X, KX = X / lengths, KX / lengths
    for _ in range(2):
        common = KV.T @ X
        X, KX = X - V @ common, KX - KV @ common
        energies, Q = np.linalg.eigh(X.T @ KX)
        kept = np.flatnonzero(energies > EXHAUSTED)[::-1]
        scaled = Q[:, kept] / np.sqrt(energies[kept])
        X, KX = X @ scaled, KX @ scaled
    return X, KX


def static_derivatives(model: FullModel, loads: Array, size: int) -> Array:
    """Ritz vectors of three loads carried to third order: (free dofs, <= min(size, 19)).

    First, second and third derivatives at rest of the equilibrium under any combination of loads
    (free dofs, 3) mN (``reduce.ritz``); of fewer than 19, those that lead in energy at these loads.
    """
    return energy_pod(model, ritz_vectors(model, loads), size)[0]


def pod(model: FullModel, displacements: Array, size: int, inner: Inner = "energy") -> Array:
    """Proper orthogonal decomposition (free dofs, <= size), nested, of displacements (k, 3 n) mm.

    The modes are best in the ``inner`` product, and orthonormal in the energy anyhow.
    """
    snapshots = displacements[:, model.free].T.astype(float)
    if inner == "energy":
        return energy_pod(model, snapshots, size)[0]
    U, amplitudes, _ = np.linalg.svd(snapshots, full_matrices=False)
    U = U[:, : min(size, int((amplitudes**2 > EXHAUSTED * amplitudes[0] ** 2).sum()))]
    L = np.linalg.cholesky(U.T @ (model.rest_stiffness @ U))
    return np.ascontiguousarray(np.linalg.solve(L, U.T).T)
