"""The contact potential of the rigid tip: its derivatives, and who feels it."""

import numpy as np
import pytest

from palpate.offline.fem.sphere import (
    FORCE,
    SPACING,
    STIFFNESS,
    penalty,
    room_for,
    sphere_of,
    sphere_surface,
    touch,
)
from palpate.shared.geometry.elements import FACES, QUAD_CORNERS

from ...shared.mechanics.material_point import rotation

TIP = sphere_of(2.0, 15.0)


def plate(kind=8):
    """Squares of the plane z = 0, 2 mm wide each, outward normal +z, and their surface.

    Four, of faces of so many nodes; each of two triangles where they have six.
    """
    own = FACES[kind].nodes
    pieces = [2 * own - 1, 1 - 2 * own] if kind == 6 else [own]
    corners = [np.add(piece, [x, y]) for x in (-1, 1) for y in (-1, 1) for piece in pieces]
    nodes, faces = np.unique(np.vstack(corners).round(9), axis=0, return_inverse=True)
    nodes = np.column_stack([nodes, np.zeros(len(nodes))])
    faces = faces.reshape(len(corners), -1).astype(np.int32)
    return nodes, faces, surface_of(nodes, faces)


def surface_of(nodes, faces):
    return sphere_surface(nodes, faces, np.ones(len(faces), bool), TIP.radius)


def pressed(surface, x, moved, wanted=FORCE):
    """Energy, its gradient in the nodes, the force on the tool, and what touches."""
    touching = room_for(surface, len(surface.faces))
    near = np.arange(len(surface.faces), dtype=np.int32)
    count, energy, deepest = touch(TIP, surface, near, x, moved, touching, wanted)
    gradient = np.zeros_like(moved)
    np.subtract.at(gradient, surface.faces[touching.face[:count]], touching.force[:count])
    return energy, gradient, gradient.sum(axis=0), deepest, touching


def slope(function, h):
    near, far = function(h) - function(-h), function(2 * h) - function(-2 * h)
    return (8 * near - far) / (12 * h)


def test_the_penalty_is_twice_continuously_differentiable():
    d = np.linspace(-0.5, 3, 701) * TIP.onset
    value, force, stiffness = np.array([penalty(TIP, x) for x in d]).T
    h = 1e-4 * TIP.onset
    for x, p, k in zip(d, force, stiffness, strict=True):
        assert slope(lambda s, x=x: penalty(TIP, x + s)[0], h) == pytest.approx(
            p, rel=1e-6, abs=1e-6 * force.max()
        )
        assert slope(lambda s, x=x: penalty(TIP, x + s)[1], h) == pytest.approx(
            k, rel=1e-6, abs=1e-3 * TIP.stiffness
        )
    assert (value[d <= 0] == 0).all()
    assert np.abs(np.diff(stiffness)).max() <= 1.01 * TIP.stiffness * (d[1] - d[0]) / TIP.onset


@pytest.mark.parametrize("kind", [4, 8, 6])
def test_force_and_stiffness_are_derivatives_of_the_energy(kind, rng):
    nodes, faces, surface = plate(kind)
    moved = 0.02 * rng.standard_normal(nodes.shape)
    x = np.array([0.13, -0.21, 1.9])
    _, gradient, reaction, deepest, touching = pressed(surface, x, moved, STIFFNESS)
    assert deepest > 0.05
    direction, away = rng.standard_normal(nodes.shape), rng.standard_normal(3)

    def along(s):
        return pressed(surface, x + s * away, moved + s * direction)

    h = 1e-5
    expected = slope(lambda s: along(s)[0], h)
    assert np.sum(gradient * direction) - reaction @ away == pytest.approx(expected, rel=1e-7)
    K = touching.stiffness
    change = np.zeros_like(moved)
    for c in range(touching.touched[0]):
        own = faces[touching.face[c]]
        for i in range(3):
            for j in range(3):
                block = K[c, min(i, j), max(i, j)]
                change[own, i] += block @ (direction[own, j] - away[j])
    error = change - slope(lambda s: along(s)[1], h)
    assert np.abs(error).max() <= 1e-6 * np.abs(change).max()


@pytest.mark.parametrize("kind", [4, 8, 6])
def test_the_blocks_that_are_not_looked_at_are_not_touched(kind, rng):
    nodes, _, surface = plate(kind)
    everywhere = surface._replace(reach=np.full_like(surface.reach, np.inf))
    for _ in range(20):
        bend = rng.uniform(-0.5, 0.5, 2)  # 1/mm
        moved = 0.03 * rng.standard_normal(nodes.shape)
        moved[:, 2] += nodes[:, :2] ** 2 @ bend / 2
        x = np.array([*rng.uniform(-1.5, 1.5, 2), 1.95 + np.abs(bend).max()])
        _, near, _, deepest, _ = pressed(surface, x, moved)
        assert np.array_equal(near, pressed(everywhere, x, moved)[1])
        assert deepest > 0 or not near.any()


def test_the_force_does_not_depend_on_the_frame(rng):
    nodes, faces, surface = plate()
    moved = 0.02 * rng.standard_normal(nodes.shape)
    x = np.array([0.3, 0.1, 1.9])
    Q = rotation(rng)
    energy, _, force, _, _ = pressed(surface, x, moved)
    turned = pressed(surface_of(nodes @ Q.T, faces), Q @ x, moved @ Q.T)
    assert turned[0] == pytest.approx(energy, rel=1e-9)
    np.testing.assert_allclose(turned[2], Q @ force, rtol=1e-9, atol=1e-9 * np.abs(force).max())


def test_on_a_rigid_plane_the_force_is_known():
    nodes, _, surface = plate()
    depth = 0.05
    *_, force, deepest, _ = pressed(surface, np.array([0, 0, 1.95]), 0 * nodes)
    # the pressure in the depth d(r) = depth - r^2 / 2R, integrated over the disc
    expected = 2 * np.pi * TIP.radius * penalty(TIP, depth)[0]
    assert force[2] == pytest.approx(expected, rel=0.04)
    off = SPACING * TIP.radius / np.sqrt(2)  # the nearest point may be so far off
    assert TIP.radius - np.hypot(TIP.radius - depth, off) <= deepest + 1e-12 <= depth
    assert np.abs(force[:2]).max() < 1e-9 * force[2]


def test_a_tip_out_of_reach_or_behind_is_not_felt():
    nodes, _, surface = plate()
    for x in ([0, 0, 2.0001], [0, 0, -1.9], [9.0, 0, 1.0]):  # above, behind the wall, beside
        assert pressed(surface, np.array(x), 0 * nodes)[0] == 0.0


@pytest.mark.parametrize(("degrees", "goes_on"), [(30, True), (60, False)])
def test_the_surface_goes_on_round_a_blunt_edge_only(degrees, goes_on):
    nodes, faces, _ = plate()
    bent, (x, _, z), angle = nodes.copy(), nodes.T, np.radians(degrees)
    bent[:, ::2] = np.where(x > 0, [x * np.cos(angle), -x * np.sin(angle)], [x, z]).T
    accessible = bent[faces].mean(axis=1)[:, 0] < 0
    surface = sphere_surface(bent, faces, accessible, TIP.radius)
    assert len(surface.faces) == (4 if goes_on else 2)


def test_the_surface_goes_on_as_far_as_a_radius_of_the_tip():
    corners = [np.add(QUAD_CORNERS, [2.0 * i, 0.0]) / 2.0 for i in range(8)]  # 1 mm wide each
    nodes, faces = np.unique(np.vstack(corners).round(9), axis=0, return_inverse=True)
    nodes, faces = np.column_stack([nodes, np.zeros(len(nodes))]), faces.reshape(8, 4)
    surface = sphere_surface(nodes, faces.astype(np.int32), np.arange(8) < 2, TIP.radius)
    assert len(surface.faces) == 4
