"""Put a load on a service: tools over the surface, and queries beside them."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.online.client.http import Client
from palpate.online.loadtest import report
from palpate.online.loadtest.generator import Machine, Stream, drive
from palpate.online.loadtest.paths import Tip, tool_path
from palpate.online.loadtest.queries import QueryStream
from palpate.online.loadtest.report import Messages, clean_windows, gather, window_of
from palpate.online.loadtest.sessions import FrameStream
from palpate.online.loadtest.target import Target
from palpate.shared.errors import PalpateError

Array = NDArray[np.float64]

LEAD = 0.1
"""Seconds before the first message, for the sockets to settle."""

SHARE = 0.15
"""Largest pressure of queries over the largest of the scene: most points of a body take that."""


@dataclass(frozen=True)
class Plan:
    """What to put on a service: the options of ``palpate loadtest``, whose help says more.

    Parameters
    ----------
    rate, queries : float, 1/s
        Frames of each session, and queries in all.
    duration : float, s
    overload : float
        If above 1: what the rates are multiplied with for another `duration`, before a third one
        as the first.
    depth : float, mm
    outputs : int
        Bits of `session.frames.Output`.
    """

    url: str
    scene: str
    sessions: int = 1
    rate: float = 1000.0
    queries: float = 0.0
    duration: float = 10.0
    overload: float = 1.0
    region: str = "all"
    connections: int = 4
    depth: float = 1.0
    outputs: int = 0
    echo: bool = False
    token: str | None = None
    seed: int = 0


@dataclass(frozen=True)
class Outcome:
    """What a load test found.

    Parameters
    ----------
    summary : dict
        JSON-able.
    machine : Machine
    clean : ndarray, shape (w,), bool
        Which windows of `machine` were clean.
    messages : dict of Messages
        By kind: ``frames`` and ``queries``, and ``echoes`` and ``checks`` to compare them with;
        those that were sent.
    """

    summary: dict[str, Any]
    machine: Machine
    clean: NDArray[np.bool_]
    messages: dict[str, Messages]


def run(plan: Plan) -> Outcome:
    """Put a load on a service and report what became of it.

    Raises
    ------
    PalpateError
        If there is nothing to send, or the service cannot be reached, lacks the scene or refuses a
        session.
    """
    if not (plan.sessions or plan.queries):
        raise PalpateError("nothing to send: ask for --sessions or --queries-per-second")
    rng = np.random.default_rng(plan.seed)
    with Client(plan.url, token=plan.token) as client:
        scene = client.scene(plan.scene)
        surface = client.accessible(plan.scene)
    target = Target(plan.url, plan.scene, plan.token)
    streams: dict[str, list[Stream]] = {"frames": [], "queries": [], "echoes": [], "checks": []}
    try:
        for i in range(plan.sessions):
            due = _schedule(plan, plan.rate, i / plan.sessions)
            path = tool_path(surface, Tip(scene["ranges"]["radius"], plan.depth), due, rng)
            streams["frames"].append(FrameStream(target, due, path, plan.outputs))
        if plan.sessions and plan.echo:
            due = _schedule(plan, plan.rate, 0.5 / plan.sessions)
            streams["echoes"].append(FrameStream(target, due, path, echo=True))
        if plan.queries:
            due = _schedule(plan, plan.queries, 0.5)
            places = rng.choice(surface.vertices, len(due))
            pressures = rng.uniform(0.0, SHARE * scene["ranges"]["pressure"][1], len(due))
            loads = places, pressures, plan.region, plan.connections
            streams["queries"].append(QueryStream(target, due, *loads))
            if plan.echo:
                due = _schedule(plan, plan.queries, 0.0)
                streams["checks"].append(QueryStream(target, due, *loads, verb="check"))
        machine = drive([stream for kind in streams.values() for stream in kind])
    finally:
        for kind in streams.values():
            for stream in kind:
                stream.close()
    return _judge(plan, machine, streams)


def _schedule(plan: Plan, rate: float, shift: float) -> Array:
    """Say when the messages of a stream are due (s), `shift` of a period after the others."""
    rates = [rate] if plan.overload == 1.0 else [rate, plan.overload * rate, rate]
    return np.concatenate(
        [
            LEAD + i * plan.duration + (np.arange(round(r * plan.duration)) + shift) / r
            for i, r in enumerate(rates)
        ]
    )


def _judge(plan: Plan, machine: Machine, streams: dict[str, list[Stream]]) -> Outcome:
    every = gather([stream.log for kind in streams.values() for stream in kind])
    messages = {name: gather([s.log for s in kind]) for name, kind in streams.items() if kind}
    clean = clean_windows(machine, every)
    summaries = {
        name: report.summarize(
            messages[name],
            clean[window_of(machine, messages[name])],
            [stream.complaint for stream in streams[name]],
        )
        for name in ("frames", "queries")
        if name in messages
    }
    summary: dict[str, Any] = {"plan": asdict(plan) | {"token": None}}
    summary |= summaries.pop("frames" if plan.sessions else "queries") | summaries
    summary["machine"] = report.summarize_machine(machine, every)
    if plan.echo:
        summary["added"] = {
            name: report.summarize_added(messages[name], messages[empty])
            for name, empty in (("frames", "echoes"), ("queries", "checks"))
            if name in messages
        }
    if plan.overload > 1.0:
        borders = LEAD + np.arange(4.0) * plan.duration
        summary["overload"] = report.summarize_overload(
            messages.get("frames", every), machine, borders
        )
    return Outcome(summary, machine, clean, messages)
