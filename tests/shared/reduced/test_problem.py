"""A local model with every quadrature point is the Galerkin model; with all modes, the full one."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from numba import njit

from palpate.offline.fem.mesh import build_mesh
from palpate.offline.fem.model import FullModel
from palpate.offline.fem.potential import Potential
from palpate.offline.fem.terms import DeadLoad, PastStress, TipContact, TipLoad, advanced
from palpate.offline.scenes import find_scene
from palpate.shared.compiled import bind, room
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.sphere import BLOCK, tip_of, tip_surface
from palpate.shared.mechanics.viscosity import step_weights
from palpate.shared.reduced import contact_search, press
from palpate.shared.reduced.corrections import Secants, Tangent, TangentWork, forget_secants
from palpate.shared.reduced.past import KNOTS, Elastic, opened, recall_points, remembering
from palpate.shared.reduced.points import LANES, STATE, Points
from palpate.shared.reduced.problem import Problem, Work, newton_method
from palpate.shared.reduced.terms import Contact, ContactWork, Dead, reaction

from ..mechanics.material_point import TISSUES, central_difference

RADIUS = 2.0
PRONY = ((0.3, 0.05), (0.2, 1.0))

COURSE = ((0.5, 0.02), (1.0, 0.05), (1.0, 0.5), (0.3, 0.0), (0.6, 0.1))
"""Shares of the load, which is a force or the depth of the tip, and time steps (s)."""

FORCE = np.array([60.0, 0.0, -250.0])
"""Of the dead load, mN."""

DEPTH = 0.6
"""Of the tip, mm."""

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
def factorise(problem, q):
    return problem.factorise(q, 0.0)


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
            for own, weights in zip(self.past.time, step_weights(PRONY, dt), strict=True):
                own[:] = weights
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


class Touched(Twins):
    """Under the rigid tip, solved by tangents."""

    search = 0.0, 100, False, contact_search.ROUND_OFF

    def __init__(self, tissue, in_time, modes):
        super().__init__(tissue, in_time, modes)
        mesh, r = self.mesh, modes
        surface = tip_surface(mesh.nodes, mesh.faces, mesh.accessible, RADIUS)
        self.contact = TipContact(self.model, surface, tip_of(RADIUS, tissue.young))
        (faces, k), ends = surface.faces.shape, surface.corner_shape.shape[1]
        sizes = {"nodes": len(mesh.nodes), "f": faces, "k": k, "ends": ends, "block": BLOCK}
        work, self.x, self.factor = room(ContactWork, r=r, **sizes), np.zeros(3), np.zeros((r, r))
        self.latest = work.latest
        self.load = bind(
            Contact(
                tip=self.contact.tip,
                surface=surface,
                x=self.x,
                nodes=np.arange(len(mesh.nodes), dtype=np.int32),
                modes=self.nodal.reshape(-1, 3, r),
                faces=np.arange(faces, dtype=np.int32),
                corners=surface.faces,
                work=work,
            )
        )
        work = room(TangentWork, r=r, state=STATE, tangent_points=self.count)
        work.units[:] = np.tile(np.eye(9).repeat(LANES, 1), self.count // LANES)
        self.correction = bind(
            Tangent(
                points=self.points,
                bulk=np.zeros((r, r)),
                formed=np.full((3, r), np.inf),
                lag=0.0,
                factor=self.factor,
                work=work,
            )
        )

    def place(self, share):
        """Centre of the tip (3,) mm."""
        return self.mesh.nodes.max(axis=0) * [0.42, 0.55, 1.0] + [0, 0, RADIUS - share * DEPTH]

    def apply(self, share):
        self.x[:] = self.place(share)
        self.latest[:] = np.inf

    def full_load(self, share):
        return TipLoad(self.contact, self.place(share), np.array([0.0, 0.0, -share * DEPTH]))

    def reaction(self, problem):
        """Force on the tool (3,) mN and its derivative (3, 3) mN/mm."""
        assert factorise(problem, self.q)
        force, tangent = np.zeros(3), np.zeros((3, 3))
        coupling, slope = np.zeros((2, 3, len(self.q)))
        reaction(self.load, self.factor, coupling, slope, force, tangent)
        return force, tangent

    def galerkin_reaction(self, full, share):
        """The same by the full model's tangent in the modes."""
        K = self.B.T @ (full.stiffness(self.B @ self.q) @ self.B)
        in_modes = SimpleNamespace(
            free=full.free,
            factorise=lambda u, shift: None,
            solve=lambda loads: self.B @ np.linalg.solve(K, self.B.T @ loads),
        )
        return self.full_load(share).reaction(in_modes, self.displacement.ravel().astype(float))


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
    """Of energy, force and reaction in and off equilibrium, along a course."""
    twins = kind(TISSUES[law], in_time, modes)
    B, q, residual, force = twins.B, twins.q, np.zeros(modes), np.zeros(len(twins.B))
    for share, dt in COURSE:
        problem = twins.solve(share, dt)
        away = q + 0.05 * np.linalg.norm(q) * rng.standard_normal(modes) / np.sqrt(modes)
        energy = -potential(problem, q, residual)[0]
        energy += potential(problem, away, residual)[0]
        full = twins.full(share, dt)
        expected = -full.potential(B @ q, force)[0]
        assert np.linalg.norm(B.T @ force) <= 2 * TARGET
        expected += full.potential(B @ away, force)[0]
        assert_close(residual, B.T @ force)
        assert energy == pytest.approx(expected, rel=2e-4)
        if isinstance(twins, Touched):
            found = twins.reaction(problem)
            for one, other in zip(found, twins.galerkin_reaction(full, share), strict=False):
                assert_close(one, other)
        if modes == len(B):
            answer = twins.full_answer(share, dt)
            assert_close(twins.displacement, answer.displacement)
            if isinstance(twins, Touched):
                assert_close(found[0], answer.force)
                assert_close(found[1], answer.tangent)
        twins.remember(dt)


def test_residual_and_tangent_are_derivatives(rng):
    """With a past, and with the tip off the tissue: contact is stiffer than differences can see."""
    twins = Touched(TISSUES["neo-hookean"], True, 24)
    twins.solve(*COURSE[0])
    twins.remember(COURSE[0][1])
    problem, residual = twins.solve(-1.0, 0.1), np.empty(24)
    q = rng.standard_normal(24)

    def gradient(at):
        potential(problem, at, residual)
        return residual.copy()

    slopes = central_difference(
        lambda at: np.array(potential(problem, at, residual)[0]), q, step=2e-2
    )
    assert_close(slopes, gradient(q), 1e-4)
    assert factorise(problem, q)
    L = np.tril(twins.factor)
    assert_close(central_difference(gradient, q, step=2e-2), L @ L.T, 1e-4)


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
