"""What a connection may cost, before it is anybody's request."""

import http.client
import json
import socket
import time
from contextlib import ExitStack, suppress
from urllib.parse import urlsplit

import pytest

from palpate.online.client.http import Client
from palpate.online.client.session import Session
from palpate.online.serve import process as server

HEAD = b"POST /scenes/toy/solve HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\n"


def connect(url):
    parts = urlsplit(url)
    return socket.create_connection((parts.hostname, parts.port), timeout=10)


@pytest.mark.parametrize("start", [b"", HEAD[:10], HEAD, HEAD + b"content-length: 9\r\n\r\n{"])
def test_a_request_that_never_ends_is_closed(url, monkeypatch, start):
    monkeypatch.setattr(server, "PATIENCE", 0.3)
    with connect(url) as connection:
        connection.sendall(start)
        with suppress(ConnectionResetError):
            assert connection.recv(1000) == b""


def test_requests_after_a_pause_are_answered(url, monkeypatch):
    """Only what has begun and does not end is closed, and never a session."""
    monkeypatch.setattr(server, "PATIENCE", 0.3)
    with Client(url) as client, Session(url, "toy") as session:
        connection = client._connection
        client.solve("toy", (5, 5, 5), 4.0)
        first = connection.sock
        for _ in range(2):
            time.sleep(0.4)
            client.solve("toy", (5, 5, 5), 4.0)
            assert session.step((5.0, 5.0, 6.5)).good
        assert connection.sock is first


def test_connections_beyond_the_limit_are_told(url, monkeypatch):
    monkeypatch.setattr(server, "MOST_CONNECTIONS", 3)
    with ExitStack() as stack:
        held = [stack.enter_context(connect(url)) for _ in range(3)]
        refused = stack.enter_context(connect(url))
        response = http.client.HTTPResponse(refused)
        response.begin()
        assert response.status == 503
        assert json.loads(response.read())["error"]["code"] == "overloaded"
        held[0].sendall(b"GET /health HTTP/1.1\r\nhost: localhost\r\n\r\n")
        assert b" 200 " in held[0].recv(1000)
