"""`palpate serve` as its user meets it: a process and a socket."""

import json
import os
import shlex
import shutil
import signal
import socket
import subprocess
import time
import urllib.request
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest

from palpate.online.client.http import Client

from ..conftest import PALPATE

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
def test_it_ends_cleanly_on_a_signal_and_logs_no_requests_nor_clients_that_hang_up(
    serve, artifact, number
):
    head = b"POST /scenes/quick/solve HTTP/1.1\r\nhost: localhost\r\ncontent-length: 100\r\n\r\n{"
    with serve(artifact.parent) as server:
        parts = urlsplit(server.url)
        with socket.create_connection((parts.hostname, parts.port)) as connection:
            connection.sendall(head)
        with Client(server.url) as client:
            client.scenes()
            assert server.stop(number) == 0
    assert "Traceback" not in server.log
    assert "/scenes" not in server.log


def test_who_says_twice_that_it_shall_end_reads_no_traceback(artifact):
    process = subprocess.Popen(
        [*PALPATE, "serve", "--artifacts", artifact.parent, "--port", "0"],
        stderr=subprocess.PIPE,
        text=True,
    )
    said = ""
    while "loading models" not in said:
        said += process.stderr.readline()
        assert process.poll() is None, said
    for _ in range(2):
        process.send_signal(signal.SIGINT)
        time.sleep(0.005)
    _, log = process.communicate(timeout=30)
    assert process.returncode == 0
    assert "Traceback" not in said + log


def compiles_in(folder, process):
    """Whether a process, by its folder in /proc, has its kernels there."""
    try:
        return f"NUMBA_CACHE_DIR={folder}".encode() in (process / "environ").read_bytes()
    except OSError:  # it has ended
        return False


def test_it_ends_while_kernels_are_compiled_and_so_do_those_that_compile(artifact, tmp_path):
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
    end = time.monotonic() + 20
    while left := [pid for pid in Path("/proc").glob("[0-9]*") if compiles_in(tmp_path, pid)]:
        assert time.monotonic() < end, left
        time.sleep(0.1)


def test_a_connection_survives_refusals_also_of_other_names_of_this_machine(server):
    head = {"content-type": "application/json"}
    with Client(server.url) as client:
        connection = client._connection
        for body, status, field, more in (
            (b"[" * 10**6, 413, "body", {}), (b"{", 422, "body", {}), (b"", 422, "body", {}),
            (b"{}", 421, "host", {"host": "evil.example"}),
        ):  # fmt: skip
            connection.request("POST", "/scenes/quick/solve", body, head | more)
            response = connection.getresponse()
            assert response.status == status
            assert json.loads(response.read())["error"]["field"] == field
        assert client.scenes()["scenes"]


def test_damaged_artifacts_are_refused_and_named_and_the_others_are_served(
    serve, artifact, tmp_path
):
    shutil.copy(artifact, tmp_path / "good.h5")
    (tmp_path / "text.h5").write_text("not HDF5 at all\n")
    (tmp_path / "half.h5").write_bytes(artifact.read_bytes()[: artifact.stat().st_size // 2])
    (tmp_path / "directory.h5").mkdir()
    with serve(tmp_path) as server:
        with Client(server.url) as client:
            found = client.scenes()
            example = client.scene("quick")["example"]["contacts"][0]
            assert client.solve("quick", **example).converged
        assert server.stop() == 0
    assert [scene["name"] for scene in found["scenes"]] == ["quick"]
    reasons = {entry["file"]: entry["reason"] for entry in found["refused"]}
    assert reasons.keys() == {"text.h5", "half.h5", "directory.h5"}
    for file, reason in reasons.items():
        assert file in reason
        assert reason in server.greeting
        assert file in server.log
    assert "Traceback" not in server.log


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--artifacts", "EMPTY"], ["palpate train turbinate"]),
        (["--port", "USED"], ["in use", "127.0.0.1:USED; try another --port"]),
        (["--host", "0.0.0.0"], ["PALPATE_TOKEN", "--public"]),
        (["--host", "::"], ["PALPATE_TOKEN", "--public"]),
        (["--host", "0.0.0.0", "--token", ""], ["PALPATE_TOKEN", "--public"]),
    ],
)
def test_what_cannot_be_served_is_told(server, artifact, tmp_path, arguments, words):
    """Without artifacts, at a port in use, and to other machines without a token."""
    known = {"EMPTY": tmp_path, "USED": str(urlsplit(server.url).port)}
    result = subprocess.run(
        [*PALPATE, "serve", "--artifacts", artifact.parent, *(known.get(a, a) for a in arguments)],
        capture_output=True, text=True,
        env={name: value for name, value in os.environ.items() if name != "PALPATE_TOKEN"},
    )  # fmt: skip
    assert result.returncode != 0
    for word in words:
        assert word.replace("USED", known["USED"]) in result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize("region", ["surface", "all"])
def test_the_wire_adds_and_takes_nothing(server, atlas, region):
    with Client(server.url) as client:
        scene = client.scene("quick")
        contact = scene["example"]["contacts"][0]
        answer = client.solve("quick", **contact, region=region)
        nodes = client.mesh("quick", region).nodes
    json.dumps(scene, allow_nan=False)
    solution = atlas.press(**contact)
    displacement = atlas.displacement(solution, region)
    np.testing.assert_allclose(answer.force, solution.force, rtol=1e-12)
    np.testing.assert_allclose(answer.displacement, displacement, atol=1e-6)
    np.testing.assert_allclose(answer.von_mises, atlas.von_mises(solution, region), atol=1e-5)
    assert len(nodes) == len(displacement)
    assert np.abs(answer.displacement).max() > 0.1
