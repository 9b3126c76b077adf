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

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from palpate.offline.fem.norms import relative
from palpate.offline.fem.problem import FullProblem
from palpate.offline.methods.catalogue import Training, build
from palpate.offline.methods.method import Case, Method, Snapshots, Steps
from palpate.offline.reduce.queries import random_loads
from palpate.offline.run.checkpoint import Checkpoint
from palpate.offline.run.streams import Stage, stream
from palpate.offline.run.tables import write_csv
from palpate.offline.run.workers import open_artifact, worker_pool
from palpate.offline.studies import hard_cases, outcomes, references
from palpate.offline.studies.hard_cases import Followed, HardCase
from palpate.offline.studies.outcomes import Result, Table
from palpate.offline.studies.references import Fields
from palpate.offline.studies.trajectories import histories
from palpate.shared.artifact import read_artifact
from palpate.shared.errors import QueryError
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
    "tensor-mass": ("tensor-mass", 1),
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
    learnt: int = SNAPSHOTS,
) -> dict[str, Any]:
    """Map what becomes of the answers of methods under hard loads.

    Parameters
    ----------
    artifact : Path
        The map goes to ``NAME/report`` beside it: ``stability.csv``, a row per method and kind;
        ``stability.png``; ``stability_silent.csv``, the artifact's silent errors.
    cases : int
        Of each kind.
    methods, kinds : sequence of str, optional
        Only these of ``METHODS``, and only these kinds; all if absent.
    learnt : int
        Full solutions that the methods learn from.

    Returns
    -------
    dict
        See ``outcomes.summaries``; ``without_equilibrium``: cases of each kind that the full model
        has no answer to; ``with_several_equilibria``, ``with_hysteresis``: cases whose path and
        jump end apart, of loads that are raised and that are lowered again, a kind each if there
        are any.
    """
    atlas, problem = ReducedModel.load(artifact), FullProblem.of_artifact(read_artifact(artifact))
    everything = hard_cases.HardLoads(atlas, problem, cases, seed).cases()
    chosen = {name: everything[name] for name in kinds or everything}
    tissues = sorted({case.poisson for own in chosen.values() for case in own})
    loads = random_loads(atlas, learnt, stream(atlas.scene.seed, Stage.STABILITY_SNAPSHOTS))
    given = [Case.of(problem, load) for load in loads]
    learning = {f"snapshots {p:g}": [HardCase(((x, 0.0),), p) for x in given] for p in tissues}
    settings = cases, seed, learnt, list(chosen)
    checkpoint = references.kept_results(artifact, atlas.scene, "stability", settings)
    with worker_pool(open_artifact, artifact) as pool:
        found = hard_cases.all_equilibria({**chosen, **learning}, pool, checkpoint)
    pairs = {name: found[name] for name in chosen}
    pairs |= hard_cases.several(pairs, cases)
    table: dict[str, dict[str, list[Result]]] = {}
    for poisson, solutions in zip(tissues, learning, strict=True):
        own_tissue = hard_cases.tissue(problem, poisson)
        training = _training(own_tissue, atlas, found[solutions])
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
                table.setdefault(name, {}).update(_kept(label, answers, asked, checkpoint))
    report = artifact.parent / atlas.name / "report"
    names = [name for name, own in pairs.items() if own]
    outcomes.publish(report, "stability", table, names, "loads")
    write_csv(report / "stability_silent.csv", _silent(table))
    checkpoint.remove()
    missing = {name: sum(truth.path is None for _, truth in own) for name, own in pairs.items()}
    return outcomes.summaries(table) | {
        "without_equilibrium": {name: count for name, count in missing.items() if count},
        "with_several_equilibria": len(pairs.get(hard_cases.SEVERAL, ())),
        "with_hysteresis": len(pairs.get(hard_cases.HYSTERESIS, ())),
    }


def stability_in_time(
    artifact: Path,
    cases: int,
    seed: int,
    many: int = MANY,
    methods: Sequence[str] | None = None,
    kinds: Sequence[str] | None = None,
    learnt: int = SNAPSHOTS_IN_TIME,
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
    many : int
        Steps of the longest history.
    methods, kinds, learnt
        As in ``stability``, of ``METHODS_IN_TIME`` and of histories.

    Returns
    -------
    dict
        See ``outcomes.summaries``.
    """
    atlas = ReducedModel.load(artifact)
    if atlas.models.viscous is None:
        raise QueryError("scene", f"{atlas.name!r} is elastic: it has no histories")
    problem = FullProblem.of_artifact(read_artifact(artifact))
    with_tip = atlas.models.viscous_tips is not None
    wanted = [name for name in methods or METHODS_IN_TIME if with_tip or name != TIP]
    hard = {
        (tip, name): own
        for tip in sorted({name == TIP for name in wanted})
        for name, own in histories(atlas, problem, tip, cases, seed, many).items()
        if kinds is None or name in kinds
    }
    settings = cases, seed, many, learnt, list(hard)
    checkpoint = references.kept_results(artifact, atlas.scene, "stability_in_time", settings)
    tasks: dict[str, Steps] = {
        f"{tip} {name} {i}": case.brief or case.steps
        for (tip, name), own in hard.items()
        for i, case in enumerate(own)
        if not case.nonsense
    }
    rng = stream(atlas.scene.seed, Stage.STABILITY_IN_TIME_SNAPSHOTS)
    made = references.random_steps(atlas, problem, learnt, rng, in_time=True)
    learning = {f"snapshots {i}": steps for i, steps in enumerate(made)}
    tips = frozenset(name for name in tasks if name.startswith("True"))
    with worker_pool(open_artifact, artifact) as pool:
        found = references.full_histories(tasks | learning, pool, checkpoint, tips)
    questions: dict[bool, dict[str, list[Question]]] = {False: {}, True: {}}
    for (tip, name), own in hard.items():
        answers = [found.get(f"{tip} {name} {i}") for i in range(len(own))]
        questions[tip][name] = [Question(*pair) for pair in zip(own, answers, strict=True)]
    solved = references.snapshots(made, [found[name] for name in learning if name in found])
    training = Training(problem, solved, atlas, in_time=True)
    table = {}
    for name in tqdm(wanted, "methods"):
        every = LARGER if name == STEPS else 1
        ask = partial(_answers, METHODS_IN_TIME[name], training, every=every)
        table[name] = _kept(name, ask, questions[name == TIP], checkpoint)
    names = list(dict.fromkeys(name for _, name in hard))
    asked = "histories (one of those of many steps)"
    report = artifact.parent / atlas.name / "report"
    outcomes.publish(report, "stability_in_time", table, names, asked)
    checkpoint.remove()
    return outcomes.summaries(table)


# --- what is asked -------------------------------------------------------------------------------


def _training(problem: FullProblem, atlas: ReducedModel, found: Sequence[Followed]) -> Training:
    solved = [(case.last.contacts[0], u.jump) for case, u in found if u.jump is not None]
    loads, displacements = zip(*solved, strict=True)
    return Training(problem, Snapshots(loads, np.stack(displacements)), atlas)


def _question(problem: FullProblem, case: HardCase, truth: Any) -> Question:
    found = truth.path, truth.jump, truth.other
    fields = [None if u is None else Fields.at_once(problem, [u]) for u in found]
    return Question(case, *fields)


def _applies(method: str, case: HardCase, atlas: ReducedModel) -> bool:
    """Whether a method can be asked at all."""
    if method in (ARTIFACT, WARM) and case.poisson != atlas.scene.tissue.poisson:
        return False
    if len(case.steps) > 1:
        return method in (ARTIFACT, WARM) or (method == FULL and case.follow)
    return method != WARM


# --- answers -------------------------------------------------------------------------------------


def _kept(
    label: str,
    answers: Callable[[Sequence[Question]], list[Result]],
    questions: Questions,
    checkpoint: Checkpoint,
) -> dict[str, list[Result]]:
    """A method's results by kind of case; kept, for some methods take their time."""
    name = f"answers {label}"
    if name not in checkpoint:
        everything = [question for own in questions.values() for question in own]
        checkpoint.store(name, answers(everything))
    results = iter(checkpoint.load(name))
    return {kind: [next(results) for _ in own] for kind, own in questions.items()}


def _answers(
    named: tuple[str, float] | None,
    training: Training,
    questions: Sequence[Question],
    every: int = 1,
) -> list[Result]:
    """What becomes of a method's answers; of the full model's jump if there is no method."""
    problem = training.problem
    if named is None:
        judge = partial(outcomes.classify, problem)
        return [judge(q.jump, q.jump is not None, q.exact, q.other) for q in questions]
    method = build(*named, training)
    return [_answer(method, problem, question, every) for question in questions]


def _answer(method: Method, problem: FullProblem, question: Question, every: int) -> Result:
    """What becomes of a case, answered in steps as large as ``every`` of its steps."""
    case, exact = question.case, question.exact
    steps = case.brief if every > 1 and case.brief else case.steps
    ends = np.unique(np.append(np.arange(every, len(steps), every), len(steps))) - 1
    counted = np.array([-1]) if case.end_only else ends
    try:
        with np.errstate(all="ignore"):
            states, trusted, refused = _play(method, steps, ends, len(counted))
            if refused:
                return Result(outcomes.REFUSED)
            if case.nonsense and states:
                return Result(outcomes.SILENT if trusted else outcomes.WRONG_FLAGGED)
            if exact is not None:
                exact = Fields(*(field[counted] for field in exact))
            found = Fields.of(method, states) if states else None
            result = outcomes.classify(problem, found, trusted, exact, question.other)
            if states and case.brief:
                result = replace(result, drift=_drift(method, case, states[-1]))
            return result
    except ValueError:  # time that makes no sense
        return Result(outcomes.REFUSED if exact is None else outcomes.DIVERGED)
    except Exception:  # whatever it is, a method must not raise
        return Result(outcomes.DIVERGED, crashed=True)


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


def _drift(method: Method, case: HardCase, end: Any) -> float:
    """How far the end of a long history is from the method's own answer to the brief one."""
    brief, *_ = _play(method, case.brief, np.arange(len(case.brief)), 1)
    return relative(*(method.displacement(x) for x in (end, *brief))) if brief else float("nan")


def _silent(table: Table) -> list[dict[str, Any]]:
    """Rows of the artifact's silent errors."""
    return [
        {"method": method, "stressor": kind, "case": i}
        | {"displacement": result.displacement, "von_mises": result.von_mises}
        for method in (ARTIFACT, WARM)
        for kind, own in table.get(method, {}).items()
        for i, result in enumerate(own)
        if result.outcome in outcomes.SILENT_OUTCOMES
    ]
