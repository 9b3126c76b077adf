"""Compiled Galerkin models: the full model's equilibrium in the span of a basis."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from palpate.offline.fem.model import FullModel
from palpate.offline.methods.catalogue import build
from palpate.offline.methods.galerkin import (
    TOLERANCE,
    Galerkin,
    GalerkinAtHand,
    point_gradients,
)
from palpate.offline.methods.method import Case
from palpate.offline.reduce.ritz import energy_pod
from palpate.offline.run.workshop import Load
from palpate.offline.validate.loads import relative
from palpate.shared.mechanics import newton
from palpate.shared.reduced.points import LANES

CLOSE = 3 * TOLERANCE
"""The residual allowed, with tissue that is at most three times softer than at rest; gradients in
single precision weigh a hundred times less."""


class Projected:
    """The full model in the span of modes (free dofs, m), for ``mechanics.newton`` in Python."""

    def __init__(self, model, modes, load):
        self.model, self.modes = model, modes
        self.load = modes.T @ load.ravel()[model.free]

    def _full(self, q):
        u = np.zeros(3 * len(self.model.mesh.nodes))
        u[self.model.free] = self.modes @ q
        return u

    def potential(self, q, residual):
        force = np.zeros(3 * len(self.model.mesh.nodes))
        energy, smallest = self.model.internal(self._full(q), force)
        residual[:] = self.modes.T @ force[self.model.free] - self.load
        return energy - self.load @ q, smallest

    def factorise(self, q, shift):
        tangent = self.modes.T @ (self.model.stiffness(self._full(q)) @ self.modes)
        try:
            self.factor = cho_factor(tangent + shift * np.eye(len(q)))
        except LinAlgError:
            return False
        return True

    def correct(self, residual, step):
        step[:] = -cho_solve(self.factor, residual)

    def solve(self):
        q, work = np.zeros(len(self.load)), np.zeros((4, len(self.load)))
        target = 1e-6 * np.linalg.norm(self.load)
        status, *_ = newton.newton(self, q, work, target, 0.0, 60, False)
        assert status == newton.CONVERGED
        return q


def test_gradients_at_points_are_those_of_the_shape_functions(workshop, rng):
    model, m = workshop.model, 3
    modes = rng.standard_normal((3 * len(workshop.mesh.nodes), m))
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


def test_a_basis_that_holds_the_answer_finds_it(workshop, queries, rng):
    model = workshop.model
    for load, exact in queries:
        u = exact.ravel()[model.free]
        basis, _ = energy_pod(model, np.stack([u, *rng.random((4, len(u)))], axis=1), 5)
        method = Galerkin(workshop, basis)
        answer = method.solve(Case.of(workshop, load))
        assert answer.converged
        assert answer.trusted
        found = method.displacement(answer.state)
        assert np.linalg.norm(found - exact) <= CLOSE * np.linalg.norm(exact)


def test_it_is_the_projected_full_model(workshop, training, queries):
    basis = training.pod(18)
    method = Galerkin(workshop, basis)
    for load, _ in queries:
        q = Projected(workshop.model, basis, workshop.load_vector(load)).solve()
        answer = method.solve(Case.of(workshop, load))
        assert answer.converged
        assert np.linalg.norm(answer.state[:18] - q) <= CLOSE * np.linalg.norm(q)


def test_answers_do_not_depend_on_what_was_asked_before(workshop, training, queries):
    method = Galerkin(workshop, training.pod(10))
    first, second = (Case.of(workshop, load) for load, _ in queries[:2])
    once = method.solve(first).state
    method.solve(second)
    np.testing.assert_array_equal(method.solve(first).state, once)


def test_a_small_load_is_answered_linearly(workshop, training, queries):
    model, basis, load = workshop.model, training.pod(10), queries[0][0]
    soft = Load(load.position, load.direction, 1e-4 * load.pressure)
    answer = Galerkin(workshop, basis).solve(Case.of(workshop, soft))
    q = basis.T @ workshop.load_vector(soft).ravel()[model.free]
    assert np.linalg.norm(answer.state[:10] - q) <= 1e-3 * np.linalg.norm(q)


def test_the_first_ritz_vector_is_exact_in_the_limit_of_small_loads(workshop, training, queries):
    method, load, errors = build("ritz-at-hand", 1, training), queries[0][0], []
    for fraction in (0.04, 0.02):
        soft = Load(load.position, load.direction, fraction * load.pressure)
        exact = workshop.solve(soft).displacement
        errors.append(
            relative(method.displacement(method.solve(Case.of(workshop, soft)).state), exact)
        )
    assert errors[0] < 0.02
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.1)


def test_a_basis_at_hand_may_come_smaller_than_the_last(workshop, training, queries):
    cases = [Case.of(workshop, load) for load, _ in queries[:2]]
    bases = iter([training.pod(11), training.pod(3)])
    method = GalerkinAtHand(workshop, 11, lambda case: next(bases))
    method.solve(cases[0])
    found = method.solve(cases[1]).state[1]
    expected = Galerkin(workshop, training.pod(3)).solve(cases[1]).state
    np.testing.assert_allclose(found, expected[:3], rtol=1e-6)


def test_no_load_moves_nothing(workshop, queries):
    load = queries[0][0]
    case = Case.of(workshop, Load(load.position, load.direction, 0.0))
    method = GalerkinAtHand(workshop, 4, lambda case: pytest.fail("not needed"))
    answer = method.solve(case)
    assert answer.converged
    assert not method.displacement(answer.state).any()


def test_points_that_share_a_dilatation_are_refused(workshop):
    other = FullModel(workshop.mesh, "hex8-mean-dilatation", workshop.scene.tissue)
    with pytest.raises(ValueError, match="dilatation"):
        Galerkin(SimpleNamespace(model=other), np.zeros((len(other.free), 4)))
