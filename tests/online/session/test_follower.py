import numpy as np
import pytest

from palpate.online.session.follower import PATIENCE, Follower
from palpate.online.session.frames import Flag

from ..fake_model import FakeModel

GOOD = Flag.CONVERGED | Flag.IN_RANGE
TOUCHING = GOOD | Flag.CONTACT


@pytest.fixture
def atlas():
    return FakeModel()


def test_a_position_that_can_be_solved_takes_one_step(atlas):
    step = Follower(atlas).follow((5.0, 5.0, 6.5), budget=0.0)
    assert (step.flags, step.steps, step.reason) == (TOUCHING, 1, "")
    np.testing.assert_array_equal(step.touch.position, [5.0, 5.0, 6.5])


def test_a_long_step_is_walked_in_strides(atlas):
    atlas.stride = 0.3
    follower = Follower(atlas)
    follower.follow((5.0, 5.0, 6.9), budget=0.0)
    step = follower.follow((5.9, 5.0, 6.4), budget=10.0)
    assert step.flags == TOUCHING
    assert step.reason == ""
    np.testing.assert_array_equal(step.touch.position, [5.9, 5.0, 6.4])
    assert step.steps > 4


def test_a_step_too_long_for_its_time_stops_on_the_way(atlas):
    atlas.stride = 0.3
    follower = Follower(atlas)
    follower.follow((1.0, 5.0, 6.5), budget=0.0)
    step = follower.repeat((9.0, 5.0, 6.5), steps=12)
    assert step.flags == TOUCHING | Flag.CLAMPED
    assert step.steps == 12
    assert step.reason
    assert 1.0 < step.touch.position[0] < 9.0
    again = follower.follow((9.0, 5.0, 6.5), budget=10.0)
    assert again.flags == TOUCHING
    assert again.touch.position[0] == 9.0


def test_without_time_the_last_good_answer_stands(atlas):
    atlas.stride = 0.3
    follower = Follower(atlas)
    good = follower.follow((1.0, 5.0, 6.5), budget=0.0)
    step = follower.follow((9.0, 5.0, 6.5), budget=0.0)
    assert step.flags == TOUCHING | Flag.FALLBACK
    assert step.touch is good.touch


def test_where_equilibria_end_the_tool_stops(atlas):
    """Strides get shorter towards the last equilibrium, and end."""
    follower = Follower(atlas)
    follower.follow((5.0, 5.0, 6.5), budget=0.0)
    step = follower.follow((5.0, 5.0, 5.0), budget=10.0)
    assert step.flags == TOUCHING & ~Flag.IN_RANGE | Flag.CLAMPED
    assert atlas.deepest - 1.5 / 32 <= step.touch.depth <= atlas.deepest


def test_where_tissue_snaps_the_search_goes_on_from_position_to_position(atlas):
    atlas.snap = 3
    follower = Follower(atlas)
    good = follower.follow((5.0, 5.0, 7.0 - atlas.deepest), budget=0.0)
    steps = [follower.follow((5.0, 5.0, z), budget=10.0) for z in (5.4, 5.3, 5.2, 5.1)]
    for step in steps[:3]:
        assert step.flags & Flag.FALLBACK
        assert step.touch is good.touch
    assert [step.steps for step in steps[1:]] == [1, 1, 1]
    assert not steps[3].flags & (Flag.FALLBACK | Flag.CLAMPED)
    assert steps[3].touch.position[2] == 5.1


def test_a_search_that_finds_nothing_starts_anew(atlas):
    atlas.stride = 0.3
    follower = Follower(atlas)
    follower.follow((5.0, 5.0, 7.0 - atlas.deepest), budget=0.0)
    for _ in range(PATIENCE):
        assert follower.follow((5.0, 5.0, 5.2), budget=0.0).flags & Flag.FALLBACK
    assert follower.follow((8.0, 5.0, 6.5), budget=0.0).flags == TOUCHING


def test_a_position_that_makes_no_sense_falls_back_at_once(atlas):
    follower = Follower(atlas)
    good = follower.follow((5.0, 5.0, 6.5), budget=0.0)
    step = follower.follow((5.0, 5.0, 3.0), budget=10.0)
    assert step.flags == TOUCHING | Flag.FALLBACK
    assert step.steps == 1
    assert step.touch is good.touch
    assert "below the surface" in step.reason


def test_repeating_takes_the_same_steps(atlas, rng):
    atlas.stride = 0.5
    follower, repeater = Follower(atlas), Follower(atlas)
    for position in rng.uniform([0, 0, 4.5], [10, 10, 8], (200, 3)):
        step = follower.follow(position, budget=2e-5)
        again = repeater.repeat(position, step.steps)
        assert (again.flags, again.steps) == (step.flags, step.steps)
        np.testing.assert_array_equal(again.touch.force, step.touch.force)


def test_a_restarted_follower_is_a_new_one(atlas):
    atlas.stride = 0.3
    follower = Follower(atlas)
    follower.follow((1.0, 5.0, 6.5), budget=0.0)
    follower.restart()
    assert follower.follow((9.0, 5.0, 6.5), budget=0.0).flags == TOUCHING
    follower.restart()
    assert follower.follow((9.0, 5.0, 4.0), budget=0.0).flags == Flag.FALLBACK


def test_over_the_valid_radius_a_linear_force_serves():
    """By Hertz's law, F = d^1.5."""
    step = Follower(FakeModel()).follow((5.0, 5.0, 6.5), budget=0.0)
    depth, radius = step.touch.depth, step.valid_radius
    for s in (-radius, radius):
        exact, linear = (depth + s) ** 1.5, depth**1.5 + 1.5 * depth**0.5 * s
        assert abs(exact - linear) < 0.03 * depth**1.5
    assert radius > 0.1 * depth
