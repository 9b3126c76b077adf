"""Compiled Galerkin models: the full model's equilibrium in the span of a basis."""

from types import SimpleNamespace

import numpy as np
import pytest

from palpate.offline.fem.model import FullModel
from palpate.offline.fem.norms import relative
from palpate.offline.fem.potential import Projected
from palpate.offline.fem.problem import Load
from palpate.offline.fem.terms import DeadLoad
from palpate.offline.methods.catalogue import build
from palpate.offline.methods.galerkin import (
    TOLERANCE,
    Galerkin,
    GalerkinAtHand,
    point_gradients,
)
from palpate.offline.methods.method import Case
from palpate.offline.reduce.ritz import energy_pod
from palpate.shared.mechanics import newton
from palpate.shared.reduced.points import LANES

CLOSE = 3 * TOLERANCE
"""The residual allowed, with tissue that is at most three times softer than at rest; gradients in
single precision weigh a hundred times less."""


def test_gradients_at_points_are_those_of_the_shape_functions(problem, rng):
    model, m = problem.model, 3
    modes = rng.standard_normal((3 * len(problem.mesh.nodes), m))
    points = np.array([5, 17, 18, 100, 101, 102, 103, *range(200, 212)])
    tiles = -(-len(points) // LANES)
    out = np.zeros((4, 9 * LANES * tiles), np.float32)
    point_gradients(model.connectivity, model.gradients, points, modes, out)
    e, q = np.divmod(points, model.weights.shape[1])
    local = modes.reshape(-1, 3, m)[model.connectivity[e]]
    expected = np.einsum("caim,caj->mcij", local, model.gradients[e, q]).reshape(m, -1, 9)
    found = out.reshape(4, tiles, 9, LANES).transpose(0, 1, 3, 2).reshape(4, -1, 9)
    np.testing.assert_allclose(found[:m, : len(points)], expected, atol=1e-6)
    assert not found[m:].any()
    assert not found[:, len(points) :].any()


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


def test_it_is_the_projected_full_model(problem, training, queries):
    basis = training.pod(18)
    method = Galerkin(problem, basis)
    for load, _ in queries:
        dead = DeadLoad(problem.load_vector(load).ravel())
        projected, q = Projected(problem.model, [dead], basis), np.zeros(18)
        target = 1e-6 * np.linalg.norm(basis.T @ dead.forces[problem.model.free])
        status, *_ = newton.newton(projected, q, np.zeros((4, 18)), target, 0.0, 60, False)
        assert status == newton.CONVERGED
        answer = method.solve(Case.of(problem, load))
        assert answer.converged
        assert np.linalg.norm(answer.state[:18] - q) <= CLOSE * np.linalg.norm(q)


def test_answers_do_not_depend_on_what_was_asked_before(problem, training, queries):
    method = Galerkin(problem, training.pod(10))
    first, second = (Case.of(problem, load) for load, _ in queries[:2])
    once = method.solve(first).state
    method.solve(second)
    np.testing.assert_array_equal(method.solve(first).state, once)


def test_a_small_load_is_answered_linearly(problem, training, queries):
    model, basis, load = problem.model, training.pod(10), queries[0][0]
    soft = Load(load.position, load.direction, 1e-4 * load.pressure)
    answer = Galerkin(problem, basis).solve(Case.of(problem, soft))
    q = basis.T @ problem.load_vector(soft).ravel()[model.free]
    assert np.linalg.norm(answer.state[:10] - q) <= 1e-3 * np.linalg.norm(q)


def test_the_first_ritz_vector_is_exact_in_the_limit_of_small_loads(problem, training, queries):
    method, load, errors = build("ritz-at-hand", 1, training), queries[0][0], []
    for fraction in (0.04, 0.02):
        soft = Load(load.position, load.direction, fraction * load.pressure)
        exact = problem.solve(soft).displacement
        errors.append(
            relative(method.displacement(method.solve(Case.of(problem, soft)).state), exact)
        )
    assert errors[0] < 0.02
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.1)


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


def test_points_that_share_a_dilatation_are_refused(problem):
    other = FullModel(problem.mesh, "hex8-mean-dilatation", problem.scene.tissue)
    with pytest.raises(ValueError, match="dilatation"):
        Galerkin(SimpleNamespace(model=other), np.zeros((len(other.free), 4)))
