"""Put a load on a service: tools over the surface, and queries beside them."""

import socket
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.online.client.connection import Connection, scene_path
from palpate.online.client.http import Client
from palpate.online.loadtest import report
from palpate.online.loadtest.generator import Machine, Stream, drive
from palpate.online.loadtest.paths import Tip, tool_path
from palpate.online.loadtest.report import Messages, clean_windows, gather, window_of
from palpate.online.loadtest.streams import FrameStream, QueryStream, write_requests
from palpate.online.session.websocket import ECHO
from palpate.shared.errors import PalpateError

Array = NDArray[np.float64]

LEAD = 0.1
"""Seconds before the first message, for the sockets to settle."""

SHARE = 0.15
"""Largest pressure of queries over the largest of the scene: most points of a body take that."""


@dataclass(frozen=True)
class Plan:
    """What to put on a service: the options of ``palpate loadtest``, whose help says more."""

    url: str
    scene: str
    sessions: int = 1
    rate: float = 1000.0  # frames of each session, 1/s
    queries: float = 0.0  # in all, 1/s
    duration: float = 10.0  # s
    overload: float = 1.0  # what rates are multiplied with for another duration, before a third one
    region: str = "all"
    connections: int = 4
    depth: float = 1.0  # mm
    outputs: int = 0  # bits of `session.frames.Output`
    echo: bool = False
    token: str | None = None
    seed: int = 0


class Outcome(NamedTuple):
    """What a load test found; ``echoes`` and ``checks`` are to compare the others with."""

    summary: dict[str, Any]  # JSON-able
    machine: Machine
    clean: NDArray[np.bool_]  # (w,), which windows of the machine were clean
    messages: dict[str, Messages]  # by kind, those that were sent


def run(plan: Plan) -> Outcome:
    """Put a load on a service and report what became of it.

    Raises `PalpateError` if there is nothing to send, or the service cannot be reached, lacks the
    scene or refuses a session.
    """
    if not (plan.sessions or plan.queries):
        raise PalpateError("nothing to send: ask for --sessions or --queries-per-second")
    with ExitStack() as stack:
        streams: list[tuple[str, Stream]] = []
        for kind, stream in _streams(plan):
            stack.callback(stream.close)
            streams.append((kind, stream))
        machine = drive([stream for _, stream in streams])
    return _judge(plan, machine, streams)


def _streams(plan: Plan) -> Iterator[tuple[str, Stream]]:
    """Connect to the service and make the streams of a plan, each with its kind."""
    rng = np.random.default_rng(plan.seed)
    with Client(plan.url, token=plan.token) as client:
        ranges = client.scene(plan.scene)["ranges"]
        surface = client.accessible(plan.scene)
    for i in range(plan.sessions):
        due = _schedule(plan, plan.rate, i / plan.sessions)
        path = tool_path(surface, Tip(ranges["radius"], plan.depth), due, rng)
        line = _connect(plan, scene_path(plan.scene, "/session"))
        yield "frames", FrameStream(line, due, path, plan.outputs)
    if plan.sessions and plan.echo:
        due = _schedule(plan, plan.rate, 0.5 / plan.sessions)
        yield "echoes", FrameStream(_connect(plan, ECHO), due, path)
    if plan.queries:
        due = _schedule(plan, plan.queries, 0.5)
        places = rng.choice(surface.vertices, len(due))
        loads = places, rng.uniform(0.0, SHARE * ranges["pressure"][1], len(due))
        yield "queries", _queries(plan, "/solve", due, loads)
        if plan.echo:
            yield "checks", _queries(plan, "/check", _schedule(plan, plan.queries, 0.0), loads)


def _connect(plan: Plan, path: str) -> socket.socket:
    """Open a WebSocket and read its greeting."""
    try:
        connection = Connection(plan.url, path, plan.token, timeout=10.0)
    except PalpateError as error:
        hint = " (start the service with: palpate serve --echo)" if path == ECHO else ""
        raise PalpateError(f"{path}: {error}{hint}") from error
    connection.receive()
    return connection.socket


def _queries(plan: Plan, verb: str, due: Array, loads: tuple[Array, Array]) -> QueryStream:
    path = scene_path(plan.scene, verb)
    requests = write_requests(plan.url, path, plan.token, loads, plan.region)
    return QueryStream(plan.url, plan.connections, due, requests)


def _schedule(plan: Plan, rate: float, shift: float) -> Array:
    """Say when the messages of a stream are due (s), `shift` of a period after the others."""
    rates = [rate] if plan.overload == 1.0 else [rate, plan.overload * rate, rate]
    due = [
        LEAD + i * plan.duration + (np.arange(round(r * plan.duration)) + shift) / r
        for i, r in enumerate(rates)
    ]
    return np.concatenate(due)


def _judge(plan: Plan, machine: Machine, streams: list[tuple[str, Stream]]) -> Outcome:
    every = gather([stream.log for _, stream in streams])
    kinds = dict.fromkeys(kind for kind, _ in streams)
    messages = {name: gather([s.log for kind, s in streams if kind == name]) for name in kinds}
    clean = clean_windows(machine, every)
    summaries = {
        name: report.summarize(
            messages[name],
            clean[window_of(machine, messages[name])],
            [stream.complaint for kind, stream in streams if kind == name],
        )
        for name in kinds
        if name in ("frames", "queries")
    }
    summary: dict[str, Any] = {"plan": asdict(plan) | {"token": None}}
    summary |= summaries.pop(next(iter(kinds))) | summaries
    summary["machine"] = report.summarize_machine(machine, every)
    if plan.echo:
        summary["added"] = {
            name: report.summarize_added(messages[name], messages[empty])
            for name, empty in (("frames", "echoes"), ("queries", "checks"))
            if name in messages
        }
    if plan.overload > 1.0:
        start, end = LEAD + plan.duration, LEAD + 2.0 * plan.duration
        summary["overload"] = report.summarize_overload(
            messages.get("frames", every), machine, start, end
        )
    return Outcome(summary, machine, clean, messages)
