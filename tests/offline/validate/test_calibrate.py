"""The error estimate on synthetic errors."""

import numpy as np

from palpate.offline.validate.compare import KnownAnswer, calibrate, calibrate_by_halves, coverage


def known(features, errors, comparable=True):
    return KnownAnswer(np.array(errors), features, True, comparable)


def some(rng, count):
    features = np.column_stack([np.ones(count), rng.standard_normal((count, 9))])
    errors = np.exp(rng.standard_normal((count, 3)) + features[:, 1:2] - 8)
    return [known(*pair) for pair in zip(features, errors, strict=True)]


def test_the_estimate_covers_what_it_is_fitted_to(rng):
    answers = some(rng, 60)
    estimator = calibrate(answers, 0.96, 1.0)
    for answer in answers:
        answer.estimated = np.exp(estimator @ answer.features)
    assert coverage(answers)[0] >= 0.97
    elsewhere = known(answers[0].features, [0.5, 0.5, 0.5], comparable=False)
    again = calibrate([*answers, elsewhere], 0.96, 1.0)
    np.testing.assert_array_equal(again, estimator)


def test_answers_are_estimated_by_the_other_half_of_the_queries(rng):
    queries = [some(rng, 3) for _ in range(40)]

    def fit(answers):
        return calibrate(answers, 0.96, 1.0)

    estimator = calibrate_by_halves(queries, fit)
    everything = [answer for answers in queries for answer in answers]
    np.testing.assert_array_equal(estimator, fit(everything))
    odd = fit([answer for answers in queries[1::2] for answer in answers])
    for answer in queries[0]:
        np.testing.assert_array_equal(answer.estimated, np.exp(odd @ answer.features))
    assert coverage(everything)[0] >= 0.85
