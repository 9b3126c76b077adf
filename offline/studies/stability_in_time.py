"""Where methods fail in time, and whether they say so: a map of methods against histories.

As ``offline.studies.stability``, for visco-elastic tissue: every method answers the same histories
(``offline.studies.courses``), step by step, for which the full model's answers are known.  An
answer is a whole history: right if its errors over all moments (relative L2 norms, over nodes and
moments) are within the scene's tolerance, flagged if any of its moments is, inverted if any of them
turns an element inside out.

Methods beside the artifact are Galerkin models with every quadrature point, on modes that vibrate
and on POD of random histories, and the full model in larger steps.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from palpate.offline.methods.galerkin_in_time import GalerkinInTime
from palpate.offline.methods.in_time import FullInTime, InTime
from palpate.offline.methods.method import Case
from palpate.offline.methods.shipped_in_time import ShippedInTime, TipInTime
from palpate.offline.methods.spaces import modal, pod
from palpate.offline.run.checkpoint import Checkpoint, content_key
from palpate.offline.run.workers import resume, worker_pool
from palpate.offline.run.workshop import Load, Workshop, open_artifact
from palpate.offline.studies import courses
from palpate.offline.studies.courses import Trial
from palpate.offline.studies.stability import (
    DIVERGED,
    INVERTED,
    OUTCOMES,
    REFUSED,
    RIGHT,
    RIGHT_FLAGGED,
    ROUGH,
    ROUGHLY,
    SILENT,
    SILENT_OUTCOMES,
    WRONG_FLAGGED,
    Reply,
    draw,
    table_row,
    write_table,
)
from palpate.offline.validate.histories import Press, loads_of, random_histories
from palpate.offline.validate.norms import relative
from palpate.shared.artifact import read_artifact
from palpate.shared.errors import PalpateError, QueryError
from palpate.shared.model import ReducedModel

Array = NDArray[np.float64]

MANY = 100_000
"""Steps of the longest history."""

LESSONS = 12
"""Random histories that POD learns from."""

LEARNING = 105
"""Sets their random numbers apart."""

SIZE = 40
LARGER = 5
"""Steps of the full model made one."""

ARTIFACT, TIP = "artifact, loads", "artifact, tip"
STEPS = f"full model, {LARGER} x the step"


class Truth(NamedTuple):
    """The full model's displacements (t, n, 3) mm and von Mises stresses (t, n) kPa."""

    displacements: NDArray[np.float32]
    stresses: NDArray[np.float32]


Question = tuple[Trial, Truth | None]
Questions = Mapping[str, Sequence[Question]]


class Played(NamedTuple):
    """A method's answers to the moments of a history that are judged."""

    displacements: Array  # (t, n, 3) mm
    stresses: Array  # (t, n) kPa
    trusted: bool


class LargerSteps(FullInTime):
    """The full model that looks only every so often."""

    family = label = STEPS


def stability_in_time(
    artifact: Path,
    cases: int,
    seed: int,
    many: int = MANY,
    methods: Sequence[str] | None = None,
    columns: Sequence[str] | None = None,
    lessons: int = LESSONS,
) -> dict[str, Any]:
    """Map what becomes of histories that strain methods.

    Parameters
    ----------
    artifact : Path
        Of visco-elastic tissue.  The map goes to ``NAME/report`` beside it, as
        ``stability_in_time.csv`` and ``.png``.
    cases : int
        Places in which each stressor is tried.
    seed : int
    many : int
        Steps of the longest history.
    methods, columns : sequence of str, optional
        Only these; all if absent.
    lessons : int
        Histories that POD learns from.

    Returns
    -------
    dict
        Per method what became of its histories, and of the longest ``drift``: how far their end is
        from the method's own answer in three steps that are long beside all time constants.
    """
    atlas = ReducedModel.load(artifact)
    if atlas.models.viscous is None:
        raise QueryError("scene", f"{atlas.name!r} is elastic: it has no histories")
    workshop = Workshop.of_artifact(read_artifact(artifact))
    asked = {False: courses.trials(atlas, False, cases, seed, many)}
    if atlas.models.viscous_tips is not None:
        asked[True] = courses.trials(atlas, True, cases, seed, many)
    asked = {
        tip: {name: own for name, own in found.items() if columns is None or name in columns}
        for tip, found in asked.items()
    }
    key = _key(artifact, f"{cases} {seed} {many} {lessons}")
    checkpoint = Checkpoint(artifact.parent / f".{artifact.stem}.stability-in-time", key)
    questions, known = _followed(artifact, atlas, asked, lessons, checkpoint)
    table: dict[str, dict[str, list[Reply]]] = {}
    for name in tqdm([n for n in methods or METHODS if n != TIP or True in asked], "methods"):
        method = METHODS[name](workshop, atlas, known)
        own = questions[name == TIP]
        table[name] = {
            stressor: [_reply(method, workshop, *question) for question in pairs]
            for stressor, pairs in own.items()
        }
    report = artifact.parent / atlas.name / "report"
    report.mkdir(parents=True, exist_ok=True)
    names = list(questions[False])
    rows = [table_row(n, c, own[c]) for n, own in table.items() for c in names if c in own]
    write_table(report / "stability_in_time.csv", rows)
    draw(report / "stability_in_time.png", rows, names, "histories (one of those of many steps)")
    checkpoint.remove()
    return {name: _summary(own) for name, own in table.items()}


def _key(artifact: Path, settings: str) -> str:
    sources = b"".join(Path(file).read_bytes() for file in (__file__, courses.__file__))
    own = hashlib.sha256(artifact.read_bytes() + settings.encode() + sources).hexdigest()[:16]
    return f"{content_key(ReducedModel.load(artifact).scene)}-{own}"


def _followed(
    artifact: Path,
    atlas: ReducedModel,
    asked: Mapping[bool, Mapping[str, Sequence[Trial]]],
    lessons: int,
    checkpoint: Checkpoint,
) -> tuple[dict[bool, dict[str, list[Question]]], Array]:
    """Trials with what the full model makes of them, and displacements (k, 3 n) to learn from."""
    tasks = {
        _label(tip, name, i): _task(tip, trial.brief or trial.presses)
        for tip, found in asked.items()
        for name, own in found.items()
        for i, trial in enumerate(own)
        if not trial.nonsense
    }
    rng = np.random.default_rng([atlas.scene.seed, LEARNING])
    for i, presses in enumerate(random_histories(atlas, lessons, rng)):
        tasks[f"lesson {i}"] = _task(False, presses)
    with worker_pool(open_artifact, artifact) as pool:
        found = resume("full histories", pool, checkpoint, tasks, _pack)
    known = [found[f"lesson {i}"] for i in range(lessons)]
    fields = [own["u"].reshape(len(own["u"]), -1) for own in known if own]
    if not fields:
        raise PalpateError("lessons: the full model could follow none of them")
    questions = {
        tip: {
            name: [(trial, _truth(found.get(_label(tip, name, i)))) for i, trial in enumerate(own)]
            for name, own in columns.items()
        }
        for tip, columns in asked.items()
    }
    return questions, np.concatenate(fields)


def _label(tip: bool, name: str, number: int) -> str:
    return f"{'tip' if tip else 'load'} {name} {number}"


def _task(tip: bool, presses: Sequence[Press]) -> tuple[Any, ...]:
    loads, times = loads_of(presses)
    if tip:
        return Workshop.follow_tip, np.array([load.position for load in loads]), times
    return Workshop.follow, loads, times


def _pack(found: Sequence[NDArray[Any]] | None) -> dict[str, NDArray[Any]]:
    return {} if found is None else {"u": found[0], "s": found[1]}


def _truth(found: Mapping[str, NDArray[Any]] | None) -> Truth | None:
    return Truth(found["u"], found["s"]) if found else None


# --- methods -------------------------------------------------------------------------------------

Builder = Callable[[Workshop, ReducedModel, Array], InTime]

METHODS: dict[str, Builder] = {
    ARTIFACT: lambda workshop, atlas, known: ShippedInTime(atlas),
    TIP: lambda workshop, atlas, known: TipInTime(atlas),
    f"pod {SIZE}": lambda workshop, atlas, known: GalerkinInTime(
        "pod", "", workshop, pod(workshop.model, known, SIZE)
    ),
    f"modal {SIZE}": lambda workshop, atlas, known: GalerkinInTime(
        "modal", "", workshop, modal(workshop.model, SIZE)
    ),
    STEPS: lambda workshop, atlas, known: LargerSteps(workshop),
}
"""Rows of the map."""


# --- answers -------------------------------------------------------------------------------------


def _reply(method: InTime, workshop: Workshop, trial: Trial, truth: Truth | None) -> Reply:
    """What becomes of a history."""
    presses, every = trial.presses, 1
    if isinstance(method, LargerSteps):
        presses, every = trial.brief or presses, LARGER
    ends = np.unique(np.append(np.arange(every, len(presses), every), len(presses))) - 1
    judged = ends[-1:] if trial.brief else ends
    try:
        with np.errstate(all="ignore"):
            played = _play(method, workshop, presses, ends, judged)
            if played is None or trial.nonsense:
                return _unanswered(trial, truth, played)
            moments = np.array([-1]) if trial.brief else judged
            known = None if truth is None else Truth(*(field[moments] for field in truth))
            reply = _judge(workshop, played, known)
            if trial.brief:
                drift = _drift(method, workshop, presses[-1], played)
                reply = replace(reply, details={"drift": drift})
            return reply
    except (QueryError, ValueError):
        return _unanswered(trial, truth, None)
    except Exception:  # whatever it is, a method must not raise
        return Reply(DIVERGED, crashed=True)


def _unanswered(trial: Trial, truth: Truth | None, played: Played | None) -> Reply:
    """A history that has no answer, or should have none."""
    if played is not None:
        return Reply(SILENT if played.trusted else WRONG_FLAGGED)
    return Reply(DIVERGED if truth is not None and not trial.nonsense else REFUSED)


def _play(
    method: InTime,
    workshop: Workshop,
    presses: Sequence[Press],
    ends: NDArray[np.int64],
    judged: NDArray[np.int64],
) -> Played | None:
    """Answers in steps that end with some of the presses; None if one is missing."""
    past, trusted, begun = method.at_rest(), True, 0
    displacements, stresses = [], []
    cases = _Cases(workshop, isinstance(method, TipInTime))
    for end in ends.tolist():
        dt = sum(press.dt for press in presses[begun : end + 1])
        converged, past = method.step(past, cases.of(presses[end]), dt)
        if not converged:
            return None
        begun = end + 1
        if end >= judged[0]:
            displacements.append(method.displacement(past))
            stresses.append(method.von_mises(past))
            trusted = trusted and method.trusted(past)
    return Played(np.array(displacements), np.array(stresses), trusted)


def _drift(method: InTime, workshop: Workshop, held: Press, played: Played) -> float:
    """How far the end of a long hold is from the method's own answer in three long steps."""
    ends = np.arange(3)
    relaxed = _play(method, workshop, 3 * (held._replace(dt=courses.LONG),), ends, ends[-1:])
    if relaxed is None:
        return float("nan")
    return relative(played.displacements[-1], relaxed.displacements[-1])


class _Cases:
    """Makes cases of presses, and keeps the last: a load that is held is always the same."""

    def __init__(self, workshop: Workshop, tip: bool) -> None:
        self._workshop, self._tip = workshop, tip
        self._last: tuple[tuple[Any, ...], Case] | None = None

    def of(self, press: Press) -> Case:
        key = (*press.position, *press.direction, press.pressure)
        if self._last is None or self._last[0] != key:
            load = Load(press.position, press.direction, press.pressure)
            case = (
                Case((load,), np.empty(0, np.int64), np.empty((0, 3)))
                if self._tip
                else Case.of(self._workshop, load)
            )
            self._last = key, case
        return self._last[1]


def _judge(workshop: Workshop, played: Played, truth: Truth | None) -> Reply:
    """Compare whole histories, over the moments that are judged."""
    u, s = played.displacements, played.stresses
    if not (np.isfinite(u).all() and np.isfinite(s).all()):
        return Reply(DIVERGED, nan=True)
    force = np.empty(u[0].size)
    inverted = any(not workshop.model.internal(own.ravel(), force)[1] > 0.0 for own in u)
    errors = float("nan"), float("nan")
    if truth is not None:
        kept = workshop.beyond_clamped_layer
        errors = (
            relative(u, truth.displacements.astype(float)),
            relative(s[:, kept], truth.stresses[:, kept].astype(float)),
        )
    tolerance = workshop.scene.tolerance
    right = errors[0] <= tolerance.displacement and errors[1] <= tolerance.von_mises
    if not played.trusted:
        outcome = RIGHT_FLAGGED if right else WRONG_FLAGGED
    elif inverted:
        outcome = INVERTED
    elif right:
        outcome = RIGHT
    else:
        outcome = ROUGH if errors[0] <= ROUGHLY else SILENT
    return Reply(outcome, *errors, inverted)


def _summary(columns: Mapping[str, Sequence[Reply]]) -> dict[str, Any]:
    replies = [reply for own in columns.values() for reply in own]
    counts = Counter(reply.outcome for reply in replies)
    return {
        "histories": len(replies),
        "silently_wrong": sum(counts[outcome] for outcome in SILENT_OUTCOMES),
        "nan": sum(reply.nan for reply in replies),
        "crashes": sum(reply.crashed for reply in replies),
        "outcomes": {outcome: counts[outcome] for outcome in OUTCOMES if counts[outcome]},
        "drift": {
            stressor: reply.details["drift"]
            for stressor, own in columns.items()
            for reply in own
            if reply.details
        },
    }
