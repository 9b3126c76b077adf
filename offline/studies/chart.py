"""The speed-accuracy charts: every method and size a point, time against error.

All methods answer the same queries, which none of them has seen: random loads, or random histories
of visco-elastic tissue.  What is timed is ``Method.step`` on one core, where it presses.  Of each
step the least of three times counts, of slow methods a single one.  A method's queries alternate
with the artifact's, and its times are scaled by what those take beside it over what they take on
the whole: points are then comparable although the speed of the machine varies, also when a killed
run was resumed later.

Errors are relative L2 norms over the moments of a query and the volume, of von Mises stress beyond
the clamped layer; a query in which a step has no answer counts as an error of 1.  Against the full
model on the scene's own mesh that is the error of reduction.  For loads there are meshes graded
towards each contact too, beside which the error of the mesh comes on top, as it does for full
models on coarser and finer meshes: of few loads, and with the near field of the contact in the
stress, which is recovered from any method's displacement.

Over histories the artifact is also asked as if there were no past ("artifact, warm"): warm queries
of the same local models at the same loads.  They are compared with the full model of tissue that
answers at once, and show what memory costs.
"""

import time
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from palpate.offline.methods.catalogue import Training, build
from palpate.offline.methods.full import Full, Remeshed
from palpate.offline.methods.method import Method, Steps
from palpate.offline.methods.shipped import Shipped
from palpate.offline.run.streams import Stage, stream
from palpate.offline.run.tables import write_csv
from palpate.offline.studies import chart_drawing as drawing
from palpate.offline.studies import references as full
from palpate.offline.studies.chart_drawing import SHIPPED, TWIN, Row
from palpate.offline.studies.references import Fields
from palpate.shared.arrays import Array, Flags
from palpate.shared.errors import PalpateError
from palpate.shared.scene import Scene

Plan = Mapping[str, Sequence[float]]
"""Sizes of every method; see ``offline.methods.catalogue.build``."""

MODES = (5, 10, 20, 40, 80)
PLAN: Plan = {
    "artifact": (1,),
    **dict.fromkeys(("modal", "ritz", "krylov"), MODES),
    "ritz-at-hand": (2, 5, 10, 20),
    "derivatives": (3, 9, 20),
    **dict.fromkeys(("pod", "pod-euclidean", "pod-ecm", "pod-ecsw"), MODES),
    **dict.fromkeys(("pod-deim", "pod-gappy", "regression"), MODES),
    "linear": (*MODES, 160),
    **dict.fromkeys(("mass-spring", "tensor-mass"), (0.5, 0.75, 1)),
    "full": (0.5, 0.75, 1, 1.25),
}
PLAN_IN_TIME: Plan = {
    **dict.fromkeys(("artifact", "artifact, warm", "full"), (1,)),
    **dict.fromkeys(("pod", "modal", "ritz"), MODES),
}

GRADED_LOADS = 20  # number of queries solved on graded meshes, the first ones
REPEATS = 10
SLOW = 10e-3  # seconds of a step beyond which it is timed only once


Queries = Sequence[tuple[Steps, Fields, tuple[Array, Array] | None]]
"""What methods are asked, the full model's answers, and those of meshes graded towards a load."""


def chart(
    artifact: Path, scene: Scene | None, snapshots: int, queries: int, seed: int
) -> dict[str, Any]:
    """Measure and draw speed and accuracy of every method.

    Parameters
    ----------
    scene : Scene or None
        That the artifact was trained on, with its files, for queries that are loads.  None for
        histories of visco-elastic tissue.
    snapshots, queries, seed : int
        Loads or histories to learn from, and to answer: those of ``palpate validate``.

    Returns
    -------
    dict
        ``points``: times and errors by key; ``pareto``: keys of those that no other beats in both
        time and p95 of displacement; ``speed_of_next``: time of the fastest other point that is at
        least as accurate, over the artifact's; ``without_equilibrium``: queries that the full model
        has no answer to; over histories ``step_over_elastic``: time of the artifact's step over
        that of its elastic twin.
    """
    in_time = scene is None
    layout = drawing.IN_TIME if in_time else drawing.OF_LOADS
    atlas, problem = full.opened(artifact, scene)
    plan = PLAN_IN_TIME if in_time else PLAN
    if not in_time:  # as many modes as the artifact has unknowns, too
        plan = {**plan, "pod": sorted({*plan["pod"], Shipped(problem, atlas).unknowns})}
    settings = snapshots, queries, seed
    given = {
        stage.name: full.random_steps(
            atlas, problem, count, stream(atlas.scene.seed, stage, seed), in_time
        )
        for stage, count in ((Stage.SNAPSHOTS, snapshots), (Stage.UNSEEN, queries))
    }
    follow = {name: [(full.followed, steps) for steps in own] for name, own in given.items()}
    with full.kept_results(artifact, atlas.scene, layout.name, settings) as checkpoint:
        solved = full.in_parallel(artifact, checkpoint, "full solutions", follow)
        learnt, asked = (
            [(steps, found) for steps, found in zip(given[name], own, strict=True) if found]
            for name, own in solved.items()
        )
        if not asked:
            raise PalpateError(f"{artifact}: the full model could follow none of the histories")
        loads = [] if scene is None else [steps[0][0].contacts[0] for steps, _ in asked]
        tasks = {"graded": [(full.graded, scene, load) for load in loads[:GRADED_LOADS]]}
        finer = full.in_parallel(artifact, checkpoint, "graded meshes", tasks)["graded"]
        questions = [(*query, fine) for query, fine in zip_longest(asked, finer)]
        training = Training(problem, full.snapshots(learnt), atlas, seed, in_time)
        measured: dict[str, Mapping[str, Any]] = {}
        # in this process: times are those of one core, and methods share what they learn from
        for name, size in tqdm([(name, size) for name, sizes in plan.items() for size in sizes]):
            key = f"{name} {size:g}"
            if key not in checkpoint:
                checkpoint.store(key, measure(training, questions, name, size))
            measured[key] = checkpoint.load(key)
        usual = float(np.median([np.median(found["beside"]) for found in measured.values()]))
        rows = [_row(key, found, usual) for key, found in measured.items()]
        report = artifact.parent / atlas.name / "report"
        write_csv(report / f"{layout.name}.csv", rows)
        drawing.draw(report / f"{layout.name}.png", rows, atlas.scene, layout)
    return _summary(rows) | {"without_equilibrium": queries - len(asked)}


# --- measuring -----------------------------------------------------------------------------------


def measure(training: Training, queries: Queries, name: str, size: float) -> dict[str, Any]:
    """Build a method and have it answer the queries.

    Errors (``drawing.FIELDS``) are by query, nan where nothing is known,
    ``times`` (s) and those ``beside``, the artifact's, by step that presses.
    """
    problem = training.problem
    method, yardstick = build(name, size, training), build("artifact", 1, training)
    other_mesh = type(method) is Remeshed
    queries = [query for query in queries if query[2] is not None or not other_mesh]
    for one in (method, yardstick):  # compiled code comes in from disk
        one.step(one.at_rest(), *queries[0][0][0])
    errors, times, unconverged = np.ones((len(queries), 4)), [], 0
    for i, (steps, exact, finer) in enumerate(queries):
        states, seconds, missed = play(method, steps)
        times.append(seconds[_pressing(steps)])
        unconverged += missed > 0
        if not missed:
            fields = Fields.of(method, states)
            if training.in_time and name == "artifact, warm":
                elastic = Full(full.of_tissue(problem, prony=()))
                exact = Fields.of(elastic, play(elastic, steps)[0])
            errors[i, :2] = fields.errors(problem, exact)
            if finer is not None:
                errors[i, 2:] = fields.total_errors(problem, steps[0][0].contacts[0], finer)
    errors[[finer is None for *_, finer in queries], 2:] = np.nan
    if other_mesh:
        errors[:, :2] = np.nan
    least, beside = _times(method, yardstick, queries, np.concatenate(times))
    found = {"unknowns": method.unknowns, "label": method.label, "unconverged": unconverged}
    found |= dict(zip(drawing.FIELDS, errors.T, strict=True))
    return found | {"times": least, "beside": beside}


def play(method: Method, steps: Steps, kept: bool = True) -> tuple[list[Any], Array, int]:
    """States of a method after every step, times (s) of the steps, and how many had no answer.

    States that are not ``kept`` cost no memory, which is how a trainer goes from step to step.
    """
    state, states, seconds, missed = method.at_rest(), list[Any](), [], 0
    for case, dt in steps:
        started = time.perf_counter()
        answer = method.step(state, case, dt)
        seconds.append(time.perf_counter() - started)
        state = answer.state
        if kept:
            states.append(state)
        missed += not answer.converged
    return states, np.array(seconds), missed


def _pressing(steps: Steps) -> Flags:
    return np.array([case.forces.any() for case, _ in steps])


def _times(
    method: Method, yardstick: Method, queries: Queries, first: Array
) -> tuple[Array, Array]:
    """Seconds that a method needs for each step, and the yardstick in turns with it."""

    def run(one: Method) -> Array:
        played = [play(one, steps, kept=False)[1][_pressing(steps)] for steps, *_ in queries]
        return np.concatenate(played)

    times, beside = first, run(yardstick)
    slow = np.median(first) > SLOW
    for _ in range(1 if slow else REPEATS - 1):
        times = times if slow else np.minimum(times, run(method))
        beside = np.minimum(beside, run(yardstick))
    return times, beside


# --- results -------------------------------------------------------------------------------------


def _row(key: str, found: Mapping[str, Any], usual: float) -> dict[str, Any]:
    """A point of the chart, its times scaled to the artifact's usual speed."""
    row: dict[str, Any] = {
        "key": key,
        "family": key.rsplit(" ", 1)[0],
        "label": found["label"],
        "unknowns": found["unknowns"],
        "time_us": float(1e6 * np.median(found["times"]) / np.median(found["beside"]) * usual),
    }
    for name in drawing.FIELDS:
        errors = found[name][~np.isnan(found[name])]
        quantiles = np.percentile(errors, [50, 95, 100]) if errors.size else np.full(3, np.nan)
        for statistic, error in zip(drawing.STATISTICS, quantiles.tolist(), strict=True):
            row[f"{name}_{statistic}"] = error
    return row | {"unconverged": found["unconverged"]}


def _summary(rows: Sequence[Row]) -> dict[str, Any]:
    points = {row["key"]: row for row in rows}
    shipped, twin = points[SHIPPED], points.get(TWIN)
    as_good = [
        row["time_us"]
        for key, row in points.items()
        if key not in (SHIPPED, TWIN) and row["displacement_p95"] <= shipped["displacement_p95"]
    ]
    summary = {
        "points": points,
        "pareto": [row["key"] for row in drawing.pareto(rows)],
        "speed_of_next": min(as_good) / shipped["time_us"],
    }
    return summary | ({"step_over_elastic": shipped["time_us"] / twin["time_us"]} if twin else {})
