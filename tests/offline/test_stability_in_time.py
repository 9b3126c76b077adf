"""The map of failures in time: the artifact holds, nonsense is refused, others fail."""

import numpy as np
import pytest

from palpate.offline.studies import trajectories
from palpate.offline.studies.outcomes import OUTCOMES, REFUSED, RIGHT, RIGHT_FLAGGED
from palpate.offline.studies.stability import LOADS, STEPS, TIP, stability
from palpate.offline.studies.trajectories import CONTROL, histories

from .conftest import drawn, table

CASES, MANY, SEED = 1, 100, 1
LONGEST, PERIODIC = "held for 100 s, 100 steps", "moves periodically, 100 steps"
KINDS = (
    CONTROL, "steps of 0.01 ms", "steps of no time", "direction flipped at once", LONGEST, PERIODIC,
    "steps of a day", "taps at 20 Hz", "1.5 x the limit", "time runs back",
)  # fmt: skip
METHODS = (LOADS, TIP, "modal 40", STEPS)


@pytest.fixture(scope="module")
def report(visco_artifact):
    return stability(visco_artifact, None, CASES, SEED, MANY, METHODS, KINDS, learnt=1)


@pytest.fixture(scope="module")
def rows(report, visco_artifact):
    folder = visco_artifact.parent / visco_artifact.stem / "report"
    assert drawn(folder / "stability_in_time.png")
    rows = table(folder / "stability_in_time.csv")
    return {(row["method"], row["stressor"]): row for row in rows}


def test_the_artifact_never_fails_silently_and_answers_steps_of_every_length(report, rows):
    for name in (LOADS, TIP):
        assert report[name]["silently_wrong"] == report[name]["nan"] == report[name]["crashes"] == 0
        for row in (rows[name, kind] for kind in KINDS[:8] if (name, kind) in rows):
            assert int(row[RIGHT]) + int(row[RIGHT_FLAGGED]) == int(row["cases"]), row
    assert int(rows[LOADS, "1.5 x the limit"][RIGHT]) == 0


def test_every_cell_counts_its_cases_and_time_that_makes_no_sense_is_refused_by_all(rows):
    for (method, stressor), row in rows.items():
        assert sum(int(row[outcome]) for outcome in OUTCOMES) == int(row["cases"]) == CASES
        assert not (method == TIP and "direction" in stressor)
    assert not [name for name in rows if name[0] not in METHODS]
    for method in METHODS:
        assert int(rows[method, "time runs back"][REFUSED]) == CASES


def test_a_long_hold_does_not_drift_and_a_periodic_movement_repeats(report):
    for name in METHODS:
        assert report[name]["drift"][LONGEST] < 5e-3
        assert name == STEPS or report[name]["drift"][PERIODIC] < 1e-3


def test_stiff_modes_and_large_steps_fail_silently(report, rows):
    for name in ("modal 40", STEPS):
        assert report[name]["silently_wrong"] > 0
    # nothing of a hold is missed by large steps
    assert int(rows[STEPS, LONGEST][RIGHT]) == 1


def test_brief_histories_end_when_and_where_the_long_ones_do(visco_atlas, visco_problem):
    def seconds(steps):
        return sum(dt for _, dt in steps)

    for tip in (False, True):
        found = histories(visco_atlas, visco_problem, tip, CASES, SEED, MANY)
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
