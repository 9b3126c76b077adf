"""How long queries take beside the full model: in turns, at the same speed of the machine.

A query's time is that of ``ReducedModel.press`` as a caller sees it, from a position in space to an
answer with its error estimate; fields are recovered after a cold query of their own.
"""

import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.problem import Load
from palpate.offline.reduce.sampling import random_tangent
from palpate.offline.validate.compare import opened
from palpate.offline.validate.queries import Place, held_out_loads
from palpate.shared.answer import Answer
from palpate.shared.model import ReducedModel, Region
from palpate.shared.reduced.workspace import Warm

ROUNDS = 20
QUERIES = 100  # of each kind in a round, beside one full solution
STEP = 0.05  # mm

TURNS = 20  # headings tried where the surface ends; if none leads on, the last is taken


def bench(artifact: Path) -> dict[str, Any]:
    """Time queries of every kind on random loads over the whole range: medians in µs.

    ``cold_us``, each query independent of the last; ``warm_us``, along paths of 0.05 mm steps over
    the surface; ``tip_us``, of the rigid tip along those; ``surface_us`` and ``fields_us``, a cold
    query with displacement and von Mises stress at the surface's or all nodes; ``full_us``, the
    full model in a single jump from rest.  ``p95``: 95th percentiles.  ``ratio``: full over cold.
    """
    atlas, problem = opened(artifact)
    state, walker = atlas.new_warm(), atlas.new_warm()
    rng = np.random.default_rng(atlas.scene.seed)
    times: dict[str, list[float]] = {}

    def press(warm: Warm, load: Load) -> Answer:
        return atlas.press(load.position, load.pressure, load.direction, warm=warm)

    def cold(load: Load) -> Answer:
        state.forget()
        return press(state, load)

    def with_fields(region: Region, load: Load) -> None:
        answer = cold(load)
        displacement = atlas.displacement(answer)
        atlas.von_mises(answer, region, displacement)
        if region == "surface":
            np.take(displacement, atlas.surface_nodes, axis=0)

    def full(load: Load) -> None:
        with suppress(NoEquilibrium):
            problem.solve(load)

    def take(kind: str, query: Callable[[Any], object], asked: Sequence[Any]) -> None:
        for one in asked:
            started = time.perf_counter()
            query(one)
            taken = time.perf_counter() - started
            times.setdefault(kind, []).append(1e6 * taken)

    warm, touch = partial(press, walker), partial(atlas.touch, warm=walker)
    for round_ in range(ROUNDS + 1):
        loads = held_out_loads(atlas, QUERIES, round_)
        path = walk(atlas, loads[0], QUERIES + 1, rng)
        take("cold_us", cold, loads)
        warm(path[0])
        take("warm_us", warm, path[1:])
        take("surface_us", partial(with_fields, "surface"), loads)
        take("fields_us", partial(with_fields, "all"), loads)
        take("full_us", full, loads[:1])
        if atlas.has_tip:
            touches = [Place.at(atlas, load.position).touch(0.5).position for load in path]
            touch(touches[0])
            take("tip_us", touch, touches[1:])
        if round_ == 0:  # compiled code came in from disk
            times.clear()
    medians = {kind: float(np.median(found)) for kind, found in times.items()}
    return medians | {
        "p95": {kind: float(np.percentile(found, 95)) for kind, found in times.items()},
        "ratio": medians["full_us"] / medians["cold_us"],
    }


def walk(
    atlas: ReducedModel, start: Load, count: int, rng: np.random.Generator, step: float = STEP
) -> list[Load]:
    """Loads that glide over the surface in steps (mm), turning where it ends.

    Tilt and share of the local pressure limit are those of ``start``.
    """
    place = Place.at(atlas, start.position)
    share = start.pressure / place.limit(start.direction)
    cosine = min(1.0, -float(start.direction @ place.normal))
    heading, turns = random_tangent(place.normal, rng), 0
    loads: list[Load] = []
    while len(loads) < count:
        reached = Place.at(atlas, place.position + step * heading)
        moved = np.linalg.norm(reached.position - place.position)
        if moved < 0.9 * step and turns < TURNS:
            heading, turns = random_tangent(place.normal, rng), turns + 1
            continue
        place, turns = reached, 0
        heading = heading - (heading @ place.normal) * place.normal
        heading /= np.linalg.norm(heading)
        direction = math.sqrt(1 - cosine**2) * heading - cosine * place.normal
        loads.append(place.press(direction, share))
    return loads
