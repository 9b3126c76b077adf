"""`palpate serve` as its user meets it: a process and a socket."""

import json
import os
import shlex
import signal
import socket
import subprocess
import time
import urllib.request
from urllib.parse import urlsplit

import pytest

from palpate.online.client.http import Client

from .conftest import PALPATE

pytestmark = pytest.mark.service


def test_the_printed_request_can_be_pasted(server):
    line = next(line for line in server.greeting.splitlines() if line.startswith("Try: "))
    curl, url, dash_h, header, dash_d, body = shlex.split(line.removeprefix("Try: "))
    assert (curl, dash_h, dash_d) == ("curl", "-H", "-d")
    name, value = header.split(": ")
    request = urllib.request.Request(url, body.encode(), {name: value})
    with urllib.request.urlopen(request) as response:
        answer = json.load(response)
    assert answer["scene"] == "quick"
    assert answer["trust"]["converged"]
    assert answer["trust"]["in_range"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_it_ends_cleanly_on_a_signal(serve, artifact, number):
    with serve(artifact.parent) as server:
        with Client(server.url) as client:
            client.scenes()
            assert server.stop(number) == 0
        assert "Traceback" not in server.log


def test_it_ends_while_kernels_are_compiled(artifact, tmp_path):
    process = subprocess.Popen(
        [*PALPATE, "serve", "--artifacts", artifact.parent, "--port", "0"],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
    )
    try:
        while not list(tmp_path.rglob("*.nbi")):  # the first kernel
            assert process.poll() is None
            time.sleep(0.1)
        process.terminate()
        _, log = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == 0
    assert "Traceback" not in log


def test_a_client_that_hangs_up_leaves_no_trace(serve, artifact):
    with serve(artifact.parent) as server:
        parts = urlsplit(server.url)
        head = (
            b"POST /scenes/quick/solve HTTP/1.1\r\nhost: localhost\r\n"
            b"content-type: application/json\r\n"
        )
        with socket.create_connection((parts.hostname, parts.port)) as connection:
            connection.sendall(head + b"content-length: 100\r\n\r\n{")
        with Client(server.url) as client:
            client.scenes()
        assert server.stop() == 0
        assert "Traceback" not in server.log


def test_on_loopback_only_names_of_this_machine_are_served(server):
    request = urllib.request.Request(f"{server.url}/scenes", headers={"host": "evil.example"})
    with pytest.raises(urllib.error.HTTPError, match="421"):
        urllib.request.urlopen(request)


def test_a_connection_survives_refusals(server):
    with Client(server.url) as client:
        connection = client._connection
        for body, status in ((b"[" * 10**6, 413), (b"{", 422), (b"", 422)):
            connection.request(
                "POST", "/scenes/quick/solve", body, {"content-type": "application/json"}
            )
            response = connection.getresponse()
            assert response.status == status
            assert json.loads(response.read())["error"]["field"] == "body"
        assert client.scenes()["scenes"]


def test_without_artifacts_it_says_how_to_make_one(tmp_path):
    result = subprocess.run(
        [*PALPATE, "serve", "--artifacts", tmp_path], capture_output=True, text=True
    )
    assert result.returncode == 2
    assert "palpate train turbinate" in result.stderr
    assert "Traceback" not in result.stderr


def test_a_port_in_use_is_told(server, artifact):
    port = str(urlsplit(server.url).port)
    result = subprocess.run(
        [*PALPATE, "serve", "--artifacts", artifact.parent, "--port", port],
        capture_output=True,
        text=True,
    )
    assert result.returncode != 0
    assert "in use" in result.stderr
    assert "Traceback" not in result.stderr
