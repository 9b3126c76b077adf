"""Compiled Galerkin models: the full model's equilibrium in the span of a basis."""

import numpy as np
import pytest

from palpate.offline.fem.potential import Projected
from palpate.offline.fem.problem import Load
from palpate.offline.fem.terms import DeadLoad
from palpate.offline.methods.galerkin import TOLERANCE, Galerkin, GalerkinAtHand
from palpate.offline.methods.method import Case
from palpate.offline.reduce.ritz import energy_pod
from palpate.shared.mechanics import newton

CLOSE = 3 * TOLERANCE
"""The residual allowed, with tissue that is at most three times softer than at rest; gradients in
single precision weigh a hundred times less."""


def test_a_basis_that_holds_the_answer_finds_it(problem, queries, rng):
    model = problem.model
    for load, exact in queries:
        u = exact.ravel()[model.free]
        basis, _ = energy_pod(model, np.stack([u, *rng.random((4, len(u)))], axis=1), 5)
        method = Galerkin(problem, basis)
        answer = method.solve(Case.of(problem, load))
        assert answer.converged
        assert answer.trusted
        found = method.displacement(answer.state)
        assert np.linalg.norm(found - exact) <= CLOSE * np.linalg.norm(exact)


def test_it_integrates_each_part_of_the_law_where_tetrahedra_do(tetrahedra, rng):
    model, load = tetrahedra.model, Load(np.array([5.0, 4.0, 8.0]), np.array([0.0, 0.0, -1.0]), 1.5)
    exact = tetrahedra.solve(load).displacement
    u = exact.ravel()[model.free]
    basis, _ = energy_pod(model, np.stack([u, *rng.random((4, len(u)))], axis=1), 5)
    method = Galerkin(tetrahedra, basis)
    assert len(method.points) == 5 * len(tetrahedra.elements)
    found = method.displacement(method.solve(Case.of(tetrahedra, load)).state)
    assert np.linalg.norm(found - exact) <= CLOSE * np.linalg.norm(exact)


def test_it_is_the_projected_full_model_whatever_was_asked_before(problem, basis, queries):
    method, size, states = Galerkin(problem, basis), basis.shape[1], []
    for load, _ in (*queries, queries[0]):
        dead = DeadLoad(problem.load_vector(load).ravel())
        projected, q = Projected(problem.model, [dead], basis), np.zeros(size)
        target = 1e-6 * np.linalg.norm(basis.T @ dead.forces[problem.model.free])
        status, *_ = newton.newton(projected, q, np.zeros((4, size)), target, 0.0, 60, False)
        assert status == newton.CONVERGED
        answer = method.solve(Case.of(problem, load))
        assert answer.converged
        assert np.linalg.norm(answer.state[:size] - q) <= CLOSE * np.linalg.norm(q)
        states.append(answer.state)
    np.testing.assert_array_equal(states[-1], states[0])


def test_a_basis_at_hand_may_come_smaller_than_the_last(problem, training, queries):
    cases = [Case.of(problem, load) for load, _ in queries[:2]]
    bases = iter([training.pod(11), training.pod(3)])
    method = GalerkinAtHand(problem, 11, lambda case: next(bases))
    method.solve(cases[0])
    found = method.solve(cases[1]).state[1]
    expected = Galerkin(problem, training.pod(3)).solve(cases[1]).state
    np.testing.assert_allclose(found, expected[:3], rtol=1e-6)


def test_no_load_moves_nothing(problem, queries):
    load = queries[0][0]
    case = Case.of(problem, Load(load.position, load.direction, 0.0))
    method = GalerkinAtHand(problem, 4, lambda case: pytest.fail("not needed"))
    answer = method.solve(case)
    assert answer.converged
    assert not method.displacement(answer.state).any()
