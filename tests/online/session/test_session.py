"""Sessions on a real socket: what is answered, what is refused, and how they end."""

import asyncio
import json
import time

import numpy as np
import pytest

from palpate.online.client.http import Client
from palpate.online.client.session import ServiceError, Session, SessionClosed
from palpate.online.serve.metrics import Metrics
from palpate.online.serve.settings import Settings
from palpate.online.serve.store import Model
from palpate.online.session import frames
from palpate.online.session import session as server_session
from palpate.online.session.follower import Follower
from palpate.online.session.frames import Flag, Output, Request
from palpate.online.session.realtime import BusyWait
from palpate.online.session.websocket import PENDING, READ_AT
from palpate.shared.errors import PalpateError

from ..fake_model import FakeModel

PRESSED = (5.0, 5.0, 6.5)  # half a millimetre deep
FREE = (5.0, 5.0, 8.0)


@pytest.fixture
def session(url):
    with Session(url, "toy") as session:
        yield session


def test_a_session_says_how_to_speak_with_it(session):
    assert session.hello["scene"] == "toy"
    assert session.hello["layout"] == json.loads(json.dumps(frames.layout()))
    assert session.hello["nodes"] == len(FakeModel().surface_nodes)
    reply = session.step(session.hello["example"]["position"])
    assert reply.good
    assert reply.contact


def test_a_position_is_answered_with_force_and_tangent(session):
    seq = session.send(PRESSED, client_time=12.5)
    reply = session.receive()
    assert (reply.seq, reply.client_time) == (seq, 12.5)
    assert reply.flags == Flag.CONTACT | Flag.CONVERGED | Flag.IN_RANGE
    np.testing.assert_allclose(reply.force, [0, 0, 10.0])
    np.testing.assert_allclose(reply.tangent, np.diag([0, 0, -20.0]))
    np.testing.assert_array_equal(reply.position, PRESSED)
    assert reply.server_received < reply.server_sent
    assert 0 < reply.solve_time <= reply.server_sent - reply.server_received
    assert 0 < reply.valid_radius < reply.depth
    np.testing.assert_array_equal(reply.model, [3, -1, -1, -1])


def test_away_from_the_tissue_force_is_zero_up_to_contact(session):
    reply = session.step(FREE)
    assert reply.flags == Flag.CONVERGED | Flag.IN_RANGE
    assert not reply.force.any()
    assert reply.valid_radius == pytest.approx(1.0)


@pytest.mark.parametrize("half", [0, Output.HALF])
def test_fields_come_when_asked_for(session, half):
    atlas = FakeModel()
    touch = atlas.touch(PRESSED)
    wanted = Output.COORDINATES | Output.DISPLACEMENT | Output.VON_MISES | Output.STRESS | half
    reply = session.step(PRESSED, wanted)
    kind = np.float16 if half else np.float32
    np.testing.assert_array_equal(
        reply.displacement, atlas.displacement(touch, "surface").astype(kind)
    )
    stress = atlas.von_mises(touch, "all")
    np.testing.assert_array_equal(reply.von_mises, stress[atlas.surface_nodes].astype(kind))
    assert reply.max_von_mises == stress.max()
    assert reply.p99_von_mises == np.float32(np.percentile(stress, 99))
    np.testing.assert_allclose(reply.coordinates[0], [0.5, 0.5])
    assert not reply.coordinates[1:].any()
    assert session.step(PRESSED).displacement is None


def test_json_says_the_same(session):
    binary = session.step(PRESSED, Output.VON_MISES)
    message = {"seq": 9, "position": PRESSED, "outputs": ["von_mises"]}
    reply = ask(session, json.dumps(message))
    assert reply["seq"] == 9
    assert reply["flags"] == ["contact", "converged", "in_range"]
    assert reply["outputs"] == ["von_mises"]
    assert reply["reason"] == ""
    np.testing.assert_array_equal(reply["force"], binary.force)
    np.testing.assert_array_equal(np.float32(reply["von_mises"]), binary.von_mises)
    assert set(reply) - {"reason"} <= set(binary._fields)


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("{", "body"),
        ("[]", "body"),
        ('{"position": [1, 2]}', "position"),
        ('{"position": [1, 2, NaN]}', "position.2"),
        ('{"position": [1, 2, 1e9]}', "position.2"),
        ('{"position": [1, 2, 3], "output": []}', "output"),
        ('{"position": [1, 2, 3], "outputs": ["half"]}', "outputs.0"),
        ('{"position": [1, 2, 3], "seq": -1}', "seq"),
    ],
)
def test_wrong_json_names_the_field_and_the_session_goes_on(session, text, field):
    assert ask(session, text)["error"]["field"] == field
    assert session.step(PRESSED).good


def test_json_has_a_limit(serving, tmp_path):
    with (
        serving(Settings(tmp_path, max_json_numbers=10), toy=FakeModel()) as url,
        Session(url, "toy") as session,
    ):
        error = ask(session, json.dumps({"position": PRESSED, "outputs": ["displacement"]}))
        assert error["error"]["code"] == "too_large_for_json"


@pytest.mark.parametrize(
    ("request_", "field"),
    [
        (Request(1, float("nan"), PRESSED), "client_time"),
        (Request(1, 0.0, (float("nan"), 0.0, 0.0)), "position"),
        (Request(1, 0.0, (0.0, float("-inf"), 0.0)), "position"),
        (Request(1, 0.0, PRESSED, 1 << 15), "outputs"),
    ],
)
def test_a_frame_of_nonsense_names_the_field_and_the_session_goes_on(session, request_, field):
    session.send_bytes(frames.encode_request(request_))
    with pytest.raises(ServiceError) as error:
        session.receive()
    assert (error.value.code, error.value.field) == ("invalid_frame", field)
    assert session.step(PRESSED).good


def test_a_frame_of_the_wrong_size_is_told(session):
    session.send_bytes(b"\x01\x00" + bytes(39))
    with pytest.raises(ServiceError, match="must have 40 bytes, not 41"):
        session.receive()
    assert session.step(PRESSED).good


def test_another_version_is_told_and_ends_the_session(session):
    session.send_bytes(b"\x02\x00" + bytes(38))
    with pytest.raises(ServiceError, match="is 2; this is version 1"):
        session.receive()
    with pytest.raises(SessionClosed) as closed:
        session.receive()
    assert closed.value.code == 4001


def test_a_position_without_an_answer_gets_the_last_good_one(session):
    before = session.step(PRESSED)
    after = session.step((5.0, 5.0, 4.0))
    assert after.flags == before.flags | Flag.FALLBACK
    assert not after.good
    np.testing.assert_array_equal(after.force, before.force)
    np.testing.assert_array_equal(after.position, PRESSED)
    reason = ask(session, json.dumps({"position": (5.0, 5.0, 4.0)}))["reason"]
    assert "below the surface" in reason
    assert session.step(FREE).good


def test_without_any_good_answer_there_is_no_force(session):
    reply = session.step((5.0, 5.0, 4.0))
    assert reply.flags == Flag.FALLBACK
    assert not reply.force.any()
    assert not reply.tangent.any()


def test_an_answer_that_is_not_finite_stays_inside(serving):
    atlas = FakeModel()
    with serving(toy=atlas) as url, Session(url, "toy") as session:
        atlas.poison = True
        reply = session.step(PRESSED)
        assert reply.flags == Flag.FALLBACK
        assert not reply.force.any()


def test_the_newest_position_counts(session):
    """Frames that come together are one task: the last is answered, the others are counted."""
    count = 20
    for i in range(count):
        request = Request(i, 0.0, (5.0, 5.0, 6.5 + 0.01 * i))
        session._protocol.send_binary(frames.encode_request(request))
    session._socket.sendall(b"".join(session._protocol.data_to_send()))
    answered, superseded = [], 0
    while not answered or answered[-1].seq != count - 1:
        answered.append(session.receive())
        superseded += answered[-1].superseded
    assert len(answered) + superseded == count
    assert superseded > 0
    seqs = [reply.seq for reply in answered]
    assert seqs == sorted(seqs)
    np.testing.assert_array_equal(answered[-1].position, [5.0, 5.0, 6.5 + 0.01 * (count - 1)])


def test_sessions_do_not_share_their_history(serving):
    """Where one tool is makes no difference to another one's steps."""
    atlas = FakeModel()
    atlas.stride = 0.2
    with (
        serving(toy=atlas) as url,
        Session(url, "toy") as one,
        Session(url, "toy") as other,
    ):
        assert one.step((5.0, 5.0, 6.5)).good
        assert other.step((1.0, 1.0, 6.5)).good
        assert one.step((5.0, 5.0, 6.4)).good
        assert other.step((1.1, 1.0, 6.4)).good


def test_a_session_does_not_inherit_the_history_of_another(serving):
    """More sessions than are kept at hand, one after the other; each starts anew."""
    atlas = FakeModel()
    atlas.stride = 0.2
    with serving(toy=atlas) as url:
        for i in range(10):
            with Session(url, "toy") as session:
                assert session.step((float(i), 1.0, 6.5)).good


def test_too_many_sessions_are_refused(serving, tmp_path):
    with serving(Settings(tmp_path, max_sessions=1), toy=FakeModel()) as url:
        with Session(url, "toy"):
            with pytest.raises(ServiceError, match="1 sessions are open") as refused:
                Session(url, "toy")
            assert (refused.value.status, refused.value.code) == (503, "too_many_sessions")
            assert refused.value.allowed == {"max_sessions": 1}
        for _ in range(100):
            try:
                Session(url, "toy").close()
                break
            except ServiceError:
                time.sleep(0.02)
        else:
            pytest.fail("the place was not given back")


def test_a_silent_session_is_closed(serving, tmp_path):
    with (
        serving(Settings(tmp_path, session_idle=0.1), toy=FakeModel()) as url,
        Session(url, "toy") as session,
    ):
        with pytest.raises(SessionClosed, match="no frame for") as closed:
            session.receive()
        assert closed.value.code == 4000


def test_a_session_that_says_goodbye_is_watched_no_more(tmp_path):
    """What interrupts a session must not interrupt its last word."""
    messages = iter(
        [{"type": "websocket.connect"}, {"type": "websocket.receive", "bytes": b"\2\0"}]
    )
    tasks = []

    async def receive():
        return next(messages)

    async def send(message):
        await asyncio.sleep(0)
        if message["type"] == "websocket.close":
            tasks.extend(asyncio.all_tasks())

    async def run():
        extensions = {PENDING: lambda: False, READ_AT: time.perf_counter}
        atlas = FakeModel()
        session = server_session.Session(
            Model(atlas, {}, list(PRESSED)),
            Follower(atlas),
            Settings(tmp_path),
            Metrics(),
            BusyWait(0),
            {"extensions": extensions},
            receive,
            send,
        )
        await session.run()

    asyncio.run(run())
    assert len(tasks) == 1


def test_an_unknown_scene_has_no_session(url, caplog):
    with pytest.raises(ServiceError, match="No such scene") as refused:
        Session(url, "other")
    assert refused.value.status == 404
    with pytest.raises(PalpateError, match="HTTP 403"):
        Session(url, "a/b c")
    assert not caplog.records


def test_a_scene_without_a_tip_has_no_session(serving):
    atlas = FakeModel()
    atlas.tips = None
    with serving(toy=atlas, other=FakeModel("other")) as url:
        with pytest.raises(ServiceError, match="trained without a tip") as refused:
            Session(url, "toy")
        assert (refused.value.status, refused.value.code) == (404, "no_tip")
        with Client(url) as client:
            assert client.solve("toy", (5.0, 5.0, 5.0), 4.0).trust["converged"]
        with Session(url, "other") as session:
            assert session.step(PRESSED).good


def test_without_a_handshake_there_is_no_session(client):
    response = client.get("/scenes/toy/session")
    assert response.status_code == 426
    assert response.json()["error"]["code"] == "upgrade_required"
    assert client.get("/scenes/other/session").status_code == 404


def test_the_layout_is_in_the_description_of_the_service(client):
    document = client.get("/openapi.json").json()
    responses = document["paths"]["/scenes/{name}/session"]["get"]["responses"]
    assert frames.tables() in responses["101"]["description"]


def ask(session, text):
    """Send text; return the JSON that comes back."""
    session._protocol.send_text(text.encode())
    session._flush()
    return json.loads(session._message())
