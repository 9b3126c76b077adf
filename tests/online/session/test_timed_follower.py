"""Sessions over tissue that remembers: its time, what stalls, snapshots, replays."""

import numpy as np
import pytest

from palpate.online.client.http import AsyncClient, Client
from palpate.online.client.session import ServiceError
from palpate.online.session.follower import PATIENCE, Follower
from palpate.online.session.frames import Flag
from palpate.online.session.recording import read_recording
from palpate.online.session.replay import replay
from palpate.online.session.timed_follower import LONGEST, TimedFollower, follower_of

from ..fake_model import FakeModel, Memory

GOOD = Flag.CONVERGED | Flag.IN_RANGE | Flag.CONTACT


class Slow(FakeModel):
    """A toy whose force grows with the time it has been touched for."""

    def __init__(self, name="toy"):
        super().__init__(name)
        tissue = self.scene.tissue.model_copy(update={"prony": ((0.5, 0.1),)})
        self.scene = self.scene.model_copy(update={"tissue": tissue})
        self.steps = []

    def touch_step(self, history, dt, position, most=40, begun=None):
        self.steps.append(dt)
        state = Memory()
        state.last = history.position
        state.gone_on = 0 if begun is None else begun.iterations
        touch = self.touch(position, state, most)
        if not touch.converged:
            return touch._replace(iterations=state.gone_on + 1), history
        after = history._replace(time=history.time + dt, position=touch.position)
        return touch._replace(force=(1.0 + after.time) * touch.force, time=after.time), after


@pytest.fixture
def atlas():
    return Slow()


def test_tissue_says_which_follower_it_wants(atlas):
    assert isinstance(follower_of(atlas), TimedFollower)
    assert type(follower_of(FakeModel())) is Follower


def test_the_clients_time_passes(atlas):
    follower = TimedFollower(atlas)
    for now in (100.0, 100.001, 100.003, 100.003):
        step = follower.follow((5.0, 5.0, 6.5), 0.0, now)
        assert step.flags == GOOD
    np.testing.assert_allclose(atlas.steps, [0.0, 0.001, 0.002, 0.0], atol=1e-9)
    assert step.touch.time == pytest.approx(0.003)


@pytest.mark.parametrize(("passed", "counted"), [(7.0, LONGEST), (-0.5, 0.0), (1e300, LONGEST)])
def test_a_client_that_stalls_or_goes_back_is_told(atlas, passed, counted):
    follower = TimedFollower(atlas)
    follower.follow((5.0, 5.0, 6.5), 0.0, 100.0)
    step = follower.follow((5.0, 5.0, 6.4), 0.0, 100.0 + passed)
    assert step.flags == GOOD | Flag.STALLED
    assert step.touch.time == counted
    step = follower.follow((5.0, 5.0, 6.4), 0.0, 100.0 + passed)
    assert step.flags == GOOD
    assert step.touch.time == pytest.approx(counted)


def test_what_a_clamped_step_left_passes_with_the_next(atlas):
    atlas.stride = 0.3
    follower = TimedFollower(atlas)
    follower.follow((1.0, 5.0, 6.5), 0.0, 0.0)
    step = follower.repeat((9.0, 5.0, 6.5), 12, 0.08)
    assert step.flags == GOOD | Flag.CLAMPED
    share = (step.touch.position[0] - 1.0) / 8.0
    assert step.touch.time == pytest.approx(0.08 * share)
    step = follower.follow((9.0, 5.0, 6.5), 10.0, 0.09)
    assert step.flags == GOOD
    assert step.touch.time == pytest.approx(0.09)


def test_without_an_answer_time_stands_still(atlas):
    follower = TimedFollower(atlas)
    good = follower.follow((5.0, 5.0, 6.5), 0.0, 0.0)
    step = follower.follow((5.0, 5.0, 3.0), 0.0, 0.05)
    assert step.flags == GOOD | Flag.FALLBACK
    assert step.touch is good.touch
    assert follower.follow((5.0, 5.0, 6.5), 0.0, 0.06).touch.time == pytest.approx(0.06)


def test_where_tissue_snaps_the_search_goes_on_from_frame_to_frame(atlas):
    atlas.snap = 3
    follower = TimedFollower(atlas)
    good = follower.follow((5.0, 5.0, 7.0 - atlas.deepest), 0.0, 0.0)
    steps = [follower.follow((5.0, 5.0, 5.4 - z), 0.0, z) for z in (0.01, 0.02, 0.03, 0.04)]
    for step in steps[:3]:
        assert step.flags & Flag.FALLBACK
        assert step.touch is good.touch
    assert steps[3].flags == GOOD & ~Flag.IN_RANGE
    assert steps[3].touch.time == pytest.approx(0.04)
    assert follower.follow((5.0, 5.0, 5.1), 0.0, 0.05).flags & Flag.FALLBACK


def test_a_search_that_finds_nothing_starts_anew(atlas):
    atlas.snap = PATIENCE
    follower = TimedFollower(atlas)
    follower.follow((5.0, 5.0, 7.0 - atlas.deepest), 0.0, 0.0)
    for _ in range(2 * PATIENCE):
        assert follower.follow((5.0, 5.0, 5.3), 0.0, 0.01).flags & Flag.FALLBACK


def test_a_snapshot_brings_back_the_state(atlas):
    follower = TimedFollower(atlas)
    follower.follow((5.0, 5.0, 6.5), 0.0, 0.0)
    follower.follow((5.0, 5.0, 6.5), 0.0, 0.05)
    kept = follower.snapshot()
    first = follower.follow((5.0, 5.0, 6.4), 0.0, 0.07)
    follower.follow((5.0, 5.0, 6.3), 0.0, 0.09)
    follower.restore(kept)
    again = follower.follow((5.0, 5.0, 6.4), 0.0, 0.11)
    np.testing.assert_array_equal(again.touch.force, first.touch.force)


def test_a_restored_state_knows_nothing_of_a_search(atlas):
    atlas.snap = 1
    follower = TimedFollower(atlas)
    follower.follow((5.0, 5.0, 7.0 - atlas.deepest), 0.0, 0.0)
    kept = follower.snapshot()
    for now in (0.01, 0.02):
        assert follower.follow((5.0, 5.0, 5.3), 0.0, now).flags & Flag.FALLBACK
        follower.restore(kept)


def test_a_restarted_follower_is_a_new_one(atlas):
    follower = TimedFollower(atlas)
    follower.follow((5.0, 5.0, 6.5), 0.0, 0.0)
    follower.restart()
    step = follower.follow((5.0, 5.0, 6.5), 0.0, 9.0)
    assert step.flags == GOOD
    assert step.touch.time == 0.0


def test_a_session_keeps_snapshots_and_its_recording_replays(serving, atlas, tmp_path, rng):
    atlas.stride = 0.3
    path = tmp_path / "session.h5"
    places = rng.uniform([0, 0, 4.5], [10, 10, 8], (60, 3))
    with (
        serving(toy=atlas) as url,
        Client(url) as client,
        client.session("toy", record=path) as session,
    ):
        assert session.hello["longest_step"] == LONGEST
        assert session.hello["snapshots"] > 0
        for number, place in enumerate(places):
            if number in (7, 20):
                session.snapshot(number % 2)
            if number in (15, 30, 31):
                session.restore(1 - number % 2 if number != 15 else 1)
            session.step(place)
        session.snapshot(3)
        for depth in np.linspace(0.0, 0.5, 20):  # without waiting, so that some are superseded
            session.send((5.0, 5.0, 6.9 - depth))
        session.restore(3)
        with pytest.raises(ServiceError) as refused:
            session.restore(5)
        assert (refused.value.code, refused.value.field) == ("unknown_snapshot", "restore")
        assert refused.value.allowed == [0, 1, 3]
        session.step((5.0, 5.0, 6.5))
    recording = read_recording(path)
    assert len(recording.commands) == 7
    report = replay(recording, atlas)
    assert (report.different, report.force_difference) == (0, 0.0)


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ('{"snapshot": 99}', "snapshot"),
        ('{"snapshot": 1, "restore": 1}', "snapshot"),
        ('{"restore": null}', "snapshot"),
        ('{"snapshot": "a"}', "snapshot"),
    ],
)
def test_a_command_that_makes_no_sense_is_refused(serving, atlas, text, field):
    with serving(toy=atlas) as url, Client(url) as client, client.session("toy") as session:
        session._protocol.send_text(text.encode())
        session._flush()
        with pytest.raises(ServiceError) as refused:
            session.receive()
        assert refused.value.field == field
        assert session.step((5.0, 5.0, 6.5)).contact


def test_asyncio_has_snapshots_too(serving, atlas):
    import asyncio

    async def run(url):
        async with AsyncClient(url) as client, client.session("toy") as session:
            await session.step((5.0, 5.0, 6.5))
            await session.snapshot(2)
            first = await session.step((5.0, 5.0, 6.4))
            await session.restore(2)
            again = await session.step((5.0, 5.0, 6.4))
            return first, again

    with serving(toy=atlas) as url:
        first, again = asyncio.run(run(url))
    assert first.contact
    assert again.contact
