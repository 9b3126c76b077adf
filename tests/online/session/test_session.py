"""Sessions on a real socket: what is answered, what is refused, and how they end."""

import json
import urllib.error
import urllib.request

import numpy as np
import pytest

from palpate.online.client.http import Client
from palpate.online.client.session import ServiceError, Session, SessionClosed
from palpate.online.session import frames
from palpate.online.session.frames import Flag, FrameError, Output, Reason, Request
from palpate.shared.errors import PalpateError

from ..conftest import error_of, place_comes_free
from ..fake_model import FakeModel

PRESSED = (5.0, 5.0, 6.5)  # half a millimetre deep
FREE = (5.0, 5.0, 8.0)


@pytest.fixture
def session(url):
    with Session(url, "toy") as session:
        yield session


def test_a_session_says_how_to_speak_with_it(session):
    assert session.greeting["scene"] == "toy"
    assert session.greeting["layout"] == json.loads(json.dumps(frames.layout()))
    assert session.greeting["nodes"] == len(FakeModel().surface_nodes)
    reply = session.step(session.greeting["example"]["position"])
    assert reply.good
    assert reply.contact


def test_a_position_is_answered_with_force_and_tangent(session):
    seq = session.send(PRESSED, client_time=12.5)
    reply = session.receive()
    assert (reply.seq, reply.client_time) == (seq, 12.5)
    assert reply.flags == Flag.CONTACT | Flag.CONVERGED | Flag.IN_RANGE | Flag.FIRST
    np.testing.assert_allclose(reply.force, [0, 0, 10.0])
    np.testing.assert_allclose(reply.tangent, np.diag([0, 0, -20.0]))
    np.testing.assert_array_equal(reply.position, PRESSED)
    assert reply.server_received < reply.server_sent
    assert 0 < reply.solve_time <= reply.server_sent - reply.server_received
    assert 0 < reply.valid_radius < reply.depth
    np.testing.assert_array_equal(reply.model, [3, -1, -1, -1])
    free = session.step(FREE)
    assert free.flags == Flag.CONVERGED | Flag.IN_RANGE
    assert not free.force.any()
    assert free.valid_radius == pytest.approx(1.0)  # up to contact


def test_a_position_without_an_answer_repeats_the_last_good_one_and_claims_nothing(session):
    before = session.step(PRESSED)
    after = session.step((5.0, 5.0, 4.0))
    assert after.flags == Flag.CONTACT | Flag.FALLBACK
    assert after.reason == Reason.BELOW_SURFACE
    assert not after.good
    np.testing.assert_array_equal(after.force, before.force)
    np.testing.assert_array_equal(after.position, PRESSED)
    errors = after.error_displacement, after.error_von_mises, after.error_force
    assert errors == (np.inf, np.inf, np.inf)
    text = ask(session, json.dumps({"position": (5.0, 5.0, 4.0)}))
    assert text["reason"] == "the tip's centre lies below the surface of the tissue"
    assert text["error_force"] is None
    assert session.step(FREE).good


@pytest.mark.parametrize("half", [0, Output.HALF])
def test_fields_come_when_asked_for(session, half):
    model, kind = FakeModel(), np.float16 if half else np.float32
    touch = model.touch(PRESSED)
    reply = session.step(PRESSED, sum(Output) - Output.HALF + half)
    moved = model.displacement(touch, "surface").astype(kind)
    np.testing.assert_array_equal(reply.displacement, moved)
    stress = model.von_mises(touch, "all")
    np.testing.assert_array_equal(reply.von_mises, stress[model.surface_nodes].astype(kind))
    assert reply.max_von_mises == stress.max()
    assert reply.p99_von_mises == np.float32(np.percentile(stress, 99))
    np.testing.assert_allclose(reply.coordinates[0], [0.5, 0.5])
    assert not reply.coordinates[1:].any()
    assert session.step(PRESSED).displacement is None


def test_outputs_can_be_named(session):
    named = session.step(PRESSED, ["stress", "displacement"])
    assert named.outputs == Output.STRESS | Output.DISPLACEMENT
    assert str(Output(named.outputs)) == "displacement, stress"
    assert str(Flag(0)) == "none"
    with pytest.raises(FrameError, match="'strain' is none of coordinates, displacement"):
        session.step(PRESSED, ["strain"])
    assert session.step(PRESSED).good


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
    assert set(reply) <= set(binary._fields)


def test_json_has_a_limit(opening):
    with opening(max_json_numbers=10) as session:
        error = ask(session, json.dumps({"position": PRESSED, "outputs": ["displacement"]}))
        assert error["error"]["code"] == "too_large_for_json"


@pytest.mark.parametrize(
    ("message", "field"),
    [
        ("{", "body"),
        ("[]", "body"),
        ('{"position": [1, 2]}', "position"),
        ('{"position": [1, 2, NaN]}', "position.2"),
        ('{"position": [1, 2, 1e9]}', "position.2"),
        ('{"position": [1, 2, 3], "output": []}', "output"),
        ('{"position": [1, 2, 3], "outputs": ["half"]}', "outputs.0"),
        ('{"position": [1, 2, 3], "seq": -1}', "seq"),
        ('{"snapshot": 99}', "snapshot"),
        ('{"snapshot": 1, "restore": 1}', "snapshot"),
        ('{"restore": null}', "snapshot"),
        ('{"snapshot": "a"}', "snapshot"),
        (frames.encode_request(Request(1, 0.0, (0.0, -np.inf, 0.0))), "position"),
        (frames.encode_request(Request(1, 0.0, PRESSED)) + b"\0", "frame"),
    ],
)
def test_what_is_wrong_is_named_and_the_session_goes_on(session, message, field):
    assert ask(session, message)["error"]["field"] == field
    assert session.step(PRESSED).good


def test_another_version_is_told_and_ends_the_session(session):
    session._connection.send(b"\x01\x00" + bytes(38))
    with pytest.raises(ServiceError, match="is 1; the layout spoken here is version 2"):
        session.receive()
    with pytest.raises(SessionClosed) as closed:
        session.receive()
    assert closed.value.code == 4001


def test_an_answer_that_is_not_finite_stays_inside(opening):
    model = FakeModel()
    with opening(model) as session:
        model.poison = True
        reply = session.step(PRESSED)
        assert reply.flags == Flag.FALLBACK | Flag.FIRST
        assert not reply.force.any()


def test_a_session_has_a_history_of_its_own(serving):
    """Not that of one beside it; nor of one before it, of more than are kept at hand."""
    with serving(FakeModel(stride=0.2)) as url:
        with Session(url, "toy") as one, Session(url, "toy") as other:
            for step in (0.0, 0.1):
                assert one.step((5.0 + step, 5.0, 6.5)).good
                assert other.step((1.0, 1.0 + step, 6.5)).good
        for i in range(10):
            with Session(url, "toy") as session:
                assert session.step((float(i), 1.0, 6.5)).good


def test_too_many_sessions_are_refused(serving):
    with serving(max_sessions=1) as url:
        with Session(url, "toy"):
            with pytest.raises(ServiceError, match="1 sessions are open") as refused:
                Session(url, "toy")
            assert (refused.value.status, refused.value.code) == (503, "too_many_sessions")
            assert refused.value.allowed == {"max_sessions": 1}
        place_comes_free(url).close()


def test_a_silent_session_is_closed(opening):
    with opening(session_idle=0.1) as session:
        with pytest.raises(SessionClosed, match="no frame for") as closed:
            session.receive()
        assert closed.value.code == 4000


def test_an_unknown_scene_has_no_session(url, caplog):
    with pytest.raises(ServiceError, match="No such scene") as refused:
        Session(url, "other")
    assert refused.value.status == 404
    with pytest.raises(PalpateError, match="nothing at this path"):
        Session(url, "a/b c")
    assert not caplog.records


def test_a_scene_without_a_tip_has_no_session(serving):
    with serving(FakeModel(has_tip=False), FakeModel("other")) as url:
        with pytest.raises(ServiceError, match="trained without a tip") as refused:
            Session(url, "toy")
        assert (refused.value.status, refused.value.code) == (404, "no_tip")
        with Client(url) as client:
            assert client.solve("toy", (5.0, 5.0, 5.0), 4.0).converged
        with Session(url, "other") as session:
            assert session.step(PRESSED).good


def test_without_a_handshake_there_is_no_session_but_its_description(client):
    assert error_of(client.get("/scenes/toy/session"), 426)["code"] == "upgrade_required"
    assert client.get("/scenes/other/session").status_code == 404
    document = client.get("/openapi.json").json()
    responses = document["paths"]["/scenes/{name}/session"]["get"]["responses"]
    assert responses["101"]["description"] == frames.document()


def test_who_cannot_read_a_refused_handshake_is_told_the_same_without_one(serving):
    """As the client in C# does."""
    models = FakeModel(), FakeModel("flat", has_tip=False)
    with serving(*models, max_sessions=1) as url, Session(url, "toy"):
        for scene in ("toy", "flat", "other"):
            with pytest.raises(ServiceError) as refused:
                Session(url, scene)
            with pytest.raises(urllib.error.HTTPError) as told:
                urllib.request.urlopen(f"{url}/scenes/{scene}/session")
            with told.value as response:
                error = json.load(response)["error"]
            assert (told.value.code, error["code"]) == (refused.value.status, refused.value.code)


def test_a_session_closed_by_its_client_says_so(session):
    session.close()
    with pytest.raises(SessionClosed, match="this client closed it"):
        session.step(PRESSED)


def ask(session, message):
    """Send a message; return the JSON that comes back."""
    session._connection.send(message)
    return json.loads(session._connection.receive())
