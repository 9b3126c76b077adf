import os
import subprocess
import sys
import urllib.request

import pytest
from prometheus_client.parser import text_string_to_metric_families

from palpate.online.client.session import Session
from palpate.online.serve.metrics import BOUNDS, WIDTH, Metrics, make_table
from palpate.online.session.frames import Flag
from palpate.shared.errors import PalpateError


def samples(text):
    """Return the samples of an exposition: {(name, labels but worker): value}."""
    return {
        (s.name, *sorted((k, v) for k, v in s.labels.items() if k != "worker")): s.value
        for family in text_string_to_metric_families(text)
        for s in family.samples
    }


def test_the_opening_of_a_session_is_no_query(url):
    with Session(url, "toy") as session:
        session.step((5.0, 5.0, 6.5))
        with urllib.request.urlopen(f"{url}/metrics") as response:
            found = samples(response.read().decode())
    assert found["palpate_queue_seconds_count", ("kind", "query")] == 0
    assert found["palpate_queue_seconds_count", ("kind", "session")] == 1
    assert found[("palpate_sessions",)] == found[("palpate_sessions_opened_total",)] == 1


def test_answers_are_timed_by_phase_and_flags_and_refusals_counted(client):
    for pressure in (4, 4, 9):
        load = {"contacts": [{"position": [5, 5, 5], "pressure": pressure}], "region": "surface"}
        client.post("/scenes/toy/solve", json=load)
    found = samples(client.get("/metrics").text)
    for phase in ("decode", "solve", "recover", "encode"):
        labels = ("kind", "query"), ("phase", phase)
        assert found["palpate_phase_seconds_count", *labels] == 3
        assert 0 < found["palpate_phase_seconds_sum", *labels] < 3
    assert found["palpate_queue_seconds_count", ("kind", "query")] == 3
    client.post("/scenes/toy/solve", json={})
    client.get("/scenes/nose")
    client.get("/scenes", headers={"origin": "https://evil.example"})
    client.get("/nowhere")
    found = samples(client.get("/metrics").text)
    assert found["palpate_flags_total", ("flag", "out_of_range"), ("kind", "query")] == 1
    for code in ("invalid_value", "unknown_scene", "foreign_origin", "not_found"):
        assert found["palpate_refusals_total", ("code", code)] == 1


def test_a_duration_is_counted_where_prometheus_expects_it():
    metrics = Metrics()
    durations = [0.0, *BOUNDS, 1.5e-6, 10.0]  # bounds are inclusive
    for duration in durations:
        metrics.count_wait(duration)
    found = samples(metrics.text())
    name, kind = "palpate_queue_seconds", ("kind", "query")
    for bound in (*BOUNDS, float("inf")):
        edge = "+Inf" if bound == float("inf") else repr(bound)
        expected = sum(duration <= bound for duration in durations)
        assert found[f"{name}_bucket", kind, ("le", edge)] == expected
    assert found[f"{name}_count", kind] == len(durations)
    assert found[f"{name}_sum", kind] == pytest.approx(sum(durations))


def test_frames_are_counted_by_phase_flag_and_wait_and_sessions_as_they_come_and_go():
    metrics = Metrics()
    good = Flag.CONTACT | Flag.CONVERGED | Flag.IN_RANGE
    for flags in (good, Flag.CONVERGED | Flag.CLAMPED, Flag.FALLBACK):
        metrics.count_frame(0.5e-3, (0.0, 1e-6, 4e-6, 4e-6, 9e-6), int(flags), 2)
    metrics.count("frames_total", "refused")
    for by in (1.0, 1.0, -1.0):
        metrics.count("sessions", by=by)
    found = samples(metrics.text())
    session = ("kind", "session")
    for phase, took in (("decode", 1e-6), ("solve", 3e-6), ("recover", 0.0), ("encode", 5e-6)):
        labels = session, ("phase", phase)
        assert found["palpate_phase_seconds_count", *labels] == 3
        assert found["palpate_phase_seconds_sum", *labels] == pytest.approx(3 * took)
    assert found["palpate_queue_seconds_sum", session] == pytest.approx(1.5e-3)
    counted = {"contact": 1, "out_of_range": 2, "unconverged": 1, "clamped": 1, "fallback": 1}
    for flag, number in counted.items():
        assert found["palpate_flags_total", ("flag", flag), session] == number
    for outcome, number in (("answered", 3), ("superseded", 6), ("refused", 1)):
        assert found["palpate_frames_total", ("outcome", outcome)] == number
    assert found[("palpate_sessions",)] == 1


HOLD = """
import sys, pathlib
from palpate.online.session.frames import Flag
from palpate.online.serve.metrics import Metrics
metrics = Metrics(pathlib.Path(sys.argv[1]))
for _ in range(3):
    metrics.count("sessions")
    metrics.count("sessions_opened_total")
print(metrics.worker, flush=True)
sys.stdin.read()
"""


def worker(table):
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, table], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    return process, int(process.stdout.readline())


@pytest.mark.skipif(os.name == "nt", reason="workers are for POSIX")
def test_a_new_worker_counts_on_where_a_killed_one_was(tmp_path):
    table = tmp_path / "metrics"
    make_table(table, 2)
    assert table.stat().st_size == 2 * 8 * WIDTH
    (first, a), (second, b) = worker(table), worker(table)
    assert {a, b} == {0, 1}
    descriptors = len(os.listdir("/dev/fd"))
    with pytest.raises(PalpateError, match="more workers than rows"):
        Metrics(table)
    assert len(os.listdir("/dev/fd")) == descriptors
    first.kill()
    first.wait()
    third = Metrics(table)
    assert third.worker == a
    assert third.restarted
    text = third.text()
    for name, worker_, value in (
        ("sessions", a, 0), ("sessions_opened_total", a, 3), ("worker_starts_total", a, 2),
        ("sessions", b, 3), ("worker_pid", b, second.pid),
    ):  # fmt: skip
        assert f'palpate_{name}{{worker="{worker_}"}} {float(value)}' in text
    second.communicate(timeout=10)
    first.communicate(timeout=10)
