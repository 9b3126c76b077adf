"""Quadratic tetrahedra: their faces and edges, the map from barycentric coordinates, their quality.

Node order is VTK's: four corners, then the middles of ``EDGES``; a face's three corners, outward by
the right-hand rule, then the middles of its sides.
"""

import itertools

import numpy as np

from palpate.shared.arrays import Array, Ints, Numbers
from palpate.shared.geometry.elements import TET10, TRIANGLE6

EDGES = np.array(TET10.edges)
FACES = np.array([(1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1)])
"""Corners of the face opposite to each corner."""

MIDDLES = np.array([TET10.on_face(corners)[3:] for corners in FACES.tolist()])
"""Middles of the sides of the same faces."""


def lattice(order: int) -> Array:
    """Barycentric coordinates (k, 4) of all points of a tetrahedron that are multiples of 1/order.

    Corners come first, in their order.
    """
    inner = [p for p in itertools.product(range(order + 1), repeat=4) if sum(p) == order]
    inner.sort(key=lambda p: (max(p) < order, [-n for n in p]))
    return np.array(inner) / order


def shape(at: Array) -> Array:
    """Quadratic shape functions (k, 10) at barycentric coordinates (k, 4)."""
    return TET10.shape(at[:, 1:])[0]


def determinants(nodes: Array, elements: Numbers, order: int = 6) -> Array:
    """Jacobian determinants (e, k) mm³ at the points of ``lattice``, nodes among them if even."""
    _, slopes = TET10.shape(lattice(order)[:, 1:])
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
    """Volume (mm³) of curved elements, whose determinants are cubic."""
    at, weights = TET10.rule(3)
    _, slopes = TET10.shape(at)
    found = np.linalg.det(np.einsum("eni,qnj->eqij", nodes[elements], slopes))
    return float(np.sum(found @ weights))


def half_thickness(nodes: Array, elements: Numbers) -> float:
    """That (mm) of a plate of the volume and the surface of straight tetrahedra."""
    a, b, c = np.moveaxis(nodes[boundary(elements)[0][:, :3]], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0
    return float(volumes(nodes[elements[:, :4]]).sum() / area)


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
    at, cells = TRIANGLE6.cells(squares)
    points = (TRIANGLE6.shape(at)[0] @ nodes[faces]).reshape(-1, 3)
    triangles = cells + len(at) * np.arange(len(faces))[:, None, None]
    _, first, weld = np.unique(points.round(9), axis=0, return_index=True, return_inverse=True)
    return points[first], weld.ravel()[triangles.reshape(-1, 3)].astype(np.int32)
