"""The body's boundary as triangles: where a queried position lands and which way is out."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

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


@njit(cache=True, error_model="numpy", nogil=True)
def _project(vertices, triangles, centres, radii, p, weights, trial):
    """Nearest triangle and barycentric ``weights`` there; returns (triangle, distance)."""
    best, nearest = np.inf, -1
    for t in range(len(triangles)):
        dx, dy, dz = p[0] - centres[t, 0], p[1] - centres[t, 1], p[2] - centres[t, 2]
        bound = best + radii[t]
        if dx * dx + dy * dy + dz * dz >= bound * bound:
            continue
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        _closest_on_triangle(p, vertices[a], vertices[b], vertices[c], trial)
        distance = 0.0
        for i in range(3):
            x = trial[0] * vertices[a, i] + trial[1] * vertices[b, i] + trial[2] * vertices[c, i]
            distance += (p[i] - x) ** 2
        distance = math.sqrt(distance)
        if distance < best:
            best, nearest = distance, t
            weights[:] = trial
    return nearest, best


@njit(cache=True, error_model="numpy", nogil=True)
def _locate(vertices, triangles, normals, centres, radii, values, p, x, normal, at):
    """Write the projection of p, the normal and the values ``at`` it; return the distance."""
    weights, trial = np.empty(3), np.empty(3)
    t, distance = _project(vertices, triangles, centres, radii, p, weights, trial)
    x[:] = 0.0
    normal[:] = 0.0
    at[:] = 0.0
    for corner in range(3):
        v, w = triangles[t, corner], weights[corner]
        for k in range(len(at)):
            at[k] += w * values[v, k]
        for i in range(3):
            x[i] += w * vertices[v, i]
            normal[i] += w * normals[v, i]
    normal /= math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
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
    _centres: Array = field(init=False, repr=False)
    _radii: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        corners = self.vertices[self.triangles]
        centres = corners.mean(axis=1)
        radii = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
        object.__setattr__(self, "_centres", centres)
        object.__setattr__(self, "_radii", radii)

    def project(self, position: Array) -> tuple[Array, Array, float]:
        """Nearest surface point (mm), its outward unit normal and the distance (mm)."""
        return self.locate(position, np.empty((len(self.vertices), 0)))[:3]

    def locate(self, position: Array, values: Array) -> tuple[Array, Array, float, Array]:
        """As ``project``, and the values (k,) there of fields given at the vertices, (v, k)."""
        x, normal, at = np.empty(3), np.empty(3), np.empty(values.shape[1])
        distance = _locate(
            self.vertices,
            self.triangles,
            self.normals,
            self._centres,
            self._radii,
            values,
            position,
            x,
            normal,
            at,
        )
        return x, normal, distance, at

    def rim(self) -> NDArray[np.int64]:
        """Vertices on the border of the surface: ends of edges that belong to one triangle."""
        edges = np.sort(np.vstack([self.triangles[:, [i, (i + 1) % 3]] for i in range(3)]), axis=1)
        unique, count = np.unique(edges, axis=0, return_counts=True)
        return np.unique(unique[count == 1])


def boundary_triangles(faces: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Boundary for drawing: node ids (s,) and triangles (t, 3) as indices into them."""
    if faces.shape[1] == 4:
        pattern = [(0, 1, 2), (0, 2, 3)]
    else:
        pattern = [(0, 4, 7), (4, 1, 5), (5, 2, 6), (6, 3, 7), (4, 5, 7), (5, 6, 7)]
    triangles = np.vstack([faces[:, p] for p in pattern])
    nodes, compact = np.unique(triangles, return_inverse=True)
    return nodes.astype(np.int32), compact.reshape(-1, 3).astype(np.int32)
