"""Few points or elements that do the work of all."""

import numpy as np
import pytest

from palpate.offline.methods.galerkin import Galerkin
from palpate.offline.methods.method import Case


@pytest.fixture(scope="module")
def forces(training, basis):
    return training.point_forces(basis)


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


def test_points_do_the_work_of_all_and_more_do_it_better(problem, basis, forces, queries, rng):
    errors = []
    for most in (20, 60, 180):
        cubature = forces.by_point(most, rng)
        assert len(cubature.points) == len(cubature.weights) <= most
        assert (cubature.weights > 0).all()
        errors.append(worst(problem, basis, queries, cubature))
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] <= 0.01


def test_elements_come_whole_and_do_it_too_but_points_are_cheaper(
    problem, basis, forces, queries, rng
):
    cubature, model = forces.by_element(30, rng), problem.model
    elements, count = np.unique(cubature.points // 8, return_counts=True)
    assert len(elements) <= 30
    assert (count == 8).all()
    factors = (cubature.weights / model.weights.ravel()[cubature.points]).reshape(-1, 8)
    assert (factors > 0).all()
    np.testing.assert_allclose(factors, np.repeat(factors[:, :1], 8, axis=1))
    assert worst(problem, basis, queries, cubature) <= 0.02
    points, elements = forces.by_point(80, rng), forces.by_element(10, rng)
    assert worst(problem, basis, queries, points) < worst(problem, basis, queries, elements)
