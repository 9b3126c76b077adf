"""Tetrahedra in the body of a scene, on a lattice as fine or as coarse as a method wants.

Each cell of the lattice (``offline.methods.lattice``) is cut into five tetrahedra, alternately one
way and the other, so that they fit together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.linalg import splu

from palpate.offline.fem.mesh import Mesh
from palpate.offline.fem.problem import FullProblem
from palpate.offline.methods.lattice import (
    SAME,
    Divisions,
    Ints,
    cells,
    coordinates,
    corners,
    grid,
    interpolation,
    lattice,
    shape_functions,
)
from palpate.offline.methods.method import Case
from palpate.shared.errors import PalpateError
from palpate.shared.geometry.elements import gauss, quadrilateral, shape
from palpate.shared.mechanics.tissue import lame

Array = NDArray[np.float64]
Cut = tuple[tuple[int, int, int, int], ...]

EVEN: Cut = ((0, 1, 2, 5), (0, 2, 3, 7), (0, 5, 7, 4), (2, 7, 5, 6), (0, 2, 7, 5))
"""Corners of the five tetrahedra of a hexahedron, by the right-hand rule; the last is central."""
ODD: Cut = ((1, 3, 0, 4), (1, 2, 3, 6), (1, 6, 4, 5), (3, 4, 6, 7), (1, 3, 4, 6))
"""The mirror image: its face diagonals are the other ones."""

EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
"""Of a tetrahedron."""

GAUSS = 8
"""Gauss points per side of a face: the lattice's functions have kinks within it."""

NEGLIGIBLE = 1e-5
"""Share of a force that is too small to be carried over."""


@dataclass(frozen=True)
class Tetrahedra:
    """A tetrahedral mesh of m nodes in a body whose scene has n.

    Free nodes come first, and of those the ones with most neighbours: see ``Stencil``.

    Attributes
    ----------
    nodes : ndarray, shape (m, 3), mm
    elements : ndarray, shape (t, 4), int
    mirrored : ndarray, shape (t, 4), int
        The tetrahedra of the other way to cut the cells.
    free : int
        Number of nodes that are not clamped.
    to_scene : csr_matrix, shape (n, m)
        Interpolates nodal values.
    carrier : csr_matrix, shape (n, m)
        Its transpose carries forces over.  Those on the surface are carried as the traction they
        stand for: forces on a few nodes of a finer mesh would not be the same load.
    """

    nodes: Array
    elements: Ints
    mirrored: Ints
    free: int
    to_scene: csr_matrix
    carrier: csr_matrix

    @classmethod
    def of(cls, problem: FullProblem, divisions: Divisions) -> Tetrahedra:
        """Cut the body of a scene, ``divisions`` (3,) cells along the axes of its lattice.

        Raises
        ------
        PalpateError
            If the map turns a tetrahedron inside out.
        """
        mesh, own = problem.mesh, lattice(problem.scene)
        held, N = shape_functions(grid(divisions), own, mesh.elements)
        nodes = np.einsum("qa,qai->qi", N, mesh.nodes[held])
        # on a clamped face the functions of the other nodes vanish
        clamped = np.einsum("qa,qa->q", N, mesh.clamped[held]) > 1.0 - SAME
        elements, mirrored = _cut(divisions, EVEN, ODD), _cut(divisions, ODD, EVEN)
        if not volumes(nodes, np.concatenate([elements, mirrored])).min() > 0.0:
            raise PalpateError(f"divisions: tetrahedra of {divisions} cells are inside out")
        order = np.lexsort((-np.bincount(edges_of(elements).ravel()), clamped))
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        at = coordinates(mesh, own)
        to_scene = interpolation(at, divisions, corners(divisions))[:, order]
        return cls(
            nodes[order],
            rank[elements],
            rank[mirrored],
            int(np.sum(~clamped)),
            to_scene,
            _carrier(mesh, at, divisions, order, to_scene),
        )

    @property
    def both_cuts(self) -> Ints:
        """The tetrahedra of both ways to cut the cells, (2 t, 4)."""
        return np.concatenate([self.elements, self.mirrored])

    def load(self, case: Case, out: Array) -> None:
        """Write the nodal forces (3, m) mN that a case amounts to."""
        out[:] = 0.0
        matrix = self.carrier
        _carry(matrix.indptr, matrix.indices, matrix.data, case.nodes, case.forces, out)

    def displacement(self, own: Array) -> Array:
        """Displacement (n, 3) mm of the scene's nodes from that of the mesh's own, (3, m)."""
        return np.asarray(self.to_scene @ own.T)


def edges_of(elements: Ints) -> Ints:
    """Pairs (e, 2) of nodes, ascending, that tetrahedra (t, 4) join, each once."""
    ends = elements[:, np.array(EDGES)].reshape(-1, 2)
    return np.unique(np.sort(ends, axis=1), axis=0)


def gradients(nodes: Array, elements: Ints) -> tuple[Array, Array]:
    """Gradients (t, 4, 3) 1/mm of the linear shape functions, and volumes (t,) mm^3."""
    corners = nodes[elements]
    edges = corners[:, 1:] - corners[:, :1]
    inverse = np.linalg.inv(edges)  # column a: gradient of shape function a + 1
    others = np.swapaxes(inverse, 1, 2)
    first = -others.sum(axis=1, keepdims=True)
    return np.concatenate([first, others], axis=1), volumes(nodes, elements)


def volumes(nodes: Array, elements: Ints) -> Array:
    """Signed volumes (t,) mm^3 of tetrahedra."""
    corners = nodes[elements]
    determinants: Array = np.linalg.det(corners[:, 1:] - corners[:, :1])
    return determinants / 6.0


def stiffness(nodes: Array, elements: Ints, young: float, poisson: float) -> csr_matrix:
    """Stiffness matrix (3 m, 3 m) mN/mm of linear elastic tetrahedra.

    A pair of nodes has ``V (lambda g_a g_b^T + mu g_b g_a^T + mu (g_a . g_b) I)``, summed over the
    tetrahedra; ``g_a`` are the gradients of the shape functions.
    """
    mu, lam = lame(young, poisson)
    g, volume = gradients(nodes, elements)
    outer = np.einsum("t,tai,tbj->taibj", volume, g, g)
    blocks = lam * outer + mu * outer.transpose(0, 1, 4, 3, 2)
    blocks += mu * np.einsum("taibi,kl->takbl", outer, np.eye(3))
    dofs = (3 * elements[:, :, None] + np.arange(3)).reshape(len(elements), 12)
    rows, columns = np.repeat(dofs, 12, axis=1).ravel(), np.tile(dofs, (1, 12)).ravel()
    return coo_matrix((blocks.ravel(), (rows, columns)), (nodes.size, nodes.size)).tocsr()


def _cut(divisions: Divisions, even: Cut, odd: Cut) -> Ints:
    """Tetrahedra (t, 4) of a lattice, cells of even and odd index sum cut in different ways."""
    flip = cells(divisions).sum(axis=1) % 2 == 1
    local = np.where(flip[:, None, None], np.array(odd), np.array(even)).reshape(len(flip), -1)
    return np.take_along_axis(corners(divisions), local, axis=1).reshape(-1, 4)


def _carrier(
    mesh: Mesh, at: Array, divisions: Divisions, order: Ints, to_scene: csr_matrix
) -> csr_matrix:
    """``Tetrahedra.carrier``, on the surface ``M^-1 B`` with a lattice's nodes in a given order.

    ``M`` holds the integrals over the surface of products of the scene's shape functions, so that
    its inverse turns forces to tractions; ``B`` those of the scene's with the lattice's.
    """
    points, weights = gauss(GAUSS, 2)
    N, dN = shape(quadrilateral(mesh.faces.shape[1]), points)
    tangents = np.einsum("fai,qaj->fqij", mesh.nodes[mesh.faces], dN)
    area = np.linalg.norm(np.cross(tangents[..., 0], tangents[..., 1]), axis=2) * weights
    surface, local = np.unique(mesh.faces, return_inverse=True)
    local = local.reshape(mesh.faces.shape)
    rows = np.repeat(local[:, None], len(points), axis=1).ravel()
    columns = np.repeat(np.arange(area.size), mesh.faces.shape[1])
    size = len(surface), area.size
    values = csr_matrix((np.tile(N, (len(local), 1)).ravel(), (rows, columns)), size)
    weighted = values @ diags(area.ravel())
    where = np.einsum("qa,fai->fqi", N, at[mesh.faces]).reshape(-1, 3)
    B = weighted @ interpolation(where, divisions, corners(divisions))[:, order]
    carried = splu((weighted @ values.T).tocsc()).solve(B.toarray())
    carried[abs(carried) < NEGLIGIBLE] = 0.0
    inner = np.ones(len(mesh.nodes))
    inner[surface] = 0.0
    spread = csr_matrix((np.ones(len(surface)), (surface, np.arange(len(surface)))))
    spread.resize(len(inner), len(surface))
    return (diags(inner) @ to_scene + spread @ csr_matrix(carried)).tocsr()


@njit(cache=True, nogil=True, error_model="numpy")
def _carry(indptr, indices, data, nodes, forces, out):
    """Add the transpose of a CSR matrix times forces (k, 3) on rows ``nodes`` (k,) to (3, m)."""
    for k in range(len(nodes)):
        for p in range(indptr[nodes[k]], indptr[nodes[k] + 1]):
            for axis in range(3):
                out[axis, indices[p]] += data[p] * forces[k, axis]
