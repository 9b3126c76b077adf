"""Bodies in files that are made here, and scenes of them."""

import numpy as np
import pytest

from palpate.shared.scene import parse_scene

SCENE = """
name = "body"
tissue.law = "neo-hookean"
tissue.young = 15.0
tissue.poisson = 0.45
endoscope.radius = 4.0
endoscope.max_tilt = 30.0
load.max_indentation = 0.15
"""

BELOW = "z = [-100.0, -4.0]"
ABOVE = "z = [0.0, 100.0]"


def scene_of(folder, geometry, support=BELOW, surface=ABOVE):
    """A scene whose file lies in a folder."""
    tables = f"[geometry]\n{geometry}\n[support]\n{support}\n[surface]\n{surface}\n"
    return parse_scene(SCENE + tables, folder)


def ball(radius=10.0, subdivisions=2):
    trimesh = pytest.importorskip("trimesh")
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)


def bricks(counts=(3, 2, 2), size=(12.0, 8.0, 8.0)):
    """Points (p, 3) mm and hexahedra (h, 8) of a box whose lower corner is at the origin."""
    grid = np.stack(
        np.meshgrid(*[np.linspace(0, s, n + 1) for n, s in zip(counts, size, strict=True)],
                    indexing="ij"), axis=-1,
    )  # fmt: skip
    number = np.arange(grid[..., 0].size).reshape(grid.shape[:3])
    i, j, k = np.moveaxis(np.indices(counts), 0, -1).reshape(-1, 3).T
    corner = [
        (0, 0, 0),
        (1, 0, 0),
        (1, 1, 0),
        (0, 1, 0),
        (0, 0, 1),
        (1, 0, 1),
        (1, 1, 1),
        (0, 1, 1),
    ]
    cells = np.stack([number[i + a, j + b, k + c] for a, b, c in corner], axis=1)
    return grid.reshape(-1, 3), cells
