"""The speed-accuracy chart: every method and size a point, time per query against error.

All methods answer the same loads, which none of them has seen.  What is timed is ``Method.solve``
on one core: everything that depends on the load and that a user waits for, but no field of mesh
size; per load the least of three times, of slow methods a single one.  A method's queries take
turns with the artifact's, and its times are scaled by what those take beside it over what they take
on the whole: so all points share one weather, also when a killed run went on later.

Errors are relative L2 norms over all nodes (displacement) and all beyond the clamped layer (von
Mises stress); an answer that did not converge counts as an error of 1.  Against the full model on
the scene's own mesh that is the error of reduction; against a refined mesh that of the mesh comes
on top.  Nodal stresses of two meshes are averaged over different elements, and next to the support
they grow with refinement, so that only displacements are compared there; and their median is drawn,
for so few loads say little of a 95th percentile.
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

from palpate.offline.methods.catalogue import Snapshots, Training, build
from palpate.offline.methods.mass_spring import MassSpring
from palpate.offline.methods.method import Case, Method
from palpate.offline.methods.shipped import Shipped
from palpate.offline.methods.tensor_mass import TensorMass
from palpate.offline.methods.tetrahedra import scaled
from palpate.offline.run.checkpoint import Checkpoint, content_key
from palpate.offline.run.workers import resume, worker_pool
from palpate.offline.run.workshop import Workshop, open_artifact
from palpate.offline.studies.baselines import SNAPSHOTS, full_solutions
from palpate.offline.studies.chart_drawing import draw, write_page
from palpate.offline.studies.chart_points import FIELDS, SHIPPED, Point, pareto, write_csv
from palpate.offline.studies.remeshed import Remeshed, refined
from palpate.offline.validate.loads import random_loads, unseen_loads
from palpate.offline.validate.norms import relative
from palpate.shared.artifact import read_artifact
from palpate.shared.errors import PalpateError
from palpate.shared.model import ReducedModel
from palpate.shared.scene import Scene

Array = NDArray[np.float64]
Plan = Mapping[str, Sequence[float]]
"""Sizes by method: unknowns, or times the divisions of the scene's mesh (``MESHED``)."""

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
MESHED = ("mass-spring", "tensor-mass linear", "tensor-mass nonlinear", "full")

REFINEMENT = 2
"""Of the divisions of the reference mesh; eight times the elements."""

REFINED_LOADS = 20
"""The first of the queries."""

REPEATS = 3
SLOW = 100e-3
"""Seconds of a query beyond which a single one per load tells enough."""


@dataclass(frozen=True)
class Bench:
    """What every method is measured on.

    Attributes
    ----------
    scene : Scene
        As it is named, with its files.
    training : Training
    cases : list of Case
    exact : ndarray, shape (k, n, 3), mm
        Full solutions.
    refined : ndarray, shape (j, n, 3), mm
        Solutions of the first cases in the refined mesh, nan where it has no equilibrium.
    """

    scene: Scene
    training: Training
    cases: list[Case]
    exact: Array
    refined: Array


def chart(
    scene: Scene, artifact: Path, snapshots: int, queries: int, seed: int, plan: Plan = PLAN
) -> dict[str, Any]:
    """Measure and draw speed and accuracy of every method.

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
        Sizes of every method; those of the artifact and the full model are needed.

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
    known, asked, finer = _references(scene, atlas, artifact, snapshots, queries, seed, checkpoint)
    tasks = {
        f"{name} {size:g}": (measure, name, size) for name, sizes in plan.items() for size in sizes
    }
    # one process: times are those of one core, and methods share what they learn from
    with worker_pool(open_bench, scene, artifact, known, asked, finer, seed, count=1) as worker:
        measured = resume("methods", worker, checkpoint, tasks, dict)
    points = _points(measured)
    folder = artifact.parent / atlas.name / "report"
    write_csv(folder / "chart.csv", points)
    draw(folder / "chart.png", points, scene)
    write_page(folder / "chart.html", points, scene)
    checkpoint.remove()
    return _report(points, pareto(points))


def _key(scene: Scene, artifact: Path, seed: int) -> str:
    """Hash of everything that results depend on, but for how they are drawn."""
    sources = [Path(__file__), Path(__file__).with_name("remeshed.py")]
    sources += sorted((Path(__file__).parents[1] / "methods").glob("*.py"))
    sha = hashlib.sha256(artifact.read_bytes() + b"%d" % seed)
    for source in sources:
        sha.update(source.read_bytes())
    return f"{content_key(scene)}-{sha.hexdigest()[:16]}"


def _references(
    scene: Scene,
    atlas: ReducedModel,
    artifact: Path,
    snapshots: int,
    queries: int,
    seed: int,
    checkpoint: Checkpoint,
) -> tuple[Snapshots, Snapshots, Array]:
    """Full solutions to learn from, those asked for, and the first of the latter refined."""
    rng = np.random.default_rng([scene.seed, SNAPSHOTS, seed])
    learned = random_loads(atlas.surface, atlas.limits, atlas.scene, snapshots, rng)
    with worker_pool(open_artifact, artifact) as pool:
        known = full_solutions("snapshots", learned, pool, checkpoint)
        asked = full_solutions("queries", unseen_loads(atlas, queries, seed), pool, checkpoint)
        tasks = {
            f"refined-{queries}-{i}": (refined, scene, REFINEMENT, load)
            for i, load in enumerate(asked[0][:REFINED_LOADS])
        }
        found = resume("refined mesh", pool, checkpoint, tasks, lambda u: {"u": u})
    return Snapshots(*known), Snapshots(*asked), np.stack([found[name]["u"] for name in tasks])


# --- in the worker that measures -----------------------------------------------------------------

_bench: Bench | None = None


def open_bench(
    scene: Scene, artifact: Path, known: Snapshots, asked: Snapshots, finer: Array, seed: int
) -> None:
    """Initialize the process that measures."""
    global _bench
    open_artifact(artifact)
    workshop = Workshop.of_artifact(read_artifact(artifact))
    _bench = Bench(
        scene,
        Training(workshop, known, ReducedModel.load(artifact), seed),
        [Case.of(workshop, load) for load in asked.loads],
        asked.displacements.reshape(len(asked.loads), -1, 3),
        finer,
    )


def measure(workshop: Workshop, name: str, size: float) -> dict[str, Any]:
    """Build a method and have it answer the loads; a task for ``run.workers``.

    Returns
    -------
    dict
        ``unknowns``, ``label``; per load ``displacement``, ``von_mises``, ``refined`` (errors),
        ``converged``, ``times`` (s) and ``beside`` (s), the artifact's times on the same loads.
    """
    assert _bench is not None
    training = _bench.training
    method = make(name, size, _bench)
    assert training.atlas is not None
    cases = _bench.cases[: len(_bench.refined)] if isinstance(method, Remeshed) else _bench.cases
    found, first = _answers(workshop, method, cases, _bench)
    times, beside = _times(method, Shipped(training.atlas), cases, first)
    return found | {
        "unknowns": method.unknowns,
        "label": method.label.encode(),
        "times": times,
        "beside": beside,
    }


def make(name: str, size: float, bench: Bench) -> Method:
    """Method of a name and size in a plan."""
    workshop = bench.training.workshop
    if name not in MESHED or (name, size) == ("full", 1):
        return build(name, int(size), bench.training)
    if name == "full":
        return Remeshed(bench.scene, size)
    cells = scaled(workshop.scene, size)
    if name == "mass-spring":
        return MassSpring(workshop, cells)
    linear = name == "tensor-mass linear"
    return TensorMass(workshop, cells, "linear" if linear else "st-venant-kirchhoff")


def _answers(
    workshop: Workshop, method: Method, cases: list[Case], bench: Bench
) -> tuple[dict[str, Any], Array]:
    """Errors of a method, and the times (k,) s of answers between which fields are recovered."""
    method.solve(cases[0])  # compiled code comes in from disk
    errors = np.ones((len(cases), 2))
    finer = np.ones(len(bench.refined))
    converged, times = np.zeros(len(cases), dtype=bool), np.zeros(len(cases))
    for i, case in enumerate(cases):
        started = time.perf_counter()
        answer = method.solve(case)
        times[i] = time.perf_counter() - started
        converged[i] = answer.converged
        if not answer.converged:
            continue
        u = method.displacement(answer)
        errors[i] = workshop.errors(u, bench.exact[i])
        if i < len(finer):
            finer[i] = relative(u, bench.refined[i])
    finer[np.isnan(bench.refined).any(axis=(1, 2))] = np.nan
    if isinstance(method, Remeshed):
        errors[:] = np.nan
    found = {"displacement": errors[:, 0], "von_mises": errors[:, 1], "refined": finer}
    return found | {"converged": converged}, times


def _times(
    method: Method, yardstick: Method, cases: list[Case], first: Array
) -> tuple[Array, Array]:
    """Seconds (k,) that a method needs for each case, and the yardstick in turns with it."""
    yardstick.solve(cases[0])
    beside = _run(yardstick, cases)
    if np.median(first) > SLOW:
        return first, np.minimum(beside, _run(yardstick, cases))
    times = first
    for _ in range(REPEATS - 1):
        times = np.minimum(times, _run(method, cases))
        beside = np.minimum(beside, _run(yardstick, cases))
    return times, beside


def _run(method: Method, cases: list[Case]) -> Array:
    times = np.empty(len(cases))
    for i, case in enumerate(cases):
        started = time.perf_counter()
        method.solve(case)
        times[i] = time.perf_counter() - started
    return times


# --- what is made of it --------------------------------------------------------------------------


def _points(measured: Mapping[str, Mapping[str, Any]]) -> list[Point]:
    """Points of the chart, times scaled to one weather."""
    usual = np.median([np.median(found["beside"]) for found in measured.values()])
    return [_point(key, found, float(usual)) for key, found in measured.items()]


def _point(key: str, found: Mapping[str, Any], usual: float) -> Point:
    weather = np.median(found["beside"]) / usual
    figures: dict[str, float] = {}
    for name in FIELDS:
        errors = found[name][~np.isnan(found[name])]
        quantiles = np.percentile(errors, [50, 95, 100]) if errors.size else np.full(3, np.nan)
        for statistic, error in zip(("median", "p95", "max"), quantiles.tolist(), strict=True):
            figures[f"{name}_{statistic}"] = error
    return Point(
        key=key,
        family=key.rsplit(" ", 1)[0],
        label=found["label"].item().decode(),
        unknowns=int(found["unknowns"]),
        time_us=float(1e6 * np.median(found["times"]) / weather),
        unconverged=int((~found["converged"]).sum()),
        **figures,
    )


def _report(points: Sequence[Point], front: Sequence[Point]) -> dict[str, Any]:
    shipped = next(point for point in points if point.key == SHIPPED)
    as_good = [
        point.time_us
        for point in points
        if point is not shipped and point.displacement_p95 <= shipped.displacement_p95
    ]
    rows = {point.key: asdict(point) for point in points}
    for row in rows.values():
        del row["key"], row["family"]
    return {
        "points": rows,
        "pareto": [point.key for point in front],
        "speed_of_next": min(as_good) / shipped.time_us,
    }
