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

import hashlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.offline.methods.catalogue import Training, build
from palpate.offline.methods.full import Remeshed
from palpate.offline.methods.method import Case, Method, Snapshots
from palpate.offline.methods.shipped import Shipped, Warm
from palpate.offline.run.checkpoint import Checkpoint, content_key
from palpate.offline.run.streams import Stage, stream
from palpate.offline.run.workers import resume, worker_pool
from palpate.offline.run.workshop import Workshop, open_artifact
from palpate.offline.studies.chart_drawing import IN_TIME, OF_LOADS, Layout, draw, write_page
from palpate.offline.studies.chart_points import FIELDS, SHIPPED, STATISTICS, TWIN, Point, pareto
from palpate.offline.studies.references import (
    Fields,
    Steps,
    full_histories,
    full_solutions,
    random_steps,
    refined,
)
from palpate.offline.studies.tables import write_csv
from palpate.offline.validate.histories import NONE_FOLLOWED
from palpate.offline.validate.loads import random_loads, unseen_loads
from palpate.offline.validate.norms import relative
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
    "tensor-mass linear": (0.5, 1, 2),
    "tensor-mass nonlinear": (0.5, 1, 2),
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
class Query:
    """What methods are asked, and the full model's answers."""

    steps: Steps
    exact: Fields


@dataclass(frozen=True)
class References:
    """Full solutions to learn from, to compare with, and of the first queries in a refined mesh."""

    snapshots: Snapshots
    queries: list[Query]
    refined: Array  # (j, n, 3) mm, nan where there is no equilibrium


def chart(
    scene: Scene, artifact: Path, snapshots: int, queries: int, seed: int, plan: Plan = PLAN
) -> dict[str, Any]:
    """Measure and draw speed and accuracy of every method under random loads.

    Parameters
    ----------
    scene : Scene
        That the artifact was trained on.
    artifact : Path
        ``chart.csv``, ``chart.png`` and ``chart.html`` go to ``NAME/report/`` beside it.
    snapshots : int
        Full solutions that methods learn from.
    queries, seed : int
        Loads to answer, the same as ``validate.loads.validate`` takes.
    plan : mapping
        Sizes of every method; those of the artifact and the full model are needed.  POD is
        measured with as many modes as the artifact has unknowns, too.

    Returns
    -------
    dict
        ``points``: times and errors by key; ``pareto``: keys of those that no other beats in both
        time and p95 of displacement; ``speed_of_next``: time of the fastest other point that is at
        least as accurate, over the artifact's.
    """
    atlas = ReducedModel.load(artifact)
    if atlas.scene.text != scene.text:
        raise PalpateError(f"{artifact}: trained on another scene than {scene.name!r}")
    checkpoint = Checkpoint(
        artifact.parent / f".{artifact.stem}.chart", _key(scene, artifact, seed)
    )
    references = _loads(scene, atlas, artifact, snapshots, queries, seed, checkpoint)
    context = scene, artifact, references, seed, False
    plan = {**plan, "pod": sorted({*plan["pod"], Shipped(atlas).unknowns})}
    return _measured(atlas, plan, context, checkpoint, "chart", OF_LOADS)


def chart_in_time(
    artifact: Path, histories: int, snapshots: int, seed: int, plan: Plan = PLAN_IN_TIME
) -> dict[str, Any]:
    """Measure and draw speed and accuracy of methods over random histories.

    Parameters
    ----------
    artifact : Path
        Of visco-elastic tissue; ``chart_in_time.csv``, ``.png`` and ``.html`` go to its report.
    histories, snapshots : int
        Random histories that methods answer, and that POD learns from.
    seed : int
        Of both; the former are those of ``palpate validate --histories``.
    plan : mapping
        As of ``chart``.

    Returns
    -------
    dict
        As of ``chart``; ``step_over_elastic``: time of the artifact's step over that of its elastic
        twin; ``without_equilibrium``: histories that the full model could not follow.
    """
    atlas = ReducedModel.load(artifact)
    if atlas.models.viscous is None:
        raise QueryError("scene", f"{atlas.name!r} is elastic: it has no histories")
    checkpoint = Checkpoint(
        artifact.parent / f".{artifact.stem}.chart_in_time", _key(atlas.scene, artifact, seed)
    )
    references = _histories(atlas, artifact, histories, snapshots, seed, checkpoint)
    context = None, artifact, references, seed, True
    report = _measured(atlas, plan, context, checkpoint, "chart_in_time", IN_TIME)
    times = {key: report["points"][key]["time_us"] for key in (SHIPPED, TWIN)}
    return report | {
        "step_over_elastic": times[SHIPPED] / times[TWIN],
        "without_equilibrium": histories - len(references.queries),
    }


def _key(scene: Scene, artifact: Path, seed: int) -> str:
    """Hash of everything that results depend on."""
    sha = hashlib.sha256(artifact.read_bytes() + b"%d" % seed)
    return f"{content_key(scene)}-{sha.hexdigest()[:16]}"


def _measured(
    atlas: ReducedModel,
    plan: Plan,
    context: tuple[Any, ...],
    checkpoint: Checkpoint,
    name: str,
    layout: Layout,
) -> dict[str, Any]:
    """Measure the methods of a plan, publish the chart and report it."""
    tasks = {
        f"{method} {size:g}": (measure, method, size)
        for method, sizes in plan.items()
        for size in sizes
    }
    # one process: times are those of one core, and methods share what they learn from
    with worker_pool(open_bench, *context, count=1) as worker:
        measured = resume("methods", worker, checkpoint, tasks, dict)
    usual = float(np.median([np.median(found["beside"]) for found in measured.values()]))
    points = [_point(key, found, usual) for key, found in measured.items()]
    artifact: Path = context[1]
    folder = artifact.parent / atlas.name / "report"
    write_csv(folder / f"{name}.csv", [asdict(point) for point in points])
    draw(folder / f"{name}.png", points, atlas.scene, layout)
    write_page(folder / f"{name}.html", points, atlas.scene, layout)
    checkpoint.remove()
    return _report(points)


# --- full solutions ------------------------------------------------------------------------------


def _loads(
    scene: Scene,
    atlas: ReducedModel,
    artifact: Path,
    snapshots: int,
    queries: int,
    seed: int,
    checkpoint: Checkpoint,
) -> References:
    """Full solutions of random loads."""
    rng = stream(scene.seed, Stage.SNAPSHOTS, seed)
    loads = random_loads(atlas.surface, atlas.limits, atlas.scene, snapshots, rng)
    with worker_pool(open_artifact, artifact) as pool:
        training = full_solutions("snapshots", loads, pool, checkpoint)
        solved = full_solutions("queries", unseen_loads(atlas, queries, seed), pool, checkpoint)
        tasks = {
            f"refined-{queries}-{i}": (refined, scene, REFINEMENT, load)
            for i, load in enumerate(solved.loads[:REFINED_LOADS])
        }
        found = resume("refined mesh", pool, checkpoint, tasks, lambda u: {"u": u})
    workshop = Workshop.of_artifact(read_artifact(artifact))
    displacements = solved.displacements.reshape(len(solved.loads), -1, 3)
    unseen = [
        Query([(Case.of(workshop, load), 0.0)], Fields(u[None], workshop.von_mises(u)[None]))
        for load, u in zip(solved.loads, displacements, strict=True)
    ]
    return References(training, unseen, np.stack([found[name]["u"] for name in tasks]))


def _histories(
    atlas: ReducedModel,
    artifact: Path,
    queries: int,
    snapshots: int,
    seed: int,
    checkpoint: Checkpoint,
) -> References:
    """Full solutions of random histories."""
    workshop = Workshop.of_artifact(read_artifact(artifact))
    stages = {
        "query": (Stage.UNSEEN, queries),
        "snapshot": (Stage.CHART_IN_TIME_SNAPSHOTS, snapshots),
    }
    histories = {
        f"{name} {i}": steps
        for name, (stage, count) in stages.items()
        for i, steps in enumerate(
            random_steps(atlas, workshop, count, stream(atlas.scene.seed, stage, seed))
        )
    }
    with worker_pool(open_artifact, artifact) as pool:
        found = full_histories(histories, set(), pool, checkpoint)
    unseen = [Query(histories[name], own) for name, own in found.items() if name[0] == "q"]
    training = [own.displacements for name, own in found.items() if name[0] == "s"]
    if not unseen or not training:
        raise PalpateError(f"{artifact}: {NONE_FOLLOWED}")
    rows = np.concatenate(training).astype(float)
    nothing = np.empty((0, *workshop.mesh.nodes.shape))
    return References(Snapshots((), rows.reshape(len(rows), -1)), unseen, nothing)


# --- in the worker that measures -----------------------------------------------------------------


_bench: tuple[Training, References] | None = None


def open_bench(
    scene: Scene | None, artifact: Path, references: References, seed: int, in_time: bool
) -> None:
    """Initialize the process that measures."""
    global _bench
    open_artifact(artifact)
    workshop = Workshop.of_artifact(read_artifact(artifact))
    atlas = ReducedModel.load(artifact)
    _bench = Training(workshop, references.snapshots, atlas, seed, scene, in_time), references


def measure(workshop: Workshop, name: str, size: float) -> dict[str, Any]:
    """Build a method and have it answer the queries; a task for ``run.workers``.

    Returns
    -------
    dict
        ``unknowns``, ``label``; per query ``displacement``, ``von_mises``, ``refined`` (errors) and
        ``converged``; per step that presses ``times`` (s) and ``beside`` (s), the artifact's times.
    """
    assert _bench is not None
    training, references = _bench
    method, yardstick = build(name, size, training), build("artifact", 1, training)
    queries, finer = references.queries, references.refined
    if isinstance(method, Remeshed):
        queries = queries[: len(finer)]
    for one in (method, yardstick):  # compiled code comes in from disk
        one.step(one.at_rest(), *queries[0].steps[0])
    errors, converged = np.ones((len(queries), 2)), np.ones(len(queries), dtype=bool)
    from_finer, times = np.ones(len(finer)), []
    for i, query in enumerate(queries):
        states, seconds = play(method, query.steps)
        times.append(seconds)
        converged[i] = states is not None
        if states is not None:
            fields = Fields.of(method, states)
            exact = at_once(workshop, query.steps) if isinstance(method, Warm) else query.exact
            errors[i] = fields.errors(workshop, exact)
            if i < len(finer):
                from_finer[i] = relative(fields.displacements[-1], finer[i])
    from_finer[np.isnan(finer).any(axis=(1, 2))] = np.nan
    if isinstance(method, Remeshed):  # nothing to compare with on another mesh
        errors[:] = np.nan
    least, beside = _times(method, yardstick, queries, np.concatenate(times))
    return {
        "unknowns": method.unknowns,
        "label": method.label.encode(),
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


def at_once(workshop: Workshop, steps: Steps) -> Fields:
    """Fields of the full model without a past, each solution from the last."""
    u: list[Array] = []
    for case, _ in steps:
        load = case.load(len(workshop.mesh.nodes))
        u.append(workshop.model.solve(load, u[-1] if u else None).displacement)
    return Fields(np.array(u), np.array([workshop.von_mises(x) for x in u]))


def _times(
    method: Method, yardstick: Method, queries: Sequence[Query], first: Array
) -> tuple[Array, Array]:
    """Seconds that a method needs for each step, and the yardstick in turns with it."""

    def run(one: Method) -> Array:
        return np.concatenate([play(one, query.steps)[1] for query in queries])

    times, beside = first, run(yardstick)
    repeats = 1 if np.median(first) > SLOW else REPEATS - 1
    for _ in range(repeats):
        if repeats > 1:
            times = np.minimum(times, run(method))
        beside = np.minimum(beside, run(yardstick))
    return times, beside


# --- results -------------------------------------------------------------------------------------


def _point(key: str, found: Mapping[str, Any], usual: float) -> Point:
    """A point of the chart, its times scaled to the artifact's usual speed."""
    figures: dict[str, float] = {}
    for name in FIELDS:
        errors = found[name][~np.isnan(found[name])]
        quantiles = np.percentile(errors, [50, 95, 100]) if errors.size else np.full(3, np.nan)
        for statistic, error in zip(STATISTICS, quantiles.tolist(), strict=True):
            figures[f"{name}_{statistic}"] = error
    return Point(
        key=key,
        family=key.rsplit(" ", 1)[0],
        label=found["label"].item().decode(),
        unknowns=int(found["unknowns"]),
        time_us=float(1e6 * np.median(found["times"]) / np.median(found["beside"]) * usual),
        unconverged=int((~found["converged"]).sum()),
        **figures,
    )


def _report(points: Sequence[Point]) -> dict[str, Any]:
    shipped = next(point for point in points if point.key == SHIPPED)
    as_good = [
        point.time_us
        for point in points
        if point.key not in (SHIPPED, TWIN) and point.displacement_p95 <= shipped.displacement_p95
    ]
    rows = {point.key: asdict(point) for point in points}
    for row in rows.values():
        del row["key"], row["family"]
    return {
        "points": rows,
        "pareto": [point.key for point in pareto(points)],
        "speed_of_next": min(as_good) / shipped.time_us,
    }
