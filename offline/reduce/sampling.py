"""Space-filling points and loads on a surface."""

import math
from collections.abc import Iterator

import numpy as np

from palpate.shared.arrays import Array
from palpate.shared.geometry.surface import Surface
from palpate.shared.scene import SceneError, Tolerance

MOST_POINTS = 20_000
"""Local models, or points of the load range, of one scene."""

CANDIDATES = 20
"""Random candidates per point wanted, from which the farthest are taken."""


def triangle_areas(surface: Surface) -> Array:
    """Areas (t,) of the triangles of a surface, mm^2."""
    a, b, c = np.moveaxis(surface.vertices[surface.triangles], 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def random_points(surface: Surface, count: int, rng: np.random.Generator) -> Array:
    """Points uniform over the surface, (count, 3) mm."""
    areas = triangle_areas(surface)
    triangle = rng.choice(len(areas), count, p=areas / areas.sum())
    r, s = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1 - r, r * (1 - s), r * s], axis=1)
    return np.einsum("pc,pci->pi", weights, surface.vertices[surface.triangles[triangle]])


def random_points_and_rim(
    surface: Surface, count: int, rng: np.random.Generator
) -> Iterator[Array]:
    """As ``random_points``, one by one, but one in four, the first among them, is on the rim."""
    points, rim = random_points(surface, count, rng), surface.rim()
    for i, point in enumerate(points):
        yield surface.vertices[rng.choice(rim)] if i % 4 == 0 else point


def spread_points(surface: Surface, count: int, rng: np.random.Generator) -> Array:
    """Points that fill the surface evenly, its rim included, (count, 3) mm.

    Farthest-point sampling among the vertices and random points.
    """
    candidates = np.vstack([surface.vertices, random_points(surface, CANDIDATES * count, rng)])
    return candidates[farthest(candidates, count)]


def farthest(points: Array, count: int) -> list[int]:
    """Indices of so many of the points (n, 3), each as far from the earlier ones as can be."""
    chosen = [int(np.argmin(points.sum(axis=1)))]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return chosen


def fewer(count: int, tolerance: Tolerance) -> int:
    """Samples to learn from, of ``count`` for the usual tolerance.

    What n samples tell is uncertain by the root of n: a looser tolerance needs fewer, but the root
    of its looseness is all that is saved, for it may be uncertain, not wrong.
    """
    return math.ceil(count / math.sqrt(tolerance.looseness))


def spacing_count(surface: Surface, spacing: float, key: str = "endoscope.radius") -> int:
    """How many points have the given mean spacing (mm) on the surface (hexagonal packing).

    Raises ``SceneError`` with the key of a scene that sets it if they are more than anybody waits
    for.
    """
    area = float(triangle_areas(surface).sum())
    count = max(1, round(area * 2 / (math.sqrt(3) * spacing**2)))
    if count > MOST_POINTS:
        raise SceneError(
            f"{key}: the accessible surface, {area:.3g} mm^2, would take {count} points "
            f"{spacing:.3g} mm apart, and at most {MOST_POINTS} are worked with; what a scene does "
            "not say of its training is in proportion to endoscope.radius"
        )
    return count


def cone(
    normal: Array, tilt: float, count: int, rng: np.random.Generator, border: bool = False
) -> Array:
    """Unit directions (count, 3) in the cone of ``tilt`` degrees round -normal or on its border."""
    share = np.ones(count) if border else rng.random(count)
    cosine = 1 - share * (1 - math.cos(math.radians(tilt)))
    sine, turn = np.sqrt(1 - cosine**2), 2 * math.pi * rng.random(count)
    t, b = tangents(normal)
    return -cosine[:, None] * normal + sine[:, None] * (
        np.cos(turn)[:, None] * t + np.sin(turn)[:, None] * b
    )


def random_tangent(normal: Array, rng: np.random.Generator) -> Array:
    """A random unit vector (3,) square to a normal."""
    return cone(normal, 90.0, 1, rng, border=True)[0]


def tangents(normal: Array) -> tuple[Array, Array]:
    """Two unit vectors that complete ``normal`` to an orthonormal frame."""
    x, y, z = normal.tolist()  # since np.cross takes ten times as long, and is asked for each load
    square = ((0.0, z, -y), (-z, 0.0, x), (y, -x, 0.0))[np.argmin(np.abs(normal))]
    t = np.array(square) / np.linalg.norm(square)
    a, b, c = t.tolist()
    return t, np.array([y * c - z * b, z * a - x * c, x * b - y * a])
