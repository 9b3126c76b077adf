from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest

from palpate.online.loadtest.run import (
    clean_windows,
    gather,
    quantiles,
    summarize,
    summarize_added,
    summarize_overload,
    table,
    verdict,
)
from palpate.online.loadtest.streams import (
    ANSWERED,
    DROPPED,
    LOST,
    MESSAGE,
    SUPERSEDED,
    Machine,
)
from palpate.online.session.frames import Flag
from palpate.online.settings import Plan


def log(due, latency_ms=0.2, late_ms=0.0, outcome=ANSWERED):
    """Return messages due at some times (s), all of one fate or each of its own."""
    found = np.zeros(len(due), MESSAGE).view(np.recarray)
    found.due, found.latency, found.lateness = due, 1e3 * np.asarray(latency_ms), 1e3 * late_ms
    found.outcome, found.solve, found["flags"] = outcome, 50.0, Flag.CONTACT
    found.window = found.due  # those of `machine` have a second
    found.latency[found.outcome != ANSWERED] = np.nan
    return found


def machine(seconds, steal=()):
    """Return a machine's record in windows of a second."""
    stolen = np.zeros(seconds)
    stolen[list(steal)] = 0.01
    return Machine(np.arange(seconds + 1.0), stolen)


def test_quantiles_are_those_of_the_values(rng):
    found = quantiles(np.append(rng.permutation(np.arange(1.0, 1001.0)), np.nan))
    assert list(found.values()) == pytest.approx([500.0, 900.0, 990.0, 999.0, 1000.0], abs=1.0)
    assert quantiles(np.full(3, np.nan))["p50_us"] is None


def test_streams_are_put_in_one_order():
    streams = [SimpleNamespace(log=log([0.1, 0.3], 3.0)), SimpleNamespace(log=log([0.2, 0.4], 2.0))]
    messages = gather(streams, machine(1))
    assert messages.due == pytest.approx([0.1, 0.2, 0.3, 0.4])
    assert messages.latency == pytest.approx([3000.0, 2000.0, 3000.0, 2000.0])
    assert not messages.window.any()


def test_a_window_is_clean_if_host_and_generator_were_on_time():
    due = np.arange(0.05, 5.0, 0.1)
    late = np.where((due > 2.0) & (due < 2.1), 0.5, 0.01)
    messages = log(due, late_ms=late)
    assert clean_windows(machine(5, steal=[4]), messages).tolist() == [1, 1, 0, 1, 0]
    messages.lateness[-12] = np.nan  # never sent
    assert clean_windows(machine(5), messages).tolist() == [1, 1, 0, 0, 1]


def test_what_became_of_messages_is_told_apart():
    outcome = [ANSWERED, LOST, SUPERSEDED, SUPERSEDED, ANSWERED, 429, 503, DROPPED]
    messages = log(np.arange(8.0), outcome=outcome)
    streams = [SimpleNamespace(complaint=why) for why in ("", "stop", "stop")]
    found = summarize(messages, np.arange(8) < 4, streams)
    counts = [found[name] for name in ("due", "answered", "lost", "superseded", "dropped")]
    assert counts == [8, 2, 1, 2, 1]
    assert found["refused"] == {"429": 1, "503": 1}
    assert found["flags"]["CONTACT"] == 2
    assert found["flags"]["FALLBACK"] == 0
    assert found["clean"]["p50_us"] == pytest.approx(200.0, rel=1e-3)
    assert found["complaints"] == ["stop"]


def judged(messages, **changes):
    """The verdict on frames at 1 kHz of a session."""
    return reported(messages, **changes)["verdict"]


def reported(messages, late_ms=0.0, steal=(), **plan):
    """The summary of a load test of frames at 1 kHz of a session."""
    messages.lateness[:] = 1e3 * late_ms
    box = machine(10, steal)
    clean = clean_windows(box, messages)
    summary = summarize(messages, clean, [SimpleNamespace(complaint="")])
    summary["machine"] = {
        "windows": 10,
        "clean_windows": int(clean.sum()),
        "steal_s": float(box.steal.sum()),
        "load_average": 0.0,
        "lateness_us": quantiles(messages.lateness),
    }
    asked = Plan("http://127.0.0.1:1", "toy", **plan)
    if asked.overload > 1:
        summary["overload"] = {"recovered_s": 0.5 if asked.overload < 5 else None}
    return summary | {"plan": asdict(asked), "verdict": verdict(asked, summary)}


def test_the_verdict_says_whether_why_and_what_to_do():
    due = np.arange(0.0, 10.0, 0.01)
    kept = judged(log(due))
    assert (kept["verdict"], kept["do"]) == ("kept", "")
    assert kept["why"] == "99 of 100 within 200 µs (frames)"
    assert kept["asked"] == "toy: 1 sessions at 1000 frames/s for 10 s"
    for fate, word, advice in (
        (SUPERSEDED, "superseded", "--workers"),
        (LOST, "lost", "log"),
        (503, "refused", "--max-sessions"),
    ):
        found = judged(log(due, outcome=np.where(due < 1.0, fate, ANSWERED)))
        assert found["verdict"] == "not kept"
        assert found["why"] == f"100 of 1000 frames were {word}"
        assert advice in found["do"]
    slow = judged(log(due, latency_ms=1.5))
    assert slow["verdict"] == "not kept"
    assert slow["why"] == "99 of 100 frames took up to 1500 µs, and one lasts 1000"
    assert judged(log(due), overload=2.0)["verdict"] == "kept"
    assert judged(log(due), overload=9.0)["verdict"] == "not kept"


def test_a_load_test_that_was_late_itself_says_nothing_of_the_service():
    due = np.arange(0.0, 10.0, 0.01)
    superseded = np.where(due < 8.0, SUPERSEDED, ANSWERED)
    assert judged(log(due, outcome=superseded), late_ms=1.6)["verdict"] == "void"
    seldom = np.where(np.arange(1000) % 100 == 50, 1.6, 0.0)  # one in a hundred, and in each window
    why = judged(log(due), late_ms=seldom)["why"]
    assert why.startswith("in 10 of 10 windows the load test itself was more than 100 µs late")
    assert "by up to 1600 µs" in why
    found = judged(log(due), steal=range(6))
    assert found["verdict"] == "void"
    assert found["why"].startswith("in 6 of 10 windows")


def test_the_verdict_is_the_first_that_is_printed_and_then_what_to_do():
    due, asked = np.arange(0.0, 10.0, 0.01), "toy: 1 sessions at 1000 frames/s for 10 s"
    lost = np.where(due < 1.0, LOST, ANSWERED)
    kept, missed, void = (
        table(reported(*found)).splitlines()
        for found in ((log(due),), (log(due, outcome=lost),), (log(due), 1.6))
    )
    assert kept[:2] == [f"kept: {asked}: 99 of 100 within 200 µs (frames)", ""]
    assert missed[0] == f"not kept: {asked}: 100 of 1000 frames were lost"
    assert missed[1].startswith("what to do: look at the service's log")
    assert void[0].startswith(f"void: {asked}: in 10 of 10 windows the load test itself was more")
    assert void[1].startswith("what to do: run it where it has a core of its own")


def test_what_the_service_adds_is_the_round_trip_less_its_work():
    """Both counted from when the message was sent."""
    due = np.arange(5.0)
    messages, empty = log(due, 0.5, late_ms=0.1), log(due, 0.3, late_ms=0.1)
    messages.recover[:] = 70.0
    messages.latency[0] = np.nan
    found = summarize_added(messages, empty)
    assert found == pytest.approx({"added_us": 280.0, "empty_us": 200.0, "ratio": 1.4})


@pytest.mark.parametrize(("slow_until", "recovered"), [(4.0, 0.0), (5.5, 2.0), (9.0, None)])
def test_recovery_is_when_latencies_are_as_before(slow_until, recovered):
    due = np.arange(0.01, 8.0, 0.01)
    slow = (due > 2.0) & (due < slow_until)
    messages = log(due, np.where(slow, 50.0, 0.2))
    found = summarize_overload(messages, machine(8), 2.0, 4.0)
    assert found["recovered_s"] == recovered
    assert found["before"]["p99_us"] == pytest.approx(200.0, rel=1e-3)
    assert found["during"]["p50_us"] == pytest.approx(50_000.0, rel=1e-3)


@pytest.mark.parametrize(
    ("begin", "end", "fate", "recovered"),
    [
        (4.8, 4.9, LOST, 1.0),  # in the last window but one: no recovery
        (2.0, 4.5, SUPERSEDED, 0.0),  # neither hides a recovery
        (0.0, 6.0, LOST, None),
    ],
)
def test_lost_messages_are_no_recovery_and_superseded_ones_do_not_count(
    begin, end, fate, recovered
):
    due = np.arange(0.01, 6.0, 0.01)
    outcome = np.where((due > begin) & (due < end), fate, ANSWERED)
    found = summarize_overload(log(due, outcome=outcome), machine(6), 2.0, 4.0)
    assert found["recovered_s"] == recovered
