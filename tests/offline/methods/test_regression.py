"""Answers without an equilibrium: the linear response and radial basis functions."""

import numpy as np
import pytest
from scipy.interpolate import RBFInterpolator

from palpate.offline.fem.norms import relative
from palpate.offline.fem.problem import Load
from palpate.offline.methods.catalogue import build
from palpate.offline.methods.method import Case
from palpate.offline.methods.regression import KERNELS, Interpolant

ALL = 10_000


@pytest.fixture(scope="module")
def linear(training):
    return build("linear", ALL, training)


def scaled(load, factor):
    return Load(load.position, load.direction, factor * load.pressure)


def test_the_linear_answer_is_exact_in_the_limit_of_small_loads(problem, linear, queries):
    load, errors = queries[0][0], []
    for fraction in (0.02, 0.01):
        small = scaled(load, fraction)
        found = linear.displacement(linear.solve(Case.of(problem, small)).state)
        errors.append(relative(found, problem.solve(small).displacement))
    assert errors[0] < 0.02
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.1)


def test_more_modes_lose_less_of_it(problem, training, linear, queries):
    case, lost = Case.of(problem, queries[0][0]), []
    every = linear.displacement(linear.solve(case).state)
    for size in (40, 80, 160):
        few = build("linear", size, training)
        assert few.unknowns == size < linear.unknowns
        lost.append(relative(few.displacement(few.solve(case).state), every))
    assert lost == sorted(lost, reverse=True)


def test_linear_answers_add_up(problem, linear, queries):
    a, b = (load for load, _ in queries[:2])
    both = linear.solve(Case.of(problem, a, b)).state
    apart = [linear.solve(Case.of(problem, load)).state for load in (a, b)]
    np.testing.assert_allclose(both, sum(apart), rtol=0, atol=1e-10 * np.abs(both).max())


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_interpolant_is_scipy_s(rng, kernel):
    features, values = rng.random((40, 7)) + 0.5, rng.random((40, 3))
    lengths, median = (4.0, 2.0), np.median(features[:, -1])
    scales = np.array([1, 1, 1, 4.0, 4.0, 4.0, 2.0 / median])
    scipy = RBFInterpolator(features * scales, values / features[:, -1:], kernel=kernel, degree=1)
    ours = Interpolant(features, values, kernel, lengths)
    for x in rng.random((5, 7)) + 0.5:
        np.testing.assert_allclose(ours(x), scipy((x * scales)[None])[0] * x[-1], rtol=1e-6)


def test_regression_repeats_what_it_has_learned(problem, training):
    method = build("regression", ALL, training)
    for load, u in zip(
        training.snapshots.loads[:5], training.snapshots.displacements, strict=False
    ):
        answer = method.solve(Case.of(problem, load))
        assert relative(method.displacement(answer.state).ravel(), u) <= 1e-4
