"""The map of failures: the artifact never fails silently, others do, and the study resumes."""

import csv
from types import SimpleNamespace

import numpy as np
import pytest

from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.methods.method import Case
from palpate.offline.scenes import find_scene
from palpate.offline.studies import stability as study
from palpate.offline.studies.hard_cases import (
    CONTROL,
    HYSTERESIS,
    LOWERED,
    SEVERAL,
    TELEPORT,
    Equilibria,
    HardCase,
    equilibria,
    several,
)
from palpate.offline.studies.outcomes import (
    ANOTHER,
    ANOTHER_FLAGGED,
    OUTCOMES,
    RIGHT,
    RIGHT_FLAGGED,
    SILENT,
    SILENT_OUTCOMES,
    WRONG_FLAGGED,
    classify,
)
from palpate.offline.studies.stability import ARTIFACT, FULL, WARM, stability

CASES, SNAPSHOTS, SEED = 3, 50, 1

METHODS = (ARTIFACT, WARM, FULL, "derivatives 19", "pod 40", "pod, no line search 40", "linear 40")

KINDS = (
    CONTROL, "load x 4", "tilt 60°", "off surface, out of reach", "half the radius",
    "1.5 x the radius", "two contacts", "Poisson 0.49", "tool moves 0.5 mm", TELEPORT, LOWERED,
)  # fmt: skip


def run(artifact):
    return stability(artifact, CASES, SEED, METHODS, KINDS, SNAPSHOTS)


@pytest.fixture(scope="module")
def report(artifact):
    return run(artifact)


@pytest.fixture(scope="module")
def rows(report, artifact):
    with (artifact.parent / "quick" / "report" / "stability.csv").open() as file:
        return {(row["method"], row["stressor"]): row for row in csv.DictReader(file)}


def test_the_artifact_never_fails_silently(report):
    for name in (ARTIFACT, WARM):
        assert report[name]["silently_wrong"] == report[name]["nan"] == report[name]["crashes"] == 0


def test_it_answers_in_range_and_refuses_or_flags_what_it_was_not_made_for(rows):
    control = rows[ARTIFACT, CONTROL]
    assert int(control[RIGHT]) + int(control[RIGHT_FLAGGED]) == CASES
    for stressor in ("load x 4", "tilt 60°", "half the radius", "two contacts"):
        assert int(rows[ARTIFACT, stressor][RIGHT]) == 0


def test_methods_that_cannot_tell_fail_silently(report):
    for name in ("pod 40", "linear 40"):
        assert sum(report[name]["outcomes"].get(outcome, 0) for outcome in SILENT_OUTCOMES) > 0


def test_the_full_model_is_right_where_it_says_what_is_true(rows):
    assert int(rows[FULL, CONTROL][RIGHT]) == CASES
    assert float(rows[FULL, CONTROL]["displacement_max"]) == 0.0


def test_every_cell_counts_its_cases_and_is_there_where_it_makes_sense(rows):
    for row in rows.values():
        assert sum(int(row[outcome]) for outcome in OUTCOMES) == int(row["cases"]) == CASES
    assert (ARTIFACT, "Poisson 0.49") not in rows
    assert ("pod 40", TELEPORT) not in rows
    assert {name for name, _ in rows} == set(METHODS)


def test_the_map_is_drawn_and_nothing_else_is_left(report, artifact):
    folder = artifact.parent / "quick" / "report"
    assert (folder / "stability.png").stat().st_size > 10_000
    assert (folder / "stability_silent.csv").is_file()
    assert not list(artifact.parent.glob(".*stability*"))


def test_a_killed_run_goes_on_where_it_stopped(report, artifact, monkeypatch):
    def kill(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(study.outcomes, "publish", kill)
        with pytest.raises(KeyboardInterrupt):
            run(artifact)
    monkeypatch.setattr(study, "_answers", lambda *_: pytest.fail("asked again"))
    assert run(artifact) == report


class Buckled:
    """A body of one node: its z is u + 2, ``u³ − 3 u = f − 3``; it snaps on at 5 mN, back at 1."""

    mesh = SimpleNamespace(nodes=np.zeros((1, 3)))
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
    case = HardCase(tuple(steps), 0.45, follow=True)
    return case, equilibria(Buckled(), case)


def test_a_load_that_snapped_and_was_lowered_stays_on_its_branch():
    raised, lowered = buckled(3.0), buckled(3.0, 6.0, 3.0)
    assert not raised[1].several
    assert raised[1].path[2] == pytest.approx(2.0 - 3**0.5)
    assert lowered[1].path[2] == pytest.approx(2.0 + 3**0.5)
    assert lowered[1].other[2] == pytest.approx(2.0 - 3**0.5)
    assert not buckled(3.0, 6.0, 0.5)[1].several  # lowered so far that it snaps back
    assert several({LOWERED: [raised, lowered]}, 9) == {SEVERAL: [], HYSTERESIS: [lowered]}


@pytest.fixture(scope="module")
def problem():
    return FullProblem(find_scene("quick"))


def test_an_answer_on_another_branch_is_told_apart_and_counts_as_silent(problem):
    x, normal, _ = problem.surface.project(np.array([4.0, 5.5, 8.0]))
    path, jump = (problem.solve(Load(x, -normal, p)).displacement.ravel() for p in (1.5, 1.0))

    def outcome(u, trusted, truth):
        question = study._question(problem, None, truth)
        found = study._question(problem, None, Equilibria(u, u)).exact
        return classify(problem, found, trusted, question.exact, question.other).outcome

    truth = Equilibria(path, jump)
    outcomes = {
        trusted: [outcome(u, trusted, truth) for u in (path, jump, 0.5 * jump)]
        for trusted in (True, False)
    }
    assert outcomes[True] == [RIGHT, ANOTHER, SILENT]
    assert outcomes[False] == [RIGHT_FLAGGED, ANOTHER_FLAGGED, WRONG_FLAGGED]
    assert ANOTHER in SILENT_OUTCOMES
    assert outcome(jump, True, Equilibria(None, jump)) == ANOTHER
    assert outcome(jump, True, Equilibria(path, path)) == SILENT


def test_the_full_model_is_followed_up_and_down_beside_the_warm_artifact(rows):
    assert {name for name, stressor in rows if stressor == LOWERED} == {ARTIFACT, WARM, FULL}
    assert int(rows[FULL, LOWERED][RIGHT]) == CASES
