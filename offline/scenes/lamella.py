"""A bony lamella in the turbinate, assumed: ``inferior_turbinate_lamella.stl``.

The image that the turbinate was segmented from does not show its bone.  What lies deeper than two
millimetres below its surface, smoothed, stands for it: a plate along the axis.
``python -m palpate.offline.scenes.lamella`` writes the file anew (needs PyVista).
"""

from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from palpate.offline.bodies.files import require

DEEP, SMOOTH, STEP = 2.0, 1.0, 0.75
"""Millimetres below the surface, of the Gauss filter, and between the points of the grid."""

FOLDER = Path(__file__).parent


def write(path: Path) -> None:
    """Write the surface as binary STL."""
    pv = require("pyvista")
    body = pv.read(FOLDER / "inferior_turbinate_left.stl")
    low, high = (np.array(body.bounds[side::2]) for side in (0, 1))
    counts = np.ceil((high - low) / STEP).astype(int) + 3
    grid = pv.ImageData(dimensions=counts, spacing=(STEP,) * 3, origin=low - STEP)
    gap = grid.compute_implicit_distance(body)["implicit_distance"].reshape(counts, order="F")
    grid["level"] = gaussian_filter(gap, SMOOTH / STEP).ravel(order="F")
    surface = grid.contour([-DEEP], scalars="level", method="flying_edges")
    surface.extract_largest().clean().save(path)


if __name__ == "__main__":
    write(FOLDER / "inferior_turbinate_lamella.stl")
