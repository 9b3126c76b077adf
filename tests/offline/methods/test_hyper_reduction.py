"""Few points or elements that do the work of all; interpolation, exact if all is sampled."""

from functools import partial

import numpy as np
import pytest

from palpate.offline.fem.problem import Load
from palpate.offline.methods.galerkin import Galerkin
from palpate.offline.methods.hyper_reduction import (
    Deim,
    contributions,
    fit_cubature,
    force_modes,
    sample,
)
from palpate.offline.methods.method import Case
from palpate.offline.validate.queries import held_out_loads


@pytest.fixture(scope="module")
def snapshots(training):
    return training.snapshots.displacements[:, training.model.free]


@pytest.fixture(scope="module")
def modes(training, snapshots, basis):
    return force_modes(training.model, snapshots, basis.shape[1])


@pytest.fixture(scope="module")
def galerkin(training, basis):
    return Galerkin(training.problem, basis)


@pytest.fixture(scope="module")
def complete(training, basis):
    """Return the method with every dof sampled: Galerkin's, with plain Newton."""
    every = np.eye(len(training.model.free))
    return Deim(training.problem, basis, every, np.arange(len(every)))


def test_with_every_dof_sampled_it_is_galerkin_s_method(training, complete, galerkin, queries):
    assert len(complete.points) == training.model.weights.size
    for load, _ in queries:
        case = Case.of(training.problem, load)
        found, exact = complete.solve(case), galerkin.solve(case)
        assert found.converged
        off = np.linalg.norm(found.state - exact.state)
        assert off <= 3e-4 * np.linalg.norm(exact.state)


def test_it_interpolates_force_modes_of_displacements_that_invert_no_element(
    training, snapshots, modes
):
    sampled, count = sample(modes, 1), modes.shape[1]
    assert np.linalg.norm(np.linalg.inv(modes[sampled])) < 1e3  # square, and far from singular
    inverted = np.vstack([snapshots, 100 * snapshots[:1]])
    np.testing.assert_array_equal(force_modes(training.model, inverted, count), modes)


def test_beyond_its_range_it_fails_where_galerkin_does_not_and_fits_fail_less(
    training, basis, modes, complete, galerkin
):
    cases = []
    for load in held_out_loads(training.atlas, 40, 1):
        beyond = Load(load.position, load.direction, 4 * load.pressure)
        cases.append(Case.of(training.problem, beyond))
    interpolated, fitted = (
        Deim(training.problem, basis, modes, sample(modes, per_mode)) for per_mode in (1, 3)
    )
    found = [
        sum(method.solve(case).converged for case in cases)
        for method in (interpolated, fitted, complete, galerkin)
    ]
    assert found == sorted(found)
    # plain Newton is not to blame: of a complete sum it loses next to nothing
    assert found[1] < 0.9 * found[2]
    assert found[3] == len(cases)


@pytest.fixture(scope="module")
def choose(training, basis, galerkin):
    """Return a function that fits a cubature of so many points, or elements."""
    cases = [Case.of(training.problem, load) for load in training.snapshots.loads]
    forces = contributions(galerkin, cases, np.random.default_rng(0))
    return partial(fit_cubature, training.model, forces)


def worst(problem, basis, queries, cubature):
    """Largest relative difference from the model with every point, in the energy norm."""
    few, every = Galerkin(problem, basis, cubature), Galerkin(problem, basis)
    errors = []
    for load, _ in queries:
        case = Case.of(problem, load)
        answer, exact = few.solve(case), every.solve(case).state
        assert answer.converged
        errors.append(np.linalg.norm(answer.state - exact) / np.linalg.norm(exact))
    return max(errors)


def test_points_do_the_work_of_all_and_more_do_it_better(problem, basis, choose, queries, rng):
    errors = []
    for most in (20, 60, 180):
        cubature = choose(most, rng)
        assert len(cubature.points) == len(cubature.weights) <= most
        assert (cubature.weights > 0).all()
        errors.append(worst(problem, basis, queries, cubature))
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] <= 0.01


def test_elements_come_whole_and_do_it_too_but_points_are_cheaper(
    problem, basis, choose, queries, rng
):
    cubature, model = choose(30, rng, by_element=True), problem.model
    elements, count = np.unique(cubature.points // 8, return_counts=True)
    assert len(elements) <= 30
    assert (count == 8).all()
    factors = (cubature.weights / model.weights.ravel()[cubature.points]).reshape(-1, 8)
    assert (factors > 0).all()
    np.testing.assert_allclose(factors, np.repeat(factors[:, :1], 8, axis=1))
    assert worst(problem, basis, queries, cubature) <= 0.02
    points, elements = choose(80, rng), choose(10, rng, by_element=True)
    assert worst(problem, basis, queries, points) < worst(problem, basis, queries, elements)
