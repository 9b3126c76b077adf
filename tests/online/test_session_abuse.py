"""Clients that do everything wrong, while another one goes on being answered."""

import itertools
import json
import math
import socket
import struct
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from urllib.parse import urlsplit

import numpy as np
import pytest

from palpate.online.client.session import Session, SessionClosed
from palpate.online.session import frames, websocket
from palpate.online.session import session as server_session
from palpate.online.session.frames import Flag, Output, Request

from .conftest import place_comes_free
from .fake_model import FakeModel

PRESSED = (5.0, 5.0, 6.5)
EVERYTHING = sum(Output) - Output.HALF


@contextmanager
def witness(url):
    """Keep a session stepping; when the context ends, every answer must have been right."""
    done = threading.Event()

    def step():
        with Session(url, "toy") as session:
            for count in itertools.count():
                depth = 0.1 + 0.01 * (count % 50)
                reply = session.step((5.0, 5.0, 7.0 - depth))
                np.testing.assert_allclose(reply.force, [0, 0, 20.0 * depth])
                assert reply.good
                assert reply.contact
                if done.wait(0.001) and count > 2:
                    return

    with ThreadPoolExecutor() as executor:
        stepping = executor.submit(step)
        try:
            yield
        finally:
            done.set()
        stepping.result()


def fuzzed(rng):
    """Make a message: a frame with some bytes changed, or anything at all."""
    kind = rng.integers(8)
    if kind == 0:
        return rng.bytes(rng.integers(0, 200))
    if kind == 1:
        return b"\x02\x00" + rng.bytes(38)
    position = rng.uniform([-5, -5, -5], [15, 15, 15]) * rng.choice([1.0, 1e3, 1e300, np.nan])
    outputs = int(rng.integers(40)) if kind == 2 else 0
    frame = bytearray(frames.encode_request(Request(1, 0.0, tuple(position), outputs)))
    for _ in range(rng.integers(3)):
        frame[rng.integers(2, len(frame))] = rng.integers(256)
    return bytes(frame)


def check(message):
    """Check that a message is a reply without NaN or an error that says what is wrong."""
    if isinstance(message, str):
        assert json.loads(message)["error"]["message"]
        return
    reply = frames.decode_reply(message)
    numbers = np.concatenate([np.ravel(value) for value in reply if value is not None])
    assert not np.isnan(numbers).any()
    assert np.isinf(numbers).sum() == (0 if reply.flags & Flag.IN_RANGE else 3)
    assert bool(reply.flags & Flag.CONVERGED) != bool(reply.flags & Flag.FALLBACK)


def test_ten_thousand_fuzzed_frames(url, rng):
    """Eight clients at a time, each replaced when the service has had enough of it."""
    codes = set()
    with witness(url), ExitStack() as stack:
        sessions = [stack.enter_context(Session(url, "toy")) for _ in range(8)]
        for _ in range(10_000 // len(sessions)):
            for session in sessions:
                session._connection.send(fuzzed(rng))
            for i, session in enumerate(sessions):
                message = session._connection.receive()
                check(message)
                if isinstance(message, str) and "unknown_version" in message:
                    with pytest.raises(SessionClosed) as closed:
                        session.receive()
                    codes.add(closed.value.code)
                    session.close()
                    sessions[i] = stack.enter_context(Session(url, "toy"))
    assert codes == {4001}


def test_fuzzed_text(url, rng):
    whole = json.dumps({"seq": 1, "position": PRESSED, "outputs": ["stress"]}).encode()
    with witness(url), Session(url, "toy") as session:
        for _ in range(300):
            text = bytearray(whole)
            for _ in range(rng.integers(1, 4)):
                text[rng.integers(len(text))] = rng.integers(32, 127)
            session._connection.protocol.send_text(bytes(text))
            session._connection.flush()
            message = session._connection.receive()
            assert "NaN" not in message
            assert set(json.loads(message)) & {"error", "force"}


def test_what_is_no_websocket_and_handshakes_that_never_end(url, rng):
    parts = urlsplit(url)
    with witness(url), ExitStack() as stack:
        for _ in range(50):
            with Session(url, "toy") as session:
                session._connection.socket.sendall(rng.bytes(rng.integers(1, 500)))
        request = b"GET /scenes/toy/session HTTP/1.1\r\nupgrade: websocket\r\n"
        for length in range(0, len(request), 2):
            connection = socket.create_connection((parts.hostname, parts.port))
            stack.enter_context(connection)
            connection.sendall(request[:length])


def test_a_message_too_long_ends_its_session_only(url):
    with witness(url), Session(url, "toy") as session:
        session._connection.send(bytes(100_000))
        with pytest.raises(SessionClosed) as closed:
            session.receive()
        assert closed.value.code == 1009


def test_clients_that_vanish(serving):
    """Half-open, reset, and hung up at once: their places are free again."""
    with serving(max_sessions=4, session_idle=0.2) as url:
        with witness(url):
            silent = [Session(url, "toy") for _ in range(3)]
            for _ in range(20):
                place_comes_free(url).close()
            for session in silent:
                session._connection.socket.close()
        with witness(url):
            for _ in range(20):
                session = place_comes_free(url)
                session.send(PRESSED)
                linger = struct.pack("ii", 1, 0)
                session._connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
                session._connection.socket.close()


def test_a_client_that_does_not_read_is_cut(serving, monkeypatch, caplog):
    monkeypatch.setattr(server_session, "PATIENCE", 0.2)
    model = FakeModel(divisions=40)  # replies of 27 KB
    with serving(model, max_sessions=2) as url, witness(url):
        with Session(url, "toy") as slow:
            slow._connection.socket.settimeout(10.0)
            frame = frames.encode_request(Request(1, 0.0, PRESSED, EVERYTHING))
            with pytest.raises(ConnectionError):
                pour(slow, itertools.repeat(frame))
        place_comes_free(url).close()
    assert "leaves replies unread" in caplog.text


PING, EMPTY_PART = 0x89, 0x00


def control(first, payload=b""):
    """Make a client's frame of less than 126 bytes with a mask of zeros."""
    return bytes((first, 0x80 | len(payload), 0, 0, 0, 0)) + payload


@pytest.mark.parametrize(
    ("frame", "most", "reason"),
    [
        (control(PING), websocket.MOST_FRAMES, "floods the service"),
        (control(PING, bytes(125)), math.inf, "answers to its pings unread"),
        (control(EMPTY_PART), websocket.MOST_FRAMES, "more than 64 parts"),
    ],
)
def test_floods_that_no_session_sees_are_cut(url, monkeypatch, caplog, frame, most, reason):
    monkeypatch.setattr(websocket, "MOST_FRAMES", most)
    with witness(url):
        with Session(url, "toy") as session:
            if frame == control(EMPTY_PART):
                session._connection.socket.sendall(control(0x02))  # begins a message
            with pytest.raises(ConnectionError):
                flood(session._connection.socket, 1000 * frame)
        place_comes_free(url).close()
    assert reason in caplog.text


def flood(connection, data):
    while True:
        connection.sendall(data)


def test_pings_and_messages_in_parts_are_answered(url):
    frame = frames.encode_request(Request(7, 0.0, PRESSED))
    with Session(url, "toy") as session:
        session._connection.socket.sendall(control(0x02, frame[:10]) + control(PING, b"!"))
        session._connection.socket.sendall(control(0x00, frame[10:30]) + control(0x80, frame[30:]))
        assert session.receive().seq == 7


def test_in_a_flood_the_newest_position_counts(url):
    """Every frame is answered, in order, or told as superseded; the last one is answered."""
    count = 10_000
    positions = [(5.0, 5.0, 6.5 + 1e-5 * i) for i in range(count)]
    with witness(url), Session(url, "toy") as session:
        frames_ = (frames.encode_request(Request(i, 0.0, at)) for i, at in enumerate(positions))
        flood = threading.Thread(target=pour, args=(session, frames_))
        flood.start()
        replies = [session.receive()]
        while replies[-1].seq != count - 1:
            replies.append(session.receive())
        flood.join()
    superseded = sum(reply.superseded for reply in replies)
    assert len(replies) + superseded == count
    assert superseded > 0
    assert (np.diff([reply.seq for reply in replies]) > 0).all()
    np.testing.assert_array_equal(replies[-1].position, positions[-1])


def pour(session, frames_):
    """Send frames as fast as the socket takes them, reading nothing."""
    protocol = type(session._connection.protocol)(session._connection.protocol.uri)
    protocol.state = session._connection.protocol.state
    for i, frame in enumerate(frames_, 1):
        protocol.send_binary(frame)
        if i % 100 == 0:
            session._connection.socket.sendall(b"".join(protocol.data_to_send()))
