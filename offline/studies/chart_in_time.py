"""The speed-accuracy chart over histories: time per step of visco-elastic tissue against error.

Every method answers the same histories, which none of them has seen, step by step and each from its
own past.  What is timed is a step on one core, without fields; of each step the least of three
times, of the full model one, and only where something presses.  Methods take turns, history by
history, so that they share the weather.  Errors are relative L2 norms over nodes and moments of a
history, against the full model; a history in which a step has no answer counts as an error of 1.

The *elastic twin* is the artifact asked as if there were no past: a warm query of the same local
models, with the same modes and cubature points, at the same loads.  It is judged by the full model
of tissue that answers at once, and says what memory costs.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from palpate.offline.methods.catalogue import Snapshots, Training
from palpate.offline.methods.galerkin_in_time import GalerkinInTime
from palpate.offline.methods.in_time import FullInTime, InTime
from palpate.offline.methods.method import Case
from palpate.offline.methods.shipped_in_time import ElasticTwin, ShippedInTime
from palpate.offline.methods.spaces import krylov, modal
from palpate.offline.run.workers import completed, worker_pool
from palpate.offline.run.workshop import Workshop, open_artifact
from palpate.offline.studies.chart_drawing import duration, percent
from palpate.offline.studies.chart_points import Point, pareto, write_csv
from palpate.offline.validate.histories import NONE_FOLLOWED, Press, loads_of, random_histories
from palpate.offline.validate.loads import UNSEEN
from palpate.offline.validate.norms import relative
from palpate.shared.artifact import read_artifact
from palpate.shared.errors import PalpateError, QueryError
from palpate.shared.model import ReducedModel
from palpate.shared.scene import Scene

Array = NDArray[np.float64]

SIZES = (5, 10, 20, 40, 80)
LEARNING = 106
"""Sets the random numbers of what POD learns from apart."""

REPEATS = 3
SHIPPED, TWIN, FULL = "artifact", "elastic twin", "full"

STYLES = {
    SHIPPED: ("this artifact", "#D55E00", "*"),
    TWIN: ("the same without memory", "#CC79A7", "*"),
    "pod": ("POD of histories", "#009E73", "D"),
    "ritz": ("responses to loads (Ritz)", "#E69F00", "s"),
    "modal": ("vibration modes", "#0072B2", "o"),
}


class Question(NamedTuple):
    """A history and the full model's answers."""

    presses: Sequence[Press]
    cases: Sequence[Case]
    displacements: Array  # (t, n, 3) mm
    stresses: Array  # (t, n) kPa


def chart_in_time(
    artifact: Path, count: int, lessons: int, seed: int, sizes: Sequence[int] = SIZES
) -> dict[str, Any]:
    """Measure and draw speed and accuracy of every method in time.

    Parameters
    ----------
    artifact : Path
        Of visco-elastic tissue; ``chart_in_time.csv`` and ``.png`` go to its report.
    count, lessons : int
        Random histories that are asked, and that POD learns from.
    seed : int
        Of both; the former are those of ``palpate validate --histories``.
    sizes : sequence of int
        Numbers of modes.

    Returns
    -------
    dict
        ``points``: times and errors by key; ``step_over_elastic``: time of the artifact's step over
        that of its elastic twin; ``speed_of_next``: as of ``offline.studies.chart.chart``;
        ``without_equilibrium``: histories that the full model could not follow.
    """
    atlas = ReducedModel.load(artifact)
    if atlas.models.viscous is None:
        raise QueryError("scene", f"{atlas.name!r} is elastic: it has no histories")
    workshop = Workshop.of_artifact(read_artifact(artifact))
    questions, known = _histories(artifact, atlas, workshop, count, lessons, seed)
    methods: dict[str, InTime] = {
        SHIPPED: ShippedInTime(atlas),
        TWIN: ElasticTwin(atlas),
        FULL: FullInTime(workshop),
        **_galerkin(workshop, known, sizes),
    }
    errors: dict[str, list[tuple[float, float]]] = {key: [] for key in methods}
    times: dict[str, list[float]] = {key: [] for key in methods}
    for question in tqdm(questions, "histories"):
        for key, method in methods.items():
            error, seconds = _answer(workshop, method, question)
            errors[key].append(error)
            times[key] += seconds
    points = [_point(key, methods[key], errors[key], times[key]) for key in methods]
    folder = artifact.parent / atlas.name / "report"
    write_csv(folder / "chart_in_time.csv", points)
    draw(folder / "chart_in_time.png", points, atlas.scene)
    return _report(points) | {"without_equilibrium": count - len(questions)}


def _histories(
    artifact: Path, atlas: ReducedModel, workshop: Workshop, count: int, lessons: int, seed: int
) -> tuple[list[Question], Array]:
    """Histories to answer, and displacements (k, 3 n) mm of others to learn from."""
    asked = np.random.default_rng([atlas.scene.seed, UNSEEN, seed])
    learnt = np.random.default_rng([atlas.scene.seed, LEARNING, seed])
    histories = {
        f"{name} {i}": presses
        for name, rng, number in (("asked", asked, count), ("learnt", learnt, lessons))
        for i, presses in enumerate(random_histories(atlas, number, rng))
    }
    tasks = {name: (Workshop.follow, *loads_of(presses)) for name, presses in histories.items()}
    with worker_pool(open_artifact, artifact) as pool:
        found = dict(tqdm(completed(pool, tasks), "full histories", len(tasks)))
    known = {name: found[name] for name in tasks if found[name] is not None}
    questions = [
        Question(
            histories[name],
            [Case.of(workshop, load) for load in tasks[name][1]],
            *(field.astype(float) for field in fields),
        )
        for name, fields in known.items()
        if name.startswith("asked")
    ]
    fields = [u.reshape(len(u), -1) for name, (u, _) in known.items() if name.startswith("learnt")]
    if not questions or not fields:
        raise PalpateError(f"{artifact}: {NONE_FOLLOWED}")
    return questions, np.concatenate(fields)


def _galerkin(workshop: Workshop, known: Array, sizes: Sequence[int]) -> dict[str, InTime]:
    """Galerkin models of every kind and size; those of POD end with what it has been shown."""
    training, most = Training(workshop, Snapshots((), known)), max(sizes)
    bases = {
        "pod": lambda size: training.pod(most)[:, :size],
        "modal": lambda size: modal(training.model, size),
        "ritz": lambda size: krylov(
            training.model, training.mass, training.loads(-(-size // 3)), size
        ),
    }
    found: dict[str, InTime] = {}
    for name, basis in bases.items():
        for size in sizes:
            modes = np.ascontiguousarray(basis(size))
            label = f"{modes.shape[1]} modes, all points"
            found[f"{name} {size}"] = GalerkinInTime(name, label, workshop, modes)
    return found


def _answer(
    workshop: Workshop, method: InTime, question: Question
) -> tuple[tuple[float, float], list[float]]:
    """Errors of displacement and stress over a history, and times (s) of the steps that press."""
    repeats = 1 if isinstance(method, FullInTime) else REPEATS
    seconds = np.full(len(question.presses), np.inf)
    for _ in range(repeats):
        past, pasts = method.at_rest(), []
        for i, (press, case) in enumerate(zip(question.presses, question.cases, strict=True)):
            started = time.perf_counter()
            converged, past = method.step(past, case, press.dt)
            seconds[i] = min(seconds[i], time.perf_counter() - started)
            pasts.append(past if converged else None)
    pressed = [press.pressure > 0.0 for press in question.presses]
    if any(past is None for past in pasts):
        return (1.0, 1.0), seconds[pressed].tolist()
    exact = question.displacements, question.stresses
    if isinstance(method, ElasticTwin):
        exact = _at_once(workshop, question.cases)
    kept = workshop.beyond_clamped_layer
    u = np.array([method.displacement(past) for past in pasts])
    s = np.array([method.von_mises(past) for past in pasts])
    return (relative(u, exact[0]), relative(s[:, kept], exact[1][:, kept])), seconds[
        pressed
    ].tolist()


def _at_once(workshop: Workshop, cases: Sequence[Case]) -> tuple[Array, Array]:
    """Displacements and stresses of the full model without a past."""
    displacements: list[Array] = []
    for case in cases:
        load = np.zeros((len(workshop.mesh.nodes), 3))
        load[case.nodes] = case.forces
        start = displacements[-1] if displacements else None
        displacements.append(workshop.model.solve(load, start).displacement)
    return np.array(displacements), np.array([workshop.von_mises(u) for u in displacements])


# --- what is made of it --------------------------------------------------------------------------


def _point(
    key: str, method: InTime, errors: Sequence[tuple[float, float]], times: Sequence[float]
) -> Point:
    figures = {"refined_median": np.nan, "refined_p95": np.nan, "refined_max": np.nan}
    for name, own in zip(("displacement", "von_mises"), np.array(errors).T, strict=True):
        quantiles = np.percentile(own, [50, 95, 100]).tolist()
        figures |= {
            f"{name}_{statistic}": error
            for statistic, error in zip(("median", "p95", "max"), quantiles, strict=True)
        }
    return Point(
        key=key,
        family=method.family,
        label=method.label,
        unknowns=method.unknowns,
        time_us=float(1e6 * np.median(times)),
        unconverged=sum(error == (1.0, 1.0) for error in errors),
        **figures,
    )


def _report(points: Sequence[Point]) -> dict[str, Any]:
    by_key = {point.key: point for point in points}
    shipped, twin = by_key[SHIPPED], by_key[TWIN]
    as_good = [
        point.time_us
        for point in points
        if point.key not in (SHIPPED, TWIN) and point.displacement_p95 <= shipped.displacement_p95
    ]
    rows: Mapping[str, dict[str, Any]] = {key: asdict(point) for key, point in by_key.items()}
    for row in rows.values():
        for name in ("key", "family", "refined_median", "refined_p95", "refined_max"):
            del row[name]
    return {
        "points": rows,
        "step_over_elastic": shipped.time_us / twin.time_us,
        "speed_of_next": min(as_good) / shipped.time_us,
    }


def draw(path: Path, points: Sequence[Point], scene: Scene) -> None:
    """Time of a step against errors of displacement and of von Mises stress."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.5, 5.6), layout="constrained")
    figure.suptitle(
        f"Speed and accuracy over histories of the scene {scene.name!r}: lower left is better",
        fontsize=14, fontweight="bold",
    )  # fmt: skip
    panels = figure.subplots(1, 2, sharex=True)
    titles = (("displacement", "Displacement"), ("von_mises", "Von Mises stress"))
    for axes, (field, title) in zip(panels, titles, strict=True):
        axes.set_title(title, loc="left", fontweight="bold")
        _draw_panel(axes, field, points, scene)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    figure.savefig(path, dpi=100)


def _draw_panel(axes: Any, field: str, points: Sequence[Point], scene: Scene) -> None:
    by_key = {point.key: point for point in points}
    shown = [point for point in points if point.key != FULL]
    for family, (name, colour, marker) in STYLES.items():
        own = [point for point in shown if point.family == family]
        times, errors = [p.time_us for p in own], [p.error(field, "p95") for p in own]
        axes.vlines(times, errors, [p.error(field, "max") for p in own], colour, lw=0.9, alpha=0.4)
        axes.plot(
            times, errors, marker=marker, color=colour, label=name, lw=0.9,
            ms=17 if marker == "*" else 6, mec="white", mew=0.6, zorder=3,
        )  # fmt: skip
    front = pareto([point for point in shown if point.key != TWIN], field)
    axes.set(xscale="log", yscale="log")
    full, shipped, twin = by_key[FULL], by_key[SHIPPED], by_key[TWIN]
    axes.set_xlim(min(p.time_us for p in points) / 1.8, 2.5 * full.time_us)
    axes.set_ylim(min(p.error(field, "p95") for p in shown) / 4, 1.5)
    axes.step(
        [*(p.time_us for p in front), axes.get_xlim()[1]],
        [*(p.error(field, "p95") for p in front), front[-1].error(field, "p95")],
        where="post", color="0.25", lw=1.2, ls=(0, (4, 2)), zorder=2,
    )  # fmt: skip
    axes.axvline(full.time_us, color="black", lw=0.9, ls=":")
    axes.annotate(
        f"full model:\n{duration(full.time_us)},\nno error", (full.time_us, axes.get_ylim()[0]),
        (-6, 8), textcoords="offset points", ha="right",
    )  # fmt: skip
    tolerance = getattr(scene.tolerance, field)
    axes.axhline(tolerance, color="#D55E00", lw=0.9, ls=":")
    axes.annotate(
        f"the scene's tolerance: {percent(tolerance)}", (axes.get_xlim()[1], tolerance), (-6, 5),
        textcoords="offset points", ha="right", color="#A34700",
    )  # fmt: skip
    error = percent(shipped.error(field, "p95"))
    axes.annotate(
        f"{error} in {duration(shipped.time_us)} a step,\n"
        f"{shipped.time_us / twin.time_us:.1f} x that without memory",
        (shipped.time_us, shipped.error(field, "p95")), (14, -22), textcoords="offset points",
        color="#A34700", fontweight="bold",
    )  # fmt: skip
    axes.xaxis.set_major_formatter(lambda x, _: duration(x))
    axes.yaxis.set_major_formatter(lambda y, _: f"{100 * y:g} %")
    axes.grid(color="0.9", lw=0.7)
    axes.set_xlabel("time per step on one core")
    axes.set_ylabel("error over a history, 95th percentile; whisker: the worst")
