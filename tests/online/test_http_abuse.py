"""Clients that do everything wrong over HTTP, while a session goes on being answered."""

import itertools
import json
import logging
import os
import socket
import time
from contextlib import ExitStack, suppress
from urllib.parse import urlsplit

import pytest

from palpate.online.client.http import Client
from palpate.online.client.session import Session
from palpate.online.serve import process as server
from palpate.online.session.frames import Request, encode_request
from palpate.shared.errors import PalpateError

from .conftest import error_of
from .fake_model import FakeModel
from .test_session_abuse import witness

HEAD = b"GET /health HTTP/1.1\r\nhost: localhost\r\n"


@pytest.fixture(autouse=True)
def quiet(caplog):
    """No client may write an error of ours into the log."""
    yield
    assert [record for record in caplog.records if record.exc_info] == []


def connect(url):
    parts = urlsplit(url)
    return socket.create_connection((parts.hostname, parts.port), timeout=10)


def answer_to(url, pieces):
    """What the service says to bytes that it is sent until it has had enough."""
    said = b""
    with connect(url) as connection:
        with suppress(ConnectionError):
            for piece in pieces:
                connection.sendall(piece)
        with suppress(ConnectionError):
            while piece := connection.recv(65536):
                said += piece
    return said


ENDLESS = {
    "header": (431, [HEAD + b"x: "], b"a"),
    "url": (414, [b"GET /"], b"a"),
    "headers": (431, [HEAD], b"a: b\r\n"),
    "newlines": (431, [], b"\r\n"),
}


@pytest.mark.parametrize(("status", "begin", "more"), ENDLESS.values(), ids=ENDLESS)
def test_a_head_without_an_end_is_refused_at_once(url, status, begin, more):
    piece = more * (65536 // len(more))
    with witness(url):
        start = time.perf_counter()
        said = answer_to(url, itertools.chain(begin, itertools.repeat(piece, 1600)))
        assert time.perf_counter() - start < 2.0
    # what is still on its way when the service closes may take the answer with it
    assert said == b"" or said.startswith(b"HTTP/1.1 %d " % status)
    said = answer_to(url, [*begin, more * (20_000 // len(more))])
    assert said.startswith(b"HTTP/1.1 %d " % status)
    error = json.loads(said.partition(b"\r\n\r\n")[2])["error"]
    assert error["allowed"] == {"max_bytes": server.MOST_HEAD}


def test_headers_after_a_body_without_an_end_are_refused_at_once(url):
    begin = HEAD + b"transfer-encoding: chunked\r\n\r\n1\r\n{\r\n0\r\nx: "
    with witness(url):
        start = time.perf_counter()
        answer_to(url, itertools.chain([begin], itertools.repeat(65536 * b"a", 400)))
        assert time.perf_counter() - start < 2.0
    assert b"HTTP/1.1 431 " in answer_to(url, [begin + 20_000 * b"a"])


def test_pieces_of_a_long_body_are_no_long_head(serving):
    head = (
        b"POST /scenes/toy/solve HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\n"
    )
    body = b'{"contacts": [{"position": [5, 5, 5], "pressure": 4}]}' + 50_000 * b" "
    pieces = b"".join(b"%x\r\n%b\r\n" % (len(p), p) for p in (body[:30_000], body[30_000:], b""))
    with serving() as url, connect(url) as connection:
        connection.sendall(head + b"transfer-encoding: chunked\r\n\r\n" + pieces)
        assert connection.recv(65536).startswith(b"HTTP/1.1 200 ")


def test_who_sends_too_much_is_kept_from_sending_more(url):
    """It would be back with the next at once."""
    start = time.perf_counter()
    with connect(url) as connection:
        connection.sendall(b"GET /" + 20_000 * b"a")
        connection.settimeout(5.0)
        assert connection.recv(65536).startswith(b"HTTP/1.1 414 ")
        with suppress(ConnectionError):
            while True:
                connection.sendall(65536 * b"a")
    assert time.perf_counter() - start > 0.9 * server.LINGER


def test_a_long_body_is_no_long_head(serving):
    body = b'{"contacts": [{"position": [5, 5, 5], "pressure": 4}]}' + 50_000 * b" "
    head = (
        b"POST /scenes/toy/solve HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\n"
    )
    whole = head + b"content-length: %d\r\n\r\n" % len(body) + body
    with serving() as url, connect(url) as connection:
        connection.sendall(whole + whole + HEAD + b"x: " + 10_000 * b"a" + b"\r\n\r\n")
        said = b""
        while said.count(b"HTTP/1.1 200 ") < 3:
            piece = connection.recv(65536)
            assert piece
            said += piece


def test_who_does_not_read_is_cut(serving, monkeypatch):
    monkeypatch.setattr(server, "UNREAD", 0.3)
    ask = b"GET /scenes/toy/mesh?region=all HTTP/1.1\r\nhost: localhost\r\n\r\n"
    with serving(FakeModel(divisions=60)) as url, witness(url), ExitStack() as stack:
        held = [stack.enter_context(connect(url)) for _ in range(20)]
        for connection in held:
            connection.sendall(10 * ask)
        time.sleep(1.0)
        for connection in held:
            with suppress(ConnectionError):
                read = b""
                while piece := connection.recv(65536):
                    read += piece
                assert read.count(b"HTTP/1.1 200 ") < 10
    assert not server.HttpProtocol.unread


def test_what_clients_do_not_read_is_bounded(serving, monkeypatch):
    """Nine take two megabytes each, of which the system holds a part."""
    monkeypatch.setattr(server, "MOST_UNREAD", 8 * 1024**2)
    ask = b"GET /scenes/toy/mesh?region=all HTTP/1.1\r\nhost: localhost\r\n\r\n"
    with serving(FakeModel(divisions=60)) as url, witness(url), ExitStack() as stack:
        for _ in range(9):
            connection = stack.enter_context(connect(url))
            connection.sendall(ask)
        for _ in range(100):
            if 0 < sum(server.HttpProtocol.unread.values()) <= 8 * 1024**2:
                break
            time.sleep(0.05)
        assert sum(server.HttpProtocol.unread.values()) <= 8 * 1024**2
        with Client(url) as client:
            client.mesh("toy")


def test_who_asks_on_and_on_is_cut(url):
    ask = b"POST /scenes/toy/solve HTTP/1.1\r\nhost: localhost\r\ncontent-length: 0\r\n\r\n"
    with witness(url):
        assert answer_to(url, [200 * ask]).count(b"HTTP/1.1 ") < 200


def test_headers_after_a_body_are_not_kept(url):
    ask = HEAD + b"transfer-encoding: chunked\r\n\r\n0\r\n" + 100 * b"a: b\r\n" + b"\r\n"
    with connect(url) as connection:
        connection.sendall(ask)
        assert b" 200 " in connection.recv(65536)


def test_a_client_cannot_say_that_it_is_another(serving):
    with serving(rate_limit=20) as url:
        answers = []
        for i in range(60):
            said = answer_to(
                url,
                [
                    b"GET /scenes HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n"
                    b"x-forwarded-for: 10.0.0.%d\r\n\r\n" % i
                ],
            )
            answers.append(said[9:12])
        assert b"429" in answers


def test_a_handshake_where_there_is_no_session_is_told(url):
    ask = (
        b"GET %b HTTP/1.1\r\nhost: localhost\r\nupgrade: websocket\r\nconnection: upgrade\r\n"
        b"sec-websocket-key: dGhlIHNhbXBsZSBub25jZQ==\r\nsec-websocket-version: 13\r\n%b\r\n"
    )
    for more, status in ((b"", 404), (b"content-length: 2\r\n", 422)):
        for path in (b"/nowhere", b"/health"):
            said = answer_to(url, [ask % (path, more)])
            assert said.startswith(b"HTTP/1.1 %d " % status)
            assert json.loads(said.partition(b"\r\n\r\n")[2])["error"]["message"]


@pytest.mark.parametrize("parts", [1, 2])
def test_text_that_is_none_ends_its_session_only(url, parts):
    with witness(url), Session(url, "toy") as session:
        protocol = session._connection.protocol
        protocol.send_text(b"\xff" if parts == 1 else b"{", fin=parts == 1)
        if parts == 2:
            protocol.send_continuation(b"\xff", fin=True)
        session._connection.flush()
        with pytest.raises(Exception, match="1007"):
            session.receive()


def test_a_good_frame_before_text_that_is_none(url):
    """Its answer is made when the session has ended."""
    with witness(url), Session(url, "toy") as session:
        protocol = session._connection.protocol
        protocol.send_binary(encode_request(Request(1, 0.0, (5.0, 5.0, 6.5))))
        protocol.send_text(b"\xff")
        session._connection.flush()
        with pytest.raises(Exception, match="1007"):
            list(iter(session.receive, None))


def test_hanging_up_with_answers_unread(url):
    with witness(url):
        for _ in range(50):
            with Session(url, "toy") as session:
                for _ in range(20):
                    session.send((5.0, 5.0, 6.5))
                session._connection.socket.close()


def test_names_of_files_that_cannot_be_shown(serve, tmp_path):
    """They are told as they can be, and the places where they are are not."""
    os.close(os.open(bytes(tmp_path) + b"/\xff\n.h5", os.O_CREAT))
    (tmp_path / ".hidden.h5").touch()
    with serve(FakeModel(), PalpateError(f"{tmp_path}/broken.h5: truncated")) as client:
        listed = client.get("/scenes")
        assert listed.status_code == 200
        refused = {row["file"]: row["reason"] for row in listed.json()["refused"]}
        assert sorted(refused) == ["\\udcff\\n.h5", "broken.h5"]
        assert refused["broken.h5"] == "broken.h5: truncated"
        assert str(tmp_path) not in listed.text


def test_a_line_of_the_log_is_one_line(tmp_path, capsys):
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    try:
        server.set_up_log(server.Settings(tmp_path, log_format="text"))
        logging.getLogger("palpate.test").error("a\nb\x1b[31m")
    finally:
        root.handlers[:] = handlers
        root.setLevel(level)
    assert capsys.readouterr().err == "ERROR: a\\nb\\x1b[31m\n"


def test_readiness_tells_no_paths(serve):
    with serve(PalpateError("/secret/place/broken.h5: truncated")) as client:
        assert "secret" not in error_of(client.get("/ready"), 503)["message"]
