"""Where methods fail, and whether they say so: maps of methods against what strains them.

Every method answers the same loads, inside the trained range and far out of it, or the same
histories of visco-elastic tissue, for which the full model's answers are known.  An answer to a
history is right if its errors over all moments are within the scene's tolerance, flagged if any of
its moments is, and inverted if any of them turns an element inside out; of a moving tool and of
long histories only the end counts.

Of loads, tissue of another Poisson's ratio is a scene of its own, from which all methods are built
anew but the artifact.  Only the artifact can start from its last answer: no other method is asked
under a moving tool.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from palpate.offline.methods.catalogue import Training, build
from palpate.offline.methods.method import Case, Method, Snapshots
from palpate.offline.run.checkpoint import Checkpoint, content_key
from palpate.offline.run.streams import Stage, stream
from palpate.offline.run.workers import worker_pool
from palpate.offline.run.workshop import Workshop, open_artifact
from palpate.offline.studies import trajectories
from palpate.offline.studies.hard_cases import (
    CONTROL,
    HYSTERESIS,
    SEVERAL,
    Equilibria,
    HardCase,
    HardLoads,
    all_equilibria,
    several,
    tissue,
)
from palpate.offline.studies.outcomes import (
    DIVERGED,
    REFUSED,
    SILENT,
    SILENT_OUTCOMES,
    WRONG_FLAGGED,
    Result,
    classify,
    flagged,
    publish,
    summary,
)
from palpate.offline.studies.references import Fields, Steps, full_histories, random_steps
from palpate.offline.studies.tables import write_csv
from palpate.offline.validate.loads import random_loads
from palpate.offline.validate.norms import relative
from palpate.shared.answer import Answer as Found
from palpate.shared.artifact import read_artifact
from palpate.shared.errors import PalpateError, QueryError
from palpate.shared.model import ReducedModel

SNAPSHOTS, SNAPSHOTS_IN_TIME = 150, 12
"""Full solutions of each tissue, or histories, that the methods learn from."""

MANY = 100_000
"""Steps of the longest history."""

SIZE, DERIVATIVES = 40, 19
LARGER = 5
"""Steps of the full model that are made one."""

ARTIFACT, WARM, FULL = "artifact", "artifact, warm", "full model, one jump"
LOADS, TIP, STEPS = "artifact, loads", "artifact, tip", f"full model, {LARGER} x the step"

METHODS: dict[str, tuple[str, float] | None] = {
    ARTIFACT: ("artifact", 1),
    WARM: ("artifact, warm", 1),
    FULL: None,
    f"derivatives {DERIVATIVES}": ("derivatives", DERIVATIVES),
    **{
        f"{name} {SIZE}": (name, SIZE)
        for name in (
            "pod", "pod, no line search", "pod-ecm", "pod-ecm, 1 point a mode", "pod-deim",
            "pod-gappy", "modal", "ritz", "krylov", "linear", "regression",
        )
    },
    "mass-spring": ("mass-spring", 1),
    "tensor-mass": ("tensor-mass linear", 1),
}  # fmt: skip
"""Rows of the map of loads: names and sizes in the catalogue.  The full model's jump is known."""

METHODS_IN_TIME: dict[str, tuple[str, float]] = {
    LOADS: ("artifact", 1),
    TIP: ("artifact, tip", 1),
    f"pod {SIZE}": ("pod", SIZE),
    f"modal {SIZE}": ("modal", SIZE),
    STEPS: ("full", 1),
}
"""Rows of the map of histories."""


class Question(NamedTuple):
    """A hard case and the full model's answer; of loads also in one jump, and if that differs."""

    case: HardCase
    exact: Fields | None
    jump: Fields | None = None
    other: Fields | None = None


Questions = Mapping[str, Sequence[Question]]
"""By kind of case."""


def stability(
    artifact: Path,
    cases: int,
    seed: int,
    methods: Sequence[str] | None = None,
    kinds: Sequence[str] | None = None,
    snapshots: int = SNAPSHOTS,
) -> dict[str, Any]:
    """Map what becomes of the answers of methods under hard loads.

    Parameters
    ----------
    artifact : Path
        The map goes to ``NAME/report`` beside it: ``stability.csv``, a row per method and kind;
        ``stability.png``; ``stability_silent.csv``, the artifact's silent errors.
    cases : int
        Of each kind.
    seed : int
    methods, kinds : sequence of str, optional
        Only these of ``METHODS``, and only these kinds; all if absent.
    snapshots : int
        Full solutions that the methods learn from.

    Returns
    -------
    dict
        By method what ``outcomes.summary`` tells, of the artifact also ``right_but_flagged`` in
        range; ``without_equilibrium``: cases of each kind that the full model has no answer to;
        ``with_several_equilibria``, ``with_hysteresis``: cases whose path and jump end apart, of
        loads that are raised and that are lowered again, a kind each if there are any.
    """
    atlas = ReducedModel.load(artifact)
    workshop = Workshop.of_artifact(read_artifact(artifact))
    everything = HardLoads(atlas, workshop, cases, seed).cases()
    chosen = {name: everything[name] for name in kinds or everything}
    tissues = sorted({case.poisson for own in chosen.values() for case in own})
    learning = _learning(atlas, workshop, tissues, snapshots)
    key = _key(artifact, f"{cases} {seed} {snapshots}")
    solved = Checkpoint(artifact.parent / f".{artifact.stem}.stability-solved", key)
    answered = Checkpoint(
        artifact.parent / f".{artifact.stem}.stability-answered",
        _key(artifact, f"{cases} {seed} {snapshots} {list(chosen)}"),
    )
    with worker_pool(open_artifact, artifact) as pool:
        found = all_equilibria({**chosen, **learning}, pool, solved)
    pairs = {name: list(zip(own, found[name], strict=True)) for name, own in chosen.items()}
    pairs |= several(pairs, cases)
    table: dict[str, dict[str, list[Result]]] = {}
    for poisson in tissues:
        own_tissue, own_learning = tissue(workshop, poisson), _learning_of(poisson)
        training = _training(own_tissue, atlas, learning[own_learning], found[own_learning])
        questions = {
            name: [_question(own_tissue, *pair) for pair in own]
            for name, own in pairs.items()
            if own and own[0][0].poisson == poisson
        }
        for name in tqdm(methods or METHODS, f"methods, Poisson {poisson:g}"):
            asked = {n: own for n, own in questions.items() if _applies(name, own[0].case, atlas)}
            if asked:
                answers = partial(_answers, METHODS[name], training)
                label = f"{name} {poisson:g}"
                table.setdefault(name, {}).update(_kept(label, answers, asked, answered))
    report = artifact.parent / atlas.name / "report"
    publish(report, "stability", table, [name for name, own in pairs.items() if own], "loads")
    write_csv(report / "stability_silent.csv", list(_silent(table)))
    for checkpoint in (solved, answered):
        checkpoint.remove()
    missing = {name: sum(truth.path is None for _, truth in own) for name, own in pairs.items()}
    return _summaries(table) | {
        "without_equilibrium": {name: count for name, count in missing.items() if count},
        "with_several_equilibria": len(pairs.get(SEVERAL, ())),
        "with_hysteresis": len(pairs.get(HYSTERESIS, ())),
    }


def stability_in_time(
    artifact: Path,
    cases: int,
    seed: int,
    many: int = MANY,
    methods: Sequence[str] | None = None,
    kinds: Sequence[str] | None = None,
    snapshots: int = SNAPSHOTS_IN_TIME,
) -> dict[str, Any]:
    """Map what becomes of histories that strain methods.

    Methods beside the artifact are Galerkin models with every quadrature point, on modes that
    vibrate and on POD of random histories, and the full model in larger steps.

    Parameters
    ----------
    artifact : Path
        Of visco-elastic tissue.  The map goes to ``NAME/report`` beside it, as
        ``stability_in_time.csv`` and ``.png``.
    cases : int
        Places in which each kind is tried.
    seed : int
    many : int
        Steps of the longest history.
    methods, kinds : sequence of str, optional
        Only these of ``METHODS_IN_TIME``, and only these kinds; all if absent.
    snapshots : int
        Histories that POD learns from.

    Returns
    -------
    dict
        By method what ``outcomes.summary`` tells; ``drift``: how far the ends of long histories are
        from the method's own answers to the brief ones that lead there too.
    """
    atlas = ReducedModel.load(artifact)
    if atlas.models.viscous is None:
        raise QueryError("scene", f"{atlas.name!r} is elastic: it has no histories")
    workshop = Workshop.of_artifact(read_artifact(artifact))
    with_tip = atlas.models.viscous_tips is not None
    wanted = [name for name in methods or METHODS_IN_TIME if with_tip or name != TIP]
    hard = {}
    for tip in {name == TIP for name in wanted}:
        found = trajectories.histories(atlas, workshop, tip, cases, seed, many)
        hard[tip] = {name: own for name, own in found.items() if kinds is None or name in kinds}
    key = _key(artifact, f"{cases} {seed} {many} {snapshots} {kinds}")
    folder = artifact.parent / f".{artifact.stem}.stability-in-time"
    checkpoint = Checkpoint(folder, key)
    questions, training = _followed(artifact, atlas, workshop, hard, snapshots, checkpoint)
    table = {}
    for name in tqdm(wanted, "methods"):
        answers = partial(
            _answers, METHODS_IN_TIME[name], training, every=LARGER if name == STEPS else 1
        )
        table[name] = _kept(name, answers, questions[name == TIP], checkpoint)
    report = artifact.parent / atlas.name / "report"
    names = list(dict.fromkeys(name for own in questions.values() for name in own))
    asked = "histories (one of those of many steps)"
    publish(report, "stability_in_time", table, names, asked)
    checkpoint.remove()
    return _summaries(table)


def _key(artifact: Path, settings: str) -> str:
    """Hash of everything that results depend on."""
    own = hashlib.sha256(artifact.read_bytes() + settings.encode()).hexdigest()[:16]
    return f"{content_key(ReducedModel.load(artifact).scene)}-{own}"


# --- what is asked -------------------------------------------------------------------------------


def _learning(
    atlas: ReducedModel, workshop: Workshop, tissues: Iterable[float], count: int
) -> dict[str, list[HardCase]]:
    """What methods learn from in each tissue: random loads in range."""
    rng = stream(atlas.scene.seed, Stage.STABILITY_SNAPSHOTS)
    loads = random_loads(atlas.surface, atlas.limits, atlas.scene, count, rng)
    cases = [Case.of(workshop, load) for load in loads]
    return {_learning_of(p): [HardCase(((case, 0.0),), p) for case in cases] for p in tissues}


def _learning_of(poisson: float) -> str:
    return f"snapshots {poisson:g}"


def _training(
    workshop: Workshop,
    atlas: ReducedModel,
    cases: Sequence[HardCase],
    found: Sequence[Equilibria],
) -> Training:
    pairs = [(case.last.contacts[0], own.jump) for case, own in zip(cases, found, strict=True)]
    solved = [(load, jump) for load, jump in pairs if jump is not None]
    displacements = np.stack([jump for _, jump in solved])
    return Training(workshop, Snapshots([load for load, _ in solved], displacements), atlas)


def _question(workshop: Workshop, case: HardCase, truth: Equilibria) -> Question:
    def fields(u: NDArray[np.float64] | None) -> Fields | None:
        if u is None:
            return None
        u = u.reshape(-1, 3)
        return Fields(u[None], workshop.von_mises(u)[None])

    return Question(case, *map(fields, (truth.path, truth.jump, truth.other)))


def _applies(method: str, case: HardCase, atlas: ReducedModel) -> bool:
    """Whether a method can be asked at all."""
    if method in (ARTIFACT, WARM) and case.poisson != atlas.scene.tissue.poisson:
        return False
    if len(case.steps) > 1:
        return method in (ARTIFACT, WARM) or (method == FULL and case.follow)
    return method != WARM


def _followed(
    artifact: Path,
    atlas: ReducedModel,
    workshop: Workshop,
    hard: Mapping[bool, Mapping[str, Sequence[HardCase]]],
    snapshots: int,
    checkpoint: Checkpoint,
) -> tuple[dict[bool, dict[str, list[Question]]], Training]:
    """Histories with the full model's answers, and what methods learn from."""
    tasks: dict[str, Steps] = {
        f"{'tip' if tip else 'load'} {name} {i}": case.brief or case.steps
        for tip, kinds in hard.items()
        for name, own in kinds.items()
        for i, case in enumerate(own)
        if not case.nonsense
    }
    tips = {name for name in tasks if name.startswith("tip")}
    rng = stream(atlas.scene.seed, Stage.STABILITY_IN_TIME_SNAPSHOTS)
    for i, steps in enumerate(random_steps(atlas, workshop, snapshots, rng)):
        tasks[f"snapshots {i}"] = steps
    with worker_pool(open_artifact, artifact) as pool:
        found = full_histories(tasks, tips, pool, checkpoint)
    solved = [own.displacements for name, own in found.items() if name.startswith("snapshots")]
    if not solved:
        raise PalpateError("snapshots: the full model could follow none of the histories")
    displacements = np.concatenate(solved).astype(float)
    rows = Snapshots((), displacements.reshape(len(displacements), -1))
    questions = {
        tip: {
            name: [
                Question(case, found.get(f"{'tip' if tip else 'load'} {name} {i}"))
                for i, case in enumerate(own)
            ]
            for name, own in kinds.items()
        }
        for tip, kinds in hard.items()
    }
    return questions, Training(workshop, rows, atlas, in_time=True)


# --- answers -------------------------------------------------------------------------------------


def _kept(
    label: str,
    answers: Callable[[Sequence[Question]], list[Result]],
    questions: Questions,
    checkpoint: Checkpoint,
) -> dict[str, list[Result]]:
    """A method's results by kind of case; kept, for some methods take their time."""
    name = f"answers {label}"
    kept = checkpoint.load(name)
    if kept is None:
        found = answers([question for own in questions.values() for question in own])
        text = json.dumps([vars(result) for result in found])
        kept = {"results": np.array(text, dtype=bytes)}
        checkpoint.store(name, kept)
    rows = iter(json.loads(kept["results"].item()))
    return {kind: [Result(**next(rows)) for _ in own] for kind, own in questions.items()}


def _answers(
    named: tuple[str, float] | None,
    training: Training,
    questions: Sequence[Question],
    every: int = 1,
) -> list[Result]:
    """What becomes of a method's answers; of the full model's jump if there is no method."""
    workshop = training.workshop
    if named is None:
        return [classify(workshop, q.jump, q.jump is not None, q.exact, q.other) for q in questions]
    method = build(*named, training)
    return [_answer(method, workshop, question, every) for question in questions]


def _answer(method: Method, workshop: Workshop, question: Question, every: int) -> Result:
    """What becomes of a case, answered in steps as large as ``every`` of its steps."""
    case, exact = question.case, question.exact
    steps = case.brief if every > 1 and case.brief else case.steps
    ends = np.unique(np.append(np.arange(every, len(steps), every), len(steps))) - 1
    counted = np.array([-1]) if case.end_only else ends
    try:
        with np.errstate(all="ignore"):
            states, trusted, refused = _play(method, steps, ends, len(counted))
            if refused:
                return Result(REFUSED)
            if case.nonsense and states:
                return Result(SILENT if trusted else WRONG_FLAGGED)
            if exact is not None:
                exact = Fields(*(field[counted] for field in exact))
            found = Fields.of(method, states) if states else None
            result = classify(workshop, found, trusted, exact, question.other)
            return replace(result, details=_details(method, case, result, states))
    except ValueError:  # time that makes no sense
        return Result(REFUSED if exact is None else DIVERGED)
    except Exception:  # whatever it is, a method must not raise
        return Result(DIVERGED, crashed=True)


def _play(
    method: Method, steps: Steps, ends: NDArray[np.int64], count: int
) -> tuple[list[Any], bool, bool]:
    """States at the last ``count`` of the ends, none if one is missing; trusted; refused."""
    state, states, trusted, begun = method.at_rest(), [], True, 0
    for number, end in enumerate(ends.tolist()):
        counts = number >= len(ends) - count
        dt = sum(seconds for _, seconds in steps[begun : end + 1])
        answer = method.step(state, steps[end][0], dt)
        # on the way of a moving tool a load may have no answer
        if not answer.converged and (counts or dt):
            return [], False, answer.refused
        begun, state = end + 1, answer.state
        if counts:
            states.append(state)
            trusted = trusted and answer.trusted
    return states, trusted, False


SAID = (
    "contact_point", "direction", "pressure", "pressure_limit", "distance", "tilt", "iterations",
    "departure", "residual", "min_jacobian", "error_displacement", "error_von_mises", "features",
)  # fmt: skip
"""What an answer of the artifact tells of itself."""


def _details(
    method: Method, case: HardCase, result: Result, states: Sequence[Any]
) -> dict[str, Any]:
    """What an artifact says of a silent error, or how far the end of a long history drifts."""
    if states and case.brief:
        brief, *_ = _play(method, case.brief, np.arange(len(case.brief)), 1)
        ends = [method.displacement(state) for state in (states[-1], *brief)]
        return {"drift": relative(*ends) if brief else float("nan")}
    said = states[-1] if states else None
    if not isinstance(said, Found) or result.outcome not in SILENT_OUTCOMES:
        return {}
    return {name: np.asarray(getattr(said, name)).tolist() for name in SAID}


# --- report --------------------------------------------------------------------------------------


def _silent(table: Mapping[str, Mapping[str, Sequence[Result]]]) -> Iterable[dict[str, Any]]:
    """Rows of the silent errors that say something of themselves."""
    for method, results in table.items():
        for kind, own in results.items():
            for i, result in enumerate(own):
                if result.details:
                    yield {
                        "method": method,
                        "stressor": kind,
                        "case": i,
                        "displacement": result.displacement,
                        "von_mises": result.von_mises,
                    } | result.details


def _summaries(table: Mapping[str, Mapping[str, Sequence[Result]]]) -> dict[str, Any]:
    report: dict[str, Any] = {}
    for method, results in table.items():
        report[method] = summary([result for own in results.values() for result in own])
        if CONTROL in results:
            report[method]["right_but_flagged_in_range"] = flagged(results[CONTROL])
        drift = {
            kind: own[0].details["drift"]
            for kind, own in results.items()
            if own and "drift" in own[0].details
        }
        if drift:
            report[method]["drift"] = drift
    return report
