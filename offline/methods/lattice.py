"""Meshes as lattices: the unit cube mapped onto a scene's body.

The scene's own hexahedra, curved as they are, map the unit cube onto the body.  Every lattice of
the cube, whatever its divisions, therefore fills the same body, and a point of one lattice is found
in another by its coordinates in the cube.  With the divisions of a scene of hex20 elements doubled,
all nodes of the scene are among those of the lattice.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from palpate.offline.fem.mesh import Mesh
from palpate.shared.geometry.elements import HEX_CORNERS, hexahedron, shape
from palpate.shared.scene import Extrusion, Scene, divisions_of

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Divisions = tuple[int, int, int]

SAME = 1e-9
"""Coordinates in the unit cube that differ by less are equal."""


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


def grid(divisions: Divisions) -> Array:
    """Points (m, 3) of a lattice in the unit cube, first index slowest."""
    points = np.moveaxis(np.indices(tuple(n + 1 for n in divisions)), 0, -1).reshape(-1, 3)
    return points / np.array(divisions)


def cells(divisions: Divisions) -> Ints:
    """Indices (c, 3) of a lattice's cells, first index slowest."""
    return np.moveaxis(np.indices(divisions), 0, -1).reshape(-1, 3)


def corners(divisions: Divisions) -> Ints:
    """Lattice points (c, 8) at the corners of every cell, in VTK's order."""
    points = cells(divisions)[:, None] + ((HEX_CORNERS + 1) / 2).astype(int)
    return np.ravel_multi_index(tuple(np.moveaxis(points, -1, 0)), np.array(divisions) + 1)


def coordinates(mesh: Mesh, divisions: Divisions) -> Array:
    """Coordinates (n, 3) in the unit cube of the nodes of a scene's mesh."""
    reference = hexahedron(mesh.elements.shape[1])
    at = np.empty((len(mesh.nodes), 3))
    at[mesh.elements] = (cells(divisions)[:, None] + (reference + 1) / 2) / divisions
    return at


def shape_functions(
    at: Array, divisions: Divisions, elements: NDArray[np.integer]
) -> tuple[Ints, Array]:
    """Nodes (q, k) of the elements that hold points of the unit cube, and their functions there.

    Parameters
    ----------
    at : ndarray, shape (q, 3)
    divisions : tuple of 3 int
    elements : ndarray, shape (c, k), int
        Nodes of the cells of that lattice, in its order.

    Returns
    -------
    nodes, values : ndarray, shape (q, k)
    """
    cell = np.minimum((at * divisions + SAME).astype(int), np.array(divisions) - 1)
    N, _ = shape(hexahedron(elements.shape[1]), 2.0 * (at * divisions - cell) - 1.0)
    return elements[np.ravel_multi_index(tuple(cell.T), divisions)], N


def interpolation(at: Array, divisions: Divisions, elements: NDArray[np.integer]) -> csr_matrix:
    """Matrix (q, m) that interpolates nodal values of a lattice at points (q, 3) of the cube."""
    nodes, N = shape_functions(at, divisions, elements)
    N[abs(N) < SAME] = 0.0
    rows = np.repeat(np.arange(len(at)), N.shape[1])
    matrix = csr_matrix((N.ravel(), (rows, nodes.ravel())), (len(at), int(elements.max()) + 1))
    matrix.eliminate_zeros()
    return matrix
