"""Where the tissue gives way, on a plate whose answer to a load is known."""

from types import SimpleNamespace

import numpy as np
import pytest

from offline.giving_way import MARGIN, REACH, bearable_share, lowered_limits
from shared.atlas import Atlas
from shared.endoscope import LIMIT_FIELDS
from shared.surface import Surface

LIMIT = 2.0


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

    def solve(self, position, pressure, direction):
        moved = pressure**1.8
        if pressure > self.snap and np.hypot(*position[:2]) < 2.0:
            moved *= 1.2
        return SimpleNamespace(converged=True, patches=((0, 1.0, np.array([moved])),))


@pytest.mark.parametrize("snap", [0.78, 0.98, 1.03])
def test_the_range_ends_before_the_tissue_gives_way_and_only_there(snap, rng):
    plate = Plate(snap * LIMIT)
    limits = lowered_limits(plate, rng)
    lowered = limits[:, 0] < LIMIT
    away = np.linalg.norm(plate.surface.vertices, axis=1)
    assert lowered[away < 2.0].all()
    assert not lowered[away > 2.0 + REACH].any()
    assert (limits[lowered, 0] <= LIMIT * snap / MARGIN).all()
    np.testing.assert_array_equal(limits[:, 1:], plate.limits[:, 1:])
    np.testing.assert_array_equal(plate.limits[:, 0], LIMIT)  # the atlas's own is left alone


def test_softening_tissue_keeps_its_range(rng):
    plate = Plate(np.inf)
    np.testing.assert_array_equal(lowered_limits(plate, rng), plate.limits)


def test_an_unconverged_answer_is_no_jump():
    plate = Plate(np.inf)
    sound = plate.solve

    def solve(position, pressure, direction):
        answer = sound(position, pressure, direction)
        if 0.9 * LIMIT < pressure < 0.97 * LIMIT:
            answer = SimpleNamespace(converged=False, patches=((0, 1.0, np.full(1, np.inf)),))
        return answer

    plate.solve = solve
    assert bearable_share(plate, np.zeros(3), np.array([0.0, 0.0, -1.0]), LIMIT) == 1.0


def test_a_trained_scene_does_not_give_way_in_its_range(artifact, rng):
    atlas = Atlas.load(artifact)
    assert (lowered_limits(atlas, rng)[:, 0] >= 0.7 * atlas.limits[:, 0]).all()
