"""The full model in time: what the past does to a whole body."""

import itertools

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import root

from palpate.shared.mechanics.tissue import lame

from .bodies import ELEMENTS, POISSON, YOUNG, body

PRONY = ((0.3, 0.1), (0.2, 1.0))
SHARE, TAU = np.array(PRONY).T


def small_body(element, divisions=(2, 2, 2), size=(3.0, 3.0, 3.0), prony=PRONY):
    return body(element, divisions, size, prony=prony)


def top_load(model, force):
    """Force (3,) mN spread over the top, not evenly."""
    nodes = model.mesh.nodes
    share = np.where(nodes[:, 2] == nodes[:, 2].max(), 1 + nodes[:, 0], 0.0)
    return np.outer(share / share.sum(), force)


@pytest.mark.parametrize("element", ELEMENTS)
def test_sudden_and_infinitely_slow_loads_meet_elastic_tissue_that_knows_no_time(element):
    model = small_body(element)
    load = top_load(model, [3.0, 0.0, -10.0])
    sudden = model.solve(load, model.at_rest, 0.0)
    instant = model.solve(load)
    np.testing.assert_array_equal(sudden.displacement, instant.displacement)
    elastic = small_body(element, prony=())
    after = elastic.solve(load, elastic.at_rest, 5.0)
    np.testing.assert_array_equal(after.displacement, instant.displacement)
    slow = model.solve(load, dt=np.inf)
    relaxed = model.relaxed.solve(load)
    np.testing.assert_allclose(slow.displacement, relaxed.displacement, atol=1e-8)
    assert np.abs(slow.displacement).max() > 1.3 * np.abs(instant.displacement).max()


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
    model = small_body("hex8", divisions=(1, 1, 1), size=(2.0, 3.0, 2.5))
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
    model = small_body("hex20")
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
