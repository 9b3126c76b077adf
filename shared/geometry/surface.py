"""The body's boundary as triangles: where a queried position lands and which way is out."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, NamedTuple

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from palpate.shared.arrays import Array, Ints, Numbers
from palpate.shared.geometry.elements import face_kind_of


@njit(cache=True, error_model="numpy", nogil=True)
def _closest_on_triangle(p, vertices, first, second, third):
    """Distance of a triangle from p, and the barycentric coordinates of its nearest point.

    Ericson, Real-Time Collision Detection, 2005, 5.1.5.  No array is made of a vertex: that takes
    longer than the arithmetic.
    """
    d1 = d2 = d3 = d4 = d5 = d6 = 0.0
    for i in range(3):
        a, b, c = vertices[first, i], vertices[second, i], vertices[third, i]
        ab, ac = b - a, c - a
        d1 += ab * (p[i] - a)
        d2 += ac * (p[i] - a)
        d3 += ab * (p[i] - b)
        d4 += ac * (p[i] - b)
        d5 += ab * (p[i] - c)
        d6 += ac * (p[i] - c)
    vc, vb, va = d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4
    if d1 <= 0.0 and d2 <= 0.0:
        v, w = 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        v, w = 1.0, 0.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v, w = d1 / (d1 - d3), 0.0
    elif d6 >= 0.0 and d5 <= d6:
        v, w = 0.0, 1.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        v, w = 0.0, d2 / (d2 - d6)
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        v = 1.0 - w
    else:
        v, w = vb / (va + vb + vc), vc / (va + vb + vc)
    u = 1.0 - v - w
    squared = 0.0
    for i in range(3):
        x = u * vertices[first, i] + v * vertices[second, i] + w * vertices[third, i]
        squared += (p[i] - x) ** 2
    return math.sqrt(squared), u, v, w


UPRIGHT = 0.7
"""Cosine between the normal and the way to a point below which it is beside the surface, beyond its
rim, rather than above or below."""


FACING = 0.7
"""Cosine between the normals of two points of one smooth side of a body."""

BLOCK = 4096
"""Vertices of a block, see ``blocks``."""


class SurfaceIndex(NamedTuple):
    """A surface as compiled code sees it, with fields given at its vertices."""

    vertices: Array  # (v, 3) mm
    triangles: Numbers  # (t, 3), neighbours next to each other
    balls: Array  # (t, 4) mm, centres and radii of balls that hold them
    normals: Array  # (v, 3)
    first: Ints  # (c + 1,) first triangle of each cluster
    centres: Array  # (3, c) mm, of balls that hold the clusters
    radii: Array  # (c,) mm
    values: Array  # (v, k)


CLUSTER = 32
"""Most triangles of a cluster."""


@njit(cache=True, error_model="numpy", nogil=True)
def _nearest_in(ground, p, cluster, found):
    """Number, distance and barycentric coordinates of the nearest triangle: ``found`` or nearer."""
    nearest, best, u, v, w = found
    balls, triangles = ground.balls, ground.triangles
    for t in range(ground.first[cluster], ground.first[cluster + 1]):
        dx, dy, dz = p[0] - balls[t, 0], p[1] - balls[t, 1], p[2] - balls[t, 2]
        bound = best + balls[t, 3]
        if dx * dx + dy * dy + dz * dz < bound * bound:
            i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
            distance, a, b, c = _closest_on_triangle(p, ground.vertices, i, j, k)
            if distance < best:
                nearest, best, u, v, w = t, distance, a, b, c
    return nearest, best, u, v, w


@njit(cache=True, error_model="numpy", nogil=True)
def locate(ground, p, squared, x, normal, at):
    """Write the projection of p, the normal and the values ``at`` it; return the distance.

    ``squared`` (clusters,) is scratch.
    """
    centres, radii = ground.centres, ground.radii
    for c in range(len(radii)):
        dx, dy, dz = p[0] - centres[0, c], p[1] - centres[1, c], p[2] - centres[2, c]
        squared[c] = dx * dx + dy * dy + dz * dz
    first = np.argmin(squared)
    found = _nearest_in(ground, p, first, (0, np.inf, 0.0, 0.0, 0.0))
    for c in range(len(radii)):
        bound = found[1] + radii[c]
        if squared[c] < bound * bound and c != first:
            found = _nearest_in(ground, p, c, found)
    t, distance, u, v, w = found
    a, b, c = ground.triangles[t, 0], ground.triangles[t, 1], ground.triangles[t, 2]
    vertices, normals, values = ground.vertices, ground.normals, ground.values
    for k in range(len(at)):
        at[k] = u * values[a, k] + v * values[b, k] + w * values[c, k]
    length = 0.0
    for i in range(3):
        x[i] = u * vertices[a, i] + v * vertices[b, i] + w * vertices[c, i]
        normal[i] = u * normals[a, i] + v * normals[b, i] + w * normals[c, i]
        length += normal[i] ** 2
    length = math.sqrt(length)
    for i in range(3):
        normal[i] /= length
    return distance


@dataclass(frozen=True)
class Surface:
    """A triangulated piece of boundary with a continuous normal.

    Parameters
    ----------
    vertices : ndarray, shape (v, 3), mm
    triangles : ndarray, shape (t, 3), int32
        Outward by the right-hand rule.
    normals : ndarray, shape (v, 3)
        Outward unit normals, interpolated over the triangles.
    """

    vertices: Annotated[Array, "surface_vertices", "mm", "v, 3", "accessible surface"]
    triangles: Annotated[
        Numbers, "surface_triangles", "1", "t, 3", "triangles of it, outward", "< v"
    ]
    normals: Annotated[Array, "surface_normals", "1", "v, 3", "outward unit normals at vertices"]

    @cached_property
    def _index(self) -> SurfaceIndex:
        """For compiled code, without fields."""
        clusters = _clusters(
            self.vertices[self.triangles].mean(axis=1), np.arange(len(self.triangles))
        )
        first = np.cumsum([0, *map(len, clusters)])
        ordered = np.ascontiguousarray(self.triangles[np.concatenate(clusters)])
        corners = self.vertices[ordered]
        low, high = corners.min(axis=1), corners.max(axis=1)
        middles = (low + high) / 2
        radii = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)
        low = np.minimum.reduceat(low, first[:-1])
        centres = (low + np.maximum.reduceat(high, first[:-1])) / 2
        own = np.repeat(centres, np.diff(first), axis=0)
        reach = np.linalg.norm(corners - own[:, None], axis=2).max(axis=1)
        return SurfaceIndex(
            vertices=self.vertices,
            triangles=ordered,
            balls=np.column_stack([middles, radii]),
            normals=self.normals,
            first=first,
            centres=np.ascontiguousarray(centres.T),
            radii=np.maximum.reduceat(reach, first[:-1]),
            values=np.empty((len(self.vertices), 0)),
        )

    def project(self, position: Array) -> tuple[Array, Array, float]:
        """Nearest surface point (mm), its outward unit normal and the distance (mm)."""
        return self.locate(position, np.empty((len(self.vertices), 0)))[:3]

    def height(self, position: Array) -> float:
        """Distance (mm) of a point above the surface; negative below."""
        foot, normal, _ = self.project(position)
        out = position - foot
        return float(np.copysign(np.linalg.norm(out), out @ normal))

    def locate(self, position: Array, values: Array) -> tuple[Array, Array, float, Array]:
        """As ``project``, and the values (k,) there of fields given at the vertices, (v, k)."""
        x, normal, at = np.empty(3), np.empty(3), np.empty(values.shape[1])
        index = self.ground(values)
        distance = locate(index, position, np.empty(len(index.radii)), x, normal, at)
        return x, normal, distance, at

    def ground(self, values: Array) -> SurfaceIndex:
        """For compiled code, with fields (v, k) given at the vertices."""
        return self._index._replace(values=np.ascontiguousarray(values))

    def curvature(self, radius: float, beyond: Array) -> Array:
        """Curvature (v, 6) 1/mm at the vertices: xx, yy, zz, xy, xz, yz; positive where convex.

        It is the change of the normal with the place, fitted to what faces the same way within a
        radius (mm): vertices, and points ``beyond`` the rim with normals (k, 6).
        """
        known = np.vstack([np.hstack([self.vertices, self.normals]), beyond])
        tree = cKDTree(known[:, :3])
        parts = [self._curvature(own, known, tree, radius) for own in blocks(len(self.vertices))]
        return np.vstack(parts)

    def _curvature(self, own: slice, known: Array, tree: Any, radius: float) -> Array:
        """The same at some of the vertices, by points with normals (p, 6) in a tree."""
        vertices, normals = self.vertices[own], self.normals[own]
        one, two, frames = neighbours(self, own, tree, known[:, 3:], radius)
        away, turned = known[two, :3] - vertices[one], known[two, 3:] - normals[one]
        s = np.einsum("nai,ni->na", frames[one], away)
        t = np.einsum("nai,ni->na", frames[one], turned)
        # least squares of t = [[a, b], [b, c]] s
        A = np.zeros((len(s), 2, 3))
        A[:, 0, :2] = A[:, 1, 1:] = s
        left, right = np.zeros((len(vertices), 3, 3)), np.zeros((len(vertices), 3))
        np.add.at(left, one, np.einsum("nab,nac->nbc", A, A))
        np.add.at(right, one, np.einsum("nab,na->nb", A, t))
        fitted = np.einsum("vab,vb->va", np.linalg.pinv(left, rcond=1e-6), right)
        bent = fitted[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
        tensor = np.einsum("vai,vab,vbj->vij", frames, bent, frames)
        return np.asarray(tensor[:, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])

    def gradient(self, values: Array) -> Array:
        """Gradient (v, 3) at the vertices of a field (v,) given there: the mean of triangles'."""
        corners, own = self.vertices[self.triangles], values[self.triangles]
        sides = np.roll(corners, 1, axis=1) - np.roll(corners, -1, axis=1)  # opposite the corners
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = np.linalg.norm(normals, axis=1, keepdims=True)  # twice
        slopes = np.cross(normals / areas, np.einsum("ta,tai->ti", own, sides))  # times these
        total = np.zeros((len(values), 4))
        np.add.at(total, self.triangles, np.column_stack([slopes, areas])[:, None])
        return np.asarray(total[:, :3] / total[:, 3:])

    def rim(self) -> Ints:
        """Vertices on the border of the surface: ends of edges that belong to one triangle."""
        edges = np.sort(np.vstack([self.triangles[:, [i, (i + 1) % 3]] for i in range(3)]), axis=1)
        unique, count = np.unique(edges, axis=0, return_counts=True)
        return np.unique(unique[count == 1])

    def rim_distance(self) -> Array:
        """Distance (v,) mm of the vertices from the nearest on the rim."""
        return np.asarray(cKDTree(self.vertices[self.rim()]).query(self.vertices)[0])


def blocks(count: int) -> list[slice]:
    """Parts of so many vertices, whose neighbours are held in memory at once."""
    return [slice(i, i + BLOCK) for i in range(0, count, BLOCK)]


def neighbours(
    surface: Surface, own: slice, tree: Any, normals: Array, radius: float, least: float = FACING
) -> tuple[Ints, Ints, Array]:
    """Pairs of some vertices and points of a tree, with normals (p, 3), that face the same way.

    No further apart than a radius (mm), with a cosine of ``least`` between their normals; then the
    vertices' tangents (v, 2, 3).
    """
    vertices, out = surface.vertices[own], surface.normals[own]
    pairs = cKDTree(vertices).sparse_distance_matrix(tree, radius, output_type="ndarray")
    one, two = pairs["i"], pairs["j"]
    facing = np.sum(out[one] * normals[two], axis=1) > least
    return one[facing], two[facing], tangent_frames(out)


def tangent_frames(normals: Array) -> Array:
    """Two unit tangents (n, 2, 3) of each of unit normals (n, 3)."""
    least = np.eye(3)[np.abs(normals).argmin(axis=1)]
    first = least - np.sum(least * normals, axis=1, keepdims=True) * normals
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first)], axis=1)


def _clusters(centres: Array, members: Ints) -> list[Ints]:
    """Triangles in groups of neighbours, halved across the longest side until small enough."""
    if len(members) <= CLUSTER:
        return [members]
    extent = np.ptp(centres[members], axis=0)
    members = members[np.argsort(centres[members, np.argmax(extent)], kind="stable")]
    half = len(members) // 2
    return _clusters(centres, members[:half]) + _clusters(centres, members[half:])


def boundary_triangles(faces: Numbers) -> tuple[Numbers, Numbers]:
    """Boundary for drawing: node ids (s,) and triangles (t, 3) as indices into them."""
    triangles = np.vstack([faces[:, own] for own in face_kind_of(faces).triangles])
    nodes, compact = np.unique(triangles, return_inverse=True)
    return nodes.astype(np.int32), compact.reshape(-1, 3).astype(np.int32)
