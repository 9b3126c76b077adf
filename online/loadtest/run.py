"""Put a load on a service: tools over the surface, and queries beside them."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.online.client.http import Client
from palpate.online.loadtest.generator import Machine, Stream, drive
from palpate.online.loadtest.paths import Tip, tool_path
from palpate.online.loadtest.queries import Queries
from palpate.online.loadtest.report import (
    Messages,
    clean_windows,
    gather,
    summarize_machine,
    summarize_overload,
    summarize_queries,
    summarize_sessions,
    window_of,
)
from palpate.online.loadtest.sessions import Session
from palpate.online.loadtest.target import Target
from palpate.shared.errors import PalpateError

Array = NDArray[np.float64]

LEAD = 0.1
"""Seconds before the first message, for the sockets to settle."""

SHARE = 0.15
"""Largest pressure of queries over the largest of the scene: most points of a body take that."""


@dataclass(frozen=True)
class Plan:
    """What to put on a service.

    Parameters
    ----------
    url, scene : str
    sessions : int
    rate : float, Hz
        Frames per second of each session.
    queries : float, 1/s
        Solves over HTTP, in all.
    duration : float, s
    overload : float
        If above 1: what the rates are multiplied with for another `duration`, before a third one
        as the first.
    region : str
        Of the fields that queries ask for: ``none``, ``surface`` or ``all``.
    connections : int
        Of the queries.
    depth : float, mm
        How deep the tools press at most.
    outputs : int
        Bits of `session.frames.Output` that frames ask for.
    token : str, optional
    seed : int
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
    token: str | None = None
    seed: int = 0


@dataclass(frozen=True)
class Outcome:
    """What a load test found.

    Parameters
    ----------
    summary : dict
        For JSON.
    machine : Machine
    clean : ndarray, shape (w,), bool
        Which windows of `machine` were clean.
    sessions, queries : Messages or None
        None if there were none of the kind.
    """

    summary: dict[str, Any]
    machine: Machine
    clean: NDArray[np.bool_]
    sessions: Messages | None
    queries: Messages | None


def run(plan: Plan) -> Outcome:
    """Put a load on a service and tell how it bore it.

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
    sessions: list[Session] = []
    queries: list[Queries] = []
    try:
        for i in range(plan.sessions):
            due = _schedule(plan, plan.rate, i / plan.sessions)
            path = tool_path(surface, Tip(scene["ranges"]["radius"], plan.depth), due, rng)
            sessions.append(Session(target, due, path, plan.outputs))
        if plan.queries:
            due = _schedule(plan, plan.queries, 0.5)
            places = rng.choice(surface.vertices, len(due))
            pressures = rng.uniform(0.0, SHARE * scene["ranges"]["pressure"][1], len(due))
            queries.append(Queries(target, due, places, pressures, plan.region, plan.connections))
        machine = drive([*sessions, *queries])
    finally:
        streams: list[Stream] = [*sessions, *queries]
        for stream in streams:
            stream.close()
    return _judge(plan, machine, sessions, queries)


def _schedule(plan: Plan, rate: float, shift: float) -> Array:
    """Say when the messages of a stream are due (s), `shift` of a period after the others."""
    rates = [rate] if plan.overload == 1.0 else [rate, plan.overload * rate, rate]
    return np.concatenate(
        [
            LEAD + i * plan.duration + (np.arange(round(r * plan.duration)) + shift) / r
            for i, r in enumerate(rates)
        ]
    )


def _judge(
    plan: Plan, machine: Machine, sessions: list[Session], queries: list[Queries]
) -> Outcome:
    every = gather([*(stream.log for stream in sessions), *(stream.log for stream in queries)])
    clean = clean_windows(machine, every)
    summary: dict[str, Any] = {"plan": asdict(plan) | {"token": None}}
    frames = solves = None
    if sessions:
        frames = gather([stream.log for stream in sessions])
        summary |= summarize_sessions(sessions, frames, clean[window_of(machine, frames)])
    for asked in queries:
        solves = gather([asked.log])
        found = summarize_queries(asked, solves, clean[window_of(machine, solves)])
        summary |= {"queries": found} if sessions else found
    summary["machine"] = summarize_machine(machine, every)
    if plan.overload > 1.0:
        borders = LEAD + np.arange(4.0) * plan.duration
        summary["overload"] = summarize_overload(
            every if frames is None else frames, machine, borders
        )
    return Outcome(summary, machine, clean, frames, solves)
