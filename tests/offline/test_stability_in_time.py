"""The map of failures in time: the artifact holds, nonsense is refused, others fail."""

import csv

import numpy as np
import pytest

from palpate.offline.fem.problem import FullProblem
from palpate.offline.studies import trajectories
from palpate.offline.studies.outcomes import OUTCOMES, REFUSED, RIGHT, RIGHT_FLAGGED
from palpate.offline.studies.stability import LOADS, STEPS, TIP, stability_in_time
from palpate.offline.studies.trajectories import CONTROL, histories
from palpate.shared.artifact import read_artifact
from palpate.shared.errors import QueryError
from palpate.shared.model import ReducedModel

CASES, MANY, SEED = 1, 100, 1
LONGEST, PERIODIC = "held for 100 s, 100 steps", "moves periodically, 100 steps"
KINDS = (
    CONTROL, "steps of 0.01 ms", "steps of no time", "direction flipped at once", LONGEST, PERIODIC,
    "steps of a day", "taps at 20 Hz", "1.5 x the limit", "time runs back",
)  # fmt: skip
METHODS = (LOADS, TIP, "modal 40", STEPS)


@pytest.fixture(scope="module")
def report(visco_artifact):
    return stability_in_time(visco_artifact, CASES, SEED, MANY, METHODS, KINDS, learnt=1)


@pytest.fixture(scope="module")
def rows(report, visco_artifact):
    folder = visco_artifact.parent / visco_artifact.stem / "report"
    assert (folder / "stability_in_time.png").stat().st_size > 10_000
    with (folder / "stability_in_time.csv").open() as file:
        return {(row["method"], row["stressor"]): row for row in csv.DictReader(file)}


def test_the_artifact_never_fails_silently(report):
    for name in (LOADS, TIP):
        assert report[name]["silently_wrong"] == report[name]["nan"] == report[name]["crashes"] == 0


def test_it_has_an_answer_to_every_length_of_steps(rows):
    for method in (LOADS, TIP):
        for stressor in KINDS[:8]:
            if (method, stressor) in rows:
                row = rows[method, stressor]
                assert int(row[RIGHT]) + int(row[RIGHT_FLAGGED]) == int(row["cases"]), stressor


def test_loads_out_of_range_are_flagged(rows):
    assert int(rows[LOADS, "1.5 x the limit"][RIGHT]) == 0


def test_time_that_makes_no_sense_is_refused_by_all(rows):
    for method in METHODS:
        assert int(rows[method, "time runs back"][REFUSED]) == CASES


def test_a_long_hold_does_not_drift(report):
    for name in METHODS:
        assert report[name]["drift"][LONGEST] < 5e-3


def test_a_periodic_movement_repeats(report):
    for name in (LOADS, TIP, "modal 40"):
        assert report[name]["drift"][PERIODIC] < 1e-3


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
    problem = FullProblem.of_artifact(read_artifact(visco_artifact))

    def seconds(steps):
        return sum(dt for _, dt in steps)

    for tip in (False, True):
        found = histories(atlas, problem, tip, CASES, SEED, MANY)
        long = {name: own[0] for name, own in found.items() if own[0].brief}
        assert len(long) == 3
        for name, case in long.items():
            assert case.end_only
            one, other = case.steps[-1][0].contacts[0], case.brief[-1][0].contacts[0]
            np.testing.assert_array_equal(one.position, other.position)
            assert one.pressure == other.pressure
            if name != PERIODIC:
                assert seconds(case.steps) == pytest.approx(seconds(case.brief))
        held = seconds(found["held for 10 000 s"][0].steps)
        assert held == pytest.approx(trajectories.LONG, rel=1e-3)


def test_elastic_scenes_have_none(artifact):
    with pytest.raises(QueryError, match="elastic"):
        stability_in_time(artifact, 1, 0)
