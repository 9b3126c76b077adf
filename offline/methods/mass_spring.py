"""Mass-spring systems, their springs identified from linear elasticity.

The springs join the corners of every cell along its edges and along both diagonals of each face,
which are the edges of its two cuts into tetrahedra.  Their stiffnesses are identified after Lloyd,
Szekely & Harders (IEEE TVCG 13, 2007), who choose those whose linearised stiffness matrix is
nearest to that of the finite element model, ``min || K - sum_s k_s b_s b_s^T ||`` in the Frobenius
norm with ``b_s`` (3 m,) the elongation of a spring by nodal displacements.  They do so for one
element at a time, and regular ones have closed forms: ``2 sqrt(2) / 25 E l`` for a tetrahedron of
edge ``l``.  Here the matrix is the assembled one of linear tetrahedra, the mean of the two cuts,
with ``k_s >= 0`` for stability.  In elements as flat as the turbinate's, stiffnesses added up from
single elements are negative in places; cut off at zero they leave a body that is much too soft in
some directions, with three times the error.

A limit of the method, whatever its springs: a network of central forces obeys Cauchy's relation,
``lambda = mu``, so that its Poisson's ratio is 1/4.  The network is therefore identified from
tissue of that ratio and cannot represent tissue of .45.  Only the overall stiffness can be
corrected: by the factor with which small loads get the full model's answer in the mean.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from palpate.offline.fem.problem import FullProblem
from palpate.offline.methods.lattice import Divisions, Ints
from palpate.offline.methods.relaxation import Relaxed
from palpate.offline.methods.tetrahedra import Tetrahedra, edges_of, stiffness

Array = NDArray[np.float64]

POISSON = 0.25
"""Poisson's ratio of every network of springs."""

SWEEPS, STALL = 2000, 1e-4
"""Most sweeps of the identification; it ends at this change, relative to the stiffest spring."""


class MassSpring(Relaxed):
    """Mass-spring system in a scene's body, at large displacements.

    Small loads get the full model's answer in the mean.

    Parameters
    ----------
    divisions : tuple of 3 int
        Cells along the axes of the scene's lattice; see ``offline.methods.lattice``.

    Attributes
    ----------
    ends : ndarray, shape (s, 2), int32
        Points that a spring joins, each pair once.
    stiffness : ndarray, shape (s,), mN/mm
    factor : float
        By which that is more than what was identified.
    """

    forcing = 0.1

    def __init__(self, problem: FullProblem, divisions: Divisions) -> None:
        mesh = Tetrahedra.of(problem, divisions)
        ends = edges_of(mesh.both_cuts)
        super().__init__(problem, mesh, mesh.both_cuts, f"{len(ends)} springs")
        self.ends = ends.astype(np.int32)
        self._vectors = mesh.nodes[ends[:, 1]] - mesh.nodes[ends[:, 0]]
        self._lengths = np.linalg.norm(self._vectors, axis=1)
        pairs = ends, ends[:, ::-1]
        self._ranks = np.stack([self.stencil.ranks(pair) for pair in pairs], axis=1)
        self.stiffness = identify(mesh.nodes, mesh.both_cuts, ends, problem.scene.tissue.young)
        self.factor = self.stiffening()
        self.stiffness *= self.factor

    def internal(self, displacement: Array, force: Array) -> float:
        """See ``Relaxed``."""
        force[:] = 0.0
        springs = self.ends, self._vectors, self._lengths, self.stiffness
        return spring_forces(*springs, displacement, force)

    def linearise(self, displacement: Array) -> None:
        """See ``Relaxed``."""
        tensors = self.stencil.tensors
        tensors[:] = 0.0
        springs = self.ends, self._vectors, self._lengths, self.stiffness
        _tangent(*springs, displacement, self._ranks, tensors)
        self.stencil.prepare()


def identify(points: Array, elements: Ints, ends: Ints, young: float) -> Array:
    """Spring stiffnesses nearest to the stiffness matrix of linear tetrahedra.

    Parameters
    ----------
    points : ndarray, shape (m, 3), mm
    elements : ndarray, shape (t, 4), int
        Two tetrahedra wherever there is tissue: each counts half.
    ends : ndarray, shape (s, 2), int
        Edges of the elements.
    young : float, kPa

    Returns
    -------
    k : ndarray, shape (s,), mN/mm
        Not negative.

    Notes
    -----
    The normal equations are ``sum_t (b_s . b_t)^2 k_t = b_s . K b_s``.
    """
    along = points[ends[:, 1]] - points[ends[:, 0]]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    rows = np.repeat(np.arange(len(ends)), 6)
    columns = (3 * ends[:, :, None] + np.arange(3)).ravel()
    values = np.stack([-along, along], axis=1).ravel()
    elongation = csr_matrix((values, (rows, columns)), (len(ends), points.size))
    normal = (elongation @ elongation.T).power(2).tocsr()
    K = 0.5 * stiffness(points, elements, young, POISSON)
    wanted = np.asarray((elongation @ K).multiply(elongation).sum(axis=1)).ravel()
    return _nonnegative(normal.indptr, normal.indices, normal.data, normal.diagonal(), wanted)


@njit(cache=True, nogil=True, error_model="numpy")
def _nonnegative(indptr, indices, data, diagonal, wanted):
    """Least squares with nonnegative unknowns by projected Gauss-Seidel on the normal equations."""
    x = np.zeros(len(wanted))
    for _ in range(SWEEPS):
        change = 0.0
        for i in range(len(x)):
            gradient = -wanted[i]
            for p in range(indptr[i], indptr[i + 1]):
                gradient += data[p] * x[indices[p]]
            new = max(0.0, x[i] - gradient / diagonal[i])
            change = max(change, abs(new - x[i]))
            x[i] = new
        if change <= STALL * x.max():
            break
    return x


@njit(cache=True, nogil=True, error_model="numpy")
def spring_forces(ends, vectors, lengths, stiffness, u, force):
    """Add the springs' force at ``u`` (3, m) to ``force`` (3, m); return the energy.

    The elongation is computed from ``|v + w|^2 - |v|^2 = w . (2 v + w)``, free of cancellation.
    """
    energy, x = 0.0, np.empty(3)
    for s in range(len(ends)):
        a, b = ends[s, 0], ends[s, 1]
        square, longer = 0.0, 0.0
        for i in range(3):
            w = u[i, b] - u[i, a]
            x[i] = vectors[s, i] + w
            square += x[i] * x[i]
            longer += w * (vectors[s, i] + x[i])
        length = np.sqrt(square)
        longer /= length + lengths[s]
        energy += 0.5 * stiffness[s] * longer * longer
        tension = stiffness[s] * longer / length
        for i in range(3):
            force[i, a] -= tension * x[i]
            force[i, b] += tension * x[i]
    return energy


@njit(cache=True, nogil=True, error_model="numpy")
def _tangent(ends, vectors, lengths, stiffness, u, ranks, tensors):
    """Add the springs' tangent at ``u`` (3, m) to a stencil's tensors; ranks (s, 2).

    ``k (n n^T + max(0, 1 - L / l) (I - n n^T))``: what a compressed spring takes from the stiffness
    across it is left out, which keeps the tangent definite (Choi & Ko, SIGGRAPH 2002).
    """
    x = np.empty(3)
    for s in range(len(ends)):
        a, b = ends[s, 0], ends[s, 1]
        square = 0.0
        for i in range(3):
            x[i] = vectors[s, i] + u[i, b] - u[i, a]
            square += x[i] * x[i]
        across = stiffness[s] * max(0.0, 1.0 - lengths[s] / np.sqrt(square))
        along = (stiffness[s] - across) / square
        for i in range(3):
            for j in range(3):
                value = along * x[i] * x[j]
                if i == j:
                    value += across
                if a < tensors.shape[2]:
                    tensors[0, 3 * i + j, a] += value
                if b < tensors.shape[2]:
                    tensors[0, 3 * i + j, b] += value
                if ranks[s, 0] >= 0:
                    tensors[ranks[s, 0], 3 * i + j, a] -= value
                    tensors[ranks[s, 1], 3 * i + j, b] -= value
