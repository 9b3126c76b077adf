"""The speed-accuracy charts: every method and size a point, time against error.

All methods answer the same queries, which none of them has seen: random loads, or random histories
of visco-elastic tissue.  A load is a history of one step of no time.  What is timed is
``Method.step`` on one core, of steps that press: everything that depends on the load and that a
user waits for, but no field of mesh size.  Of each step the least of three times counts, of slow
methods a single one.  A method's queries alternate with the artifact's, and its times are scaled by
what those take beside it over what they take on the whole: all points are then comparable although
the speed of the machine varies, also when a killed run was resumed later.

Errors are relative L2 norms over the moments of a query and all nodes (displacement) or all nodes
beyond the clamped layer (von Mises stress); a query in which a step has no answer counts as an
error of 1.  Against the full model on the scene's own mesh that is the error of reduction.  For
loads there is a refined mesh too, against which the error of the mesh comes on top.  Nodal stresses
of two meshes are averaged over different elements, and next to the support they grow with
refinement, so that only displacements are compared there; few loads are solved in the refined mesh,
so that their median is drawn.

Over histories the artifact is also asked as if there were no past ("artifact, warm"): warm queries
of the same local models at the same loads.  They are compared with the full model of tissue that
answers at once, and show what memory costs.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from palpate.offline.fem.norms import relative
from palpate.offline.fem.problem import FullProblem
from palpate.offline.methods.catalogue import Training, build
from palpate.offline.methods.full import Remeshed
from palpate.offline.methods.method import Method, Snapshots, Steps
from palpate.offline.methods.shipped import Shipped
from palpate.offline.run.checkpoint import Checkpoint
from palpate.offline.run.streams import Stage, stream
from palpate.offline.run.tables import write_csv
from palpate.offline.run.workers import open_artifact, resume, worker_pool
from palpate.offline.studies import chart_drawing as drawing
from palpate.offline.studies import references as full
from palpate.offline.studies.chart_drawing import SHIPPED, TWIN, Row
from palpate.offline.studies.references import Fields
from palpate.shared.artifact import read_artifact
from palpate.shared.errors import PalpateError, QueryError
from palpate.shared.model import ReducedModel
from palpate.shared.scene import Scene

Array = NDArray[np.float64]
Plan = Mapping[str, Sequence[float]]
"""Sizes of every method; see ``offline.methods.catalogue.build``."""

MODES = (5, 10, 20, 40, 80)
PLAN: Plan = {
    "artifact": (1,),
    "modal": MODES,
    "ritz": MODES,
    "krylov": MODES,
    "ritz-at-hand": (2, 5, 10, 20),
    "derivatives": (3, 9, 20),
    "pod": MODES,
    "pod-euclidean": MODES,
    "pod-ecm": MODES,
    "pod-ecsw": MODES,
    "pod-deim": MODES,
    "pod-gappy": MODES,
    "linear": (*MODES, 160),
    "regression": MODES,
    "mass-spring": (0.5, 1, 2),
    "tensor-mass": (0.5, 1, 2),
    "full": (0.5, 0.75, 1, 1.5),
}
PLAN_IN_TIME: Plan = {
    "artifact": (1,),
    "artifact, warm": (1,),
    "full": (1,),
    "pod": MODES,
    "modal": MODES,
    "ritz": MODES,
}

REFINEMENT = 2
"""Factor on the divisions of the reference mesh: eight times the elements."""

REFINED_LOADS = 20
"""Number of queries solved in the refined mesh, the first ones."""

REPEATS = 3
SLOW = 100e-3
"""Seconds of a step beyond which it is timed only once."""


@dataclass(frozen=True)
class References:
    """Full solutions to learn from, to compare with, and of the first queries in a refined mesh."""

    snapshots: Snapshots
    queries: list[tuple[Steps, Fields]]
    refined: Array  # (j, n, 3) mm, nan where there is no equilibrium


def chart(
    artifact: Path,
    scene: Scene | None,
    snapshots: int,
    queries: int,
    seed: int,
    plan: Plan | None = None,
) -> dict[str, Any]:
    """Measure and draw speed and accuracy of every method.

    Parameters
    ----------
    artifact : Path
        ``chart.csv``, ``chart.png`` and ``chart.html``, or ``chart_in_time.*``, go to
        ``NAME/report/`` beside it.
    scene : Scene or None
        That the artifact was trained on, with its files, for queries that are loads.  None for
        histories of visco-elastic tissue.
    snapshots : int
        Full solutions, or histories, that methods learn from.
    queries, seed : int
        Loads or histories to answer, the same as ``palpate validate`` takes.
    plan : mapping, optional
        Sizes of every method; those of the artifact and the full model are needed.  Under loads POD
        is measured with as many modes as the artifact has unknowns, too.

    Returns
    -------
    dict
        ``points``: times and errors by key; ``pareto``: keys of those that no other beats in both
        time and p95 of displacement; ``speed_of_next``: time of the fastest other point that is at
        least as accurate, over the artifact's; ``without_equilibrium``: queries that the full model
        has no answer to; over histories ``step_over_elastic``: time of the artifact's step over
        that of its elastic twin.
    """
    layout = drawing.IN_TIME if scene is None else drawing.OF_LOADS
    atlas = ReducedModel.load(artifact)
    if scene is None and atlas.models.viscous is None:
        raise QueryError("scene", f"{atlas.name!r} is elastic: it has no histories")
    if scene is not None and atlas.scene.text != scene.text:
        raise PalpateError(f"{artifact}: trained on another scene than {scene.name!r}")
    settings = snapshots, queries, seed
    checkpoint = full.kept_results(artifact, scene or atlas.scene, layout.name, settings)
    problem = FullProblem.of_artifact(read_artifact(artifact))
    plan = plan or (PLAN_IN_TIME if scene is None else PLAN)
    if scene is not None:
        plan = {**plan, "pod": sorted({*plan["pod"], Shipped(problem, atlas).unknowns})}
    references = _solved(atlas, problem, artifact, scene, settings, checkpoint)
    training = Training(problem, references.snapshots, atlas, seed, scene, in_time=scene is None)
    measured: dict[str, Mapping[str, Any]] = {}
    # in this process: times are those of one core, and methods share what they learn from
    for name, size in tqdm([(name, size) for name, sizes in plan.items() for size in sizes]):
        key = f"{name} {size:g}"
        if key not in checkpoint:
            checkpoint.store(key, measure(training, references, name, size))
        measured[key] = checkpoint.load(key)
    usual = float(np.median([np.median(found["beside"]) for found in measured.values()]))
    rows = [_row(key, found, usual) for key, found in measured.items()]
    report = artifact.parent / atlas.name / "report"
    write_csv(report / f"{layout.name}.csv", rows)
    drawing.draw(report / f"{layout.name}.png", rows, atlas.scene, layout)
    drawing.write_page(report / f"{layout.name}.html", rows, atlas.scene, layout)
    checkpoint.remove()
    return _summary(rows) | {"without_equilibrium": queries - len(references.queries)}


def _solved(
    atlas: ReducedModel,
    problem: FullProblem,
    artifact: Path,
    scene: Scene | None,
    settings: tuple[int, int, int],
    checkpoint: Checkpoint,
) -> References:
    """Full solutions of as many snapshots and queries as the settings say, with their seed."""
    *counts, seed = settings
    stages = {"snapshot": Stage.SNAPSHOTS, "query": Stage.UNSEEN}
    histories: dict[str, Steps] = {}
    for (name, stage), count in zip(stages.items(), counts, strict=True):
        rng = stream(atlas.scene.seed, stage, seed)
        for i, steps in enumerate(full.random_steps(atlas, problem, count, rng, scene is None)):
            histories[f"{name} {i}"] = steps
    with worker_pool(open_artifact, artifact) as pool:
        found = full.full_histories(histories, pool, checkpoint)
        learnt = {name: own for name, own in found.items() if name.startswith("snapshot")}
        queries = [(histories[name], own) for name, own in found.items() if name not in learnt]
        if not queries:
            raise PalpateError(f"{artifact}: the full model could follow none of the queries")
        tasks = {
            f"refined {i}": (full.refined, scene, REFINEMENT, steps[0][0].contacts[0])
            for i, (steps, _) in enumerate(queries[:REFINED_LOADS])
            if scene is not None
        }
        finer = resume("refined mesh", pool, checkpoint, tasks)
    return References(
        full.snapshots([histories[name] for name in learnt], list(learnt.values())),
        queries,
        np.array([finer[name] for name in tasks]).reshape(-1, *problem.mesh.nodes.shape),
    )


# --- measuring -----------------------------------------------------------------------------------


def measure(training: Training, references: References, name: str, size: float) -> dict[str, Any]:
    """Build a method and have it answer the queries.

    Returns
    -------
    dict
        ``unknowns``, ``label``; per query ``displacement``, ``von_mises``, ``refined`` (errors) and
        ``converged``; per step that presses ``times`` (s) and ``beside`` (s), the artifact's times.
    """
    problem = training.problem
    method, yardstick = build(name, size, training), build("artifact", 1, training)
    queries, finer = references.queries, references.refined
    if isinstance(method, Remeshed):
        queries = queries[: len(finer)]
    for one in (method, yardstick):  # compiled code comes in from disk
        one.step(one.at_rest(), *queries[0][0][0])
    errors, converged = np.ones((len(queries), 2)), np.ones(len(queries), dtype=bool)
    from_finer, times = np.ones(len(finer)), []
    for i, (steps, exact) in enumerate(queries):
        states, seconds = play(method, steps)
        times.append(seconds)
        converged[i] = states is not None
        if states is not None:
            fields = Fields.of(method, states)
            twin = training.in_time and name == "artifact, warm"
            errors[i] = fields.errors(problem, at_once(problem, steps) if twin else exact)
            if i < len(finer):
                from_finer[i] = relative(fields.displacements[-1], finer[i])
    from_finer[np.isnan(finer).any(axis=(1, 2))] = np.nan
    if isinstance(method, Remeshed):  # nothing to compare with on another mesh
        errors[:] = np.nan
    least, beside = _times(method, yardstick, queries, np.concatenate(times))
    return {
        "unknowns": method.unknowns,
        "label": method.label,
        "displacement": errors[:, 0],
        "von_mises": errors[:, 1],
        "refined": from_finer,
        "converged": converged,
        "times": least,
        "beside": beside,
    }


def play(method: Method, steps: Steps) -> tuple[list[Any] | None, Array]:
    """States of a method after every step, None if one has no answer; times (s) of pressing."""
    state, states, seconds = method.at_rest(), [], []
    converged = True
    for case, dt in steps:
        started = time.perf_counter()
        answer = method.step(state, case, dt)
        taken = time.perf_counter() - started
        state, converged = answer.state, converged and answer.converged
        states.append(state)
        if case.forces.any():
            seconds.append(taken)
    return states if converged else None, np.array(seconds)


def at_once(problem: FullProblem, steps: Steps) -> Fields:
    """Fields of the full model without a past, each solution from the last."""
    u: list[Array] = []
    for case, _ in steps:
        load = case.load(len(problem.mesh.nodes))
        u.append(problem.model.solve(load, start=u[-1] if u else None).displacement)
    return Fields.at_once(problem, u)


def _times(
    method: Method, yardstick: Method, queries: Sequence[tuple[Steps, Fields]], first: Array
) -> tuple[Array, Array]:
    """Seconds that a method needs for each step, and the yardstick in turns with it."""

    def run(one: Method) -> Array:
        return np.concatenate([play(one, steps)[1] for steps, _ in queries])

    times, beside = first, run(yardstick)
    repeats = 1 if np.median(first) > SLOW else REPEATS - 1
    for _ in range(repeats):
        if repeats > 1:
            times = np.minimum(times, run(method))
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
    return row | {"unconverged": int((~found["converged"]).sum())}


def _summary(rows: Sequence[Row]) -> dict[str, Any]:
    points = {row["key"]: row for row in rows}
    shipped, twin = points[SHIPPED], points.get(TWIN)
    as_good = [
        row["time_us"]
        for key, row in points.items()
        if key not in (SHIPPED, TWIN) and row["displacement_p95"] <= shipped["displacement_p95"]
    ]
    summary = {
        "points": {
            key: {name: value for name, value in row.items() if name not in ("key", "family")}
            for key, row in points.items()
        },
        "pareto": [row["key"] for row in drawing.pareto(rows)],
        "speed_of_next": min(as_good) / shipped["time_us"],
    }
    return summary | ({"step_over_elastic": shipped["time_us"] / twin["time_us"]} if twin else {})
