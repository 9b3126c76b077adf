"""The load on the turbinate is a smooth function of the contact point, faces' edges included."""

import numpy as np
import pytest

from palpate.offline.fem.mesh import accessible_surface, build_mesh
from palpate.offline.scenes import find_scene
from palpate.shared.geometry.quadrature import LOAD_SPACING, surface_quadrature
from palpate.shared.mechanics.footprint import footprint

STEP = 0.05  # mm
RADIUS = 2.0  # mm


@pytest.fixture(scope="module")
def turbinate():
    mesh = build_mesh(find_scene("turbinate-paper"))
    return mesh, accessible_surface(mesh)


def loads(turbinate, path, spacing=LOAD_SPACING):
    """Nodal weights (steps, nodes) along a path of positions."""
    mesh, surface = turbinate
    quadrature = surface_quadrature(mesh.nodes, mesh.faces, spacing)
    nodal = np.empty((len(path), len(mesh.nodes)))
    for row, position in zip(nodal, path, strict=True):
        x, normal, _ = surface.project(position)
        footprint(quadrature, x, normal, RADIUS, row)
    return nodal


def path(start, axis, steps):
    return np.array(start) + STEP * np.arange(steps)[:, None] * np.eye(3)[axis]


PATHS = {
    "along the nose": path((10.2, 15.0, 11.0), 1, 200),
    "across the medial side": path((10.3, 17.3, 5.0), 2, 160),
    "off the posterior end": path((10.2, 0.0, 9.0), 1, 80),
}


@pytest.mark.parametrize("path", PATHS.values(), ids=PATHS)
def test_no_jump_no_kink_and_quadrature_is_fine_enough(turbinate, path):
    nodal = loads(turbinate, path)
    scale = np.linalg.norm(nodal, axis=1).max()
    steps = np.linalg.norm(np.diff(nodal, axis=0), axis=1) / scale
    bends = np.linalg.norm(np.diff(nodal, 2, axis=0), axis=1) / scale
    # A smooth load moves by about STEP / RADIUS and turns by its square; a jump or a kink would
    # show in the second differences at the size of the first ones.
    assert steps.max() < 2 * STEP / RADIUS
    assert bends.max() < 0.2 * steps.max()
    fine = loads(turbinate, path[::7], spacing=0.1)
    error = np.linalg.norm(nodal[::7] - fine, axis=1) / np.linalg.norm(fine, axis=1)
    assert error.max() < 0.01
