"""The full model in time: what the past does to a whole body."""

import itertools

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import root

from palpate.offline.fem.mesh import build_mesh
from palpate.offline.fem.model import FullModel
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.reduce.load_range import load_range
from palpate.offline.scenes import find_scene
from palpate.shared.mechanics.neo_hookean import NeoHookeanTissue
from palpate.shared.mechanics.tissue import lame
from palpate.shared.mechanics.viscosity import step_weights

from ...shared.energies import advance, past_energy_and_power

YOUNG, POISSON = 15.0, 0.45
PRONY = ((0.3, 0.1), (0.2, 1.0))
SHARE, TAU = np.array(PRONY).T
ELEMENTS = ("hex8", "hex8-mean-dilatation", "hex8-fbar", "hex20")
TOP = np.array([5.0, 5.0, 8.0])


def body(element, divisions=(2, 2, 2), size=(3.0, 3.0, 3.0), prony=PRONY):
    scene = find_scene("quick")
    geometry = scene.geometry.model_copy(
        update={"element": element, "divisions": divisions, "size": size}
    )
    mesh = build_mesh(scene.model_copy(update={"geometry": geometry}))
    tissue = NeoHookeanTissue(law="neo-hookean", young=YOUNG, poisson=POISSON, prony=prony)
    return FullModel(mesh, element, tissue)


def top_load(model, force):
    """Force (3,) mN spread over the top, not evenly."""
    nodes = model.mesh.nodes
    top = nodes[:, 2] == nodes[:, 2].max()
    load = np.zeros_like(nodes)
    load[top] = np.outer(1 + nodes[top, 0], force) / np.sum(1 + nodes[top, 0])
    return load


@pytest.fixture(scope="module")
def problem():
    return FullProblem(find_scene("quick-visco"))


@pytest.fixture(params=ELEMENTS)
def element(request):
    return request.param


def test_tangent_of_relaxed_tissue_is_the_derivative_of_its_force(element, rng):
    model = body(element).relaxed
    u = 0.1 * rng.standard_normal(len(model.free))
    v = rng.standard_normal(len(model.free))
    full = np.zeros(3 * len(model.mesh.nodes))
    full[model.free] = u
    exact = model.stiffness(full) @ v
    h = 1e-5
    difference = (model.internal_free(u + h * v) - model.internal_free(u - h * v)) / (2 * h)
    np.testing.assert_allclose(difference, exact, rtol=0, atol=1e-6 * np.abs(exact).max())


def test_sudden_and_infinitely_slow_loads_meet_elastic_tissue(element):
    model = body(element)
    load = top_load(model, [3.0, 0.0, -10.0])
    sudden = model.solve(load, model.at_rest, 0.0)
    instant = model.solve(load)
    np.testing.assert_array_equal(sudden.displacement, instant.displacement)
    slow = model.solve(load, dt=np.inf)
    relaxed = model.relaxed.solve(load)
    np.testing.assert_allclose(slow.displacement, relaxed.displacement, atol=1e-8)
    assert np.abs(slow.displacement).max() > 1.3 * np.abs(instant.displacement).max()


def test_without_terms_time_changes_nothing(element):
    model = body(element, prony=())
    past = model.at_rest
    for force, dt in (([0.0, 0.0, -9.0], 0.1), ([4.0, 0.0, -3.0], 0.0), ([1.0, 0.0, 2.0], 5.0)):
        load = top_load(model, force)
        expected = model.solve(load, start=past.displacement)
        found = model.solve(load, past, dt)
        past = found.past
        np.testing.assert_array_equal(found.displacement, expected.displacement)


def creep_of_one_element(nodes, load, times):
    """Displacement (8, 3) of the unit of independent code: trilinear element, Simo's stress.

    Of each point the state is the mean of S0 over the past, of each term; time is integrated by an
    adaptive Runge-Kutta method.
    """
    mu, lam = lame(YOUNG, POISSON)
    at = np.array(list(itertools.product((-1, 1), repeat=3))) / np.sqrt(3)
    middle, half = nodes.mean(axis=0), np.ptp(nodes, axis=0) / 2
    corner = np.sign(nodes - middle)
    N = 1 + at[:, None] * corner  # (q, node, axis)
    grad = np.stack(
        [corner[:, i] * np.delete(N, i, axis=2).prod(axis=2) / 8 / half[i] for i in range(3)], -1
    )
    weight = half.prod()
    free = np.flatnonzero(nodes[:, 2] > 0)

    def deform(x):
        u = np.zeros((8, 3))
        u[free] = x.reshape(-1, 3)
        return np.eye(3) + np.einsum("ni,qnj->qij", u, grad)

    def deviator(A, C):
        return A - np.einsum("qij,qij->q", C, A)[:, None, None] / 3 * np.linalg.inv(C)

    def driving(F):
        C = np.swapaxes(F, 1, 2) @ F
        return mu * deviator(np.broadcast_to(np.eye(3), C.shape), C)

    def residual(x, past):
        F = deform(x)
        C, J = np.swapaxes(F, 1, 2) @ F, np.linalg.det(F)[:, None, None]
        T = np.swapaxes(np.linalg.inv(F), 1, 2)
        S = -np.einsum("a,aqij->qij", SHARE, past)
        P = mu * (F - T) + lam / 2 * (J**2 - 1) * T + F @ (J ** (-2 / 3) * deviator(S, C))
        force = weight * np.einsum("qij,qnj->ni", P, grad)
        return (force[free] - load[free]).ravel()

    guess = np.zeros(3 * len(free))

    def solve(past):
        found = root(residual, guess, args=(past.reshape(2, 8, 3, 3),), tol=1e-12)
        guess[:] = found.x
        return found.x

    def rate(_, past):
        now = driving(deform(solve(past)))
        return ((now - past.reshape(2, 8, 3, 3)) / TAU[:, None, None, None]).ravel()

    past = solve_ivp(rate, (0, times[-1]), np.zeros(144), rtol=1e-6, atol=1e-7, t_eval=times).y.T
    return np.array([solve(p).reshape(-1, 3) for p in past])


def test_creep_of_one_element_against_independent_integration():
    model = body("hex8", divisions=(1, 1, 1), size=(2.0, 3.0, 2.5))
    load = top_load(model, [6.0, -3.0, -12.0])
    times = np.linspace(0, 1.0, 5)
    expected = creep_of_one_element(model.mesh.nodes, load, times)
    found = model.solve(load, model.at_rest)
    shown, steps = [found.displacement], 100
    for step in range(1, steps + 1):
        found = model.solve(load, found.past, times[-1] / steps)
        if step % (steps // 4) == 0:
            shown.append(found.displacement)
    top = model.mesh.nodes[:, 2] > 0
    np.testing.assert_allclose(np.array(shown)[:, top], expected, atol=1e-4 * np.ptp(expected))
    assert np.abs(shown[-1]).max() > 1.3 * np.abs(shown[0]).max() > 0.2


def test_convergence_in_the_step_is_of_second_order():
    model = body("hex20")
    load = top_load(model, [3.0, 0.0, -10.0])

    def after(steps):
        past = model.at_rest
        for share in np.linspace(0, 1, steps + 1)[1:]:
            past = model.solve(np.sin(4 * share) * load, past, 0.3 / steps).past
        return past.displacement

    exact = after(128)
    errors = [np.linalg.norm(after(steps) - exact) for steps in (4, 8, 16)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all(np.abs(orders - 2.0) < 0.3), orders


def test_stored_energy_returns_to_zero_and_dissipation_is_never_negative():
    """Over 50 random histories of a small body, with sudden and slow changes of its load."""
    model, rng = body("hex8", divisions=(3, 3, 3)), np.random.default_rng(4)
    mu, scale, force = model.law.mu[0], 0.0, np.zeros(model.mesh.nodes.size)

    def step(past, means, load, dt):
        """Go on; return the past, the stored energy and the dissipated power."""
        past = model.solve(load, past, dt).past
        moved = past.displacement[model.connectivity]
        F = np.eye(3) + np.einsum("eai,eqaj->eqij", moved, model.gradients)
        advance(F, step_weights(PRONY, dt), means)
        extra, power = past_energy_and_power(F, means, PRONY, mu)
        elastic, _ = model.internal(past.displacement.reshape(-1), force)
        return past, elastic + np.sum(model.weights * extra), np.sum(model.weights * power)

    for _ in range(50):
        past, means = model.at_rest, np.zeros((3, *model.weights.shape, 7))
        for _ in range(4):
            load = top_load(model, rng.uniform([-4, -4, -12], [4, 4, 6]))
            past, stored, power = step(past, means, load, 10 ** rng.uniform(-2, 0.5))
            scale = max(scale, power)
            assert power >= -1e-12 * scale
        for dt in (0.0, 0.01, 1.0, *[5.0] * 10):
            past, left, power = step(past, means, np.zeros_like(load), dt)
            assert power >= -1e-12 * scale
        assert abs(left) <= 1e-8 * stored
    assert scale > 1.0


def test_limits_are_those_of_a_load_that_stays(problem):
    fields = load_range(problem, TOP)
    model = problem.model
    load = problem.load_vector(Load(TOP, np.array([0.0, 0.0, -1.0]), fields[0]))
    moved = np.linalg.norm(model.relaxed.solve(load).displacement, axis=1).max()
    assert moved == pytest.approx(0.15 * 8.0, rel=0.03)
