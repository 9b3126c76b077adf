"""The body's boundary as triangles: where a queried position lands and which way is out."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True, error_model="numpy", nogil=True)
def _closest_on_triangle(p, a, b, c, weights):
    """Barycentric coordinates of the point of triangle abc nearest to p (Ericson 2005, 5.1.5)."""
    d1 = d2 = d3 = d4 = d5 = d6 = 0.0
    for i in range(3):
        ab, ac = b[i] - a[i], c[i] - a[i]
        d1 += ab * (p[i] - a[i])
        d2 += ac * (p[i] - a[i])
        d3 += ab * (p[i] - b[i])
        d4 += ac * (p[i] - b[i])
        d5 += ab * (p[i] - c[i])
        d6 += ac * (p[i] - c[i])
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
    weights[0], weights[1], weights[2] = 1.0 - v - w, v, w


UPRIGHT = 0.7
"""Cosine between the normal and the way to a point below which it is beside the surface, beyond its
rim, rather than above or below."""


class Ground(NamedTuple):
    """A surface as compiled code sees it, with fields given at its vertices."""

    vertices: Array  # (v, 3) mm
    triangles: NDArray[np.int32]  # (t, 3), neighbours next to each other
    normals: Array  # (v, 3)
    first: NDArray[np.int64]  # (c + 1,) first triangle of each cluster
    centres: Array  # (3, c) mm, of balls that hold the clusters
    radii: Array  # (c,) mm
    values: Array  # (v, k)


CLUSTER = 8
"""Most triangles of a cluster."""


@njit(cache=True, error_model="numpy", nogil=True)
def _project(ground, p, squared, weights, trial):
    """Nearest triangle and barycentric ``weights`` there; returns (triangle, distance).

    ``squared`` (c,) is scratch: squared distances of the balls' centres.
    """
    centres, radii = ground.centres, ground.radii
    x, y, z = p[0], p[1], p[2]
    for c in range(len(radii)):
        dx, dy, dz = x - centres[0, c], y - centres[1, c], z - centres[2, c]
        squared[c] = dx * dx + dy * dy + dz * dz
    first = np.argmin(squared[: len(radii)])
    nearest, best = _nearest_in(ground, p, first, 0, np.inf, weights, trial)
    for c in range(len(radii)):
        bound = best + radii[c]
        if squared[c] < bound * bound and c != first:
            nearest, best = _nearest_in(ground, p, c, nearest, best, weights, trial)
    return nearest, best


@njit(cache=True, error_model="numpy", nogil=True)
def _nearest_in(ground, p, cluster, nearest, best, weights, trial):
    """``nearest`` triangle and its distance ``best``, or those of a nearer one in the cluster."""
    for t in range(ground.first[cluster], ground.first[cluster + 1]):
        distance = _distance(ground, p, t, trial)
        if distance < best:
            nearest, best = t, distance
            weights[:] = trial
    return nearest, best


@njit(cache=True, error_model="numpy", nogil=True)
def _distance(ground, p, t, weights):
    """Distance of p from triangle t, and the barycentric coordinates of its nearest point."""
    vertices = ground.vertices
    a, b, c = ground.triangles[t, 0], ground.triangles[t, 1], ground.triangles[t, 2]
    _closest_on_triangle(p, vertices[a], vertices[b], vertices[c], weights)
    distance = 0.0
    for i in range(3):
        x = weights[0] * vertices[a, i] + weights[1] * vertices[b, i] + weights[2] * vertices[c, i]
        distance += (p[i] - x) ** 2
    return math.sqrt(distance)


@njit(cache=True, error_model="numpy", nogil=True)
def locate(ground, p, scratch, x, normal, at):
    """Write the projection of p, the normal and the values ``at`` it; return the distance.

    ``scratch`` (clusters + 6,) holds one value for each ball of triangles and six more.
    """
    count = len(ground.radii)
    weights, trial = scratch[count : count + 3], scratch[count + 3 :]
    t, distance = _project(ground, p, scratch[:count], weights, trial)
    x[:] = 0.0
    normal[:] = 0.0
    at[:] = 0.0
    for corner in range(3):
        v, w = ground.triangles[t, corner], weights[corner]
        for k in range(len(at)):
            at[k] += w * ground.values[v, k]
        for i in range(3):
            x[i] += w * ground.vertices[v, i]
            normal[i] += w * ground.normals[v, i]
    length = math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
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

    vertices: Array
    triangles: NDArray[np.int32]
    normals: Array
    _ordered: NDArray[np.int32] = field(init=False, repr=False)
    _first: NDArray[np.int64] = field(init=False, repr=False)
    _centres: Array = field(init=False, repr=False)
    _radii: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        clusters = _clusters(
            self.vertices[self.triangles].mean(axis=1), np.arange(len(self.triangles))
        )
        first = np.cumsum([0, *map(len, clusters)])
        starts = first[:-1]
        ordered = np.ascontiguousarray(self.triangles[np.concatenate(clusters)])
        corners = self.vertices[ordered]
        low = np.minimum.reduceat(corners.min(axis=1), starts)
        high = np.maximum.reduceat(corners.max(axis=1), starts)
        centres = (low + high) / 2
        own = np.repeat(centres, np.diff(first), axis=0)
        reach = np.linalg.norm(corners - own[:, None], axis=2).max(axis=1)
        object.__setattr__(self, "_ordered", ordered)
        object.__setattr__(self, "_first", first)
        object.__setattr__(self, "_centres", np.ascontiguousarray(centres.T))
        object.__setattr__(self, "_radii", np.maximum.reduceat(reach, starts))

    def project(self, position: Array) -> tuple[Array, Array, float]:
        """Nearest surface point (mm), its outward unit normal and the distance (mm)."""
        return self.locate(position, np.empty((len(self.vertices), 0)))[:3]

    def locate(self, position: Array, values: Array) -> tuple[Array, Array, float, Array]:
        """As ``project``, and the values (k,) there of fields given at the vertices, (v, k)."""
        x, normal, at = np.empty(3), np.empty(3), np.empty(values.shape[1])
        scratch = np.empty(len(self._radii) + 6)
        distance = locate(self.ground(values), position, scratch, x, normal, at)
        return x, normal, distance, at

    @property
    def clusters(self) -> int:
        """Number of balls that triangles are searched in."""
        return len(self._radii)

    def ground(self, values: Array) -> Ground:
        """For compiled code, with fields (v, k) given at the vertices."""
        return Ground(
            self.vertices,
            self._ordered,
            self.normals,
            self._first,
            self._centres,
            self._radii,
            np.ascontiguousarray(values),
        )

    def rim(self) -> NDArray[np.int64]:
        """Vertices on the border of the surface: ends of edges that belong to one triangle."""
        edges = np.sort(np.vstack([self.triangles[:, [i, (i + 1) % 3]] for i in range(3)]), axis=1)
        unique, count = np.unique(edges, axis=0, return_counts=True)
        return np.unique(unique[count == 1])


def _clusters(centres: Array, members: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Triangles in groups of neighbours, halved across the longest side until small enough."""
    if len(members) <= CLUSTER:
        return [members]
    extent = np.ptp(centres[members], axis=0)
    members = members[np.argsort(centres[members, np.argmax(extent)], kind="stable")]
    half = len(members) // 2
    return _clusters(centres, members[:half]) + _clusters(centres, members[half:])


def boundary_triangles(faces: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Boundary for drawing: node ids (s,) and triangles (t, 3) as indices into them."""
    if faces.shape[1] == 4:
        pattern = [(0, 1, 2), (0, 2, 3)]
    else:
        pattern = [(0, 4, 7), (4, 1, 5), (5, 2, 6), (6, 3, 7), (4, 5, 7), (5, 6, 7)]
    triangles = np.vstack([faces[:, p] for p in pattern])
    nodes, compact = np.unique(triangles, return_inverse=True)
    return nodes.astype(np.int32), compact.reshape(-1, 3).astype(np.int32)
