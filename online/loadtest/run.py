"""Put a load on a service: tools over the surface, and queries beside them."""

import json
import socket
from collections.abc import Iterator
from contextlib import ExitStack

import numpy as np
from numpy.typing import NDArray

from palpate.online.client.http import Client
from palpate.online.client.session import Connection, scene_path, split_address
from palpate.online.loadtest.paths import tool_path
from palpate.online.loadtest.report import Outcome, judge
from palpate.online.loadtest.streams import FrameStream, QueryStream, Stream, drive
from palpate.online.serve.wire import BINARY, JSON
from palpate.online.session.frames import Output
from palpate.online.session.websocket import ECHO
from palpate.online.settings import Plan
from palpate.shared.errors import PalpateError

Array = NDArray[np.float64]

LEAD = 0.1
"""Seconds before the first message, for the sockets to settle."""

SHARE = 0.15
"""Largest pressure of queries over the largest of the scene: most points of a body take that."""


def run(plan: Plan) -> Outcome:
    """Put a load on a service and report what became of it.

    Raises `PalpateError` if there is nothing to send, or the service cannot be reached, lacks the
    scene or refuses a session.
    """
    if not (plan.sessions or plan.queries):
        raise PalpateError("nothing to send: ask for --sessions or --queries-per-second")
    with ExitStack() as stack:
        streams: list[Stream] = []
        for stream in _streams(plan):
            stack.callback(stream.close)
            streams.append(stream)
        machine = drive(streams)
    return judge(plan, machine, streams, LEAD + plan.duration)


def _streams(plan: Plan) -> Iterator[Stream]:
    """Connect to the service and make the streams of a plan."""
    rng = np.random.default_rng(plan.seed)
    with Client(plan.url, token=plan.token) as client:
        ranges = client.scene(plan.scene)["ranges"]
        surface = client.accessible(plan.scene)
    outputs = sum(Output[name.upper()] for name in plan.outputs)
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
    return QueryStream(kind, due, plan.url, plan.connections, requests)


def _schedule(plan: Plan, rate: float, shift: float) -> Array:
    """Say when the messages of a stream are due (s), `shift` of a period after the others."""
    rates = [rate] if plan.overload == 1.0 else [rate, plan.overload * rate, rate]
    due = [
        LEAD + i * plan.duration + (np.arange(round(r * plan.duration)) + shift) / r
        for i, r in enumerate(rates)
    ]
    return np.concatenate(due)
