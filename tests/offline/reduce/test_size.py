"""The smallest size that meets a tolerance, and what is said when none does."""

import numpy as np
import pytest

from palpate.offline.reduce.sampling import fewer
from palpate.offline.reduce.size import (
    LADDER,
    MARGIN,
    RUNG,
    WORST,
    Trial,
    TrialResult,
    choose,
    ladder,
)
from palpate.shared.mechanics.neo_hookean import NeoHookeanTissue
from palpate.shared.scene import Budget, Tolerance

BUDGET = Budget(query=150e-6)


def attempts(errors, seconds=50e-6):
    """Trials whose errors are given size by size; also the sizes tried, in order."""
    tried = []

    def attempt(size):
        tried.append(LADDER.index(size))
        error = np.full(20, errors[tried[-1]])
        return Trial.of(size, [TrialResult(error, 2 * error, seconds)])

    return attempt, tried


PLACES = range(len(LADDER))


@pytest.mark.parametrize("smallest", PLACES)
@pytest.mark.parametrize(
    ("errors", "most"),
    [
        (lambda k: 0.0075 * RUNG**k, 3),  # as sizes are expected to differ
        (lambda k: 0.02 if k < 0 else 0.007, len(LADDER)),
        (lambda k: 1.0 if k < 0 else 0.0, len(LADDER)),
    ],
)
def test_the_smallest_size_that_is_good_enough(smallest, errors, most):
    attempt, tried = attempts([errors(i - smallest) for i in PLACES])
    choice = choose(LADDER, Tolerance(displacement=0.01, von_mises=0.02), BUDGET, attempt)
    assert choice.size == LADDER[smallest]
    assert len(tried) == len(set(tried)) <= most
    assert choice.why.startswith("the smallest")
    assert [LADDER.index(trial.size) for trial in choice.trials] == sorted(tried)


def test_a_looser_tolerance_takes_a_smaller_model():
    errors = [0.03, 0.015, 0.01, 0.006, 0.004]
    sizes = [
        choose(LADDER, Tolerance(displacement=t, von_mises=2 * t), BUDGET, attempts(errors)[0]).size
        for t in (0.01, 0.02, 0.05)
    ]
    assert sizes == [LADDER[3], LADDER[1], LADDER[0]]


def test_a_loose_tolerance_pays_for_no_trial_of_a_large_model():
    errors = [0.03 * RUNG**i for i in PLACES]
    attempt, tried = attempts(errors)
    choose(LADDER, Tolerance(displacement=0.05, von_mises=0.1), BUDGET, attempt)
    assert tried == [0]


def test_a_tolerance_out_of_reach_is_said_plainly():
    attempt, _ = attempts([0.5, 0.4, 0.3, 0.2, 0.1])
    choice = choose(LADDER, Tolerance(displacement=0.01, von_mises=0.02), BUDGET, attempt)
    assert choice.size == LADDER[-1]
    assert "no size meets the tolerance of 1.00%" in choice.why
    assert "10.00% displacement, 20.00% von Mises" in choice.why


def test_a_budget_exceeded_names_the_best_within_it():
    def attempt(size):
        place = LADDER.index(size)
        error = np.full(20, [0.5, 0.4, 0.3, 0.005, 0.004][place])
        return Trial.of(size, [TrialResult(error, error, 60e-6 * place)])

    choice = choose(LADDER, Tolerance(displacement=0.01, von_mises=0.02), BUDGET, attempt)
    assert choice.size == LADDER[3]
    assert "180 µs to solve, over the budget of 150 µs" in choice.why
    assert "the best within it" in choice.why
    assert "30.00% displacement" in choice.why


def test_a_single_wild_error_is_not_outweighed_by_many_good_ones():
    tolerance = Tolerance(displacement=0.01, von_mises=0.02)
    error = np.full(99, 0.5 * MARGIN * 0.01)
    good = Trial.of(LADDER[0], [TrialResult(error, error, 1e-4)])
    wild = np.append(error, 1.01 * WORST * 0.01)
    assert good.meets(tolerance)
    assert not Trial.of(LADDER[0], [TrialResult(wild, error, 1e-4)]).meets(tolerance)


def test_one_patch_may_lie_where_tissue_gives_way_and_two_may_not():
    tolerance = Tolerance(displacement=0.01, von_mises=0.02)
    good, wild = (TrialResult(error, error, 1e-4) for error in np.outer([0.004, 0.2], np.ones(9)))
    assert Trial.of(LADDER[0], [good, good, wild]).meets(tolerance)
    assert not Trial.of(LADDER[0], [good, wild, wild]).meets(tolerance)


def test_a_looser_tolerance_is_served_by_fewer_samples():
    usual = Tolerance(displacement=0.01, von_mises=0.02)
    loose = Tolerance(displacement=0.04, von_mises=0.1)
    tight = Tolerance(displacement=0.001, von_mises=0.02)
    assert [fewer(300, tolerance) for tolerance in (usual, loose, tight)] == [300, 150, 300]
    assert fewer(1, loose) == 1


def test_the_less_compressible_the_more_points():
    sizes = [
        ladder(NeoHookeanTissue(law="neo-hookean", young=15.0, poisson=p))
        for p in (0.3, 0.45, 0.49, 0.499)
    ]
    assert sizes[0] == sizes[1] == LADDER
    for own in zip(*sizes[1:], strict=True):
        assert len({size.modes for size in own}) == 1
        points = np.array([size.cubature_points for size in own])
        np.testing.assert_allclose(points[1:] / points[0], [1.76, 3.81], rtol=0.2)
