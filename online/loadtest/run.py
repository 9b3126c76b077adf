"""Put a load on a service, tools over the surface and queries beside them, and report.

Latencies are given in all windows and in the clean ones.
"""

import json
import os
import socket
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from palpate.online.client.http import Client
from palpate.online.client.session import Connection, connect, scene_path, split_address
from palpate.online.loadtest.paths import tool_path
from palpate.online.loadtest.streams import (
    ANSWERED,
    DROPPED,
    LOST,
    SUPERSEDED,
    WINDOW,
    FrameStream,
    Machine,
    QueryStream,
    Stream,
    drive,
)
from palpate.online.serve.wire import BINARY, JSON
from palpate.online.session.frames import Flag, output_bits
from palpate.online.session.websocket import ECHO
from palpate.online.settings import Plan
from palpate.shared.arrays import Array, Flags
from palpate.shared.errors import PalpateError

Messages = np.recarray[Any, Any]
"""What became of n messages, `streams.MESSAGE`, in the order in which they were due."""

LEAD = 0.1
"""Seconds before the first message, for the sockets to settle."""

SHARE = 0.15
"""Largest pressure of queries over the largest of the scene: most points of a body take that."""

ON_TIME = 100.0
"""Latest that a message may be sent in a clean window, µs after it was due."""

KEPT = 0.99
"""Share of messages that are answered where a service keeps what is asked."""

_KEPT = {True: "kept", False: "not kept"}
_LESS = "ask for fewer sessions or a lower rate, leave it a core, or give it more with --workers"
_ADVICE = {
    "superseded": _LESS,
    "dropped": _LESS,
    "lost": "look at the service's log for why it ended connections",
    "refused": "look at --rate-limit, --max-sessions and --max-wait of the service",
}

QUANTILES = {"p50_us": 50.0, "p90_us": 90.0, "p99_us": 99.0, "p999_us": 99.9, "max_us": 100.0}


class Outcome(NamedTuple):
    """What a load test found; ``echoes`` and ``checks`` are to compare the others with."""

    summary: dict[str, Any]  # JSON-able
    machine: Machine
    clean: Flags  # (w,), which windows of the machine were clean
    messages: dict[str, Messages]  # by kind, those that were sent


def run(plan: Plan) -> Outcome:
    """Put a load on a service and report what became of it.

    Raises `PalpateError` if there is nothing to send, or the service cannot be reached, lacks the
    scene or refuses a session.
    """
    if not (plan.sessions or plan.queries):
        raise PalpateError("nothing to send: ask for --sessions or --queries-per-second")
    with ExitStack() as stack:
        streams = [stack.enter_context(closing(stream)) for stream in _streams(plan)]
        machine = drive(streams)
    return _judge(plan, machine, streams)


def _streams(plan: Plan) -> Iterator[Stream]:
    """Connect to the service and make the streams of a plan."""
    rng = np.random.default_rng(plan.seed)
    with Client(plan.url, token=plan.token) as client:
        ranges = client.scene(plan.scene)["ranges"]
        surface = client.accessible(plan.scene)
    outputs = output_bits(plan.outputs)
    for i in range(plan.sessions):
        due = _schedule(plan, plan.rate, i / plan.sessions)
        path = tool_path(surface, ranges["radius"], plan.depth, due, rng)
        line = _connect(plan, scene_path(plan.scene, "/session"))
        yield FrameStream("frames", due, line, path, outputs)
    if plan.sessions and plan.echo:
        due = _schedule(plan, plan.rate, 0.5 / plan.sessions)
        yield FrameStream("echoes", due, _connect(plan, ECHO), path)
    if plan.queries:
        due = _schedule(plan, plan.queries, 0.5)
        places = rng.choice(surface.vertices, len(due))
        loads = places, rng.uniform(0.0, SHARE * ranges["pressure"][1], len(due))
        yield _queries(plan, "queries", "/solve", due, loads)
        if plan.echo:
            due = _schedule(plan, plan.queries, 0.0)
            yield _queries(plan, "checks", "/check", due, loads)


def _connect(plan: Plan, path: str) -> socket.socket:
    """Open a WebSocket and read its greeting."""
    try:
        connection = Connection(plan.url, path, plan.token, timeout=10.0)
    except PalpateError as error:
        hint = " (start the service with: palpate serve --echo)" if path == ECHO else ""
        raise PalpateError(f"{path}: {error}{hint}") from error
    connection.receive()
    return connection.socket


def _queries(
    plan: Plan, kind: str, verb: str, due: Array, loads: tuple[Array, Array]
) -> QueryStream:
    """Write requests for loads, positions (n, 3) mm and pressures (n,) kPa, answered in binary."""
    head = [f"POST {scene_path(plan.scene, verb)} HTTP/1.1", f"accept: {BINARY}"]
    head += [f"host: {split_address(plan.url).netloc}", f"content-type: {JSON}"]
    head += [f"authorization: Bearer {plan.token}"] if plan.token else []
    contacts = zip(*(values.tolist() for values in loads), strict=True)
    bodies = (
        json.dumps({"contacts": [{"position": at, "pressure": pressure}], "region": plan.region})
        for at, pressure in contacts
    )
    requests = ["\r\n".join([*head, f"content-length: {len(b)}", "", b]).encode() for b in bodies]
    sockets = [connect(plan.url, timeout=10.0) for _ in range(plan.connections)]
    return QueryStream(kind, due, sockets, requests)


def _schedule(plan: Plan, rate: float, shift: float) -> Array:
    """Say when the messages of a stream are due (s), `shift` of a period after the others."""
    rates = [rate] if plan.overload == 1.0 else [rate, plan.overload * rate, rate]
    due = [
        LEAD + i * plan.duration + (np.arange(round(r * plan.duration)) + shift) / r
        for i, r in enumerate(rates)
    ]
    return np.concatenate(due)


def _judge(plan: Plan, machine: Machine, streams: Sequence[Stream]) -> Outcome:
    """Summarize what became of the messages of a plan."""
    every = gather(streams, machine)
    by_kind = {stream.kind: [s for s in streams if s.kind == stream.kind] for stream in streams}
    messages = {kind: gather(alike, machine) for kind, alike in by_kind.items()}
    clean = clean_windows(machine, every)
    summaries = {
        kind: summarize(found, clean, by_kind[kind])
        for kind, found in messages.items()
        if kind in ("frames", "queries")
    }
    summary: dict[str, Any] = {"plan": asdict(plan) | {"token": None}}
    summary |= summaries.pop(next(iter(messages))) | summaries
    summary["machine"] = {
        "window_s": WINDOW,
        "windows": len(clean),
        "clean_windows": int(clean.sum()),
        "steal_s": round(float(machine.steal.sum()), 2),
        "load_average": os.getloadavg()[0],
        "lateness_us": quantiles(every.lateness),
    }
    if plan.echo:
        summary["added"] = {
            kind: summarize_added(messages[kind], messages[empty])
            for kind, empty in (("frames", "echoes"), ("queries", "checks"))
            if kind in messages
        }
    if plan.overload > 1.0:
        start, end = LEAD + plan.duration, LEAD + 2.0 * plan.duration
        first = messages.get("frames", every)
        summary["overload"] = summarize_overload(first, machine, start, end)
    summary["verdict"] = verdict(plan, summary)
    return Outcome(summary, machine, clean, messages)


def verdict(plan: Plan, summary: dict[str, Any]) -> dict[str, str]:
    """Say whether a service ``kept`` what a plan asked, ``not kept`` or ``void``; why, what to do.

    It is kept if ``KEPT`` of all messages are answered, frames within the time of one in 99 of 100;
    of an overload, if all is as before soon after.  It is void if the generator or the machine was
    at fault.
    """
    machine, parts = summary["machine"], []
    parts += [f"{plan.sessions} sessions at {plan.rate:g} frames/s"] if plan.sessions else []
    parts += [f"{plan.queries:g} queries/s"] if plan.queries else []
    asked = f"{plan.scene}: {' and '.join(parts)} for {plan.duration:g} s"
    late, latest = (machine["lateness_us"][name] for name in ("p99_us", "max_us"))
    windows, clean = machine["windows"], machine["clean_windows"]
    if late is None or late > ON_TIME or 2 * clean < windows:
        why = f"in {windows - clean} of {windows} windows the load test itself was more than "
        why += f"{ON_TIME:.0f} µs late, by up to {latest or 0:.0f} µs, or the machine's host took "
        why += f"time ({machine['steal_s']} s)"
        do = "run it where it has a core of its own, or ask for less"
        return {"verdict": "void", "asked": asked, "why": why, "do": do}
    if "overload" in summary:
        recovered = summary["overload"]["recovered_s"]
        why = f"{plan.overload:g} times that; " + (
            "it has not recovered" if recovered is None else f"recovered after {recovered} s"
        )
        do = "look at the picture (--out) for what stays late" if recovered is None else ""
        return {"verdict": _KEPT[recovered is not None], "asked": asked, "why": why, "do": do}
    kinds = {"frames" if plan.sessions else "queries": summary}
    kinds |= {"queries": summary["queries"]} if "queries" in summary else {}
    said, advice = [], ""
    for name, kind in kinds.items():
        missed = {what: kind[what] for what in ("superseded", "lost", "dropped")}
        missed["refused"] = sum(kind["refused"].values())
        most = max(missed, key=lambda what: missed[what])
        if kind["answered"] < KEPT * kind["due"]:
            said.append(f"{missed[most]} of {kind['due']} {name} were {most}")
            advice = advice or _ADVICE[most]
        slowest, frame = kind["clean"]["p99_us"], 1e6 / plan.rate
        if name == "frames" and slowest is not None and slowest > frame:
            said.append(f"99 of 100 frames took up to {slowest:.0f} µs, and one lasts {frame:.0f}")
            advice = advice or _ADVICE["superseded"]
    if said:
        return {"verdict": _KEPT[False], "asked": asked, "why": "; ".join(said), "do": advice}
    why = "99 of 100 within " + " and ".join(
        f"{kind['clean']['p99_us'] or 0:.0f} µs ({name})" for name, kind in kinds.items()
    )
    return {"verdict": _KEPT[True], "asked": asked, "why": why, "do": ""}


def gather(streams: Sequence[Stream], machine: Machine) -> Messages:
    """Put the messages of several streams in one table, with the windows in which they were due."""
    messages = np.concatenate([stream.log for stream in streams])
    messages["window"] = np.searchsorted(machine.borders[1:-1], messages["due"], "right")
    return messages[np.argsort(messages["due"], kind="stable")].view(np.recarray)


def clean_windows(machine: Machine, messages: Messages) -> Flags:
    """Tell in which windows (w,) the host took no time and every message was sent on time."""
    clean = machine.steal == 0
    clean[messages.window[~(messages.lateness <= ON_TIME)]] = False  # also of those never sent
    return clean


def quantiles(microseconds: Array) -> dict[str, float | None]:
    """Tell the `QUANTILES` of those durations that are not NaN; None if there are none."""
    known = microseconds[np.isfinite(microseconds)]
    if not len(known):
        return dict.fromkeys(QUANTILES)
    values = np.percentile(known, list(QUANTILES.values()), method="inverted_cdf")
    return dict(zip(QUANTILES, values.tolist(), strict=True))


def summarize(messages: Messages, clean: Flags, streams: Sequence[Stream]) -> dict[str, Any]:
    """Say what became of frames or queries, those of `clean` windows (w,) apart."""
    outcomes = Counter(messages.outcome.tolist())
    flags = messages["flags"][messages.outcome == ANSWERED]
    unhindered = messages[clean[messages.window]]
    return {
        "due": len(messages),
        "answered": outcomes.pop(ANSWERED, 0),
        "lost": outcomes.pop(LOST, 0),
        "superseded": outcomes.pop(SUPERSEDED, 0),
        "dropped": outcomes.pop(DROPPED, 0),
        "refused": {str(status): number for status, number in sorted(outcomes.items())},
        "flags": {bit.name: int((flags & bit > 0).sum()) for bit in Flag},
        "clean": quantiles(unhindered.latency),
        "all": quantiles(messages.latency),
        "solve_us": quantiles(messages.solve),
        "clean_solve_us": quantiles(unhindered.solve),
        "complaints": sorted({stream.complaint for stream in streams if stream.complaint}),
    }


def summarize_added(messages: Messages, empty: Messages) -> dict[str, float]:
    """Say what the service adds to a solve, in medians.

    ``added_us`` is the round trip less what the service spent on solving and on recovering fields;
    ``empty_us`` the round trip of what was only checked or echoed; ``ratio`` the first over the
    second.
    """
    trip, empty_trip = (m.latency - m.lateness for m in (messages, empty))
    added = float(np.nanmedian(trip - messages.solve - messages.recover))
    empty_us = float(np.nanmedian(empty_trip))
    return {"added_us": added, "empty_us": empty_us, "ratio": added / empty_us}


def summarize_overload(
    messages: Messages, machine: Machine, start: float, end: float
) -> dict[str, Any]:
    """Describe latencies and answers before, during and after an overload of `start` to `end` (s).

    ``recovered_s`` is from its end to the first window from which on no window's 99th percentile is
    above twice the worst before; None if that never came, or nothing was well before.
    """
    phases = np.searchsorted([start, end], messages.due, "right")
    report: dict[str, Any] = {}
    for number, name in enumerate(("before", "during", "after")):
        of_phase = messages[phases == number]
        report[name] = {
            "due": len(of_phase),
            "answered": int((of_phase.outcome == ANSWERED).sum()),
            **quantiles(of_phase.latency),
        }
    before, after = (np.unique(messages.window[phases == phase]) for phase in (0, 2))
    bar = 2.0 * max(_worst(messages, w) for w in before)
    recovered = None
    for w in after[::-1]:
        if np.isinf(bar) or _worst(messages, w) > bar:
            break
        recovered = max(0.0, round(float(machine.borders[w]) - end, 3))
    report["recovered_s"] = recovered
    return report


def _worst(messages: Messages, window: int) -> float:
    """99th percentile of the latencies of a window; infinite if messages got no answer."""
    latency = messages.latency[(messages.window == window) & (messages.outcome != SUPERSEDED)]
    known = np.nan_to_num(latency, nan=np.inf, posinf=np.inf)
    return float(np.percentile(known, 99, method="higher")) if len(known) else np.inf


def table(summary: dict[str, Any]) -> str:
    """Write a summary for people: rows of Markdown per kind of message and of windows."""
    said, flags = summary["verdict"], summary["flags"]
    rows = [
        f"{said['verdict']}: {said['asked']}: {said['why']}",
        *([f"what to do: {said['do']}"] if said["do"] else []),
        "",
        "| | answered | lost | superseded | refused, dropped "
        "| p50 µs | p99 µs | p99.9 µs | max µs |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    kinds = {"frames" if summary["plan"]["sessions"] else "queries": summary}
    if "queries" in summary:
        kinds["queries"] = summary["queries"]
    for name, kind in kinds.items():
        refused = sum(kind["refused"].values()) + kind["dropped"]
        counts = f"{kind['answered']} | {kind['lost']} | {kind['superseded']} | {refused}"
        rows += [
            f"| {name}, clean windows | | | | | {_row(kind['clean'])} |",
            f"| {name}, all windows | {counts} | {_row(kind['all'])} |",
            f"| {name}, solve alone | | | | | {_row(kind['solve_us'])} |",
        ]
    if summary["plan"]["sessions"] and summary["answered"]:
        beyond = 1.0 - flags["IN_RANGE"] / summary["answered"]
        rows += ["", f"{beyond:.1%} of frames out of range, {flags['FALLBACK']} fallbacks"]
    rows += [
        "",
        "{clean_windows} of {windows} windows clean; steal {steal_s} s; load average "
        "{load_average:.1f}; generator late by {lateness_us[p50_us]:.1f} µs (p50), "
        "{lateness_us[p99_us]:.1f} µs (p99)".format(**summary["machine"]),
    ]
    for name, added in summary.get("added", {}).items():
        rows.append(
            f"the service adds {added['added_us']:.0f} µs to what it spends on {name}: "
            f"{added['ratio']:.2f} times an empty round trip ({added['empty_us']:.0f} µs)"
        )
    if "overload" in summary:
        recovered = summary["overload"]["recovered_s"]
        rows.append("not recovered" if recovered is None else f"recovered after {recovered} s")
    rows += [complaint for kind in kinds.values() for complaint in kind["complaints"]]
    return "\n".join(rows)


def _row(values: dict[str, float | None]) -> str:
    columns = ("p50_us", "p99_us", "p999_us", "max_us")
    return " | ".join("" if (v := values[name]) is None else f"{v:.0f}" for name in columns)


def draw(outcome: Outcome, path: Path) -> None:
    """Write a PNG: latencies over time, unclean windows in grey, and their distribution."""
    import matplotlib  # only this needs it
    from matplotlib.figure import Figure

    with matplotlib.rc_context({"font.size": 9}):
        figure = Figure(figsize=(11, 4.2), layout="constrained")
        over_time, shares = figure.subplots(1, 2, width_ratios=(3, 2), sharey=True)
        borders = outcome.machine.borders
        for start, end, clean in zip(borders, borders[1:], outcome.clean, strict=False):
            if not clean:
                over_time.axvspan(start, end, color="0.9", lw=0)
        for label, colour in (("frames", "C0"), ("queries", "C1")):
            if (messages := outcome.messages.get(label)) is None:
                continue
            milliseconds = messages.latency / 1e3
            over_time.plot(messages.due, milliseconds, ".", color=colour, ms=1, label=label)
            known = np.sort(milliseconds[np.isfinite(milliseconds)])
            longer = 1.0 - np.arange(len(known)) / max(len(known), 1)
            shares.step(longer, known, color=colour, label=label)
        over_time.set(yscale="log", xlabel="time [s]", ylabel="latency from when due [ms]")
        over_time.legend(loc="upper right", markerscale=8)
        shares.set(xscale="log", xlabel="share of messages that took longer")
        for axes in (over_time, shares):
            axes.grid(alpha=0.3)
        figure.savefig(path, dpi=130)
