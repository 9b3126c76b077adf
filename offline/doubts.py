"""What a scene may say and most likely does not mean: other units, sizes that do not fit."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from palpate.offline.fem.section import bulge, read_outline
from palpate.shared.arrays import Array
from palpate.shared.scene import Extrusion, Scene

SMALLEST, LARGEST = 2.0, 1000.0
"""Sizes of a body, mm."""

SOFTEST, STIFFEST = 0.1, 1000.0
"""Young's moduli of soft tissue, kPa: brain has one, cartilage some hundreds."""

SLENDEREST = 0.01
"""Radius of a tip over the size of the body; a liver's is a thirtieth."""

BULGE = 0.02
"""How far a smooth outline strays from the lines between its points, over its extent."""

SLIGHT = 2.0
"""Largest tilt, degrees, that may be one in radians."""


def doubts(scene: Scene, nodes: Array) -> Iterator[str]:
    """Say what to look at once more of a scene with nodes (n, 3) mm of its body, key by key."""
    sizes = np.ptp(nodes, axis=0)
    body = " x ".join(f"{size:.3g}" for size in sizes) + " mm"
    if not SMALLEST <= sizes.max() <= LARGEST:
        yield f"geometry: a body of {body}; lengths are in mm"
    young, radius, tilt = scene.tissue.young, scene.endoscope.radius, scene.endoscope.max_tilt
    if not SOFTEST <= young <= STIFFEST:
        yield f"tissue.young = {young:g}: soft tissue has {SOFTEST:g} to {STIFFEST:g} kPa"
    if 2.0 * radius > np.median(sizes):
        yield f"endoscope.radius = {radius:g}: its tip is wider than the body of {body}"
    if radius < SLENDEREST * sizes.max():
        yield f"endoscope.radius = {radius:g}: its tip is tiny beside the body of {body}"
    if 0.0 < tilt < SLIGHT:
        yield f"endoscope.max_tilt = {tilt:g}: angles are in degrees"
    if isinstance(scene.geometry, Extrusion) and scene.folder is not None:
        yield from _bulges(scene.folder / scene.geometry.section)


def _bulges(file: Path) -> Iterator[str]:
    """Say where the smooth outline of a section is another one than its points may mean."""
    points = read_outline(file)
    gap, (x, z) = bulge(points)
    if gap > BULGE * np.ptp(points, axis=0).max():
        yield (
            f"geometry.section: the smooth curve through its {len(points)} points strays {gap:.2g} "
            f"mm from the straight lines between them, near ({x:.3g}, {z:.3g}); give more points "
            "there"
        )
