"""What a session makes of bytes, however they are cut."""

import socket

import numpy as np
import pytest

from palpate.online.loadtest.streams import ANSWERED, LOST, SUPERSEDED, FrameStream
from palpate.online.session.frames import REPLY, REQUEST, Flag

NAN = np.nan
POSITIONS = np.arange(15.0).reshape(5, 3)


@pytest.fixture
def session():
    """Return a session whose service is the socket `far`."""
    near, far = socket.socketpair()
    session = FrameStream("frames", np.arange(5) / 10, near, POSITIONS, outputs=2)
    session.far = far
    yield session
    session.close()
    far.close()


def reply(number, superseded=0, payload=b""):
    record = np.zeros(1, REPLY)
    record["version"], record["seq"], record["superseded"] = 2, number, superseded
    record["flags"], record["solve_time"] = Flag.CONTACT | Flag.CONVERGED, 5e-5
    body = record.tobytes() + payload
    if len(body) < 2**16:
        return b"\x82\x7e" + len(body).to_bytes(2, "big") + body
    return b"\x82\x7f" + len(body).to_bytes(8, "big") + body


@pytest.mark.parametrize("payload", [b"", bytes(70_000)])
@pytest.mark.parametrize("cut", [1, 2, 3, 100, 10**6])
def test_replies_may_come_in_pieces(session, payload, cut):
    for number in range(3):
        session.send(number, now=number)
    received = reply(0, payload=payload) + reply(2, superseded=1, payload=payload)
    for start in range(0, len(received), max(cut, len(received) // 1000)):
        session.far.sendall(received[start : start + max(cut, len(received) // 1000)])
        assert session.receive(session.sockets[0], now=50)
    while session.waiting:
        session.receive(session.sockets[0], now=50)
    assert session.log["outcome"].tolist() == [ANSWERED, SUPERSEDED, ANSWERED, LOST, LOST]
    np.testing.assert_allclose(session.log["latency"], 1e6 * np.array([50.0, NAN, 49.8, NAN, NAN]))
    np.testing.assert_allclose(session.log["lateness"][:3], 1e6 * np.array([0.0, 0.9, 1.8]))
    assert session.log["solve"][2] == pytest.approx(50.0)
    assert session.log["flags"][0] == Flag.CONTACT | Flag.CONVERGED


def test_what_was_not_told_to_be_superseded_is_lost(session):
    for number in range(5):
        session.send(number, now=number)
    session.far.sendall(reply(4, superseded=2))
    session.receive(session.sockets[0], now=50)
    assert session.log["outcome"].tolist() == [LOST, LOST, SUPERSEDED, SUPERSEDED, ANSWERED]


def test_pings_are_answered(session):
    session.far.sendall(b"\x89\x02hi")
    session.receive(session.sockets[0], now=0)
    pong = session.far.recv(100)  # with a random mask
    assert (pong[:2], len(pong)) == (b"\x8a\x82", 8)


def test_a_close_message_ends_it_with_its_reason(session):
    session.far.sendall(b"\x88\x06\x03\xe9stop")
    assert not session.receive(session.sockets[0], now=0)
    assert session.complaint == "stop"
    session.send(0, now=5)
    assert np.isnan(session.log["lateness"][0])
    assert not session.waiting


def test_a_service_that_does_not_read_holds_nobody_up(session):
    session.sockets[0].setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)
    for _ in range(2000):
        for number in range(5):
            session.send(number, now=1)
    taken = 0
    session.far.settimeout(1.0)
    while taken < 5 * 2000 * (6 + REQUEST.itemsize):
        taken += len(session.far.recv(1 << 20))
        session.far.sendall(b"\x89\x00")  # any news lets it send on
        session.receive(session.sockets[0], now=2)
