"""Where methods fail, and whether they say so: a map of methods against what strains them.

Every method answers the same loads, inside the trained range and far out of it, for which the full
model's answer is known.  A method that gives a wrong answer and vouches for it has failed silently,
which is the one failure a user cannot guard against; most methods have no way to fail otherwise.
One kind of wrong answer is told apart and counted with the others: where a load has several
equilibria, that which its path does not lead to.

Tissue of another Poisson's ratio is a scene of its own, from which all methods are built anew but
the artifact.  Only the artifact can start from its last answer: nothing else is asked on the way
of a moving tool.
"""

from __future__ import annotations

import csv
import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from palpate.offline import methods as methods_package
from palpate.offline.methods.catalogue import Snapshots, Training, build
from palpate.offline.methods.deim import PlainNewton
from palpate.offline.methods.galerkin import Cubature, Galerkin, GalerkinModel
from palpate.offline.methods.mass_spring import MassSpring
from palpate.offline.methods.method import Case, Method
from palpate.offline.methods.shipped import Shipped
from palpate.offline.methods.tensor_mass import TensorMass
from palpate.offline.methods.tetrahedra import scaled
from palpate.offline.run.checkpoint import Checkpoint, content_key
from palpate.offline.run.workers import worker_pool
from palpate.offline.run.workshop import Workshop, open_artifact
from palpate.offline.studies import hard_cases
from palpate.offline.studies.hard_cases import (
    CONTROL,
    HYSTERESIS,
    SEVERAL,
    Stressors,
    Trial,
    Truth,
    tissue,
    truths,
)
from palpate.offline.validate.loads import random_loads
from palpate.shared.artifact import read_artifact
from palpate.shared.model import ReducedModel, Solution

Array = NDArray[np.float64]

SNAPSHOTS = 150
"""Full solutions of each tissue that the methods learn from."""

LEARNING = 103
"""Sets their random numbers apart."""

SIZE, DERIVATIVES = 40, 19

ROUGHLY = 0.1
"""Error of displacement that a wrong answer may have to be roughly right; hardly any but the
artifact is within the tolerance of a scene, and not even these have the stress."""

ARTIFACT, WARM, FULL = "artifact", "artifact, warm", "full model, one jump"

RIGHT = "right"
RIGHT_FLAGGED = "right but flagged"
WRONG_FLAGGED = "wrong but flagged"
ANOTHER_FLAGGED = "another equilibrium but flagged"
REFUSED = "refused, or rightly none"
DIVERGED = "not converged"
ANOTHER = "silently another equilibrium"
ROUGH = "silently wrong, displacement within 10 %"
SILENT = "silently wrong"
INVERTED = "silently inverted"

OUTCOMES = {
    RIGHT: "#0072B2",
    RIGHT_FLAGGED: "#8CC5E8",
    WRONG_FLAGGED: "#C8C8C8",
    ANOTHER_FLAGGED: "#EBC9DB",
    REFUSED: "#ECECEC",
    DIVERGED: "#7F7F7F",
    ANOTHER: "#CC79A7",
    ROUGH: "#F0E442",
    SILENT: "#D55E00",
    INVERTED: "#000000",
}
"""What can become of an answer, and its colour: after Okabe & Ito, told apart by all eyes."""

SILENT_OUTCOMES = (ANOTHER, ROUGH, SILENT, INVERTED)


@dataclass(frozen=True)
class Reply:
    """What became of a case.

    Attributes
    ----------
    outcome : str
    displacement, von_mises : float
        Relative errors, NaN without an answer or without an equilibrium.
    inverted, nan, crashed : bool
        Whether the answer turns an element inside out, is vouched for but not finite, is none
        because the method raised.
    details : dict
        What the artifact says of a silent error.
    """

    outcome: str
    displacement: float = float("nan")
    von_mises: float = float("nan")
    inverted: bool = False
    nan: bool = False
    crashed: bool = False
    details: dict[str, Any] = field(default_factory=dict)


Question = tuple[Trial, Truth]

Table = dict[str, dict[str, list[Reply]]]
"""Replies by method and stressor."""

Builder = Callable[[Training], Method]


def stability(
    artifact: Path,
    cases: int,
    seed: int,
    methods: Sequence[str] | None = None,
    columns: Sequence[str] | None = None,
    snapshots: int = SNAPSHOTS,
) -> dict[str, Any]:
    """Map what becomes of the answers of methods under stress.

    Parameters
    ----------
    artifact : Path
        The map goes to ``NAME/report`` beside it: ``stability.csv``, a row per method and stressor;
        ``stability.png``; ``stability_silent.csv``, the artifact's silent errors.
    cases : int
        Of each stressor.
    seed : int
    methods, columns : sequence of str, optional
        Only these of ``METHODS``, and only these stressors; all if absent.
    snapshots : int
        Full solutions that the methods learn from.

    Returns
    -------
    dict
        ``artifact``: totals of its silent errors, of answers that are not finite and of crashes,
        and the share of right answers that it flags, overall and in range; ``methods``: outcomes;
        ``without_equilibrium``: cases that the full model has no answer to;
        ``with_several_equilibria``, ``with_hysteresis``: cases whose path and jump end apart, of
        loads that are raised and that are lowered again, a column each if there are any.
    """
    atlas = ReducedModel.load(artifact)
    workshop = Workshop.of_artifact(read_artifact(artifact))
    everything = Stressors(atlas, workshop, cases, seed).trials()
    trials = {name: everything[name] for name in columns or everything}
    poissons = sorted({trial.poisson for own in trials.values() for trial in own})
    lessons = _lessons(atlas, workshop, poissons, snapshots)
    key = _key(artifact, cases, seed, snapshots)
    solved = Checkpoint(artifact.parent / f".{artifact.stem}.stability-solved", key)
    asked = Checkpoint(
        artifact.parent / f".{artifact.stem}.stability-asked", _key_of_answers(key, trials)
    )
    with worker_pool(open_artifact, artifact) as pool:
        found = truths({**trials, **lessons}, pool, solved)
    questions = {
        name: list(zip(own, found[name], strict=True)) for name, own in trials.items()
    } | _several(trials, found, cases)
    table: Table = {}
    for poisson in poissons:
        lesson = lessons[_lesson(poisson)]
        training = _training(tissue(workshop, poisson), atlas, lesson, found[_lesson(poisson)])
        asking = {n: own for n, own in questions.items() if own and own[0][0].poisson == poisson}
        for name in tqdm(methods or METHODS, f"methods, Poisson {poisson:g}"):
            own = {n: pairs for n, pairs in asking.items() if _applies(name, pairs[0][0], atlas)}
            if own:
                table.setdefault(name, {}).update(_replies(name, training, own, asked))
    return _publish(artifact.parent / atlas.name / "report", table, questions, (solved, asked))


def _key(artifact: Path, cases: int, seed: int, snapshots: int) -> str:
    """Of full solutions."""
    settings = f"{cases} {seed} {snapshots}".encode()
    made = Path(hard_cases.__file__).read_bytes()
    own = hashlib.sha256(artifact.read_bytes() + made + settings).hexdigest()[:16]
    return f"{content_key(ReducedModel.load(artifact).scene)}-{own}"


def _lessons(
    atlas: ReducedModel, workshop: Workshop, poissons: Iterable[float], count: int
) -> dict[str, list[Trial]]:
    """What methods learn from in each tissue: random loads in range."""
    rng = np.random.default_rng([atlas.scene.seed, LEARNING])
    loads = random_loads(atlas.surface, atlas.limits, atlas.scene, count, rng)
    cases = [Case.of(workshop, load) for load in loads]
    return {_lesson(p): [Trial(case, p) for case in cases] for p in poissons}


def _lesson(poisson: float) -> str:
    return f"lesson {poisson:g}"


def _key_of_answers(key: str, columns: Iterable[str]) -> str:
    """As a key of full solutions, of the questions and of the methods."""
    sha = hashlib.sha256(" ".join([key, *columns]).encode() + Path(__file__).read_bytes())
    for source in sorted(Path(methods_package.__path__[0]).glob("*.py")):
        sha.update(source.read_bytes())
    return sha.hexdigest()[:16]


def _training(
    workshop: Workshop, atlas: ReducedModel, lesson: Sequence[Trial], found: Sequence[Truth]
) -> Training:
    known = [(t.case.contacts[0], u.jump) for t, u in zip(lesson, found, strict=True)]
    pairs = [(load, jump) for load, jump in known if jump is not None]
    displacements = np.stack([jump for _, jump in pairs])
    return Training(workshop, Snapshots([load for load, _ in pairs], displacements), atlas)


def _several(
    trials: Mapping[str, Sequence[Trial]], found: Mapping[str, Sequence[Truth]], most: int
) -> dict[str, list[Question]]:
    """Of all loads that were followed, those of several equilibria: raised, and lowered again."""
    followed: dict[str, list[Question]] = {}
    for name, own in trials.items():
        for trial, truth in zip(own, found[name], strict=True):
            if trial.follow:
                column = followed.setdefault(HYSTERESIS if trial.before else SEVERAL, [])
                column += [(trial, truth)] if truth.several else []
    return {name: own[:most] for name, own in followed.items()}


def _applies(method: str, trial: Trial, atlas: ReducedModel) -> bool:
    """Whether a method can be asked at all."""
    if method in (ARTIFACT, WARM) and trial.poisson != atlas.scene.tissue.poisson:
        return False
    if trial.before:
        return method in (ARTIFACT, WARM) or (method == FULL and trial.follow)
    return method != WARM


# --- methods -------------------------------------------------------------------------------------


def _named(name: str, size: int = SIZE) -> Builder:
    return lambda training: build(name, size, training)


def _warm(training: Training) -> Method:
    assert training.atlas is not None
    return Shipped(training.atlas, training.atlas.new_state())


def _sparse(training: Training) -> Method:
    """As pod-ecm, but with a cubature of one point per mode instead of six."""
    basis = training.pod(SIZE)
    cubature = training.point_forces(basis).by_point(basis.shape[1], training.rng(SIZE))
    return Galerkin("pod-ecm", "sparse", training.model, basis, cubature)


def _whole_steps(training: Training) -> Method:
    """As pod, but by plain Newton's method: no line search, no check of the tangent."""
    basis = training.pod(SIZE)
    reduced = GalerkinModel(training.model, SIZE, Cubature.full(training.model))
    reduced.adopt(basis)
    test = reduced.content.system.gradients
    return PlainNewton("pod", "whole steps", basis.shape[1], reduced, test)


def _springs(training: Training) -> Method:
    return MassSpring(training.workshop, scaled(training.workshop.scene, 1))


def _tensors(training: Training) -> Method:
    return TensorMass(training.workshop, scaled(training.workshop.scene, 1))


METHODS: dict[str, Builder | None] = {
    ARTIFACT: _named("artifact"),
    WARM: _warm,
    FULL: None,
    f"derivatives {DERIVATIVES}": _named("derivatives", DERIVATIVES),
    f"pod {SIZE}": _named("pod"),
    f"pod {SIZE}, no line search": _whole_steps,
    f"pod-ecm {SIZE}": _named("pod-ecm"),
    f"pod-ecm {SIZE}, 1 point a mode": _sparse,
    f"pod-deim {SIZE}": _named("pod-deim"),
    f"pod-gappy {SIZE}": _named("pod-gappy"),
    f"modal {SIZE}": _named("modal"),
    f"ritz {SIZE}": _named("ritz"),
    f"krylov {SIZE}": _named("krylov"),
    f"linear {SIZE}": _named("linear"),
    f"regression {SIZE}": _named("regression"),
    "mass-spring": _springs,
    "tensor-mass": _tensors,
}
"""Rows of the map.  The full model's jump is known already; springs and tensors have a cell for
each element of the scene."""


# --- answers -------------------------------------------------------------------------------------


def _replies(
    name: str, training: Training, questions: Mapping[str, Sequence[Question]], asked: Checkpoint
) -> dict[str, list[Reply]]:
    """What a method makes of the questions of each stressor; kept, for some take their time."""
    label = f"{name} {training.workshop.scene.tissue.poisson:g}"
    kept = asked.load(label)
    if kept is None:
        rows = [vars(reply) for reply in _ask(name, training, questions)]
        kept = {key: np.array([row[key] for row in rows]) for key in rows[0]}
        kept["outcome"] = np.array([list(OUTCOMES).index(row["outcome"]) for row in rows])
        kept["details"] = np.array([json.dumps(row["details"]) for row in rows], dtype=bytes)
        asked.store(label, kept)
    return _unpack(kept, questions)


def _unpack(
    kept: Mapping[str, NDArray[Any]], questions: Mapping[str, Sequence[Question]]
) -> dict[str, list[Reply]]:
    fields = {key: values.tolist() for key, values in kept.items()}
    fields["outcome"] = [list(OUTCOMES)[i] for i in fields["outcome"]]
    fields["details"] = [json.loads(text) for text in fields["details"]]
    rows = (
        Reply(**dict(zip(fields, row, strict=True))) for row in zip(*fields.values(), strict=True)
    )
    return {stressor: [next(rows) for _ in own] for stressor, own in questions.items()}


def _ask(name: str, training: Training, questions: Mapping[str, Sequence[Question]]) -> list[Reply]:
    pairs = [pair for own in questions.values() for pair in own]
    builder = METHODS[name]
    if builder is None:
        return [_judge(training.workshop, u.jump, u.jump is not None, u) for _, u in pairs]
    method = builder(training)
    return [_reply(method, training, trial, truth) for trial, truth in pairs]


def _reply(method: Method, training: Training, trial: Trial, truth: Truth) -> Reply:
    """Put a question, after those on the way to it."""
    for case in trial.before if isinstance(method, Shipped) else ():
        method.solve(case)
    try:
        answer = method.solve(trial.case)
        if answer.refused:
            return Reply(REFUSED)
        with np.errstate(all="ignore"):
            u = method.displacement(answer).ravel() if answer.converged else None
            reply = _judge(training.workshop, u, answer.trusted, truth)
    except Exception:  # whatever it is, a method must not raise
        return Reply(DIVERGED, crashed=True)
    if isinstance(answer.state, Solution) and reply.outcome in SILENT_OUTCOMES:
        return replace(reply, details=_details(answer.state))
    return reply


def _judge(workshop: Workshop, u: Array | None, trusted: bool, truth: Truth) -> Reply:
    """What became of a displacement (3 n,), None if the method has none."""
    if u is None:
        return Reply(DIVERGED if truth.path is not None else REFUSED)
    if not np.isfinite(u).all():
        return Reply(DIVERGED, nan=True)
    inverted = not workshop.model.internal(u, np.empty_like(u))[1] > 0.0
    errors, right = _against(workshop, u, truth.path)
    another = not right and _against(workshop, u, truth.other)[1]
    if not trusted:
        outcome = RIGHT_FLAGGED if right else ANOTHER_FLAGGED if another else WRONG_FLAGGED
    elif inverted:
        outcome = INVERTED
    elif right:
        outcome = RIGHT
    elif another:
        outcome = ANOTHER
    else:
        outcome = ROUGH if errors[0] <= ROUGHLY else SILENT
    return Reply(outcome, *errors, inverted)


def _against(
    workshop: Workshop, u: Array, reference: Array | None
) -> tuple[tuple[float, float], bool]:
    """Errors of displacement and stress, NaN without a reference; whether they are tolerated."""
    if reference is None:
        return (float("nan"), float("nan")), False
    errors = workshop.errors(u.reshape(-1, 3), reference.reshape(-1, 3))
    tolerance = workshop.scene.tolerance
    return errors, errors[0] <= tolerance.displacement and errors[1] <= tolerance.von_mises


def _details(solution: Solution) -> dict[str, Any]:
    """What an answer says of itself."""
    return {
        "contact": solution.contact_point.tolist(),
        "direction": solution.direction.tolist(),
        "pressure": solution.pressure,
        "pressure_share": solution.pressure / solution.pressure_limit,
        "distance": solution.distance,
        "tilt": solution.tilt,
        "iterations": solution.iterations,
        "departure": solution.departure,
        "residual": solution.residual,
        "min_jacobian": solution.min_jacobian,
        "estimated_displacement": solution.error_displacement,
        "estimated_von_mises": solution.error_von_mises,
        "features": solution.features.tolist(),
    }


# --- report --------------------------------------------------------------------------------------


def _publish(
    report: Path,
    table: Table,
    questions: Mapping[str, Sequence[Question]],
    checkpoints: Sequence[Checkpoint],
) -> dict[str, Any]:
    """Write the map, forget what it was made of, and sum it up."""
    report.mkdir(parents=True, exist_ok=True)
    rows = [
        table_row(method, stressor, table[method][stressor])
        for method in table
        for stressor in questions
        if stressor in table[method]
    ]
    silent = [
        {"method": method, "stressor": stressor, "case": i}
        | {"displacement": reply.displacement, "von_mises": reply.von_mises}
        | reply.details
        for method, columns in table.items()
        for stressor, replies in columns.items()
        for i, reply in enumerate(replies)
        if reply.details
    ]
    write_table(report / "stability.csv", rows)
    write_table(report / "stability_silent.csv", silent)
    draw(report / "stability.png", rows, [name for name, own in questions.items() if own])
    for checkpoint in checkpoints:
        checkpoint.remove()
    return _summary(table, questions)


def table_row(method: str, stressor: str, replies: Sequence[Reply]) -> dict[str, Any]:
    """What became of the cases of a stressor: counts of outcomes, median and largest errors."""
    counts = Counter(reply.outcome for reply in replies)
    row: dict[str, Any] = {"method": method, "stressor": stressor, "cases": len(replies)}
    row |= {outcome: counts[outcome] for outcome in OUTCOMES}
    row["inverted"] = sum(reply.inverted for reply in replies)
    for name in ("displacement", "von_mises"):
        errors = np.array([getattr(reply, name) for reply in replies])
        errors = errors[~np.isnan(errors)]
        for key, of in (("median", np.median), ("max", np.max)):
            row[f"{name}_{key}"] = float(of(errors)) if len(errors) else float("nan")
    return row


def write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows of equal keys as CSV."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else ["method"], lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({key: _text(value) for key, value in row.items()})


def _text(value: Any) -> str:
    if isinstance(value, list):
        return " ".join(f"{x:.4g}" for x in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _summary(table: Table, questions: Mapping[str, Sequence[Question]]) -> dict[str, Any]:
    missing = {
        stressor: sum(truth.path is None for _, truth in own) for stressor, own in questions.items()
    }
    report: dict[str, Any] = {
        "without_equilibrium": {stressor: n for stressor, n in missing.items() if n},
        "with_several_equilibria": len(questions.get(SEVERAL, ())),
        "with_hysteresis": len(questions.get(HYSTERESIS, ())),
    }
    for name in (ARTIFACT, WARM):
        if name in table:
            report[name] = _honesty(table[name])
    report["methods"] = {
        method: dict(Counter(reply.outcome for own in columns.values() for reply in own))
        for method, columns in table.items()
    }
    return report


def _honesty(columns: Mapping[str, Sequence[Reply]]) -> dict[str, Any]:
    """How far a method's word can be trusted."""
    replies = [reply for own in columns.values() for reply in own]
    return {
        "cases": len(replies),
        "silently_wrong": sum(reply.outcome in SILENT_OUTCOMES for reply in replies),
        "of_these_another_equilibrium": sum(reply.outcome == ANOTHER for reply in replies),
        "nan": sum(reply.nan for reply in replies),
        "crashes": sum(reply.crashed for reply in replies),
        "right_but_flagged": _flagged(replies),
    } | ({"right_but_flagged_in_range": _flagged(columns[CONTROL])} if CONTROL in columns else {})


def _flagged(replies: Sequence[Reply]) -> float:
    """Share of right answers that are flagged."""
    counts = Counter(reply.outcome for reply in replies)
    right = counts[RIGHT] + counts[RIGHT_FLAGGED]
    return counts[RIGHT_FLAGGED] / right if right else 0.0


def draw(
    path: Path, rows: Sequence[Mapping[str, Any]], columns: Sequence[str], asked: str = "loads"
) -> None:
    """Draw the map: a bar of outcomes for each method and stressor, its median error below."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    methods = list(dict.fromkeys(row["method"] for row in rows))
    size = 3.2 + 0.72 * len(columns), 2.8 + 0.44 * len(methods)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.add_subplot()
    for row in rows:
        _cell(axes, columns.index(row["stressor"]), methods.index(row["method"]), row)
    axes.set_xticks(range(len(columns)), columns, rotation=40, ha="left", rotation_mode="anchor")
    axes.xaxis.tick_top()
    axes.set_yticks([y + MIDDLE for y in range(len(methods))], methods)
    axes.set(xlim=(-0.55, len(columns) - 0.45), ylim=(len(methods) - 0.45, -0.55))
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    handles = [Patch(facecolor=c, edgecolor="0.4", label=name) for name, c in OUTCOMES.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle(
        "Who fails under what, and who says so: what became of the answers to "
        f"{rows[0]['cases']} {asked} of each kind\n"
        "Below each bar: median error of displacement of the answers given, flagged ones included",
        fontsize=13,
    )
    figure.savefig(path, dpi=100)


MIDDLE = -0.12
"""Of the bar in a cell, below the cell's own."""


def _cell(axes: Any, x: int, y: int, row: Mapping[str, Any]) -> None:
    """One cell of the map, a unit wide."""
    left, cases = x - 0.45, int(row["cases"])
    for outcome, colour in OUTCOMES.items():
        width = 0.9 * int(row[outcome]) / cases
        axes.barh(y + MIDDLE, width, 0.46, left, color=colour, linewidth=0)
        left += width
    axes.barh(y + MIDDLE, 0.9, 0.46, x - 0.45, fill=False, edgecolor="0.4", linewidth=0.5)
    axes.text(x, y + 0.25, _percent(row["displacement_median"]), ha="center", va="center", size=8)


def _percent(error: float) -> str:
    """Two digits for people; a dash where there is no answer to have one."""
    percent = 100 * error
    if np.isnan(percent):
        return "–"
    if not 0.01 <= percent < 1000:
        return "< 0.01 %" if percent < 0.01 else "> 999 %"
    digits = 0 if percent > 9.95 else 1 if percent > 0.095 else 2
    return f"{percent:.{digits}f} %"
