"""How the service is run: settings, several workers, who is let in, what it tells of itself."""

import json
import os
import re
import signal
import subprocess
import time
import urllib.request
from contextlib import ExitStack

import pytest

from palpate.online.client.connection import SessionClosed
from palpate.online.client.http import Client
from palpate.online.loadtest.run import Plan, run

from .conftest import PALPATE

pytestmark = pytest.mark.service


def get(url, **headers):
    with urllib.request.urlopen(urllib.request.Request(url, headers=headers)) as response:
        return response.read().decode()


def workers(url, **headers):
    """Return what each worker says of itself: {worker: {metric: value}}."""
    found = {}
    for name, worker, value in re.findall(
        r'^palpate_worker_(\w+)\{worker="(\d+)"\} (\S+)$', get(f"{url}/metrics", **headers), re.M
    ):
        found.setdefault(int(worker), {})[name] = float(value)
    return found


@pytest.mark.parametrize("arguments", [("0.0.0.0",), ("::",), ("0.0.0.0", "--token", "")])
def test_other_machines_are_not_let_in_without_a_token(artifact, arguments):
    environment = {k: v for k, v in os.environ.items() if k != "PALPATE_TOKEN"}
    result = subprocess.run(
        [*PALPATE, "serve", "--artifacts", artifact.parent, "--host", *arguments],
        capture_output=True,
        text=True,
        env=environment,
    )
    assert result.returncode == 2
    assert "PALPATE_TOKEN" in result.stderr
    assert "--public" in result.stderr


def test_with_a_token_they_are(serve, artifact):
    with serve(artifact.parent, "--host", "0.0.0.0", PALPATE_TOKEN="secret") as server:
        url = server.url.replace("0.0.0.0", "127.0.0.1")
        with pytest.raises(urllib.error.HTTPError, match="401"):
            get(f"{url}/scenes")
        assert "quick" in get(f"{url}/scenes", authorization="Bearer secret")
        assert server.stop() == 0
        assert "secret" not in server.log


def help_of(command):
    result = subprocess.run([*PALPATE, command, "--help"], capture_output=True, text=True)
    return result.stdout


def test_help_names_the_variable_of_every_setting():
    text = help_of("serve")
    options = re.findall(r"^  --([\w-]+)", text, re.M)
    assert len(options) > 10
    for option in options:
        variable = "PALPATE_" + option.replace("-", "_").upper()
        assert re.search(rf"\b{variable}S?\b", re.sub(r"\s+", " ", text)), option


@pytest.mark.parametrize("command", ["serve", "loadtest"])
def test_help_has_an_example_a_line(command):
    text = help_of(command)
    _, examples = text.split("Examples:\n")
    assert all(line.startswith(("    palpate ", "    PALPATE_")) for line in examples.splitlines())
    assert "\\b" not in text


def test_settings_come_from_the_environment(serve, artifact):
    with serve(
        artifact.parent, PALPATE_MAX_BODY="2000", PALPATE_REALTIME="1", PALPATE_ACCESS_LOG="1"
    ) as server:
        with Client(server.url) as client:
            client.solve("quick", **client.scene("quick")["example"]["contacts"][0])
        request = urllib.request.Request(
            f"{server.url}/scenes/quick/solve", b" " * 2001, {"content-type": "application/json"}
        )
        with pytest.raises(urllib.error.HTTPError, match="413"):
            urllib.request.urlopen(request)
        assert server.stop() == 0
    records = [json.loads(line) for line in server.log.splitlines()]
    messages = [record["message"] for record in records]
    assert any(message.startswith("real-time scheduling: ") for message in messages)
    assert any("POST /scenes/quick/solve" in message and "200" in message for message in messages)


def test_requests_are_not_logged_unless_asked_for(serve, artifact):
    with serve(artifact.parent) as server:
        with Client(server.url) as client:
            client.scenes()
        assert server.stop() == 0
    assert "/scenes" not in server.log


def sessions_of(url):
    """Return how many sessions each worker has: {worker: sessions}."""
    found = re.findall(r'^palpate_sessions\{worker="(\d+)"\} (\S+)$', get(f"{url}/metrics"), re.M)
    return {int(worker): float(number) for worker, number in found}


def session_on(worker, url, client):
    """Open a session on a worker: again and again, since any of them may accept it."""
    for _ in range(500):
        before = sessions_of(url)
        session = client.session("quick")
        if sessions_of(url)[worker] > before[worker]:
            return session
        session.close()
        time.sleep(0.02)
    raise AssertionError(f"worker {worker} gets no session")


@pytest.mark.skipif(os.name == "nt", reason="workers are for POSIX")
def test_a_killed_worker_is_replaced_while_the_others_sessions_go_on(serve, artifact):
    with serve(artifact.parent, "--workers", "2") as server, ExitStack() as stack:
        while len(before := workers(server.url)) < 2:
            time.sleep(0.05)
        client = stack.enter_context(Client(server.url))
        sessions = [stack.enter_context(session_on(w, server.url, client)) for w in (0, 1)]
        position = sessions[0].greeting["example"]["position"]
        replies = [session.step(position) for session in sessions]
        assert all(reply.contact for reply in replies), replies

        os.kill(int(before[0]["pid"]), signal.SIGKILL)
        with pytest.raises(SessionClosed):
            sessions[0].step(position)
        while (after := workers(server.url))[0]["starts_total"] < 2:
            assert sessions[1].step(position).good
            time.sleep(0.02)
        assert after[0]["pid"] != before[0]["pid"]
        assert after[1]["pid"] == before[1]["pid"]
        with session_on(0, server.url, client) as session:  # it has clients again
            assert session.step(position).good

        assert server.stop() == 0
        with pytest.raises(SessionClosed, match="stopping"):
            sessions[1].step(position)
        assert "Traceback" not in server.log
    for worker in after.values():
        with pytest.raises(ProcessLookupError):
            os.kill(int(worker["pid"]), 0)


def test_a_service_under_too_much_load_sheds_it_and_recovers(serve, artifact):
    with serve(artifact.parent, "--rate-limit", "20") as server:
        plan = Plan(
            server.url, "quick", sessions=2, rate=300.0, queries=80.0, duration=2.0, overload=10.0
        )
        summary = run(plan).summary
        queries = summary["queries"]
        assert summary["lost"] == 0
        assert summary["complaints"] == []
        assert summary["overload"]["before"]["answered"] > 0
        assert set(queries["refused"]) <= {"429", "503"}
        assert queries["refused"]
        assert queries["lost"] == 0
        assert summary["overload"]["after"]["answered"] > 0
        # it lives and has counted what it refused
        text = get(f"{server.url}/metrics")
        for code, status in (("too_many_requests", "429"), ("overloaded", "503")):
            counted = re.search(rf'code="{code}",worker="0"\}} (\S+)', text)
            assert float(counted[1]) == queries["refused"].get(status, 0)
        assert server.stop() == 0
        assert "Traceback" not in server.log
