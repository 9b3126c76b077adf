"""The map of failures in time: the artifact holds, nonsense is refused, others fail."""

import csv

import numpy as np
import pytest

from palpate.offline.studies import courses
from palpate.offline.studies.courses import CONTROL, trials
from palpate.offline.studies.stability import OUTCOMES, REFUSED, RIGHT, RIGHT_FLAGGED
from palpate.offline.studies.stability_in_time import ARTIFACT, STEPS, TIP, stability_in_time
from palpate.shared.errors import QueryError
from palpate.shared.model import ReducedModel

CASES, MANY, SEED = 1, 100, 1
LONGEST = "held for 100 s, 100 steps"
COLUMNS = (
    CONTROL, "steps of 0.01 ms", "steps of no time", "direction flipped at once", LONGEST,
    "1.5 x the limit", "time runs back",
)  # fmt: skip
METHODS = (ARTIFACT, TIP, "modal 40", STEPS)


@pytest.fixture(scope="module")
def report(visco_artifact):
    return stability_in_time(visco_artifact, CASES, SEED, MANY, METHODS, COLUMNS, lessons=1)


@pytest.fixture(scope="module")
def rows(report, visco_artifact):
    folder = visco_artifact.parent / visco_artifact.stem / "report"
    assert (folder / "stability_in_time.png").stat().st_size > 10_000
    with (folder / "stability_in_time.csv").open() as file:
        return {(row["method"], row["stressor"]): row for row in csv.DictReader(file)}


def test_the_artifact_never_fails_silently(report):
    for name in (ARTIFACT, TIP):
        assert report[name]["silently_wrong"] == report[name]["nan"] == report[name]["crashes"] == 0


def test_it_has_an_answer_to_every_length_of_steps(rows):
    for method in (ARTIFACT, TIP):
        for stressor in COLUMNS[:5]:
            if (method, stressor) in rows:
                row = rows[method, stressor]
                assert int(row[RIGHT]) + int(row[RIGHT_FLAGGED]) == int(row["cases"]), stressor


def test_loads_out_of_range_are_flagged(rows):
    assert int(rows[ARTIFACT, "1.5 x the limit"][RIGHT]) == 0


def test_time_that_makes_no_sense_is_refused_by_all(rows):
    for method in METHODS:
        assert int(rows[method, "time runs back"][REFUSED]) == CASES


def test_a_long_hold_does_not_drift(report):
    for name in METHODS:
        assert report[name]["drift"][LONGEST] < 5e-3


def test_stiff_modes_and_large_steps_fail_silently(report, rows):
    for name in ("modal 40", STEPS):
        assert report[name]["silently_wrong"] > 0
    # nothing of a hold is missed by large steps
    assert int(rows[STEPS, LONGEST][RIGHT]) == 1


def test_every_cell_counts_its_cases(rows):
    for (method, stressor), row in rows.items():
        assert sum(int(row[outcome]) for outcome in OUTCOMES) == int(row["cases"]) == CASES
        assert not (method == TIP and "direction" in stressor)
    assert not [name for name in rows if name[0] not in METHODS]


def test_brief_histories_end_when_and_where_the_long_ones_do(visco_artifact):
    atlas = ReducedModel.load(visco_artifact)
    for tip in (False, True):
        found = trials(atlas, tip, CASES, SEED, MANY)
        long = [trial for own in found.values() for trial in own if trial.brief]
        assert len(long) == 2
        for trial in long:
            seconds = [sum(press.dt for press in own) for own in (trial.presses, trial.brief)]
            assert seconds[0] == pytest.approx(seconds[1])
            np.testing.assert_array_equal(trial.presses[-1].position, trial.brief[-1].position)
            assert trial.presses[-1].pressure == trial.brief[-1].pressure
        held = sum(press.dt for press in found["held for 10 000 s"][0].presses)
        assert held == pytest.approx(courses.LONG, rel=1e-3)


def test_elastic_scenes_have_none(artifact):
    with pytest.raises(QueryError, match="elastic"):
        stability_in_time(artifact, 1, 0)
