"""How long queries take, beside the full model: all kinds in turns, so that they share the weather.

A query's time is that of ``ReducedModel.solve`` as a caller sees it, from a position in space to an
answer with its error estimate; fields are recovered after a cold query of their own.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.offline.reduce.sampling import tangents
from palpate.offline.run.workshop import Load, Workshop
from palpate.offline.validate.loads import unseen_loads
from palpate.shared.artifact import read_artifact
from palpate.shared.mechanics.footprint import TIP_DEPTH, pressure_limit
from palpate.shared.model import ReducedModel, Region

Array = NDArray[np.float64]

ROUNDS = 20
QUERIES = 100
"""Of each kind in a round, beside one full solution."""

STEP = 0.05  # mm


def bench(artifact: Path) -> dict[str, Any]:
    """Time queries of every kind on random loads over the whole range.

    Parameters
    ----------
    artifact : Path

    Returns
    -------
    dict
        Medians in µs: ``cold_us``, each query independent of the last; ``warm_us``, along paths of
        0.05 mm steps over the surface; ``tip_us``, of the rigid tip along those; ``surface_us`` and
        ``fields_us``, a cold query with displacement and von Mises stress at the surface's or all
        nodes; ``full_us``, the full model in a single jump from rest. ``p95``: their 95th
        percentiles. ``ratio``: full over cold.
    """
    atlas = ReducedModel.load(artifact)
    workshop = Workshop.of_artifact(read_artifact(artifact))
    state, walker = atlas.new_warm(), atlas.new_warm()
    rng = np.random.default_rng(atlas.scene.seed)

    def cold(load: Load) -> None:
        state.forget()
        atlas.press(load.position, load.pressure, load.direction, warm=state)

    def warm(load: Load) -> None:
        atlas.press(load.position, load.pressure, load.direction, warm=walker)

    def with_fields(load: Load, region: Region) -> None:
        state.forget()
        solution = atlas.press(load.position, load.pressure, load.direction, warm=state)
        displacement = atlas.displacement(solution)
        atlas.von_mises(solution, region, displacement)
        if region == "surface":
            np.take(displacement, atlas.surface_nodes, axis=0)

    times: dict[str, list[float]] = {}

    def touch(position: Array) -> None:
        atlas.touch(position, warm=walker)

    def take(kind: str, query: Callable[[Any], object], loads: list[Any]) -> None:
        times.setdefault(kind, []).extend(_time(query, load) for load in loads)

    for round_ in range(ROUNDS + 1):
        loads = unseen_loads(atlas, QUERIES, round_)
        first, *steps = walk(atlas, loads[0], QUERIES + 1, rng)
        take("cold_us", cold, loads)
        warm(first)
        take("warm_us", warm, steps)
        take("surface_us", lambda load: with_fields(load, "surface"), loads)
        take("fields_us", lambda load: with_fields(load, "all"), loads)
        take("full_us", workshop.sample, loads[:1])
        if atlas.models.tips is not None:
            first_touch, *touches = [tip_at(atlas, load) for load in (first, *steps)]
            touch(first_touch)
            take("tip_us", touch, touches)
        if round_ == 0:
            # compiled code came in from disk
            times.clear()
    medians = {kind: float(np.median(found)) for kind, found in times.items()}
    return medians | {
        "p95": {kind: float(np.percentile(found, 95)) for kind, found in times.items()},
        "ratio": medians["full_us"] / medians["cold_us"],
    }


def walk(atlas: ReducedModel, start: Load, count: int, rng: np.random.Generator) -> list[Load]:
    """Loads that glide over the surface in steps of ``STEP``, turning where it ends.

    Tilt and share of the local pressure limit are those of ``start``.
    """
    surface = atlas.surface
    x, normal, _, fields = surface.locate(start.position, atlas.limits)
    share = start.pressure / pressure_limit(fields, normal, start.direction)
    cosine = min(1.0, -float(start.direction @ normal))
    heading = _random_tangent(normal, rng)
    loads: list[Load] = []
    while len(loads) < count:
        reached, normal, _, fields = surface.locate(x + STEP * heading, atlas.limits)
        if np.linalg.norm(reached - x) < 0.9 * STEP:
            heading = _random_tangent(normal, rng)
            continue
        x = reached
        heading = heading - (heading @ normal) * normal
        heading /= np.linalg.norm(heading)
        direction = math.sqrt(1 - cosine**2) * heading - cosine * normal
        loads.append(Load(x, direction, share * pressure_limit(fields, normal, direction)))
    return loads


def tip_at(atlas: ReducedModel, load: Load) -> Array:
    """Centre of a tip at a load's contact, half as deep as may be."""
    x, normal, _, fields = atlas.surface.locate(load.position, atlas.limits)
    return x + (atlas.scene.endoscope.radius - fields[TIP_DEPTH] / 2) * normal


def _random_tangent(normal: Array, rng: np.random.Generator) -> Array:
    turn = 2 * math.pi * rng.random()
    t, b = tangents(normal)
    return math.cos(turn) * t + math.sin(turn) * b


def _time(query: Callable[[Any], object], load: Any) -> float:
    """Time of one query, µs."""
    started = time.perf_counter()
    query(load)
    return 1e6 * (time.perf_counter() - started)
