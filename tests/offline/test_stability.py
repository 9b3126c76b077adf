"""The map of failures: the artifact never fails silently, others do, and the study resumes."""

from types import SimpleNamespace

import numpy as np
import pytest

from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.problem import Load
from palpate.offline.methods.method import Case
from palpate.offline.scenes import find_scene
from palpate.offline.studies import outcomes
from palpate.offline.studies import stability as study
from palpate.offline.studies.hard_cases import (
    CONTROL,
    HYSTERESIS,
    LOWERED,
    SEVERAL,
    TELEPORT,
    HardCase,
    Question,
    ask_full_model,
    several,
)
from palpate.offline.studies.outcomes import (
    ANOTHER,
    ANOTHER_FLAGGED,
    RIGHT,
    RIGHT_FLAGGED,
    SILENT,
    SILENT_OUTCOMES,
    WRONG_FLAGGED,
    classify,
)
from palpate.offline.studies.references import Fields
from palpate.offline.studies.stability import ARTIFACT, FULL, WARM, stability

from .conftest import drawn, table

CASES, SNAPSHOTS, SEED = 3, 50, 1

METHODS = (ARTIFACT, WARM, FULL, "derivatives 19", "pod 40", "pod, no line search 40", "linear 40")

KINDS = (
    CONTROL, "load x 4", "tilt 60°", "off surface, out of reach", "half the radius",
    "1.5 x the radius", "two contacts", "Poisson 0.49", "tool moves 0.5 mm", TELEPORT, LOWERED,
)  # fmt: skip


def run(artifact):
    scene = find_scene("quick")
    return stability(artifact, scene, CASES, SEED, 0, METHODS, KINDS, SNAPSHOTS)


@pytest.fixture(scope="module")
def report(artifact):
    """Return the report of a run that was killed at its end and went on where it stopped."""

    def kill(*_):
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(outcomes, "publish", kill)
        with pytest.raises(KeyboardInterrupt):
            run(artifact)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "_answers", lambda *_: pytest.fail("asked again"))
        return run(artifact)


@pytest.fixture(scope="module")
def rows(report, artifact):
    rows = table(artifact.parent / "quick" / "report" / "stability.csv")
    return {(row["method"], row["stressor"]): row for row in rows}


def test_the_artifact_never_fails_silently_and_answers_in_range_alone(report, rows):
    for name in (ARTIFACT, WARM):
        assert report[name]["silently_wrong"] == report[name]["nan"] == report[name]["crashes"] == 0
    control = rows[ARTIFACT, CONTROL]
    assert int(control[RIGHT]) + int(control[outcomes.RIGHT_FLAGGED]) == CASES
    for stressor in ("load x 4", "tilt 60°", "half the radius", "two contacts"):
        assert int(rows[ARTIFACT, stressor][RIGHT]) == 0


def test_methods_that_cannot_tell_fail_silently_and_the_full_model_is_right(report, rows):
    for name in ("pod 40", "linear 40"):
        assert sum(report[name]["outcomes"].get(outcome, 0) for outcome in SILENT_OUTCOMES) > 0
    assert int(rows[FULL, CONTROL][RIGHT]) == int(rows[FULL, LOWERED][RIGHT]) == CASES
    assert float(rows[FULL, CONTROL]["displacement_max"]) == 0.0


def test_every_cell_counts_its_cases_and_is_there_where_it_makes_sense(rows):
    for row in rows.values():
        assert sum(int(row[outcome]) for outcome in outcomes.OUTCOMES) == int(row["cases"]) == CASES
    assert (ARTIFACT, "Poisson 0.49") not in rows
    assert ("pod 40", TELEPORT) not in rows
    assert {name for name, _ in rows} == set(METHODS)
    assert {name for name, stressor in rows if stressor == LOWERED} == {ARTIFACT, WARM, FULL}


def test_the_map_is_drawn_and_nothing_else_is_left(report, artifact):
    folder = artifact.parent / "quick" / "report"
    assert drawn(folder / "stability.png")
    assert not list(artifact.parent.glob(".*stability*"))


class Buckled:
    """A body of one node: its z is u + 2, ``u³ − 3 u = f − 3``; it snaps on at 5 mN, back at 1."""

    mesh = SimpleNamespace(nodes=np.zeros((1, 3)))
    von_mises = staticmethod(lambda u: u[:, 2])
    scene = SimpleNamespace(tissue=SimpleNamespace(poisson=0.45))

    @property
    def model(self):
        return self

    def solve(self, load, start=None, smallest_step=1.0):
        z = 0.0 if start is None else start[0, 2]
        roots = np.roots([1.0, 0.0, -3.0, 3.0 - load[0, 2]]) + 2.0
        stable = [r.real for r in roots if abs(r.imag) < 1e-9 and abs(r.real - 2.0) > 1.0]
        if not stable:
            raise NoEquilibrium("load: none")
        u = np.zeros((1, 3))
        u[0, 2] = min(stable, key=lambda root: abs(root - z))
        return SimpleNamespace(displacement=u)


def buckled(*forces):
    """A case that leads through forces on that node, and its equilibria."""
    steps = [(Case((), np.array([0]), np.array([[0.0, 0.0, force]])), 0.0) for force in forces]
    return ask_full_model(Buckled(), HardCase(steps, 0.45, follow=True))


def height(fields):
    return fields.displacements[0, 0, 2]


def test_a_load_that_snapped_and_was_lowered_stays_on_its_branch():
    raised, lowered = buckled(3.0), buckled(3.0, 6.0, 3.0)
    assert not raised.several
    assert height(raised.exact) == pytest.approx(2.0 - 3**0.5)
    assert height(lowered.exact) == pytest.approx(2.0 + 3**0.5)
    assert height(lowered.other) == pytest.approx(2.0 - 3**0.5)
    assert not buckled(3.0, 6.0, 0.5).several  # lowered so far that it snaps back
    assert several({LOWERED: [raised, lowered]}, 9) == {SEVERAL: [], HYSTERESIS: [lowered]}


def test_where_the_full_model_is_lost_on_the_way_nothing_is_known_to_be_right():
    raised, lowered = (buckled(*loads).case for loads in ((3.0,), (3.0, 6.0, 3.0)))
    jump = buckled(3.0).jump
    assert Question(lowered, None, jump).lost
    assert not Question(lowered, jump, jump).lost
    assert not Question(lowered, None, None).lost  # there is none, which is known
    assert not Question(raised, None, jump).lost


def test_an_answer_on_another_branch_is_told_apart_and_counts_as_silent(problem):
    x, normal, _ = problem.surface.project(np.array([4.0, 5.5, 8.0]))
    path, jump, half = (
        Fields(share * u[None], problem.von_mises(share * u)[None])
        for p, share in ((1.5, 1.0), (1.0, 1.0), (1.0, 0.5))
        for u in [problem.solve(Load(x, -normal, p)).displacement]
    )

    def outcome(found, trusted, exact, jump):
        question = Question(None, exact, jump)
        return classify(problem, found, trusted, question.exact, question.other).outcome

    outcomes = {
        trusted: [outcome(found, trusted, path, jump) for found in (path, jump, half)]
        for trusted in (True, False)
    }
    assert outcomes[True] == [RIGHT, ANOTHER, SILENT]
    assert outcomes[False] == [RIGHT_FLAGGED, ANOTHER_FLAGGED, WRONG_FLAGGED]
    assert ANOTHER in SILENT_OUTCOMES
    assert outcome(jump, True, None, jump) == ANOTHER
    assert outcome(jump, True, path, path) == SILENT
