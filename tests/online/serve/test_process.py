"""What a connection may cost, what the log has, and what real time says of itself."""

import http.client
import json
import logging
import os
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, suppress
from urllib.parse import urlsplit

import pytest

from palpate.online.client.http import Client
from palpate.online.client.session import Session
from palpate.online.serve import process as server
from palpate.online.settings import Settings

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


@pytest.fixture
def root():
    """Give the root logger back as it was."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield root
    root.handlers[:] = handlers
    root.setLevel(level)


def test_a_record_is_one_line_of_json(root, tmp_path, capsys):
    server.set_up_log(Settings(tmp_path))
    try:
        raise ValueError("no\nway")
    except ValueError:
        logging.getLogger("palpate.test").exception("it failed: %s", "twice")
    logging.getLogger("palpate.test").debug("too much detail")
    (line,) = capsys.readouterr().err.splitlines()
    record = json.loads(line)
    assert record["level"] == "error"
    assert record["logger"] == "palpate.test"
    assert record["message"] == "it failed: twice"
    assert "ValueError" in record["exception"]


def test_text_and_level_can_be_chosen(root, tmp_path, capsys):
    server.set_up_log(Settings(tmp_path, log_format="text", log_level="error"))
    logging.getLogger("palpate.test").warning("quiet")
    logging.getLogger("palpate.test").error("loud")
    assert capsys.readouterr().err == "ERROR: loud\n"


ENTER = """
import os
from palpate.online.serve.process import run_in_real_time
before = os.sched_getscheduler(0) if hasattr(os, "sched_getscheduler") else None
print(run_in_real_time())
if before is not None:
    print(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO)
"""


def test_it_says_what_the_system_granted():
    run = subprocess.run([sys.executable, "-c", ENTER], capture_output=True, text=True, check=True)
    said, *fifo = run.stdout.splitlines()
    assert said.startswith("real-time scheduling: ")
    assert "memory lock: " in said
    if fifo:  # it must not claim more than what is so
        assert ("real-time scheduling: on" in said) == (fifo == ["True"])


@pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="not known to this system")
def test_a_refusal_is_told_with_what_it_takes(monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    said = server.run_in_real_time()
    assert "refused (Operation not permitted)" in said
    assert "CAP_SYS_NICE" in said
