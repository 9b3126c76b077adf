"""A half-space under the footprint, beside the point loads of Boussinesq and Cerruti."""

import math

import numpy as np
import pytest

from palpate.shared.mechanics.half_space import CELL, REACH, WIDE, half_space, local_field, pressed

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
