"""Kinks of a surface are smoothed as a tip feels them; sharp edges stay."""

from types import SimpleNamespace

import numpy as np
import pytest

from palpate.offline.fem.mesh import accessible_surface
from palpate.offline.fem.smooth import smoothed
from palpate.shared.mechanics.tip import CURVED_WITHIN, bend, tangents_of

from .test_tetrahedra import ball

RADIUS = 2.0


def roof(degrees):
    """A surface that turns by an angle along y, and the mesh that it is of."""
    x, y = np.meshgrid(np.linspace(-2.0, 2.0, 33), np.linspace(-2.0, 2.0, 33), indexing="ij")
    nodes = np.stack([x, y, -np.tan(np.radians(degrees / 2)) * np.abs(x)], axis=-1).reshape(-1, 3)
    number = np.arange(33 * 33).reshape(33, 33)
    corners = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.stack(corners, axis=-1).reshape(-1, 4).astype(np.int32)
    mesh = SimpleNamespace(nodes=nodes, faces=faces, accessible=np.ones(len(faces), bool))
    return accessible_surface(mesh), mesh


def felt_deeper(surface, x, degrees, depth):
    """By how much a tip feels deeper (mm) than where it is; see ``fem.smooth``."""
    curvature = surface.curvature(CURVED_WITHIN * RADIUS, np.empty((0, 6)))
    foot, normal, _, bent = surface.locate(np.array(x), curvature)
    tangents, along = np.empty((2, 3)), np.empty((2, 2))
    tangents_of(normal, tangents)
    a = np.sqrt(depth / bend(bent, tangents, RADIUS, along))
    around, share = np.meshgrid(np.linspace(0, 2 * np.pi, 65)[:-1], (np.arange(40) + 0.5) / 40)
    r = a * np.sqrt(1.0 - (1.0 - share.ravel()) ** 2)  # of equal force of a flat punch
    s = r * np.array([np.cos(around.ravel()), np.sin(around.ravel())])
    top = foot + s.T @ tangents
    height = -(np.tan(np.radians(degrees / 2)) * np.abs(top[:, 0]) + top[:, 2]) * normal[2]
    return np.mean(height + 0.5 * np.einsum("an,ab,bn->n", s, along, s))


@pytest.mark.parametrize(("depth", "share"), [(0.1, 0.2), (0.2, 0.6)])
def test_a_tip_feels_a_kink_nearly_as_deep_as_it_is(depth, share):
    """On faces that meet at 20 degrees it was off by 11 um in root mean square."""
    rough, mesh = roof(20.0)
    smooth, places = smoothed(rough, mesh, RADIUS), [(x, 0.03, 0.0) for x in (0.0, 0.15, 0.3, 0.5)]
    before, after = (
        np.sqrt(np.mean([felt_deeper(one, x, 20.0, depth) ** 2 for x in places]))
        for one in (rough, smooth)
    )
    assert before > 0.01
    assert after < share * before


def test_a_plane_and_a_sharp_edge_stay_where_they_are():
    for degrees in (0.0, 60.0):
        surface, mesh = roof(degrees)
        after = smoothed(surface, mesh, RADIUS)
        np.testing.assert_allclose(after.vertices, surface.vertices, atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(after.normals, axis=1), 1.0, atol=1e-12)


def test_a_ball_stays_round():
    smooth = smoothed(accessible_surface(ball()), ball(), 0.5)
    np.testing.assert_allclose(np.linalg.norm(smooth.vertices, axis=1), 1.0, atol=2e-3)
    assert np.sum(smooth.vertices * smooth.normals, axis=1).min() > 0.998
