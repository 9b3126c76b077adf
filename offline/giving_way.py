"""Where tissue gives way within its load range: the range ends before that.

Near a fold of the load path a small error of the force is a large one of the displacement, and
between the folds of the full and of the reduced model the two lie on different branches: the one
kind of answer that is converged, in range and wrong.  The reduced model is quick enough to be
pressed everywhere, in all directions and a little beyond the range, and shows where its own path
turns; the full model's does so close by.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from tqdm import tqdm

from offline.sampling import cone, random_points_and_rim
from shared.atlas import Atlas
from shared.endoscope import pressure_limit

Array = NDArray[np.float64]

PATHS_PER_PATCH = 16

SHARES = np.linspace(0.6, 1.1, 11)
"""Of the limit at which each path is solved."""

SUDDEN = 1.0
"""Growth of the exponent of displacement over pressure from one step to the next: softening tissue
has up to .6, a jump by 5 % of the displacement 1."""

MARGIN = 1.1
"""Pressure at which the reduced model gives way over the limit: the full model's may be lower."""

REACH = 2.0
"""Distance (mm) from where tissue gives way up to which the limit is lowered."""

CLOSER = 24
"""More paths near each that gives way."""


def lowered_limits(atlas: Atlas, rng: np.random.Generator) -> Array:
    """The atlas's load range (v, LIMIT_FIELDS), lowered where its tissue gives way."""
    surface, limits = atlas.surface, atlas.limits.copy()
    vertices = cKDTree(surface.vertices)
    count = PATHS_PER_PATCH * len(atlas.models.centres)
    found = _giving_way(atlas, random_points_and_rim(surface, count, rng), count, rng)
    near = [rng.choice(vertices.query_ball_point(x, REACH), CLOSER) for x, _ in found]
    if near:
        closer = surface.vertices[np.concatenate(near)]
        found += _giving_way(atlas, closer, len(closer), rng)
    share = np.ones(len(limits))
    for x, bearable in found:
        lowered = vertices.query_ball_point(x, REACH)
        share[lowered] = np.minimum(share[lowered], bearable)
    limits[:, 0] *= share
    return limits


def _giving_way(
    atlas: Atlas, points: Iterable[Array], count: int, rng: np.random.Generator
) -> list[tuple[Array, float]]:
    """Contact points where tissue gives way in a random direction, and what is bearable there."""
    found = []
    for i, point in enumerate(tqdm(points, "giving way", count)):
        x, normal, _, fields = atlas.surface.locate(point, atlas.limits)
        direction = cone(normal, atlas.scene.endoscope.max_tilt, 1, rng, border=i % 2 == 0)[0]
        share = bearable_share(atlas, x, direction, pressure_limit(fields, normal, direction))
        if share < 1.0:
            found.append((x, share))
    return found


def bearable_share(atlas: Atlas, x: Array, direction: Array, limit: float) -> float:
    """Share of a pressure (kPa) up to which tissue yields gradually, with ``MARGIN``; at most 1."""
    moved = np.full(len(SHARES), np.nan)  # where it does not converge an answer says so itself
    for i, share in enumerate(SHARES):
        solution = atlas.solve(x, share * limit, direction)
        if solution.converged:
            moved[i] = sum(weight * np.linalg.norm(wide) for _, weight, wide in solution.patches)
    exponents = np.diff(np.log(moved)) / np.diff(np.log(SHARES))
    sudden = np.flatnonzero(np.diff(exponents) > SUDDEN)
    return float(SHARES[sudden[0] + 1]) / MARGIN if len(sudden) else 1.0
