import json
import os
import re
import resource
import threading
import urllib.error
import urllib.request
from contextlib import closing, contextmanager

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from palpate.online import commands
from palpate.online.client.session import ServiceError, Session
from palpate.online.serve import layout
from palpate.online.session.frames import (
    REPLY_FIELDS,
    Flag,
    Output,
    Request,
    encode_reply,
    encode_request,
)
from palpate.online.session.recording import ASKED, Recorder, read_recording
from palpate.online.session.tracker import LONGEST, ToolTracker, replay
from palpate.shared.errors import PalpateError
from palpate.shared.model import ReducedModel

from ..conftest import place_comes_free
from ..fake_model import FakeModel


@pytest.fixture
def stiff():
    """Return a toy that needs many strides, so that the number of steps matters."""
    return FakeModel(stride=0.3)


@pytest.fixture
def recorded(opening, stiff, tmp_path, rng, monkeypatch):
    """Return the recording of a wild session, written piece by piece, and its replies."""
    monkeypatch.setattr("palpate.online.session.recording.CHUNK", 10)
    path = tmp_path / "session.h5"
    touch, answering = stiff.touch, threading.Event()
    monkeypatch.setattr(stiff, "touch", lambda *a, **k: answering.wait() and touch(*a, **k))
    answering.set()
    with opening(stiff, record=path) as session:
        replies = [
            session.step(position, Output.STRESS if i % 3 == 0 else 0)
            for i, position in enumerate(rng.uniform([0, 0, 4.5], [10, 10, 8], (100, 3)))
        ]
        answering.clear()  # until all are sent, so that some are superseded
        for i in range(50):
            session.send((5.0, 5.0, 7.0 - 0.01 * i))
        answering.set()
        while replies[-1].seq != 150:
            replies.append(session.receive())
    return path, replies


def test_a_recording_holds_what_was_asked_and_answered(recorded):
    path, replies = recorded
    recording = read_recording(path)
    assert recording.scene == "toy"
    assert [request.seq for request in recording.requests] == [reply.seq for reply in replies]
    assert len(replies) < 150
    np.testing.assert_array_equal(recording.requests[-1].position, (5.0, 5.0, 7.0 - 0.49))
    np.testing.assert_array_equal(recording.replies["force"], [reply.force for reply in replies])
    assert (np.diff(recording.received) > 0).all()
    with h5py.File(path) as file:
        for field in (*ASKED, *REPLY_FIELDS):
            assert file[field.name].attrs["units"] == field.unit
            assert file[field.name].attrs["description"]


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ({}, "200"),
        ({"commands": [[0, 1]]}, "reshape"),
        ({"commands": [[0, 1, None]]}, "a command is none"),
        ({"commands": [[0, 3, 1.0]]}, "a command is none"),
        ({"greeting": {}}, "scene"),
        ({"requests": np.zeros(7, np.uint8)}, "buffer size"),
        ({"replies": np.zeros(0, np.uint8)}, "not those"),
        ({"received": np.zeros(3)}, "shape"),
    ],
)
def test_frames_that_were_kept_make_a_recording(recorded, url, tmp_path, wrong, why):
    recording = read_recording(recorded[0])
    requests = b"".join(map(encode_request, recording.requests))
    head = {"greeting": {"scene": "toy"}, "commands": []}
    arrays = {
        "received": recording.received,
        "requests": np.frombuffer(requests, np.uint8),
        "replies": recording.replies.view(np.uint8),
    }
    head |= {name: value for name, value in wrong.items() if name in head}
    arrays |= {name: value for name, value in wrong.items() if name in arrays}
    request = urllib.request.Request(
        f"{url}/recordings", layout.encode(head, arrays), {"Content-Type": layout.BINARY}
    )
    if wrong:
        with pytest.raises(urllib.error.HTTPError, match="422") as refused:
            urllib.request.urlopen(request)
        assert why in json.load(refused.value)["error"]["message"]
        return
    with urllib.request.urlopen(request) as response:
        (tmp_path / "again.h5").write_bytes(response.read())
    again = read_recording(tmp_path / "again.h5")
    assert again.requests == recording.requests
    np.testing.assert_array_equal(again.replies, recording.replies)
    np.testing.assert_array_equal(again.received, recording.received)


def test_commands_are_recorded_and_replayed(opening, tmp_path, rng):
    model, path = FakeModel(in_time=True, stride=0.3), tmp_path / "session.h5"
    places = rng.uniform([0, 0, 4.5], [10, 10, 8], (60, 3))
    with opening(model, record=path) as session:
        assert session.greeting["longest_step"] == LONGEST
        assert session.greeting["snapshots"] > 0
        for number, place in enumerate(places):
            if number in (7, 20):
                session.snapshot(number % 2)
            if number in (15, 30, 31):
                session.restore(1 - number % 2 if number != 15 else 1)
            if number in (10, 40):
                session.young(4.0 * number)
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
    assert len(recording.commands) == 9
    report = replay(recording, model)
    assert (report["different"], report["force_difference"]) == (0, 0.0)


def test_a_replay_gives_the_same_answers_and_tells_what_differs(recorded, stiff):
    path, replies = recorded
    recording = read_recording(path)
    assert len({reply.flags & (Flag.CLAMPED | Flag.FALLBACK) for reply in replies}) > 1
    assert list(replay(recording, stiff).values()) == [len(replies), 0, None, 0.0]
    stiff.stiffness *= 1.0 + 1e-15 * 8
    report = replay(recording, stiff)
    assert report["different"] > 0
    assert 0 < report["force_difference"] < 1e-12
    touching = np.flatnonzero(recording.replies["flags"] & Flag.CONTACT)
    assert report["first_different"] == touching[0]


@pytest.fixture
def recorder(tmp_path):
    with closing(Recorder(tmp_path / "session.h5", {"scene": "toy"})) as recorder:
        yield recorder


def test_requests_that_were_dropped_or_refused_are_not_kept(recorder, tmp_path):
    """The service complains of the latter without a number; numbers start again at 2^32."""
    answer = ToolTracker(FakeModel()).follow((5.0, 5.0, 6.5), 0.0)
    for first in (1, 2**32 - 4):
        requests = [Request((first + i) % 2**32, 0.0, (5.0, 5.0, 6.5)) for i in range(10)]
        for request in requests:
            recorder.sent(request)
        recorder.received(encode_reply(requests[-1], answer), 1.0)
        assert not recorder._requests
    recorder.close()
    assert [r.seq for r in read_recording(tmp_path / "session.h5").requests] == [10, 5]


@contextmanager
def room_on_disk(size):
    """Let no file grow larger, as on a disk with so much room (bytes)."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_ends_the_recording_and_not_the_session(url, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr("palpate.online.session.recording.CHUNK", 10)
    path = tmp_path / "session"  # no name of an artifact, which would be served
    with room_on_disk(200_000):
        session = Session(url, "toy", record=path)
        replies = [session.step((5.0, 5.0, 6.9 - 0.001 * i)) for i in range(400)]
        session.young(20.0)
        with pytest.raises(PalpateError) as ended:
            session.close()
    assert all(reply.good for reply in replies)
    told = rf"{path}: File too large; the recording ends after (\d+) replies"
    count = int(re.fullmatch(told, str(ended.value))[1])
    assert [record.getMessage() for record in caplog.records] == [str(ended.value)]
    recording = read_recording(path)
    assert 0 < count == len(recording.replies) < 400
    assert replay(recording, FakeModel())["different"] == 0


def test_without_room_for_a_recording_there_is_no_session(serving, tmp_path):
    with serving(max_sessions=1) as url:
        with room_on_disk(1000), pytest.raises(PalpateError, match="File too large; the recording"):
            Session(url, "toy", record=tmp_path / "session")
        place_comes_free(url).close()


def test_requests_without_any_reply_do_not_fill_the_memory(recorder, monkeypatch):
    monkeypatch.setattr("palpate.online.session.recording.MOST_UNANSWERED", 10)
    for seq in range(100):
        recorder.sent(Request(seq, 0.0, (5.0, 5.0, 6.5)))
    assert list(recorder._requests) == list(range(90, 100))


def test_a_reply_to_a_frame_of_the_clients_own_is_left_out(url, tmp_path):
    path = tmp_path / "session.h5"
    with Session(url, "toy", record=path) as session:
        session._connection.send(encode_request(Request(77, 0.0, (5.0, 5.0, 6.5))))
        assert session.receive().seq == 77
        reply = session.step((5.0, 5.0, 6.4))
    assert [request.seq for request in read_recording(path).requests] == [reply.seq]


def test_other_files_and_other_scenes_are_refused(recorded, tmp_path):
    text, foreign, newer = (tmp_path / name for name in ("text", "foreign", "newer"))
    text.write_text("no HDF5")
    with h5py.File(foreign, "w"), h5py.File(newer, "w") as file:
        file.attrs["format"], file.attrs["format_version"] = "palpate-session", 9
    for path, reason in (
        (tmp_path / "missing", "cannot be read"),
        (text, "cannot be read"),
        (foreign, "not a recording"),
        (newer, "version 9"),
        (recorded[0], "of scene 'toy', the artifact of 'other'"),
    ):
        with pytest.raises(PalpateError, match=reason):
            replay(read_recording(path), FakeModel("other"))


def test_the_command_tells_and_its_exit_code_too(recorded, stiff, monkeypatch):
    path, replies = recorded
    monkeypatch.setattr(ReducedModel, "load", lambda path: stiff)
    result = CliRunner().invoke(commands.replay, [str(path), "toy.h5", "--json"])
    assert result.exit_code == 0
    assert json.loads(result.output)["replies"] == len(replies)
    stiff.stiffness *= 2
    result = CliRunner().invoke(commands.replay, [str(path), "toy.h5"])
    assert result.exit_code == 1
    assert "different" in result.output


def test_a_pipe_is_no_recording(tmp_path):
    os.mkfifo(tmp_path / "pipe.h5")
    with pytest.raises(PalpateError, match="not a regular file"):
        read_recording(tmp_path / "pipe.h5")
