"""Quadratic tetrahedra: their faces and edges, the map from barycentric coordinates, their quality.

Node order is VTK's: four corners, then the middles of ``EDGES``; a face's three corners, outward by
the right-hand rule, then the middles of its sides.
"""

import itertools

import numpy as np

from palpate.shared.arrays import Array, Ints, Numbers

EDGES = np.array([(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)])
FACES = np.array([(1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1)])
"""Corners of the face opposite to each corner."""

MIDDLES = np.array([(5, 9, 8), (7, 9, 6), (4, 8, 7), (6, 5, 4)])
"""Middles of the sides of the same faces."""


def lattice(order: int) -> Array:
    """Barycentric coordinates (k, 4) of all points of a tetrahedron that are multiples of 1/order.

    Corners come first, in their order.
    """
    inner = [p for p in itertools.product(range(order + 1), repeat=4) if sum(p) == order]
    inner.sort(key=lambda p: (max(p) < order, [-n for n in p]))
    return np.array(inner) / order


def shape(at: Array) -> tuple[Array, Array]:
    """Quadratic shape functions (..., 10) and slopes (..., 10, 4) at barycentric points (..., 4).

    Slopes are partial derivatives as if the four coordinates were independent.
    """
    first, second = at[..., EDGES[:, 0]], at[..., EDGES[:, 1]]
    N = np.concatenate([at * (2.0 * at - 1.0), 4.0 * first * second], axis=-1)
    dN = np.zeros((*at.shape[:-1], 10, 4))
    corner, edge = np.arange(4), np.arange(6)
    dN[..., corner, corner] = 4.0 * at - 1.0
    dN[..., 4 + edge, EDGES[:, 0]] = 4.0 * second
    dN[..., 4 + edge, EDGES[:, 1]] = 4.0 * first
    return N, dN


def determinants(nodes: Array, elements: Numbers, order: int = 6) -> Array:
    """Jacobian determinants (e, k) mm³ at the points of ``lattice``, nodes among them if even."""
    _, dN = shape(lattice(order))
    slopes = dN[..., 1:] - dN[..., :1]
    found: Array = np.linalg.det(np.einsum("eni,qnj->eqij", nodes[elements], slopes))
    return found


def least_determinants(nodes: Array, elements: Numbers) -> Array:
    """Lower bounds (e,) mm³ of the determinants anywhere in the elements.

    The determinant is a cubic; it is nowhere less than the least of its Bernstein coefficients.
    """
    at = lattice(3)
    powers = np.rint(3 * at).astype(int)
    factorial = np.array([1, 1, 2, 6])
    bernstein = 6 / factorial[powers].prod(axis=1) * np.prod(at[:, None] ** powers, axis=2)
    coefficients = determinants(nodes, elements, order=3) @ np.linalg.inv(bernstein).T
    least: Array = coefficients.min(axis=1)
    return least


def edge_lengths(nodes: Array, elements: Numbers | Ints) -> Array:
    """Lengths (e, 6) mm of the straight ``EDGES`` of elements (e, 4 or 10)."""
    ends = nodes[elements[:, EDGES]]
    lengths: Array = np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2)
    return lengths


def volumes(corners: Array) -> Array:
    """Volumes (e,) mm³ of straight tetrahedra of corners (e, 4, 3)."""
    found: Array = np.linalg.det(corners[:, 1:4] - corners[:, :1]) / 6.0
    return found


def volume(nodes: Array, elements: Numbers) -> float:
    """Volume (mm³) of curved elements: a rule of degree three is exact."""
    a, b = 1.0 / 6.0, 0.5
    at = np.vstack([np.full((1, 4), 0.25), np.full((4, 4), a) + (b - a) * np.eye(4)])
    _, dN = shape(at)
    slopes = dN[..., 1:] - dN[..., :1]
    found = np.linalg.det(np.einsum("eni,qnj->eqij", nodes[elements], slopes))
    return float(np.sum(found @ np.array([-0.8, 0.45, 0.45, 0.45, 0.45])) / 6.0)


def raised(points: Array, corners: Numbers) -> tuple[Array, Numbers]:
    """Nodes (n, 3) and elements (e, 10) with straight edges of tetrahedra (e, 4)."""
    ends = np.sort(corners[:, EDGES], axis=2).reshape(-1, 2)
    edges, number = np.unique(ends, axis=0, return_inverse=True)
    nodes = np.vstack([points, points[edges].mean(axis=1)])
    middles = len(points) + number.reshape(-1, 6)
    return nodes, np.hstack([corners, middles]).astype(np.int32)


def boundary(elements: Numbers) -> tuple[Numbers, Ints, Ints]:
    """Faces (f, 6) of one element only, that element (f,), and its corner opposite (f,)."""
    corners = elements[:, FACES].reshape(-1, 3)
    _, first, count = np.unique(
        np.sort(corners, axis=1), axis=0, return_index=True, return_counts=True
    )
    outer = np.sort(first[count == 1])
    owner, opposite = outer // 4, outer % 4
    middles = elements[owner[:, None], MIDDLES[opposite]]
    return np.hstack([corners[outer], middles]), owner, opposite


def manifold(faces: Numbers) -> bool:
    """Whether every edge of faces (f, 3 or 6) belongs to two of them, walked once each way."""
    sides = np.stack([faces[:, :3], np.roll(faces[:, :3], -1, axis=1)], axis=2).reshape(-1, 2)
    once = len(np.unique(sides, axis=0)) == len(sides)
    _, count = np.unique(np.sort(sides, axis=1), axis=0, return_counts=True)
    return bool(once and (count == 2).all())


def dihedral_angles(corners: Array) -> Array:
    """Angles (e, 6), degrees, at the edges of straight tetrahedra of corners (e, 4, 3)."""
    a, b, c = (corners[:, FACES[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    pairs = np.array(list(itertools.combinations(range(4), 2)))
    cosine = -np.sum(normals[:, pairs[:, 0]] * normals[:, pairs[:, 1]], axis=2)
    angles: Array = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return angles


def scaled_jacobians(corners: Array) -> Array:
    """Least det J over the product of three edges, 1 for a regular one (e,); Verdict's measure."""
    sides = corners[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]] - corners[:, :, None]
    product = np.linalg.norm(sides, axis=3).prod(axis=2)
    least: Array = np.sqrt(2.0) * 6.0 * volumes(corners) / product.max(axis=1)
    return least


def quality(nodes: Array, elements: Numbers) -> dict[str, float]:
    """How good elements are: angles and scaled Jacobians are those of straight edges."""
    corners = nodes[elements[:, :4]]
    angles, scaled = dihedral_angles(corners), scaled_jacobians(corners)
    everywhere = determinants(nodes, elements)
    return {
        "dihedral_min": float(angles.min()),
        "dihedral_1_percent": float(np.percentile(angles.min(axis=1), 1)),
        "dihedral_max": float(angles.max()),
        "scaled_jacobian_min": float(scaled.min()),
        "scaled_jacobian_1_percent": float(np.percentile(scaled, 1)),
        "jacobian_ratio_min": float((everywhere.min(axis=1) / everywhere.mean(axis=1)).min()),
        "inverted": float(np.sum(~(everywhere.min(axis=1) > 0))),
        "volume_mm3": volume(nodes, elements),
    }


def curved(faces: Numbers, nodes: Array, squares: int = 4) -> tuple[Array, Numbers]:
    """Points (p, 3) mm and triangles (t, 3) of six-node faces, each side cut into ``squares``."""
    steps = [(i, j) for i in range(squares + 1) for j in range(squares + 1 - i)]
    number = {step: k for k, step in enumerate(steps)}
    own = [
        (number[i, j], number[i + 1, j], number[i, j + 1])
        for i, j in steps
        if i + j < squares
    ] + [
        (number[i + 1, j], number[i + 1, j + 1], number[i, j + 1])
        for i, j in steps
        if i + j < squares - 1
    ]  # fmt: skip
    x, y = np.array(steps).T / squares
    z = 1.0 - x - y
    N = np.stack(
        [z * (2 * z - 1), x * (2 * x - 1), y * (2 * y - 1), 4 * z * x, 4 * x * y, 4 * y * z], axis=1
    )
    points = N @ nodes[faces]
    triangles = np.array(own) + len(steps) * np.arange(len(faces))[:, None, None]
    _, first, weld = np.unique(
        points.reshape(-1, 3).round(9), axis=0, return_index=True, return_inverse=True
    )
    return points.reshape(-1, 3)[first], weld.ravel()[triangles.reshape(-1, 3)].astype(np.int32)
