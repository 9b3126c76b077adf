"""The footprint of the endoscope on surfaces whose answer is known."""

import math

import numpy as np
import pytest

from palpate.shared.mechanics.footprint import MEANS, SurfaceQuadrature, footprint, means

RADIUS = 2.0
DISC = 8 / 15 * math.pi * RADIUS**2  # pi R^2 times the mean of (1 - rho^4)^2 over the disc


def plane(size=10.0, cells=200, normal=(0.0, 0.0, 1.0)):
    """A flat square [0, size]^2 at z = 0, a midpoint rule, one node per cell."""
    ticks = (np.arange(cells) + 0.5) * size / cells
    x, y = (c.ravel() for c in np.meshgrid(ticks, ticks, indexing="ij"))
    count = len(x)
    return SurfaceQuadrature(
        points=np.column_stack([x, y, np.zeros(count)]),
        normals=np.tile(np.asarray(normal), (count, 1)),
        areas=np.full(count, (size / cells) ** 2),
        nodes=np.arange(count, dtype=np.int32)[:, None],
        shape=np.ones((count, 1)),
    )


def press(surface, x, normal=(0.0, 0.0, 1.0), radius=RADIUS):
    nodal = np.full(int(surface.nodes.max()) + 1, np.nan)
    area = footprint(surface, np.asarray(x, float), np.asarray(normal, float), radius, nodal)
    return area, nodal


MIDDLE = [5.0, 5.0, 0.0]


@pytest.mark.parametrize(
    ("surface", "case", "share"),
    [
        ({}, {}, 1.0),
        ({}, {"radius": RADIUS / 2}, 1 / 4),
        ({}, {"x": [0.0, 5.0, 0.0]}, 1 / 2),
        ({}, {"x": [10.0, 10.0, 0.0]}, 1 / 4),
        ({}, {"x": [-RADIUS, 5.0, 0.0]}, 0.0),
        ({}, {"normal": [0.6, 0.0, 0.8]}, 0.8),
        ({"normal": (0.0, 0.0, -1.0)}, {}, 0.0),
    ],
    ids=["flat", "half the radius", "edge", "corner", "beside", "inclined", "facing away"],
)
def test_area_is_that_of_the_profile_as_far_as_it_lies_on_the_surface(surface, case, share):
    whole = share in (0.8, 1.0)
    area = press(plane(**surface), **{"x": MIDDLE} | case)[0]
    assert area == pytest.approx(share * DISC, rel=1e-5 if whole else 1e-4, abs=0.0)


def test_area_is_the_sum_of_the_nodal_weights(rng):
    surface = plane(cells=20)
    nodes = rng.integers(0, 50, (400, 4)).astype(np.int32)
    surface = surface._replace(nodes=nodes, shape=rng.dirichlet(np.ones(4), 400))
    area, nodal = press(surface, [4.2, 5.3, 0.0])
    assert nodal.sum() == pytest.approx(area, rel=1e-13)


def test_force_acts_at_the_contact_point():
    surface = plane()
    area, nodal = press(surface, [4.23, 5.71, 0.0])
    assert nodal @ surface.points / area == pytest.approx([4.23, 5.71, 0.0], abs=2e-5)


def test_nothing_outside_the_footprint_is_loaded():
    surface = plane()
    _, nodal = press(surface, [4.0, 5.0, 0.0])
    distance = np.linalg.norm(surface.points - [4.0, 5.0, 0.0], axis=1)
    assert (nodal[distance >= RADIUS] == 0).all()
    assert (nodal[distance < 0.99 * RADIUS] > 0).all()


def test_load_is_smooth_in_the_contact_point():
    surface = plane()
    loads = np.array([press(surface, [x, 5.0, 0.0])[1] for x in np.linspace(4, 6, 41)])
    scale = np.linalg.norm(loads[0])
    steps = np.linalg.norm(np.diff(loads, axis=0), axis=1) / scale
    bends = np.linalg.norm(np.diff(loads, 2, axis=0), axis=1) / scale
    # Steps of 0.05 mm on R = 2 mm: first differences O(h/R), second ones O((h/R)^2), no kinks.
    assert steps.max() < 4 * 0.05 / RADIUS
    assert bends.max() < 20 * (0.05 / RADIUS) ** 2
    areas = [press(surface, [x, 5.0, 0.0])[0] for x in np.linspace(4, 6, 41)]
    assert np.ptp(areas) < 2e-5 * DISC


def test_load_fades_in_smoothly_over_the_rim():
    areas = [press(plane(), [x, 5.0, 0.0])[0] for x in np.linspace(-2, 2, 41)]
    assert (np.diff(areas) >= 0).all()
    assert areas[0] == 0.0
    assert areas[-1] == pytest.approx(DISC, rel=1e-5)


@pytest.mark.parametrize("x", [[5.0, 5.0, 0.0], [9.2, 5.3, 0.0]], ids=["inside", "at an edge"])
def test_means_change_with_the_place_as_their_derivatives_say(x):
    surface, normal = plane(), np.array([0.0, 0.0, 1.0])
    tangents, flat = np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0]]), np.zeros((2, 2))
    field = np.sin(surface.points[:, 0]) * np.cos(0.7 * surface.points[:, 1])

    def found(shift=(0.0, 0.0)):
        nodal = np.empty((MEANS, len(surface.points)))
        means(surface, np.array(x) + shift @ tangents, normal, tangents, flat, RADIUS, nodal)
        return nodal @ field

    area, nodal = press(surface, x)
    mean, one, two, *second = found(np.zeros(2))
    assert mean == pytest.approx(nodal @ field / area, rel=1e-12)
    h = 0.05
    for axis, slope in ((0, one), (1, two)):
        step = h * np.eye(2)[axis]
        ahead, behind = found(step), found(-step)
        assert slope == pytest.approx((ahead[0] - behind[0]) / (2 * h), abs=2e-3)
        for other in (0, 1):
            expected = (ahead[1 + other] - behind[1 + other]) / (2 * h)
            assert second[axis + other] == pytest.approx(expected, abs=1e-2)
