"""How the service is run: settings, several workers, who is let in, what it tells of itself."""

import json
import os
import re
import shutil
import signal
import time
import urllib.request
from contextlib import ExitStack, suppress

import numpy as np
import pytest
from click.testing import CliRunner
from prometheus_client.parser import text_string_to_metric_families

from palpate.online.client.http import Client
from palpate.online.client.session import ServiceError, Session, SessionClosed
from palpate.online.loadtest.run import run
from palpate.online.settings import Plan
from palpate.shared.cli import main
from palpate.shared.model import ReducedModel

from .conftest import process_memory, rewritten

pytestmark = pytest.mark.service


def get(url):
    with urllib.request.urlopen(url) as response:
        return response.read().decode()


def workers(url):
    """Return what each worker says of itself: {worker: {metric: value}}."""
    found = {}
    for family in text_string_to_metric_families(get(f"{url}/metrics")):
        for name, labels, value, *_ in family.samples:
            if labels.keys() == {"worker"}:
                found.setdefault(int(labels["worker"]), {})[name] = value
    return found


def test_help_names_the_variable_of_every_setting():
    text = CliRunner().invoke(main, ["serve", "--help"]).stdout
    options = re.findall(r"^  --(?!help)([\w-]+)", text, re.M)
    assert len(options) > 10
    for option in options:
        variable = "PALPATE_" + option.replace("-", "_").upper()
        assert re.search(rf"\b{variable}S?\b", re.sub(r"\s+", " ", text)), option


@pytest.mark.parametrize("command", ["serve", "loadtest"])
def test_help_has_an_example_a_line(command):
    _, examples = CliRunner().invoke(main, [command, "--help"]).stdout.split("Examples:\n")
    assert all(line.startswith(("    palpate ", "    PALPATE_")) for line in examples.splitlines())


def test_settings_come_from_the_environment_and_a_token_lets_other_machines_in(serve, artifact):
    settings = {"TOKEN": "secret", "MAX_BODY": "2000", "REALTIME": "1", "ACCESS_LOG": "1"}
    environment = {f"PALPATE_{name}": value for name, value in settings.items()}
    with serve(artifact.parent, "--host", "0.0.0.0", **environment) as server:
        url = server.url.replace("0.0.0.0", "127.0.0.1")
        with pytest.raises(urllib.error.HTTPError, match="401"):
            get(f"{url}/scenes")
        with Client(url, token="secret") as client:
            client.solve("quick", **client.scene("quick")["example"]["contacts"][0])
            with pytest.raises(ServiceError) as refused:
                client.solve("quick", [0.0] * 1000, 1.0)
        assert refused.value.status == 413
        assert server.stop() == 0
    messages = [json.loads(line)["message"] for line in server.log.splitlines()]
    assert any(message.startswith("real-time scheduling: ") for message in messages)
    assert any("POST /scenes/quick/solve" in message and "200" in message for message in messages)
    assert "secret" not in server.log


@pytest.mark.parametrize(
    ("proxy", "statuses"),
    [
        ([], [200, 429]),
        (["--proxy", "10.0.0.9"], [200, 429]),
        (["--proxy", "127.0.0.1"], [200, 200]),
    ],
)
def test_only_a_proxy_that_is_named_is_believed_who_its_clients_are(
    serve, artifact, proxy, statuses
):
    found = []
    with serve(artifact.parent, "--rate-limit", "0.01", *proxy) as server:
        for client in ("10.0.0.1", "10.0.0.2"):
            request = urllib.request.Request(
                f"{server.url}/scenes", headers={"X-Forwarded-For": client}
            )
            try:
                with urllib.request.urlopen(request) as response:
                    found.append(response.status)
            except urllib.error.HTTPError as refused:
                with refused:
                    found.append(refused.code)
    assert found == statuses


def misbehave(url, times):
    """Ask for what is refused, and leave sessions in the middle of nonsense."""
    for i in range(times):
        for path, body in (
            ("/scenes/quick/solve", 20_000 * b"[0,"),  # no JSON
            ("/scenes/quick/solve", 70_000 * b"["),  # too long
            (f"/scenes/{i}{5_000 * 'a'}/solve", b"{}"),
            (f"/{i}{20_000 * 'a'}", b""),  # its head is too long
        ):
            with pytest.raises((urllib.error.URLError, ConnectionError)):
                urllib.request.urlopen(f"{url}{path}", body)
        with suppress(ServiceError), Session(url, "quick") as session:  # there may be too many
            for nonsense in (1_000 * b"x", '{"position": [1e9', '{"snapshot": 99}'):
                session._connection.send(nonsense)
            session._connection.socket.close()


def test_refused_requests_and_abandoned_sessions_take_no_memory_for_good(serve, artifact):
    with serve(artifact.parent) as server:
        misbehave(server.url, 50)
        before = process_memory(server.process.pid)
        misbehave(server.url, 300)
        assert process_memory(server.process.pid) - before < 20e6  # of 45 MB that were sent
        with Client(server.url) as client:
            assert client.scenes()["scenes"]


def session_on(worker, url, client, **options):
    """Open a session on a worker: again and again, since any of them may accept it."""
    for _ in range(500):
        before = workers(url)[worker]["palpate_sessions"]
        session = client.session("quick", **options)
        if workers(url)[worker]["palpate_sessions"] > before:
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
        lasting = stack.enter_context(session_on(0, server.url, client, reconnect=10.0))
        assert lasting.step(position).first

        os.kill(int(before[0]["palpate_worker_pid"]), signal.SIGKILL)
        with pytest.raises(SessionClosed):
            sessions[0].step(position)
        assert lasting.step(position).first  # it is with the other worker, or with the new one
        assert lasting.reconnections == 1
        while (after := workers(server.url))[0]["palpate_worker_starts_total"] < 2:
            assert sessions[1].step(position).good
            time.sleep(0.02)
        assert after[0]["palpate_worker_pid"] != before[0]["palpate_worker_pid"]
        assert after[1]["palpate_worker_pid"] == before[1]["palpate_worker_pid"]
        for worker in after.values():  # the models are in memory once
            own, whole = (worker[f"palpate_worker_{kind}_bytes"] for kind in ("own", "resident"))
            assert 0 < own < 0.7 * whole
        with session_on(0, server.url, client) as session:  # it has clients again
            assert session.step(position).good

        assert server.stop() == 0
        with pytest.raises(SessionClosed, match="stopping"):
            sessions[1].step(position)
        assert "Traceback" not in server.log
    for worker in after.values():
        with pytest.raises(ProcessLookupError):
            os.kill(int(worker["palpate_worker_pid"]), 0)


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


def test_an_artifact_replaced_under_load_loses_no_answer_and_mixes_none(
    serve, artifact, atlas, tmp_path
):
    times = int(os.environ.get("PALPATE_REPLACED", "4"))
    folder, made = tmp_path / "served", tmp_path / "made"
    folder.mkdir()
    made.mkdir()
    files = [artifact, rewritten(artifact, made / "stiffer.h5", "young = 15.0", "young = 20.0")]
    position, pressure = atlas.surface.vertices[40], 1.0
    models = [ReducedModel.load(file) for file in files]
    moved = [m.press(position, pressure).contact_displacement.tolist() for m in models]
    tip = position + 0.8 * atlas.scene.endoscope.radius * atlas.surface.normals[40]
    felt = atlas.touch(tip).force

    def feels_the_first(session):
        away = np.linalg.norm(session.step(tip).force - felt)
        assert away < 1e-3 * np.linalg.norm(felt)  # the other's is a third larger

    shutil.copy(artifact, folder / "quick.h5")
    with serve(folder) as server, Client(server.url) as client, client.session("quick") as session:
        served, answers = 0, 0
        for replaced in range(1, times + 1):
            shutil.copy(files[replaced % 2], folder / "quick.part")
            (folder / "quick.part").rename(folder / "quick.h5")
            end = time.monotonic() + 30
            while served != replaced % 2:
                assert time.monotonic() < end, "it is not taken up"
                answer = client.solve("quick", position, pressure)
                served = moved.index(answer.contact_displacement.tolist())
                feels_the_first(session)
                answers += 1
        (folder / "quick.h5").unlink()
        end = time.monotonic() + 30
        while "quick" in get(f"{server.url}/scenes"):
            assert time.monotonic() < end, "it is still served"
        with pytest.raises(ServiceError, match="No such scene"):
            client.solve("quick", position, pressure)
        feels_the_first(session)
    print(f"{times} times replaced, {answers} answers")
