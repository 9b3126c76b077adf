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
AT = (5.0, 5.0, SURFACE - 0.5)


def reply_at(*position):
    """Return what a service of the toy replies to a position."""
    step = ToolTracker(TOY).follow(position, budget=0.0)
    return decode_reply(encode_reply(Request(0, 0.0, position), step))


def test_near_a_reply_the_force_is_that_of_the_tissue():
    """The toy is linear, so that the linearisation is exact."""
    reply = reply_at(*AT)
    there = np.array([5.03, 5.0, SURFACE - 0.55])
    np.testing.assert_allclose(linear_force(reply, there), TOY.touch(there).force)


def test_beyond_the_valid_radius_the_force_grows_no_more():
    reply = reply_at(*AT)
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


def after(reply, now=0.0, most=MOST):
    """A device that has had one reply."""
    device = Extrapolator(most)
    device.update(reply, now)
    return device


def test_the_first_touch_does_not_spike_and_the_largest_force_holds():
    assert not Extrapolator(MOST).force(AT, 1.0).any()  # without a reply
    device = after(reply_at(*AT), 1.0)
    forces = [device.force(AT, 1.0 + share * BLEND)[2] for share in (0.0, 0.5, 1.0, 2.0)]
    np.testing.assert_allclose(forces, [0.0, 5.0, 10.0, 10.0], atol=1e-9)
    assert after(reply_at(*AT), most=2.0).force(AT, BLEND)[2] == pytest.approx(2.0)


def test_a_new_reply_takes_over_without_a_jump():
    device = after(reply_at(*AT))
    before = device.force(AT, 0.02)
    device.update(reply_at(*AT)._replace(force=np.array([0.0, 0.0, 30.0])), 0.02)
    np.testing.assert_allclose(device.force(AT, 0.02), before)
    np.testing.assert_allclose(device.force(AT, 0.02 + 0.5 * BLEND), [0, 0, 20.0])
    np.testing.assert_allclose(device.force(AT, 0.02 + BLEND), [0, 0, 30.0])


def test_replies_faster_than_the_blend_are_followed():
    """At 1 kHz each reply comes amid the blend of the last one."""
    device = Extrapolator(MOST)
    for now in 1e-3 * np.arange(60):
        device.update(reply_at(*AT), now)
        force = device.force(AT, now)
    np.testing.assert_allclose(force, [0, 0, 10.0], rtol=1e-4)


def test_when_replies_stop_the_force_fades():
    device = after(reply_at(*AT))
    np.testing.assert_allclose(device.force(AT, HOLD), [0, 0, 10.0])
    np.testing.assert_allclose(device.force(AT, HOLD + 0.5 * RAMP), [0, 0, 5.0])
    assert not device.force(AT, HOLD + RAMP).any()
    assert fade(1e9) == 0.0
    device.update(reply_at(*AT), 10.0)
    assert not device.force(AT, 10.0).any()
    np.testing.assert_allclose(device.force(AT, 10.0 + BLEND), [0, 0, 10.0])


def test_answers_that_are_only_repeated_fade_too():
    """The tip is where there is no equilibrium: replies go on, but none is of where it is."""
    device, tracker = Extrapolator(MOST), ToolTracker(TOY)

    def tick(position, now):
        step = tracker.follow(position, budget=0.0)
        reply = decode_reply(encode_reply(Request(0, 0.0, position), step))
        device.update(reply, now)
        return reply, device.force(AT, now)

    tick(AT, 0.0)
    for now in 1e-3 * np.arange(1, 1000):
        reply, force = tick((5.0, 5.0, SURFACE - 1.8), now)
        assert reply.flags & Flag.FALLBACK
        np.testing.assert_allclose(reply.force, [0, 0, 10.0])
        if now >= BLEND:
            np.testing.assert_allclose(force, [0, 0, 10.0 * fade(now)], atol=1e-9)
    assert force[2] == 0.0
    tick(AT, 1.0)
    np.testing.assert_allclose(device.force(AT, 1.0 + BLEND), [0, 0, 10.0])


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
