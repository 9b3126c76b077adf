"""The error estimate on synthetic errors."""

import numpy as np
import pytest

from palpate.offline.validate.compare import (
    CONFIDENCE,
    COVERAGE,
    KnownAnswer,
    calibrate,
    calibrate_by_halves,
    coverage,
    covering,
)


def known(features, errors, comparable=True, near_rim=False):
    return KnownAnswer(np.array(errors), features, True, comparable, near_rim)


def some(rng, count, rim=0.0, wider=1.0):
    """Answers whose errors go with their second feature, a share of them near the rim.

    There they scatter more.
    """
    features = np.column_stack([np.ones(count), rng.standard_normal((count, 9)), np.zeros(count)])
    features[: int(rim * count), -1] = 1.0
    scatter = np.where(features[:, -1:] > 0, wider, 1.0) * rng.standard_normal((count, 3))
    errors = np.exp(scatter + features[:, 1:2] - 8)
    return [
        known(own, error, near_rim=own[-1] > 0) for own, error in zip(features, errors, strict=True)
    ]


def single(answers):
    return [[answer] for answer in answers]


def estimated(answers, estimator):
    for answer in answers:
        answer.estimated = np.exp(estimator @ answer.features)
    return answers


def test_the_estimate_covers_what_it_is_fitted_to(rng):
    answers = some(rng, 60)
    estimator, confidence = calibrate(single(answers), 1.0)
    assert confidence == pytest.approx(1 - COVERAGE**60)
    assert coverage(estimated(answers, estimator))[0] >= 0.97
    elsewhere = known(answers[0].features, [0.5, 0.5, 0.5], comparable=False)
    again, _ = calibrate(single([*answers, elsewhere]), 1.0)
    np.testing.assert_array_equal(again, estimator)


@pytest.mark.parametrize("count", [60, 150, 300])
def test_enough_of_other_scores_are_covered_as_surely_as_is_said(rng, count):
    share, confidence = covering(count)
    assert confidence >= CONFIDENCE
    known = np.sort(rng.random((4000, count)), axis=1)
    # of uniform scores the share that a bound covers is the bound
    sure = np.mean(known[:, round(share * (count + 1)) - 1] >= COVERAGE)
    assert sure == pytest.approx(confidence, abs=0.02)
    one_less = np.mean(known[:, round(share * (count + 1)) - 2] >= COVERAGE)
    assert one_less < CONFIDENCE + 0.02


def test_of_few_scores_all_are_covered_and_it_is_said_how_sure_that_is(rng):
    assert covering(12) == (pytest.approx(12 / 13), pytest.approx(1 - COVERAGE**12))
    answers = some(rng, 12)
    known = estimated(answers, calibrate(single(answers), 1.0)[0])
    assert coverage(known)[0] == 1.0


def test_answers_near_the_rim_are_as_well_covered_as_the_rest(rng):
    found = []
    for _ in range(20):
        estimator, _ = calibrate(single(some(rng, 150, rim=0.4, wider=2.5)), 1.0)
        unseen = estimated(some(rng, 500, rim=0.4, wider=2.5), estimator)
        groups = [[a for a in unseen if a.near_rim == near] for near in (False, True)]
        found.append([coverage(own)[0] for own in groups])
    assert (np.mean(np.array(found) >= COVERAGE, axis=0) >= 0.75).all()
    assert (np.median(found, axis=0) <= 0.995).all()  # neither pays for the other


def test_the_answers_to_one_query_count_as_one(rng):
    """All of a history may err alike."""
    queries = [[known(a.features, a.errors)] * 20 for a in some(rng, 30)]
    assert calibrate(queries, 1.0)[1] == pytest.approx(1 - COVERAGE**30)


def test_answers_are_estimated_by_the_other_half_of_the_queries(rng):
    queries = [some(rng, 3) for _ in range(40)]
    estimator, confidence = calibrate_by_halves(queries, 1.0)
    everything = [answer for answers in queries for answer in answers]
    whole = calibrate(queries, 1.0)
    np.testing.assert_array_equal(estimator, whole[0])
    assert confidence == whole[1]
    odd, _ = calibrate(queries[1::2], 1.0)
    for answer in queries[0]:
        np.testing.assert_array_equal(answer.estimated, np.exp(odd @ answer.features))
    assert coverage(everything)[0] >= 0.85
