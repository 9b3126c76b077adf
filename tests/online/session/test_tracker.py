"""Following a tool over tissue that is elastic, and over tissue that lives in the client's time."""

import numpy as np
import pytest

from palpate.online.session.frames import Flag, Reason
from palpate.online.session.tracker import LONGEST, ToolTracker

from ..fake_model import FakeModel

TOUCHING = Flag.CONVERGED | Flag.IN_RANGE | Flag.CONTACT


@pytest.fixture(params=[False, True], ids=["elastic", "in time"])
def model(request):
    return FakeModel(in_time=request.param)


def begun(model, *at, **changes):
    """A tracker of a model changed like this, and its first answer."""
    vars(model).update(changes)
    tracker = ToolTracker(model)
    return tracker, tracker.follow(at, 0.0, 0.0)


def is_fallback(answer, good):
    """Whether an answer repeats a good one without calling it one."""
    return answer.flags == Flag.CONTACT | Flag.FALLBACK and answer.touch is good.touch


def test_a_position_that_can_be_solved_takes_one_step(model):
    _, answer = begun(model, 5.0, 5.0, 6.5)
    told = answer.flags, answer.steps, answer.reason
    assert told == (TOUCHING | Flag.FIRST, 1, Reason.NONE)
    np.testing.assert_array_equal(answer.touch.position, [5.0, 5.0, 6.5])


def test_a_long_step_is_walked_in_strides_while_there_is_time(model):
    tracker, _ = begun(model, 5.0, 5.0, 6.9, stride=0.3)
    answer = tracker.follow((5.9, 5.0, 6.4), budget=10.0)
    assert (answer.flags, answer.reason) == (TOUCHING, Reason.NONE)
    np.testing.assert_array_equal(answer.touch.position, [5.9, 5.0, 6.4])
    assert answer.steps > 4
    late = tracker.follow((1.0, 5.0, 6.5), budget=0.0)
    assert is_fallback(late, answer)
    assert late.reason == Reason.NO_EQUILIBRIUM


def test_a_step_too_long_for_its_time_stops_on_the_way(model):
    tracker, _ = begun(model, 1.0, 5.0, 6.5, stride=0.3)
    answer = tracker.follow((9.0, 5.0, 6.5), budget=10.0, most=12, now=0.08)
    assert answer.flags == TOUCHING | Flag.CLAMPED
    assert (answer.steps, answer.reason) == (12, Reason.NO_EQUILIBRIUM)
    share = (answer.touch.position[0] - 1.0) / 8.0
    assert 0.0 < share < 1.0
    again = tracker.follow((9.0, 5.0, 6.5), budget=10.0, now=0.09)
    assert again.flags == TOUCHING
    assert again.touch.position[0] == 9.0
    if model.steps:  # the time of the rest of the way passes with the next answer
        assert answer.touch.time == pytest.approx(0.08 * share)
        assert again.touch.time == pytest.approx(0.09)


def test_where_equilibria_end_the_tool_stops(model):
    """Strides get shorter towards the last equilibrium, and end."""
    tracker, _ = begun(model, 5.0, 5.0, 6.5)
    answer = tracker.follow((5.0, 5.0, 5.0), budget=10.0)
    assert answer.flags == TOUCHING & ~Flag.IN_RANGE | Flag.CLAMPED | Flag.TOO_DEEP
    assert model.deepest - 1.5 / 32 <= answer.touch.depth <= model.deepest


def test_where_there_is_no_way_the_next_position_is_searched_for_from_rest(model):
    tracker, good = begun(model, 5.0, 5.0, 6.5, stride=0.3)
    assert is_fallback(tracker.follow((9.0, 5.0, 6.5), budget=0.0, now=0.01), good)
    found = tracker.follow((9.0, 5.0, 6.5), budget=0.0, now=0.02)
    assert (found.flags, found.steps) == (TOUCHING, 1)


def test_a_position_that_makes_no_sense_falls_back_at_once_and_takes_no_time(model):
    tracker, good = begun(model, 5.0, 5.0, 6.5)
    answer = tracker.follow((5.0, 5.0, 3.0), 10.0, 0.05)
    assert is_fallback(answer, good)
    assert (answer.steps, answer.reason) == (1, Reason.BELOW_SURFACE)
    again = tracker.follow((5.0, 5.0, 6.5), 0.0, 0.06)
    assert again.flags == TOUCHING
    assert again.touch.time == pytest.approx(0.06 if model.steps else 0.0)


def test_before_any_answer_nothing_is_claimed(model):
    _, answer = begun(model, 5.0, 5.0, 4.0)
    assert (answer.flags, answer.reason) == (Flag.FALLBACK | Flag.FIRST, Reason.BELOW_SURFACE)
    assert not answer.touch.force.any()
    assert not answer.touch.tangent.any()


def test_repeating_takes_the_same_steps(model, rng):
    model.stride = 0.5
    tracker, repeater = ToolTracker(model), ToolTracker(model)
    for i, position in enumerate(rng.uniform([0, 0, 4.5], [10, 10, 8], (200, 3))):
        answer = tracker.follow(position, 2e-5, 0.001 * i)
        again = repeater.follow(position, np.inf, 0.001 * i, answer.steps)
        assert (again.flags, again.steps) == (answer.flags, answer.steps)
        np.testing.assert_array_equal(again.touch.force, answer.touch.force)


def test_a_restarted_tracker_is_a_new_one(model):
    tracker, _ = begun(model, 1.0, 5.0, 6.5, stride=0.3)
    tracker.restart()
    answer = tracker.follow((9.0, 5.0, 6.5), 0.0, 9.0)
    assert (answer.flags, answer.touch.time) == (TOUCHING | Flag.FIRST, 0.0)
    tracker.restart()
    assert tracker.follow((9.0, 5.0, 4.0), budget=0.0).flags == Flag.FALLBACK | Flag.FIRST


def test_a_snapshot_brings_back_the_state(model):
    tracker = ToolTracker(model)
    for now in (0.0, 0.05):
        tracker.follow((5.0, 5.0, 6.5), 0.0, now)
    tracker.obey("snapshot", 0)
    first = tracker.follow((5.0, 5.0, 6.4), 0.0, 0.07)
    tracker.follow((5.0, 5.0, 6.3), 0.0, 0.09)
    tracker.obey("restore", 0)
    again = tracker.follow((5.0, 5.0, 6.4), 0.0, 0.11)
    np.testing.assert_array_equal(again.touch.force, first.touch.force)


def test_the_clients_time_passes():
    in_time = FakeModel(in_time=True)
    tracker = ToolTracker(in_time)
    for now, first in (100.0, Flag.FIRST), (100.001, 0), (100.003, 0), (100.003, 0):
        answer = tracker.follow((5.0, 5.0, 6.5), 0.0, now)
        assert answer.flags == TOUCHING | first
    np.testing.assert_allclose(in_time.steps, [0.0, 0.001, 0.002, 0.0], atol=1e-9)
    assert answer.touch.time == pytest.approx(0.003)


@pytest.mark.parametrize(("passed", "counted"), [(7.0, LONGEST), (-0.5, 0.0), (1e300, LONGEST)])
def test_a_client_that_stalls_or_goes_back_is_told(model, passed, counted):
    """Elastic tissue knows no time."""
    tracker = ToolTracker(model)
    tracker.follow((5.0, 5.0, 6.5), 0.0, 100.0)
    for flag in (Flag.STALLED, 0):
        answer = tracker.follow((5.0, 5.0, 6.4), 0.0, 100.0 + passed)
        assert answer.flags == (TOUCHING | flag if model.steps else TOUCHING)
        assert answer.touch.time == pytest.approx(counted if model.steps else 0.0)


def test_over_the_valid_radius_a_linear_force_holds():
    """By Hertz's law, F = d^1.5."""
    _, answer = begun(FakeModel(), 5.0, 5.0, 6.5)
    depth, radius = answer.touch.depth, answer.valid_radius
    for s in (-radius, radius):
        exact, linear = (depth + s) ** 1.5, depth**1.5 + 1.5 * depth**0.5 * s
        assert abs(exact - linear) < 0.03 * depth**1.5
    assert radius > 0.1 * depth
