"""Load tests of a toy service on a real socket."""

import json
import re

import numpy as np
import pytest
from click.testing import CliRunner

from palpate.online.commands import loadtest
from palpate.online.loadtest.run import run, table
from palpate.online.settings import Plan, Settings
from palpate.shared.errors import PalpateError


@pytest.mark.parametrize("region", ["none", "all"])
def test_queries_are_all_answered(url, region):
    plan = Plan(url, "toy", sessions=0, queries=100.0, duration=0.5, region=region)
    summary = run(plan).summary
    assert (summary["due"], summary["answered"], summary["lost"]) == (50, 50, 0)
    assert summary["refused"] == {}
    assert summary["solve_us"]["p50_us"] < summary["all"]["p50_us"]


def test_no_frame_of_a_session_is_lost(url):
    plan = Plan(
        url, "toy", sessions=2, rate=200.0, queries=20.0, duration=0.5, outputs=("displacement",)
    )
    outcome = run(plan)
    summary = outcome.summary
    assert (summary["due"], summary["lost"], summary["complaints"]) == (200, 0, [])
    assert summary["answered"] + summary["superseded"] == 200
    assert 0 < summary["flags"]["CONTACT"] < summary["answered"]
    assert summary["solve_us"]["p50_us"] < summary["all"]["p50_us"]
    assert summary["queries"]["answered"] == 10
    assert len(outcome.messages["frames"].due) == 200
    assert len(outcome.messages["queries"].due) == 10

    # none before it is due, and latency counts from then
    for messages in outcome.messages.values():
        assert (messages.lateness >= 0).all()
        known = np.isfinite(messages.latency)
        assert (messages.latency > messages.lateness)[known].all()
    borders = np.diff(outcome.machine.borders)
    assert (borders > 0).all()
    assert len(outcome.machine.steal) == len(borders)


def test_superseded_frames_are_told_from_lost_ones(url):
    plan = Plan(url, "toy", sessions=1, rate=9000.0, duration=0.5)
    summary = run(plan).summary
    assert summary["answered"] + summary["superseded"] == summary["due"] == 4500
    assert summary["lost"] == 0


def test_a_session_that_the_service_ends_is_told_and_the_other_goes_on(serving):
    with serving(session_idle=0.15) as url:
        plan = Plan(url, "toy", sessions=1, rate=3.0, queries=20.0, duration=1.0)
        summary = run(plan).summary
    assert "no frame for" in summary["complaints"][0]
    assert summary["lost"] > 0
    assert summary["queries"]["answered"] == 20


@pytest.mark.parametrize(
    ("plan", "why"),
    [
        ({"sessions": Settings.max_sessions + 1}, "16 sessions are open"),
        ({"sessions": 0}, "--sessions or --queries-per-second"),
        ({"duration": 0.5, "echo": True}, "palpate serve --echo"),
    ],
)
def test_what_cannot_be_done_is_refused(url, plan, why):
    with pytest.raises(PalpateError, match=why):
        run(Plan(url, "toy", **plan))


def test_too_much_is_refused_and_told_apart(url):
    plan = Plan(url, "toy", sessions=0, queries=100.0, duration=0.5, overload=60.0, region="none")
    summary = run(plan).summary
    counted = summary["answered"] + summary["dropped"] + sum(summary["refused"].values())
    assert counted + summary["lost"] == summary["due"] == 50 + 3000 + 50
    assert set(summary["overload"]) == {"before", "during", "after", "recovered_s"}


def test_what_the_service_adds_is_measured(serving):
    with serving(echo=True, token="secret") as url:
        plan = Plan(url, "toy", rate=100.0, queries=50.0, duration=0.5, echo=True, token="secret")
        outcome = run(plan)
    assert {name: len(m.due) for name, m in outcome.messages.items()} == {
        "frames": 50, "echoes": 50, "queries": 25, "checks": 25
    }  # fmt: skip
    assert set(outcome.summary["added"]) == {"frames", "queries"}
    for added in outcome.summary["added"].values():
        assert 0 < added["added_us"] < 10 * added["empty_us"]
    assert "times an empty round trip" in table(outcome.summary)


def test_the_command_prints_json_and_draws(url, tmp_path):
    picture = tmp_path / "load.png"
    arguments = [url, "toy", "--sessions", "0", "--queries-per-second", "50", "--duration", "0.5"]
    result = CliRunner().invoke(loadtest, [*arguments, "--json", "--out", str(picture)])
    assert result.exit_code == 0, result.output
    summary = json.loads(result.output)
    assert {"lost", "clean", "all", "solve_us", "machine"} <= set(summary)
    assert {"p50_us", "p99_us", "p999_us"} <= set(summary["all"])
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_the_command_prints_a_table(url):
    arguments = [url, "toy", "--rate", "50", "--queries-per-second", "50", "--duration", "0.5"]
    outputs = ["--output", "displacement", "--output", "half"]
    result = CliRunner().invoke(loadtest, [*arguments, *outputs])
    for kind in ("frames", "queries"):
        row = re.search(rf"\| {kind}, all windows" + 4 * r" \| (\d+)", result.output)
        assert row, result.output
        answered, lost, superseded, refused = map(int, row.groups())
        assert (lost, refused) == (0, 0)
        assert answered + superseded == 25  # a busy machine may send some late, in a bunch
