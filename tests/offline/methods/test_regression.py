"""Answers without an equilibrium: the linear response and radial basis functions."""

import numpy as np

from palpate.offline.fem.norms import relative
from palpate.offline.methods.catalogue import build
from palpate.offline.methods.method import Case

ALL = 10_000


def test_linear_answers_add_up(problem, training, queries):
    linear, (a, b) = build("linear", ALL, training), (load for load, _ in queries[:2])
    both = linear.solve(Case.of(problem, a, b)).state
    apart = [linear.solve(Case.of(problem, load)).state for load in (a, b)]
    np.testing.assert_allclose(both, sum(apart), rtol=0, atol=1e-10 * np.abs(both).max())


def test_regression_repeats_what_it_has_learned(problem, training):
    method = build("regression", ALL, training)
    for load, u in zip(
        training.snapshots.loads[:5], training.snapshots.displacements, strict=False
    ):
        answer = method.solve(Case.of(problem, load))
        assert relative(method.displacement(answer.state).ravel(), u) <= 1e-4
