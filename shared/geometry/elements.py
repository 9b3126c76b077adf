"""Hexahedra and their faces: shape functions, reference nodes and quadrature.

Node order is VTK's: hex8 corners, hex20 corners then edge midpoints; faces likewise (quad4, quad8).
"""

import itertools

import numpy as np

from palpate.shared.arrays import Array

HEX_CORNERS = np.array(
    [
        [-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1],
        [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1],
    ],
    dtype=float,
)  # fmt: skip
HEX_EDGES = (
    (0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7),
)  # fmt: skip
HEX20_NODES = np.vstack(
    [HEX_CORNERS, [(HEX_CORNERS[a] + HEX_CORNERS[b]) / 2 for a, b in HEX_EDGES]]
)
QUAD_CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=float)
QUAD8_NODES = np.vstack(
    [QUAD_CORNERS, [(QUAD_CORNERS[a] + QUAD_CORNERS[(a + 1) % 4]) / 2 for a in range(4)]]
)


def gauss(points: int, dimension: int) -> tuple[Array, Array]:
    """Gauss-Legendre rule on [-1, 1]^d: coordinates (points^d, d) and weights (points^d,)."""
    x, w = np.polynomial.legendre.leggauss(points)
    grid = np.array(list(itertools.product(x, repeat=dimension)))
    weights = np.array([np.prod(c) for c in itertools.product(w, repeat=dimension)])
    return grid, weights


def shape(nodes: Array, at: Array) -> tuple[Array, Array]:
    """Lagrange or serendipity shape functions of the element with reference ``nodes``.

    Parameters
    ----------
    nodes : ndarray, shape (n, d)
        ``HEX_CORNERS``, ``HEX20_NODES``, ``QUAD_CORNERS`` or ``QUAD8_NODES``.
    at : ndarray, shape (q, d)
        Reference coordinates.

    Returns
    -------
    N : ndarray, shape (q, n)
    dN : ndarray, shape (q, n, d)
        Derivatives with respect to the reference coordinates.

    Notes
    -----
    Serendipity (Hughes, The Finite Element Method, ch. 3): with ``l_i = 1 + x_i a_i``, corners
    ``prod l_i (sum x_i a_i - d + 1) / 2^d``, midpoints ``(1 - x_k^2) prod_{i != k} l_i / 2^(d-1)``.
    """
    n, d = nodes.shape
    quadratic = n > 2**d
    N = np.empty((len(at), n))
    dN = np.empty((len(at), n, d))
    for a, corner in enumerate(nodes):
        middle = corner == 0
        factor = np.where(middle, 1 - at**2, 1 + at * corner)
        slope = np.where(middle, -2 * at, np.broadcast_to(corner, at.shape))
        scale = 2.0 ** -(d - middle.sum())
        others = [np.prod(np.delete(factor, i, axis=1), axis=1) for i in range(d)]
        product = np.prod(factor, axis=1)
        N[:, a] = scale * product
        for i in range(d):
            dN[:, a, i] = scale * slope[:, i] * others[i]
        if quadratic and not middle.any():
            extra = at @ corner - (d - 1)
            for i in range(d):
                dN[:, a, i] = dN[:, a, i] * extra + N[:, a] * corner[i]
            N[:, a] *= extra
    return N, dN


def hexahedron(nodes_per_element: int) -> Array:
    """Reference nodes of the 8- or 20-node hexahedron."""
    return {8: HEX_CORNERS, 20: HEX20_NODES}[nodes_per_element]


def quadrilateral(nodes_per_face: int) -> Array:
    """Reference nodes of the 4- or 8-node face."""
    return {4: QUAD_CORNERS, 8: QUAD8_NODES}[nodes_per_face]
