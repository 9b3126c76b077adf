"""Where the tissue gives way, on a plate whose answer to a load is known."""

from types import SimpleNamespace

import numpy as np
import pytest

from palpate.offline.reduce.limit_points import (
    FAR,
    MARGIN,
    REACH,
    SLIP_REACH,
    limit_load_share,
    lowered_depths,
    lowered_limits,
    path_independent_share,
)
from palpate.shared.errors import QueryError
from palpate.shared.geometry.surface import Surface
from palpate.shared.mechanics.footprint import LIMIT_FIELDS, TIP_DEPTH
from palpate.shared.model import ReducedModel

LIMIT = 2.0

RADIUS = 2.0

EDGE = 5.0


class Plate:
    """Softening tissue of a flat surface, 10 mm wide, that snaps at a pressure near one corner."""

    def __init__(self, snap):
        x = np.linspace(0.0, 10.0, 21)
        corners = np.arange(21 * 21).reshape(21, 21)
        a, b = corners[:-1, :-1].ravel(), corners[1:, :-1].ravel()
        c, d = corners[1:, 1:].ravel(), corners[:-1, 1:].ravel()
        vertices = np.stack([*np.meshgrid(x, x, indexing="ij"), np.zeros((21, 21))], axis=2)
        self.surface = Surface(
            vertices.reshape(-1, 3),
            np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32),
            np.tile([0.0, 0.0, 1.0], (21 * 21, 1)),
        )
        self.limits = np.tile(np.eye(LIMIT_FIELDS)[1:4].sum(axis=0), (21 * 21, 1))
        self.limits[:, 0] = LIMIT
        self.models = SimpleNamespace(centres=np.zeros((40, 3)))
        self.scene = SimpleNamespace(endoscope=SimpleNamespace(max_tilt=30.0))
        self.snap = snap

    def press(self, position, pressure, direction):
        moved = pressure**1.8
        if pressure > self.snap and np.hypot(*position[:2]) < 2.0:
            moved *= 1.2
        return SimpleNamespace(converged=True, parts=((0, 1.0, np.array([moved])),))


def limits_of(atlas, rng):
    """Limits of a plate or an atlas lowered where it gives way."""
    return lowered_limits(
        atlas.surface, atlas.limits, atlas.scene, len(atlas.models.centres), asking(atlas), rng
    )


def depths_of(atlas, rng):
    """The same of depths."""
    count = len(atlas.models.centres)
    return lowered_depths(atlas.surface, atlas.limits, count, asking(atlas), rng)


def asking(atlas):
    return lambda _, function, rows: [function(atlas, *row) for row in rows]


@pytest.mark.parametrize("snap", [0.78, 0.98, 1.03])
def test_the_range_ends_before_the_tissue_gives_way_and_only_there(snap, rng):
    plate = Plate(snap * LIMIT)
    limits = limits_of(plate, rng)
    lowered = limits[:, 0] < LIMIT
    away = np.linalg.norm(plate.surface.vertices, axis=1)
    assert lowered[away < 2.0].all()
    assert not lowered[away > 2.0 + REACH].any()
    assert (limits[lowered, 0] <= LIMIT * snap / MARGIN).all()
    np.testing.assert_array_equal(limits[:, 1:], plate.limits[:, 1:])
    np.testing.assert_array_equal(plate.limits[:, 0], LIMIT)  # the atlas's own is left alone


def test_softening_tissue_keeps_its_range(rng):
    plate = Plate(np.inf)
    np.testing.assert_array_equal(limits_of(plate, rng), plate.limits)


def test_an_unconverged_answer_is_no_jump():
    plate = Plate(np.inf)
    sound = plate.press

    def press(position, pressure, direction):
        answer = sound(position, pressure, direction)
        if 0.9 * LIMIT < pressure < 0.97 * LIMIT:
            answer = SimpleNamespace(converged=False, parts=((0, 1.0, np.full(1, np.inf)),))
        return answer

    plate.press = press
    assert limit_load_share(plate, np.zeros(3), np.array([0.0, 0.0, -1.0]), LIMIT) == 1.0


def test_a_trained_scene_does_not_give_way_in_its_range(artifact, rng):
    atlas = ReducedModel.load(artifact)
    assert (limits_of(atlas, rng)[:, 0] >= 0.7 * atlas.limits[:, 0]).all()


class Side:
    """On which side of the edge the tissue lies."""

    side = None

    def forget(self):
        self.side = None


class Edge(Plate):
    """Tissue with an edge across it that a deep tip carries along, 1 mm at most."""

    def __init__(self, slip):
        super().__init__(np.inf)
        self.limits[:, TIP_DEPTH] = 1.0
        self.models = SimpleNamespace(centres=np.zeros((100, 3)))
        self.scene = SimpleNamespace(endoscope=SimpleNamespace(radius=RADIUS))
        self.slip = slip

    def new_warm(self):
        return Side()

    def touch(self, position, warm=None):
        depth, beyond = RADIUS - position[2], position[0] - EDGE
        side = np.sign(beyond) or 1.0
        if warm is not None:
            carried = warm.side is not None and depth > self.slip and abs(beyond) < 1.0
            side = warm.side = warm.side if carried else side
        return SimpleNamespace(converged=True, parts=((3, 1.0, np.array([depth, side])),))


def test_the_depth_ends_where_the_way_to_a_contact_matters_and_only_there(rng):
    plate = Edge(slip=0.5)
    limits = depths_of(plate, rng)
    lowered = limits[:, TIP_DEPTH] < 1.0
    away = np.abs(plate.surface.vertices[:, 0] - EDGE)
    assert lowered[away < 0.5].mean() > 0.9
    assert not lowered[away > FAR + SLIP_REACH].any()
    assert (limits[lowered, TIP_DEPTH] <= 0.5).all()
    assert (limits[lowered, TIP_DEPTH] > 0.3).all()
    np.testing.assert_array_equal(limits[:, :TIP_DEPTH], plate.limits[:, :TIP_DEPTH])
    np.testing.assert_array_equal(plate.limits[:, TIP_DEPTH], 1.0)


def test_tissue_that_slips_off_nowhere_keeps_its_depth(rng):
    plate = Edge(slip=np.inf)
    np.testing.assert_array_equal(depths_of(plate, rng), plate.limits)


def test_a_way_with_no_answer_tells_nothing():
    plate = Edge(slip=0.5)
    sound = plate.touch

    def touch(position, warm=None):
        if warm is not None and position[0] < EDGE:
            raise QueryError("position", "below the surface")
        return sound(position, warm)

    plate.touch = touch
    assert path_independent_share(plate, np.array([EDGE + 0.1, 5.0, 0.0])) == 1.0


def test_nothing_slips_off_a_trained_slab(artifact, rng):
    atlas = ReducedModel.load(artifact)
    np.testing.assert_array_equal(depths_of(atlas, rng), atlas.limits)
