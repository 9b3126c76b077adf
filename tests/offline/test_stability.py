"""The map of failures: the artifact never fails silently, others do, and the study resumes."""

import csv

import pytest

from offline.studies import stability as study
from offline.studies.stability import (
    ARTIFACT,
    FULL,
    OUTCOMES,
    RIGHT,
    RIGHT_FLAGGED,
    SILENT_OUTCOMES,
    WARM,
    stability,
)
from offline.studies.stressors import CONTROL, TELEPORT

CASES, SNAPSHOTS, SEED = 3, 50, 1

METHODS = (ARTIFACT, WARM, FULL, "derivatives 19", "pod 40", "pod 40, no line search", "linear 40")

COLUMNS = (
    CONTROL, "load x 4", "tilt 60°", "off surface, out of reach", "half the radius",
    "1.5 x the radius", "two contacts", "Poisson 0.49", "tool moves 0.5 mm", TELEPORT,
)  # fmt: skip


def run(artifact):
    return stability(artifact, CASES, SEED, METHODS, COLUMNS, SNAPSHOTS)


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
        assert sum(report["methods"][name].get(outcome, 0) for outcome in SILENT_OUTCOMES) > 0


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
    with monkeypatch.context() as patch:
        patch.setattr(study, "_publish", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            run(artifact)
    monkeypatch.setattr(study, "_ask", lambda *_: pytest.fail("asked again"))
    assert run(artifact) == report
