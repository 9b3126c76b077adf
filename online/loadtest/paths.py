"""Where a tool goes: over the whole accessible surface, in and out of contact, fast as a hand."""

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from palpate.online.serve.schemas import Accessible
from palpate.shared.arrays import Array

SPEED = 50.0
"""Largest speed of the tip, mm/s: a hand in a hurry."""

STEP = 0.05
"""Spacing of the points of a path, mm."""

SMOOTHING = 1.0
"""Standard deviation, mm along the path, of the filter that rounds the mesh's corners off."""

WAVE = 12.0
"""Way over the surface from one lifting of the tip to the next, mm."""

LIFTED = 1.0
"""How far the tip is lifted, mm."""


def tool_path(
    surface: Accessible, radius: float, depth: float, times: Array, rng: np.random.Generator
) -> Array:
    """Move a tip over a surface; return its centre (n, 3) mm at `times` (n,) s, from 0 upwards.

    It goes the shortest way from one random vertex to the next, `LIFTED` above the surface and
    `depth` below it in turn (mm), and slows down and speeds up between a tenth of `SPEED` and all
    of it.
    """
    period, phase = 5.0, rng.uniform(0.0, 2 * np.pi)
    # The integral of SPEED (0.55 - 0.45 cos(2 pi t / period + phase)).
    angle = 2 * np.pi * times / period + phase
    way = SPEED * (0.55 * times - 0.45 * period / (2 * np.pi) * (np.sin(angle) - np.sin(phase)))
    feet, normals = _walk(surface, float(way[-1]), rng)
    along = _lengths(feet)
    swing = np.sin(2 * np.pi * along / WAVE + rng.uniform(0.0, 2 * np.pi))
    below = (depth - LIFTED) / 2 + (depth + LIFTED) / 2 * swing
    centres = feet + (radius - below)[:, None] * normals
    return make_interp_spline(_lengths(centres), centres, 1)(way)


def _walk(surface: Accessible, length: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Walk over a surface so far that a tip above it has gone at least `length` mm.

    Returns points (k, 3) mm about `STEP` apart, smoothed, and the unit normals there.
    """
    vertices = surface.vertices.astype(np.float64)
    edges = np.vstack([surface.triangles[:, [i, (i + 1) % 3]] for i in range(3)])
    weights = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    graph = coo_array((weights, edges.T), (len(vertices), len(vertices))).tocsr()
    # Where the surface is hollow the tip takes a shorter way than its foot.
    way = [int(rng.integers(len(vertices)))]
    walked = 0.0
    while walked < 2.0 * length + 4 * WAVE:
        distance, before = dijkstra(graph, False, way[-1], return_predecessors=True)
        target = int(rng.choice(np.flatnonzero(np.isfinite(distance))))
        walked += float(distance[target])
        leg = [target]
        while leg[-1] != way[-1]:
            leg.append(int(before[leg[-1]]))
        way += leg[-2::-1]
    along = _lengths(vertices[way])
    at = np.arange(0.0, along[-1], STEP)
    points, normals = (
        gaussian_filter1d(make_interp_spline(along, field[way], 1)(at), SMOOTHING / STEP, axis=0)
        for field in (vertices, surface.normals)
    )
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _lengths(points: Array) -> Array:
    """Length of a polyline from its start to each of its points."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
