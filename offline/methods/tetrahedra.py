"""Tetrahedra in the body of a scene, on a lattice as fine or as coarse as a method wants.

The scene's own hexahedra, curved as they are, map the unit cube onto the body.  A lattice of the
cube with other divisions is mapped by them, so that every size fills the same body; each of its
cells is cut into five tetrahedra, alternately one way and the other, which then fit together.  With
the divisions of a scene of hex20 doubled, all nodes of the scene are among those of the lattice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import splu

from palpate.offline.fem.mesh import Mesh
from palpate.offline.methods.method import Case
from palpate.offline.run.workshop import Workshop
from palpate.shared.errors import PalpateError
from palpate.shared.geometry.elements import HEX_CORNERS, gauss, hexahedron, quadrilateral, shape
from palpate.shared.scene import Extrusion, Scene, divisions_of

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Divisions = tuple[int, int, int]
Cut = tuple[tuple[int, int, int, int], ...]

EVEN: Cut = ((0, 1, 2, 5), (0, 2, 3, 7), (0, 5, 7, 4), (2, 7, 5, 6), (0, 2, 7, 5))
"""Corners of the five tetrahedra of a hexahedron, by the right-hand rule; the last is central."""
ODD: Cut = ((1, 3, 0, 4), (1, 2, 3, 6), (1, 6, 4, 5), (3, 4, 6, 7), (1, 3, 4, 6))
"""The mirror image: its face diagonals are the other ones."""

EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
"""Of a tetrahedron."""

SAME = 1e-9
"""Coordinates in the unit cube that differ by less are equal."""

GAUSS = 8
"""Points a side of a face at which it is integrated: the lattice's functions have kinks."""

NEGLIGIBLE = 1e-5
"""Share of a force too small to be carried over."""


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
        How many of the nodes are.
    to_scene : csr_matrix, shape (n, m)
        Interpolates nodal values.
    carrier : csr_matrix, shape (n, m)
        Its transpose carries forces over: those on the surface as the traction they stand for, for
        which forces on a few nodes of a finer mesh are no substitute.
    """

    nodes: Array
    elements: Ints
    mirrored: Ints
    free: int
    to_scene: csr_matrix
    carrier: csr_matrix

    @classmethod
    def of(cls, workshop: Workshop, divisions: Divisions) -> Tetrahedra:
        """Cut the body of a scene, ``divisions`` (3,) cells along the axes of its lattice.

        Raises
        ------
        PalpateError
            If the map turns a tetrahedron inside out.
        """
        mesh, own = workshop.mesh, lattice(workshop.scene)
        nodes, clamped = _mapped(mesh, own, _grid(divisions) / np.array(divisions))
        elements, mirrored = _cut(divisions, EVEN, ODD), _cut(divisions, ODD, EVEN)
        if not volumes(nodes, np.concatenate([elements, mirrored])).min() > 0.0:
            raise PalpateError(f"divisions: tetrahedra of {divisions} cells are inside out")
        order = np.lexsort((-np.bincount(edges_of(elements).ravel()), clamped))
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        at = _coordinates(mesh, own)
        to_scene = _interpolation(at, divisions)[:, order]
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

    @property
    def edges(self) -> Ints:
        """Pairs (e, 2) of nodes that an element joins, each once."""
        return edges_of(self.elements)

    def load(self, case: Case, out: Array) -> None:
        """Write the nodal forces (3, m) mN that a case amounts to."""
        out[:] = 0.0
        matrix = self.carrier
        _carry(matrix.indptr, matrix.indices, matrix.data, case.nodes, case.forces, out)

    def displacement(self, own: Array) -> Array:
        """Displacement (n, 3) mm of the scene's nodes from that of the mesh's own, (3, m)."""
        return np.asarray(self.to_scene @ own.T)


def lattice(scene: Scene) -> Divisions:
    """Hexahedra of a scene along the axes of its mesh's lattice (see ``fem.mesh``)."""
    along, second, third = divisions_of(scene.geometry)
    return (
        (along, third, second) if isinstance(scene.geometry, Extrusion) else (along, second, third)
    )


def scaled(scene: Scene, factor: float) -> Divisions:
    """Divisions of a scene's lattice times a factor, rounded up to a whole cell."""
    along, second, third = (int(np.ceil(factor * n - SAME)) for n in lattice(scene))
    return along, second, third


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


def _grid(divisions: Divisions) -> Ints:
    """Points (m, 3) of a lattice, first index slowest."""
    return np.moveaxis(np.indices(tuple(n + 1 for n in divisions)), 0, -1).reshape(-1, 3)


def _cut(divisions: Divisions, even: Cut, odd: Cut) -> Ints:
    """Tetrahedra (t, 4) of a lattice, cells of even and odd index sum cut in different ways."""
    cells = np.moveaxis(np.indices(divisions), 0, -1).reshape(-1, 3)
    flip = cells.sum(axis=1) % 2 == 1
    local = np.where(flip[:, None, None], np.array(odd), np.array(even)).reshape(len(cells), -1)
    return np.take_along_axis(_corners(cells, divisions), local, axis=1).reshape(-1, 4)


def _corners(cells: Ints, divisions: Divisions) -> Ints:
    """Lattice points (c, 8) at the corners of cells (c, 3), in VTK's order."""
    points = cells[:, None] + ((HEX_CORNERS + 1) / 2).astype(int)
    return np.ravel_multi_index(tuple(np.moveaxis(points, -1, 0)), np.array(divisions) + 1)


def _located(at: Array, divisions: Divisions) -> tuple[Ints, Array]:
    """Cells (q, 3) that hold points (q, 3) of the unit cube, and where in [-1, 1]^3 they do."""
    cells = np.minimum((at * divisions + SAME).astype(int), np.array(divisions) - 1)
    return cells, 2.0 * (at * divisions - cells) - 1.0


def _mapped(mesh: Mesh, own: Divisions, at: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Points (q, 3) mm of the body at coordinates (q, 3) in the unit cube; whether clamped (q,)."""
    cells, local = _located(at, own)
    elements = mesh.elements[np.ravel_multi_index(tuple(cells.T), own)]
    N, _ = shape(hexahedron(mesh.elements.shape[1]), local)
    # on a clamped face the functions of the other nodes vanish
    clamped = np.einsum("qa,qa->q", N, mesh.clamped[elements]) > 1.0 - SAME
    return np.einsum("qa,qai->qi", N, mesh.nodes[elements]), clamped


def _coordinates(mesh: Mesh, own: Divisions) -> Array:
    """Coordinates (n, 3) in the unit cube of a scene's nodes."""
    reference = hexahedron(mesh.elements.shape[1])
    cells = np.moveaxis(np.indices(own), 0, -1).reshape(-1, 3)
    at = np.empty((len(mesh.nodes), 3))
    at[mesh.elements] = (cells[:, None] + (reference + 1) / 2) / own
    return at


def _interpolation(at: Array, divisions: Divisions) -> csr_matrix:
    """Matrix (q, m) that interpolates a lattice trilinearly at points (q, 3) of the unit cube."""
    cells, local = _located(at, divisions)
    N, _ = shape(HEX_CORNERS, local)
    N[abs(N) < SAME] = 0.0
    rows = np.repeat(np.arange(len(at)), 8)
    columns = _corners(cells, divisions).ravel()
    size = len(at), int(np.prod(np.array(divisions) + 1))
    matrix = csr_matrix((N.ravel(), (rows, columns)), size)
    matrix.eliminate_zeros()
    return matrix


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
    B = weighted @ _interpolation(where, divisions)[:, order]
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
