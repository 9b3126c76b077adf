"""Where the tissue gives way, on a plate whose answer to a load is known."""

from types import SimpleNamespace

import numpy as np
import pytest

from palpate.offline.reduce import limit_points
from palpate.offline.reduce.limit_points import FAR, MARGIN, REACH, SLIP_REACH
from palpate.shared.errors import QueryError
from palpate.shared.geometry.surface import Surface
from palpate.shared.mechanics.footprint import LIMIT_FIELDS, TIP_DEPTH

LIMIT = RADIUS = 2.0
EDGE = 5.0


class Plate:
    """Softening tissue of a flat surface, 10 mm wide, that snaps at a pressure near one corner."""

    lost = np.inf, np.inf
    """Between these pressures no equilibrium is found."""

    def __init__(self, snap):
        x = np.linspace(0.0, 10.0, 21)
        a = np.add.outer(21 * np.arange(20), np.arange(20)).ravel()  # corners of squares
        triangles = np.vstack([np.stack([a, a + 21, a + 22], 1), np.stack([a, a + 22, a + 1], 1)])
        vertices = np.stack([*np.meshgrid(x, x, indexing="ij"), np.zeros((21, 21))], axis=2)
        normals = np.tile([0.0, 0.0, 1.0], (21 * 21, 1))
        self.surface = Surface(vertices.reshape(-1, 3), triangles.astype(np.int32), normals)
        self.limits = np.tile(np.eye(LIMIT_FIELDS)[1:4].sum(axis=0), (21 * 21, 1))
        self.limits[:, 0] = LIMIT
        self.models = SimpleNamespace(centres=np.zeros((40, 3)))
        self.scene = SimpleNamespace(endoscope=SimpleNamespace(max_tilt=30.0))
        self.snap = snap

    def press(self, position, pressure, direction):
        moved = pressure**1.8
        if pressure > self.snap and np.hypot(*position[:2]) < 2.0:
            moved *= 1.2
        found = not self.lost[0] < pressure < self.lost[1]
        return SimpleNamespace(
            converged=found, parts=((0, 1.0, np.array([moved if found else np.inf])),)
        )


def asking(atlas):
    return lambda _, function, rows: [function(atlas, *row) for row in rows]


def limits_of(atlas, rng):
    """Limits of a plate or an atlas lowered where it gives way."""
    return limit_points.lowered_limits(atlas, asking(atlas), rng)


def depths_of(atlas, rng):
    """The same of depths."""
    return limit_points.lowered_depths(atlas, asking(atlas), rng)


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


def test_tissue_that_only_softens_and_slips_off_nowhere_keeps_its_range(rng):
    plate, edge = Plate(np.inf), Edge(slip=np.inf)
    np.testing.assert_array_equal(limits_of(plate, rng), plate.limits)
    np.testing.assert_array_equal(depths_of(edge, rng), edge.limits)


def test_a_trained_slab_hardly_gives_way_in_its_range_and_nothing_slips_off(atlas, rng):
    assert (limits_of(atlas, rng)[:, 0] >= 0.7 * atlas.limits[:, 0]).all()
    np.testing.assert_array_equal(depths_of(atlas, rng), atlas.limits)


class Side:
    """On which side of the edge the tissue lies."""

    side = None

    def forget(self):
        self.side = None


class Edge(Plate):
    """Tissue with an edge across it that a deep tip carries along, 1 mm at most."""

    blind = False
    """Whether no way leads to an answer on the near side."""

    def __init__(self, slip):
        super().__init__(np.inf)
        self.limits[:, TIP_DEPTH] = 1.0
        self.models = SimpleNamespace(centres=np.zeros((100, 3)))
        self.scene = SimpleNamespace(endoscope=SimpleNamespace(radius=RADIUS))
        self.slip = slip

    def new_warm(self):
        return Side()

    def touch(self, position, warm=None):
        if self.blind and warm is not None and position[0] < EDGE:
            raise QueryError("position", "below the surface")
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


def test_what_has_no_answer_is_no_jump_and_tells_nothing_of_the_way():
    plate, edge, down = Plate(np.inf), Edge(slip=0.5), np.array([0.0, 0.0, -1.0])
    plate.lost, edge.blind = (0.9 * LIMIT, 0.97 * LIMIT), True
    assert limit_points.limit_load_share(plate, np.zeros(3), down, LIMIT) == 1.0
    assert limit_points.path_independent_share(edge, np.array([EDGE + 0.1, 5.0, 0.0])) == 1.0
