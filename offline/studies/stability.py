"""Where methods fail, and whether they say so: maps of methods against what strains them.

Every method answers the same loads, inside the trained range and far out of it, or the same
histories of visco-elastic tissue, for which the full model's answers are known.  An answer to a
history is right if its errors over all moments are within the scene's tolerance, flagged if any of
its moments is, and inverted if any of them turns an element inside out; of a moving tool and of
long histories only the end counts.

For tissue of another Poisson's ratio all methods are built anew but the artifact.  Only that can
start from its last answer: no other method is asked under a moving tool.  In time the others are
Galerkin models with every quadrature point and the full model in larger steps.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from palpate.offline.fem.norms import relative
from palpate.offline.fem.problem import FullProblem
from palpate.offline.methods.catalogue import Training, build
from palpate.offline.methods.method import Method, Steps
from palpate.offline.run.streams import Stage, stream
from palpate.offline.studies import hard_cases, outcomes
from palpate.offline.studies import references as full
from palpate.offline.studies.hard_cases import HardCase, Question
from palpate.offline.studies.outcomes import Result
from palpate.offline.studies.references import Fields
from palpate.offline.studies.trajectories import histories
from palpate.shared.arrays import Ints
from palpate.shared.model import ReducedModel
from palpate.shared.scene import Scene

SNAPSHOTS, SNAPSHOTS_IN_TIME = 150, 12
"""Full solutions of each tissue, or histories, that the methods learn from."""

SIZE, DERIVATIVES = 40, 19
LARGER = 5  # steps of the full model that are made one
ARTIFACT, WARM, FULL = "artifact", "artifact, warm", "full model, one jump"
LOADS, TIP, STEPS = "artifact, loads", "artifact, tip", f"full model, {LARGER} x the step"

Methods = Mapping[str, tuple[str, float] | None]

METHODS: Methods = {
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

METHODS_IN_TIME: Methods = {
    LOADS: ("artifact", 1),
    TIP: ("artifact, tip", 1),
    f"pod {SIZE}": ("pod", SIZE),
    f"modal {SIZE}": ("modal", SIZE),
    STEPS: ("full", 1),
}
"""Rows of the map of histories."""


def stability(
    artifact: Path,
    scene: Scene | None,
    cases: int,
    seed: int,
    many: int = 0,
    methods: Sequence[str] | None = None,
    kinds: Sequence[str] | None = None,
    learnt: int | None = None,
) -> dict[str, Any]:
    """Map what becomes of the answers of methods under hard loads, or in hard histories.

    Parameters
    ----------
    scene : Scene or None
        That the artifact was trained on, with its files, for loads.  None for histories of
        visco-elastic tissue.
    cases : int
        Loads of each kind, or places in which each kind of history is tried.
    many : int
        Steps of the longest history, if there are any.
    methods, kinds : sequence of str, optional
        Only these of ``METHODS`` or ``METHODS_IN_TIME``, and only these kinds; all if absent.
    learnt : int, optional
        Full solutions, or histories, that the methods learn from.

    Returns
    -------
    dict
        See ``outcomes.summaries``; ``without_equilibrium``: cases of each kind that the full model
        has no answer to.  Those that it loses on the way there are not asked.
    """
    in_time = scene is None
    atlas, problem = full.opened(artifact, scene)
    title, rows, stage, most = (
        ("stability_in_time", METHODS_IN_TIME, Stage.STABILITY_IN_TIME_SNAPSHOTS, SNAPSHOTS_IN_TIME)
        if in_time
        else ("stability", METHODS, Stage.STABILITY_SNAPSHOTS, SNAPSHOTS)
    )
    wanted = [name for name in methods or rows if name != TIP or (atlas.has_tip and in_time)]
    if in_time:
        asked = histories(atlas, problem, False, cases, seed, many)
        touched = histories(atlas, problem, True, cases, seed, many) if TIP in wanted else {}
        asked = {kind: own + touched.get(kind, []) for kind, own in asked.items()}
    else:
        asked = hard_cases.HardLoads(atlas, problem, cases, seed).cases()
    asked = {kind: asked[kind] for kind in kinds or asked}
    poissons = sorted({case.poisson for own in asked.values() for case in own})
    random = stream(atlas.scene.seed, stage)
    given = full.random_steps(atlas, problem, learnt or most, random, in_time)
    learning = {f"snapshots {p:g}": [HardCase(x, p, in_time) for x in given] for p in poissons}
    settings = cases, seed, many, len(given), list(asked), wanted
    tasks = {
        kind: [(hard_cases.ask_full_model, case) for case in own]
        for kind, own in (asked | learning).items()
    }
    with full.kept_results(artifact, atlas.scene, title, settings) as checkpoint:
        solved = full.in_parallel(artifact, checkpoint, "full solutions", tasks)
        answered = {kind: solved[kind] for kind in asked}
        answered |= hard_cases.several(answered, cases)
        questions = {kind: [q for q in own if not q.lost] for kind, own in answered.items()}
        table: dict[str, dict[str, list[Result]]] = {name: {} for name in wanted}
        for poisson, solutions in zip(poissons, learning, strict=True):
            pairs = [(question.case.steps, question.jump) for question in solved[solutions]]
            own_tissue = full.of_tissue(problem, poisson=poisson)
            training = Training(own_tissue, full.snapshots(pairs), atlas, in_time=in_time)
            for name in tqdm(wanted, f"methods, Poisson {poisson:g}"):
                label = f"answers {name} {poisson:g}"
                put = {
                    kind: [q for q in every if _applies(name, q.case, poisson, atlas)]
                    for kind, every in questions.items()
                }
                put = {kind: own for kind, own in put.items() if own}
                if label not in checkpoint:
                    found = _answers(name, rows[name], training, put) if put else {}
                    checkpoint.store(label, found)
                table[name] |= checkpoint.load(label)
        noun = "histories (one of those of many steps)" if in_time else "loads"
        kept = [kind for kind, own in questions.items() if own]
        outcomes.publish(artifact.parent / atlas.name / "report", title, table, kept, noun)
    missing = {kind: sum(q.exact is None for q in own) for kind, own in answered.items()}
    return outcomes.summaries(table) | {
        "without_equilibrium": {kind: count for kind, count in missing.items() if count}
    }


def _applies(method: str, case: HardCase, poisson: float, atlas: ReducedModel) -> bool:
    """Whether a method, made for tissue of this Poisson's ratio, can be asked at all."""
    if case.poisson != poisson or (method == TIP) != case.tip:
        return False
    if method in (ARTIFACT, WARM) and poisson != atlas.scene.tissue.poisson:
        return False
    if len(case.steps) > 1 and not case.history:
        return method in (ARTIFACT, WARM) or (method == FULL and case.follow)
    return method != WARM


def _answers(
    name: str,
    named: tuple[str, float] | None,
    training: Training,
    asked: Mapping[str, Sequence[Question]],
) -> dict[str, list[Result]]:
    """What becomes of a method's answers; of the full model's jump if there is no method."""
    problem, every = training.problem, LARGER if name == STEPS else 1
    method = None if named is None else build(*named, training)

    def answer(q: Question) -> Result:
        if method is not None:
            return _answer(method, problem, q, every)
        return outcomes.classify(problem, q.jump, q.jump is not None, q.exact, q.other)

    return {kind: [answer(question) for question in own] for kind, own in asked.items()}


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


def _play(method: Method, steps: Steps, ends: Ints, count: int) -> tuple[list[Any], bool, bool]:
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
