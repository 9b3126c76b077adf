"""Sessions that are lost: who asks for it gets another one, and is told."""

import socket
import time

import pytest

from palpate.online.client.session import ServiceError, Session, SessionClosed
from palpate.online.session.recording import read_recording
from palpate.online.session.tracker import replay

from ..conftest import place_comes_free
from ..fake_model import FakeModel

PRESSED = (5.0, 5.0, 6.5)


@pytest.fixture
def in_time(serving):
    """Return the address of a toy whose force grows with the time since rest."""
    with serving(FakeModel(in_time=True), max_sessions=1, session_idle=0.3) as url:
        yield url


def pressed_for_a_while(session):
    """Press until the force has grown; return it as it was at rest."""
    at_rest = session.step(PRESSED, client_time=0.0)
    assert at_rest.first
    later = session.step(PRESSED, client_time=0.1)
    assert not later.first
    assert later.force[2] > at_rest.force[2]
    return at_rest.force.tolist()


def lose(session):
    session._connection.socket.shutdown(socket.SHUT_RDWR)


@pytest.mark.parametrize("how", [lose, lambda _: time.sleep(0.6)], ids=["broken", "silent"])
def test_a_lost_session_is_begun_anew_at_rest_and_says_so(in_time, how):
    with Session(in_time, "toy", reconnect=5.0) as session:
        at_rest = pressed_for_a_while(session)
        session.snapshot(1)
        how(session)
        reply = session.step(PRESSED, client_time=0.2)
        assert (reply.first, reply.force.tolist()) == (True, at_rest)
        assert session.reconnections == 1
        with pytest.raises(ServiceError, match="None was kept by this number"):
            session.restore(1)
        assert not session.step(PRESSED, client_time=0.3).first


def test_without_being_asked_to_it_ends(in_time):
    with Session(in_time, "toy") as session:
        lose(session)
        with pytest.raises(SessionClosed, match="1006"):
            session.step(PRESSED)


def test_who_closed_it_gets_no_other(in_time):
    with Session(in_time, "toy", reconnect=5.0) as session:
        session.close()
        for what in (lambda: session.step(PRESSED), session.poll, session.reconnect):
            with pytest.raises(SessionClosed, match="this client closed it"):
                what()


def test_it_is_tried_for_as_long_as_was_said_and_then_told_why_not(serving):
    with serving(max_sessions=1) as url, Session(url, "toy", reconnect=0.5) as session:
        lose(session)
        with place_comes_free(url):
            start = time.perf_counter()
            with pytest.raises(ServiceError, match="1 sessions are open"):
                session.step(PRESSED)
            assert 0.2 < time.perf_counter() - start < 2.0
        assert session.step(PRESSED).good
        assert session.reconnections == 1


def test_a_refusal_that_will_not_pass_is_told_at_once(url):
    with Session(url, "toy", reconnect=60.0) as session:
        session._open = lambda: Session(url, "other")
        lose(session)
        with pytest.raises(ServiceError, match="No such scene"):
            session.step(PRESSED)


def test_who_sends_and_receives_can_have_another_one_as_well(in_time):
    with Session(in_time, "toy") as session:
        lose(session)
        session.reconnect()
        number = session.send(PRESSED)
        reply = session.receive()
        assert (reply.seq, reply.first, session.reconnections) == (number, True, 1)


def test_a_recording_goes_on_and_is_replayed(in_time, tmp_path):
    path = tmp_path / "session.h5"
    with Session(in_time, "toy", record=path, reconnect=5.0) as session:
        for _ in range(3):
            pressed_for_a_while(session)
            session.snapshot(2)
            lose(session)
        session.step(PRESSED)
    recording = read_recording(path)
    assert len(recording.replies) == 7
    assert replay(recording, FakeModel(in_time=True))["different"] == 0
