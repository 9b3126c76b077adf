"""A half-space under the footprint, beside the point loads of Boussinesq and Cerruti."""

import math

import numpy as np
import pytest

from palpate.shared.mechanics.half_space import (
    CELL,
    DENT_ENDS,
    REACH,
    WIDE,
    dent,
    dented,
    half_space,
    local_field,
    pressed,
    whole_field,
)

POISSON = 0.4
AT = np.linspace(0.0, REACH, 11)
LOADS = pytest.mark.parametrize("load", [(1.0, 0.0), (0.0, 1.0)], ids=["pressure", "shear"])


@pytest.fixture(scope="module")
def tables():
    return half_space(POISSON, AT)


@pytest.fixture(scope="module")
def local():
    return local_field(POISSON)


def superposed(point, load):
    """Displacement times 2 mu by a sum of point loads (Johnson, Contact Mechanics, ch. 3)."""
    r, w = np.polynomial.legendre.leggauss(80)
    r, w = (r + 1) / 2, w / 2
    angle = np.arange(160) / 160 * 2 * math.pi
    force = np.outer(w * r * (1 - r**4) ** 2, np.full(160, 2 * math.pi / 160)) / (2 * math.pi)
    x = point[0] - np.outer(r, np.cos(angle))
    y = point[1] - np.outer(r, np.sin(angle))
    z, one = point[2], 1 - 2 * POISSON
    far = np.sqrt(x**2 + y**2 + z**2)
    if load[0]:
        side = z / far**3 - one / (far * (far + z))
        kernels = x * side, y * side, 2 * (1 - POISSON) / far + z**2 / far**3
    else:
        deep = far + z
        kernels = (
            1 / far + x**2 / far**3 + one * (1 / deep - x**2 / (far * deep**2)),
            x * y * (1 / far**3 - one / (far * deep**2)),
            x * (z / far**3 + one / (far * deep)),
        )
    return np.array([np.sum(force * kernel) for kernel in kernels])


def whole(table):
    """Tables as ``pressed`` takes them, of nothing above the surface."""
    above = np.zeros((len(table), round(1 / CELL), *table.shape[2:]))
    return np.concatenate([above, table], axis=1).reshape(len(table), -1)


def at(table, point, load):
    u, H = np.empty(3), np.empty((3, 3))
    pressed(table, *point, *load, u, H)
    return u, H


def stress(H):
    """Of a gradient times 2 mu."""
    return (H + H.T) / 2 + POISSON / (1 - 2 * POISSON) * np.trace(H) * np.eye(3)


@LOADS
@pytest.mark.parametrize("point", [(0.4, 0.3, 0.5), (1.2, -0.5, 0.75), (0.0, 0.0, 1.5)])
def test_displacement_is_that_of_point_loads(point, load):
    grid = np.arange(0.0, REACH, CELL)
    found, _ = at(whole(half_space(POISSON, grid)), point, load)
    np.testing.assert_allclose(found, superposed(point, load), rtol=2e-3, atol=1e-3)


@LOADS
def test_the_surface_carries_the_footprint_and_nothing_else(load):
    table = whole(half_space(POISSON, np.arange(0.0, REACH, CELL)))
    for r in (0.0, 0.5, 0.8, 1.3, 2.0):
        traction = -stress(at(table, (0.6 * r, 0.8 * r, 0.0), load)[1])[:, 2]
        expected = (1 - r**4) ** 2 if r < 1 else 0.0
        np.testing.assert_allclose(
            traction, [expected * load[1], 0.0, expected * load[0]], atol=1e-3
        )


def test_the_centre_moves_as_the_closed_forms_say(tables):
    mean = 1 - 2 / 5 + 1 / 9  # of the pressure along a radius
    assert tables[0, 0, 1, 0] == pytest.approx(2 * (1 - POISSON) * mean, rel=1e-4)
    assert tables[0, 0, 2, 0] == pytest.approx((2 - POISSON) * mean, rel=1e-4)


@LOADS
def test_forces_balance_in_the_half_space(load):
    table, step = whole(half_space(POISSON, np.arange(0.0, REACH, CELL))), 2 * CELL
    point, divergence = np.array([0.5, 0.0, 0.6]), np.zeros(3)
    for j, away in enumerate(step * np.eye(3)):
        change = stress(at(table, point + away, load)[1]) - stress(at(table, point - away, load)[1])
        divergence += change[:, j] / (2 * step)
    assert np.abs(divergence).max() < 0.01


@LOADS
@pytest.mark.parametrize("point", [(0.5, 0.4, 0.3), (-1.1, 0.6, 0.8), (0.2, -0.3, 2.0)])
def test_the_gradient_is_that_of_the_displacement(local, load, point):
    step, numeric = 0.05, np.empty((3, 3))
    for j, away in enumerate(step * np.eye(3)):
        numeric[:, j] = at(local, point + away, load)[0] - at(local, point - away, load)[0]
    found = at(local, point, load)[1]
    np.testing.assert_allclose(found, numeric / (2 * step), atol=0.01 * np.abs(found).max() + 2e-3)


@LOADS
def test_near_the_contact_it_differs_smoothly_from_the_half_space(local, tables, load):
    """By what a wide footprint of the same force does, and by nothing at the end of its reach."""
    u, _ = at(local, (0.0, 0.0, 0.0), load)
    n = 1 if load[0] else 2
    assert u[2 if load[0] else 0] == pytest.approx((1 - 1 / WIDE) * tables[0, 0, n, 0], rel=1e-6)
    for point in ((REACH, 0.0, 0.0), (0.0, 0.0, REACH), (1.8, 0.0, 1.8), (0.0, 0.5, -1.0)):
        u, H = at(local, point, load)
        assert np.abs(u).max() + np.abs(H).max() < 1e-12


def under_a_sphere(a, point):
    u, H = np.empty(3), np.empty((3, 3))
    dented(a, POISSON, *point, u, H)
    return u, H


@pytest.mark.parametrize("a", [0.1, 0.7])
def test_under_a_sphere_the_surface_carries_hertz_pressure_and_takes_its_shape(a):
    modulus, force = 1 / (1 - POISSON), 8 * math.pi / 15  # E* over 2 mu
    centre = under_a_sphere(a, (0.0, 0.0, 0.0))[0][2]
    for r in (0.0, 0.5 * a, 0.9 * a, 1.2 * a, 2.0):
        u, H = under_a_sphere(a, (0.6 * r, 0.8 * r, 0.0))
        expected = 1.5 * force / (math.pi * a**2) * math.sqrt(max(1 - (r / a) ** 2, 0.0))
        np.testing.assert_allclose(-stress(H)[:, 2], [0.0, 0.0, expected], atol=1e-3 * force / a**2)
        if r < a:  # of a sphere of radius 4 a^3 E* / 3 F
            assert centre - u[2] == pytest.approx(0.375 * force * r**2 / (a**3 * modulus), abs=1e-5)


@pytest.mark.parametrize("point", [(0.05, 0.02, 0.03), (0.5, 0.4, 0.3), (-1.1, 0.6, 0.8)])
def test_under_a_sphere_forces_balance_and_far_away_it_is_a_point_load(point):
    a, step, numeric, divergence = 0.1, 1e-4, np.empty((3, 3)), np.zeros(3)
    u, H = under_a_sphere(a, point)
    for j, away in enumerate(step * np.eye(3)):
        (ahead, more), (behind, less) = (
            under_a_sphere(a, np.add(point, side)) for side in (away, -away)
        )
        numeric[:, j] = (ahead - behind) / (2 * step)
        divergence += (stress(more) - stress(less))[:, j] / (2 * step)
    np.testing.assert_allclose(H, numeric, atol=1e-5 * np.abs(H).max())
    np.testing.assert_allclose(divergence, 0.0, atol=1e-4 * np.abs(H).max() / a)
    x, far, one = np.array(point), math.hypot(*point), 1 - 2 * POISSON
    side = x[2] / far**3 - one / (far * (far + x[2]))
    load = [x[0] * side, x[1] * side, 2 * (1 - POISSON) / far + x[2] ** 2 / far**3]
    if far > 5 * a:
        np.testing.assert_allclose(u, 4 / 15 * np.array(load), rtol=0.03)


def test_a_dent_is_what_a_sphere_does_more_than_a_footprint_and_ends():
    table = whole_field(POISSON)
    u, H = np.zeros(3), np.zeros((3, 3))
    dent(table, 0.2, POISSON, 0.3, 0.1, 0.4, 2.0, u, H)
    sphere, footprint = under_a_sphere(0.2, (0.3, 0.1, 0.4)), at(table, (0.3, 0.1, 0.4), (1.0, 0.0))
    np.testing.assert_allclose(u, 2 * (sphere[0] - footprint[0]), atol=1e-12)
    np.testing.assert_allclose(H, 2 * (sphere[1] - footprint[1]), atol=1e-12)
    before = u.copy()
    dent(table, 0.2, POISSON, 0.0, DENT_ENDS, 0.1, 2.0, u, H)
    np.testing.assert_array_equal(u, before)
    # just before the end it is small already, and its gradient is that of what fades
    point, step, numeric = np.array([1.1, 0.6, 0.7]), 0.05, np.empty((3, 3))
    for j, away in enumerate(step * np.eye(3)):
        ahead, behind = np.zeros((2, 3))
        dent(table, 0.2, POISSON, *(point + away), 1.0, ahead, H.copy())
        dent(table, 0.2, POISSON, *(point - away), 1.0, behind, H.copy())
        numeric[:, j] = (ahead - behind) / (2 * step)
    u[:], H[:] = 0.0, 0.0
    dent(table, 0.2, POISSON, *point, 1.0, u, H)
    np.testing.assert_allclose(H, numeric, atol=2e-3)
    assert np.abs(u).max() < 0.02 * np.abs(sphere[0]).max()
