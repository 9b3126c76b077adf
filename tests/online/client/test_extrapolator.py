import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.online.client.extrapolator import (
    BLEND,
    HOLD,
    RAMP,
    Extrapolator,
    fade,
    linear_force,
)
from palpate.online.session.frames import Flag, Request, decode_reply, encode_reply
from palpate.online.session.tracker import ToolTracker

from ..fake_model import FakeModel

TOY = FakeModel()
RADIUS = 2.0
MOST = 1000.0
SURFACE = 5.0 + RADIUS


def reply_at(*position):
    """Return what a service of the toy replies to a position."""
    step = ToolTracker(TOY).follow(position, budget=0.0)
    return decode_reply(encode_reply(Request(0, 0.0, position), step))


def test_near_a_reply_the_force_is_that_of_the_tissue():
    """The toy is linear, so that the linearisation is exact."""
    reply = reply_at(5.0, 5.0, SURFACE - 0.5)
    there = np.array([5.03, 5.0, SURFACE - 0.55])
    np.testing.assert_allclose(linear_force(reply, there), TOY.touch(there).force)


def test_beyond_the_valid_radius_the_force_grows_no_more():
    reply = reply_at(5.0, 5.0, SURFACE - 0.5)
    rim = linear_force(reply, reply.position - [0, 0, reply.valid_radius])
    deep = linear_force(reply, reply.position - [0, 0, 5.0])
    np.testing.assert_allclose(deep, rim)
    assert rim[2] > reply.force[2]


coordinate = st.floats(-3.0, 3.0)


@given(st.tuples(coordinate, coordinate, coordinate), st.floats(0.0, 1.4))
def test_a_force_never_pulls(step, depth):
    reply = reply_at(5.0, 5.0, SURFACE - depth)
    reply = reply._replace(valid_radius=10.0)
    force = linear_force(reply, reply.position + np.array(step))
    assert force @ reply.normal >= -1e-12 * np.abs(reply.force).max()


def test_without_replies_there_is_no_force():
    assert not Extrapolator(MOST).force((5.0, 5.0, SURFACE - 1.0), 0.0).any()


def test_the_first_touch_does_not_spike():
    device = Extrapolator(MOST)
    at = (5.0, 5.0, SURFACE - 0.5)
    device.update(reply_at(*at), 1.0)
    forces = [device.force(at, 1.0 + share * BLEND)[2] for share in (0.0, 0.5, 1.0, 2.0)]
    np.testing.assert_allclose(forces, [0.0, 5.0, 10.0, 10.0], atol=1e-9)


def test_a_new_reply_takes_over_without_a_jump():
    device = Extrapolator(MOST)
    at = (5.0, 5.0, SURFACE - 0.5)
    device.update(reply_at(*at), 0.0)
    before = device.force(at, 0.02)
    other = reply_at(5.0, 5.0, SURFACE - 0.5)._replace(force=np.array([0.0, 0.0, 30.0]))
    device.update(other, 0.02)
    np.testing.assert_allclose(device.force(at, 0.02), before)
    np.testing.assert_allclose(device.force(at, 0.02 + 0.5 * BLEND), [0, 0, 20.0])
    np.testing.assert_allclose(device.force(at, 0.02 + BLEND), [0, 0, 30.0])


def test_replies_faster_than_the_blend_are_followed():
    """At 1 kHz each reply comes amid the blend of the last one."""
    device = Extrapolator(MOST)
    at = (5.0, 5.0, SURFACE - 0.5)
    for tick in range(60):
        device.update(reply_at(*at), 1e-3 * tick)
        force = device.force(at, 1e-3 * tick)
    np.testing.assert_allclose(force, [0, 0, 10.0], rtol=1e-4)


def test_when_replies_stop_the_force_fades():
    device = Extrapolator(MOST)
    at = (5.0, 5.0, SURFACE - 0.5)
    device.update(reply_at(*at), 0.0)
    np.testing.assert_allclose(device.force(at, HOLD), [0, 0, 10.0])
    np.testing.assert_allclose(device.force(at, HOLD + 0.5 * RAMP), [0, 0, 5.0])
    assert not device.force(at, HOLD + RAMP).any()
    assert fade(1e9) == 0.0
    late = reply_at(*at)
    device.update(late, 10.0)
    assert not device.force(at, 10.0).any()
    np.testing.assert_allclose(device.force(at, 10.0 + BLEND), [0, 0, 10.0])


def test_answers_that_are_only_repeated_fade_too():
    """The tip is where there is no equilibrium: replies go on, but none is of where it is."""
    device, tracker = Extrapolator(MOST), ToolTracker(TOY)
    at, too_deep = (5.0, 5.0, SURFACE - 0.5), (5.0, 5.0, SURFACE - 1.8)

    def tick(position, now):
        step = tracker.follow(position, budget=0.0)
        reply = decode_reply(encode_reply(Request(0, 0.0, position), step))
        device.update(reply, now)
        return reply, device.force(at, now)

    tick(at, 0.0)
    forces = []
    for now in 1e-3 * np.arange(1, 1000):
        reply, force = tick(too_deep, now)
        assert reply.flags & Flag.FALLBACK
        np.testing.assert_allclose(reply.force, [0, 0, 10.0])
        if now >= BLEND:
            np.testing.assert_allclose(force, [0, 0, 10.0 * fade(now)], atol=1e-9)
        forces.append(force[2])
    assert forces[-1] == 0.0
    tick(at, 1.0)
    np.testing.assert_allclose(device.force(at, 1.0 + BLEND), [0, 0, 10.0])


def test_the_force_on_a_moving_device_is_continuous(rng):
    """Replies late and irregular, device in and out of contact: no tick jumps."""
    device = Extrapolator(MOST)
    tick = 1e-4
    times = tick * np.arange(10_000)
    path = SURFACE - 0.4 + 0.6 * np.sin(2 * np.pi * 1.0 * times)
    forces = []
    for now, z in zip(times, path, strict=True):
        if rng.random() < 0.02:
            device.update(reply_at(5.0, 5.0, z + rng.normal(0.0, 0.02)), now)
        forces.append(device.force((5.0, 5.0, z), now))
    forces = np.array(forces)
    # steps of the tool, and of what is left of an offset of at most the largest force
    allowed = 20.0 * np.abs(np.diff(path)).max() + np.abs(forces).max() * tick / BLEND
    assert np.abs(np.diff(forces[:, 2])).max() <= 1.01 * allowed
    assert (forces[:, 2] >= 0.0).all()
    assert forces[:, 2].max() > 15.0


def test_the_largest_force_holds_in_any_state():
    device = Extrapolator(most=2.0)
    at = (5.0, 5.0, SURFACE - 1.0)
    device.update(reply_at(*at), 0.0)
    assert device.force(at, BLEND)[2] == pytest.approx(2.0)
