"""A local model with every quadrature point is the Galerkin model; with all modes, the full one."""

import itertools

import numpy as np
import pytest
from numba import njit

from palpate.offline.fem.mesh import build_mesh
from palpate.offline.fem.model import FullModel
from palpate.offline.fem.potential import Potential
from palpate.offline.fem.terms import DeadLoad, PastStress, TipLoad, advanced
from palpate.offline.scenes import find_scene
from palpate.shared.compiled import bind, room
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.footprint import MEANS
from palpate.shared.mechanics.tip import tip_of
from palpate.shared.mechanics.viscosity import step_weights
from palpate.shared.reduced import press
from palpate.shared.reduced.corrections import Secants, TouchedSecants, forget_secants
from palpate.shared.reduced.past import KNOTS, Elastic, opened, recall_points, remembering, set_step
from palpate.shared.reduced.points import LANES, Points
from palpate.shared.reduced.problem import Problem, Work, newton_method
from palpate.shared.reduced.terms import Contact, Dead, Pushed

from ..mechanics.material_point import TISSUES, central_difference

RADIUS = 2.0
PRONY = ((0.3, 0.05), (0.2, 1.0))

COURSE = ((0.5, 0.02), (1.0, 0.05), (1.0, 0.5), (0.3, 0.0), (0.6, 0.1))
"""Shares of the load, which is a force or the depth of the tip, and time steps (s)."""

FORCE = np.array([60.0, 0.0, -250.0])
"""Of the dead load, mN."""

DEPTH, NORMAL = 0.6, np.array([0.1, 0.0, np.sqrt(0.99)])
"""Of the tip, mm, and the direction that it pushes against."""

TARGET = 2e-5
"""Residual in equilibrium, in the energy norm, (mN mm)^(1/2); states have norms of 2 to 30."""

ACCURATE = 1e-5
"""Relative error of sums in single precision."""


@njit(cache=True)
def begin(past, mu):
    past.begin_step(mu, 0, 0)


@njit(cache=True)
def end(past, points, work, q):
    past.end_step(points, work, 0, q, True)


@njit(cache=True)
def potential(problem, q, residual):
    return problem.potential(q, residual)


@njit(cache=True)
def correct(problem, residual, step):
    problem.correct(residual, step)


@njit(cache=True)
def recall(past, points, work):
    recall_points(points, work, past, 0)


class Twins:
    """The full model of a block, and a local model of it with every quadrature point."""

    def __init__(self, tissue, in_time, modes):
        scene = find_scene("quick")
        size = {"size": (8.0, 8.0, 6.0), "divisions": (3, 3, 2), "element": "hex8"}
        geometry = scene.geometry.model_copy(update=size)
        self.mesh = mesh = build_mesh(scene.model_copy(update={"geometry": geometry}))
        tissue = tissue.model_copy(update={"prony": PRONY if in_time else ()})
        self.model = model = FullModel(mesh, tissue)
        self.in_time, self.history, self.q = in_time, model.at_rest, np.zeros(modes)
        values, vectors = np.linalg.eigh(model.rest_stiffness.toarray())
        nodal = np.zeros((3 * len(mesh.nodes), modes), np.float32)
        nodal[model.free] = (vectors / np.sqrt(values))[:, :modes]
        self.nodal, self.B = nodal, nodal[model.free].astype(float)
        u = nodal.reshape(-1, 3, modes)[mesh.elements]
        G = np.einsum("eqaj,eair->eqijr", model.gradients, u).reshape(-1, LANES, 9, modes)
        self.count = model.weights.size
        law = model.law.at(np.repeat(np.arange(len(model.weights)), model.weights.shape[1]))
        self.mu = law.mu
        self.points = bind(
            Points(
                gradients=G.transpose(3, 0, 2, 1).reshape(modes, -1).astype(np.float32),
                steps=np.ones(modes, np.float32),
                weights=model.weights.ravel(),
                law=law,
            )
        )
        work = room(Work, r=modes, c=self.count)
        self.state, self.work = work.latest, bind(work)
        self.past = Elastic()
        if in_time:
            D = (self.B.T @ (model.deviatoric_stiffness @ self.B)).astype(np.float32)
            self.past = remembering(D[None], len(PRONY), self.count)
            opened(self.past.records[0], len(PRONY), modes, self.count).share[-1] = 1.0
        self._past = bind(self.past)

    def solve(self, share, dt):
        """Go to equilibrium under a share of the load after a time step; return the problem."""
        if self.in_time:
            set_step(self.past, step_weights(PRONY, dt))
        begin(self._past, self.mu)
        self.apply(share)
        problem = bind(Problem(self.points, self._past, self.load, self.correction, self.work))
        work = np.zeros((4, len(self.q)))
        status, *_ = newton_method(problem, self.q, work, TARGET, *self.search)
        assert status == newton.CONVERGED
        return problem

    def full(self, share, dt):
        """Potential of the full model under the same load, after the same displacements."""
        past = [PastStress(self.model, self.history, step_weights(PRONY, dt))]
        return Potential(self.model, [self.full_load(share), *(past if self.in_time else [])])

    def full_answer(self, share, dt):
        """Equilibrium of the full model under it."""
        return self.model.solve(self.full_load(share), self.history if self.in_time else None, dt)

    @property
    def displacement(self):
        """Of the nodes (n, 3) mm."""
        return (self.nodal @ self.q).reshape(-1, 3)

    def remember(self, dt):
        """Let both models remember this equilibrium."""
        if self.in_time:
            end(self._past, self.points, self.work, self.q)
            weights = step_weights(PRONY, dt)
            self.history = advanced(self.model, self.history, self.displacement, weights)


class Pressed(Twins):
    """Under a dead load, solved by secants."""

    search = np.inf, 400, True, press.ROUND_OFF

    def __init__(self, tissue, in_time, modes):
        super().__init__(tissue, in_time, modes)
        vectors = np.zeros((3, modes))
        self.f, self.external, _ = vectors
        self.inverse, self.origin = np.zeros((modes, modes)), np.zeros((2, modes))
        self.load = bind(Dead(self.f))
        self.correction = bind(Secants(self.inverse, self.origin, self.external, vectors[2]))
        middle = self.mesh.nodes.max(axis=0) * [0.4, 0.6, 1.0]
        near = np.exp(-np.sum((self.mesh.nodes - middle) ** 2, axis=1) / 4)
        self.whole = near[:, None] / near.sum() * FORCE

    def apply(self, share):
        self.f[:] = self.nodal.T @ (share * self.whole).ravel()
        self.external[:] = self.f + (self.past.step.exerted if self.in_time else 0.0)
        forget_secants(self.inverse, self.origin)

    def full_load(self, share):
        return DeadLoad(share * self.whole.ravel())


class Touched(Pressed):
    """Under the rigid tip at a place of the top, solved by secants beside its law."""

    def __init__(self, tissue, in_time, modes):
        super().__init__(tissue, in_time, modes)
        self.tip = tip_of(RADIUS, tissue)
        weights = self.whole @ FORCE
        self.mean = weights / weights.sum()
        self.contact = room(Contact, r=modes)
        self.contact.mean[:] = np.einsum("n,nir->ir", self.mean, self.nodal.reshape(-1, 3, modes))
        self.contact.normal[:] = NORMAL
        self.contact.along[:] = NORMAL @ self.contact.mean
        self.contact.law[:2] = self.tip.local_law(1.0 / RADIUS, np.inf)
        self.steady, answer = np.zeros((2, modes))
        self.load = bind(Pushed(self.contact, np.zeros(modes), self.steady, self.external))
        secants = Secants(self.inverse, self.origin, self.external, np.zeros(modes))
        self.correction = bind(
            TouchedSecants(secants, self.contact.along, self.contact.found, answer)
        )

    def apply(self, share):
        self.contact.law[4] = share * DEPTH
        self.steady[:] = self.past.step.exerted if self.in_time else 0.0
        forget_secants(self.inverse, self.origin)

    def full_load(self, share):
        nodal = np.zeros((MEANS, len(self.mean)))
        nodal[0] = self.mean
        inside = np.array([np.inf, 0.0, 0.0, 0.0])
        law, away = (
            (*self.tip.local_law(1.0 / RADIUS, np.inf), 0.0, 0.0),
            (RADIUS - share * DEPTH) * NORMAL,
        )
        return TipLoad(self.tip, nodal, np.eye(3)[:2], np.zeros((2, 2)), away, NORMAL, law, inside)


def assert_close(found, expected, tolerance=ACCURATE):
    assert np.linalg.norm(found - expected) <= tolerance * np.linalg.norm(expected)


@pytest.mark.parametrize(
    ("kind", "law", "in_time", "modes"),
    [
        *itertools.product((Pressed, Touched), ("neo-hookean",), (False, True), (24, 96)),
        *((Touched, law, True, 24) for law in TISSUES if law != "neo-hookean"),
    ],
)
def test_all_points_make_the_galerkin_model_and_all_modes_the_full_one(
    kind, law, in_time, modes, rng
):
    """Of energy and force in and off equilibrium, along a course."""
    twins = kind(TISSUES[law], in_time, modes)
    B, q, residual, force = twins.B, twins.q, np.zeros(modes), np.zeros(len(twins.B))
    for share, dt in COURSE:
        problem = twins.solve(share, dt)
        away = q + 0.05 * np.linalg.norm(q) * rng.standard_normal(modes) / np.sqrt(modes)
        energy = -potential(problem, q, residual)[0]
        found = twins.contact.found[0] if isinstance(twins, Touched) else 0.0
        energy += potential(problem, away, residual)[0]
        full = twins.full(share, dt)
        expected = -full.potential(B @ q, force)[0]
        assert np.linalg.norm(B.T @ force) <= 2 * TARGET
        expected += full.potential(B @ away, force)[0]
        assert_close(residual, B.T @ force)
        assert energy == pytest.approx(expected, rel=2e-4)
        if modes == len(B):
            answer = twins.full_answer(share, dt)
            assert_close(twins.displacement, answer.displacement, 2 * ACCURATE)
            if isinstance(twins, Touched):
                exact = full.terms[0].touch(answer.displacement.ravel()).force
                assert found == pytest.approx(exact, rel=1e-4)
        twins.remember(dt)


def test_the_residual_is_the_derivative_of_the_energy(rng):
    """With a past, under the tip and off it."""
    for share in (1.0, -1.0):
        twins = Touched(TISSUES["neo-hookean"], True, 24)
        twins.solve(*COURSE[0])
        twins.remember(COURSE[0][1])
        problem, residual = twins.solve(share, 0.1), np.empty(24)
        q = twins.q + 0.1 * rng.standard_normal(24)
        slopes = central_difference(
            lambda at, p=problem, r=residual: np.array(potential(p, at, r)[0]), q, step=2e-2
        )
        potential(problem, q, residual)
        assert_close(slopes, residual, 2e-4)


def test_a_secant_is_what_the_inverse_tangent_answers_from_then_on(rng):
    twins = Pressed(TISSUES["neo-hookean"], False, 24)
    problem, inverse = twins.solve(0.0, 0.0), twins.inverse
    K, load = np.diag(rng.uniform(0.5, 2.0, 24)), rng.standard_normal(24)
    twins.external[:] = load
    forget_secants(inverse, twins.origin)
    states, correction = rng.standard_normal((3, 24)), np.empty(24)
    for state in states:
        twins.state[:] = state
        correct(problem, K @ state - load, correction)
    step = states[-1] - states[-2]
    np.testing.assert_allclose(inverse @ K @ step, step, atol=1e-12)
    np.testing.assert_allclose(inverse, inverse.T, atol=1e-12)
    np.testing.assert_allclose(correction, -inverse @ (K @ states[-1] - load), atol=1e-12)
    assert np.linalg.eigvalsh(inverse)[0] > 0.0


def test_few_knots_keep_the_weight_and_about_the_past_of_a_path():
    twins = Pressed(TISSUES["neo-hookean"], True, 24)
    for number in range(60):
        twins.solve(0.5 + 0.4 * np.sin(0.3 * number), 0.03)
        twins.remember(0.03)
    memory = opened(twins.past.records[0], len(PRONY), 24, twins.count)
    assert len(memory.knots) == KNOTS
    np.testing.assert_allclose(memory.share.sum(axis=0), 1.0, rtol=1e-12)
    assert np.all(memory.share >= 0)
    np.testing.assert_array_equal(memory.knots[-1], memory.q)
    assert_close(memory.share.T @ memory.knots, memory.mean, 0.05)
    exact = memory.points.copy()
    memory.points[:] = np.nan
    recall(twins._past, twins.points, twins.work)
    assert_close(memory.points, exact, 0.02)
