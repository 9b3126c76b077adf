"""A liver of our own making, of the size and about the form of one: ``liver.stl``.

Two lobes, hollowed out below, are a level of a sum of Gaussians; smaller ones at random places make
it uneven.  What lies deeper than five millimetres is in ``liver_parenchyma.stl``: what is above
stands for the capsule and the tissue that it holds.  ``python -m palpate.offline.scenes.liver``
writes both files anew (needs PyVista).
"""

from pathlib import Path

import numpy as np

from palpate.offline.bodies.files import require
from palpate.shared.arrays import Array

SEED, STEP = 21, 5.0
"""Of the random ones; mm between the points of the grid."""

LOBES = [
    # centre and standard deviations, mm, and height
    ((34.0, 0.0, 2.0), (31.0, 31.0, 36.0), 1.0),
    ((-4.0, 8.0, 14.0), (30.0, 24.0, 22.0), 0.75),
    ((-42.0, 14.0, 20.0), (26.0, 19.0, 14.0), 0.65),
    ((-8.0, -6.0, -34.0), (34.0, 26.0, 20.0), -0.55),
]
BUMPS, BUMP, UNEVEN = 24, 14.0, 0.08
LEVEL = 0.42

CAPSULE = 5.0
"""Millimetres of tissue that the capsule stiffens."""


def level(points: Array) -> Array:
    """The sum of Gaussians at points (n, 3) mm."""
    rng = np.random.default_rng(SEED)
    found = np.zeros(len(points))
    for centre, widths, height in LOBES:
        found += height * np.exp(-0.5 * np.sum(((points - centre) / widths) ** 2, axis=1))
    for _ in range(BUMPS):
        at = rng.uniform([-80.0, -50.0, -50.0], [90.0, 50.0, 60.0])
        away = np.sum((points - at) ** 2, axis=1) / BUMP**2
        found += rng.uniform(-UNEVEN, UNEVEN) * np.exp(-0.5 * away)
    return found


def write(folder: Path) -> None:
    """Write both surfaces as binary STL."""
    pv = require("pyvista")
    low, high = np.array([-120.0, -80.0, -90.0]), np.array([120.0, 90.0, 90.0])
    counts = np.rint((high - low) / STEP).astype(int) + 1
    grid = pv.ImageData(dimensions=counts, spacing=(STEP,) * 3, origin=low)
    grid["level"] = level(np.array(grid.points))
    body = grid.contour([LEVEL], scalars="level", method="flying_edges").extract_largest().clean()
    body.save(folder / "liver.stl")
    gap = grid.compute_implicit_distance(body)
    inner = gap.contour([-CAPSULE], scalars="implicit_distance", method="flying_edges")
    inner.extract_largest().clean().save(folder / "liver_parenchyma.stl")


if __name__ == "__main__":
    write(Path(__file__).parent)
