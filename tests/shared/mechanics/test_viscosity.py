"""The visco-elastic law: an exact recurrence, a potential, limits, and no energy out of nothing.

What the law should give is computed from Simo's own form, a convolution of the isochoric stress of
the modified Neo-Hookean law, in which the tensors of the implementation do not appear.
"""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from palpate.shared.mechanics import laws, tissue, viscosity
from palpate.shared.mechanics.neo_hookean import NeoHookean
from palpate.shared.mechanics.tensors import unpacked

from ..energies import advance, past_energy_and_power
from .differences import central_difference

LAW = NeoHookean(*tissue.lame(15.0, 0.45))
MU = LAW.mu
PRONY = ((0.3, 0.1), (0.2, 1.0))
SHARE, TAU = np.array(PRONY).T
GLASSY = 0.0
RELAXED = np.inf


def rest(terms=2):
    return np.zeros((terms + 1, 7))


def predicted(history, dt, prony=PRONY):
    """``B``, packed, and the same of the means of ``c``: (7,)."""
    B = np.empty(7)
    loss = viscosity.predict(history, viscosity.step_weights(prony, dt), B)
    B[[0, 1, 2, 6]] -= loss
    return B


def answer(F, B):
    """Energy density and stress (3, 3) at a deformation gradient (3, 3)."""
    J, square, P = LAW.first_piola(tuple(F.ravel()))
    modulus = MU * J ** (-2 / 3)
    contraction, Q = viscosity.overstress(tuple(F.ravel()), unpacked(B), J, modulus)
    W = LAW.energy(J, square) + (modulus * contraction - 3 * MU * B[6]) / 2
    return W, np.reshape(np.add(P, Q), (3, 3))


def tangent(F, B):
    A = np.empty((9, 9))
    laws.tangent(LAW, tuple(F.ravel()), A)
    viscosity.add_tangent(tuple(F.ravel()), unpacked(B), MU, A)
    return A


def go(history, F, dt, prony=PRONY):
    """Advance a history in place to F; return energy density and stress there."""
    B = predicted(history, dt, prony)
    advance(F, viscosity.step_weights(prony, dt), history)
    return answer(F, B)


def elastic_isochoric(F):
    """Stress of the modified Neo-Hookean law's isochoric part."""
    C, J = F.T @ F, np.linalg.det(F)
    return MU * J ** (-2 / 3) * (F - np.trace(C) / 3 * np.linalg.inv(F).T)


def elastic(F):
    return np.reshape(LAW.first_piola(tuple(F.ravel()))[2], (3, 3))


def deformation(rng, size=0.35):
    while True:
        F = np.eye(3) + rng.uniform(-size, size, (3, 3))
        if np.linalg.det(F) > 0.4:
            return F


def by_simo(deformations, dt):
    """Stress after a history in equal fine steps, by Simo's convolution of S0 = mu DEV[I]."""
    F = deformations[-1]
    J = np.linalg.det(F)

    def deviator(A, C):
        return A - np.sum(C * A) / 3 * np.linalg.inv(C)

    driving = np.array([MU * deviator(np.eye(3), G.T @ G) for G in deformations])
    ages = dt * np.arange(len(deformations))[::-1]
    change = np.diff(driving, axis=0)
    S = np.zeros((3, 3))
    for g, tau in PRONY:
        kernel = np.exp(-(ages[1:] + ages[:-1]) / 2 / tau)
        kept = np.einsum("t,tij->ij", kernel, change)
        S += g * (kept - driving[-1])
    return elastic(F) + F @ (J ** (-2 / 3) * deviator(S, F.T @ F))


def smooth_path(rng):
    """A deformation gradient as a function of time; the identity and at rest at t = 0."""
    A, B = rng.uniform(-0.25, 0.25, (2, 3, 3))

    def at(t):
        return np.eye(3) + A * np.sin(6 * t) + B * (1 - np.cos(9 * t))

    return at


def after(path, steps, end=0.4):
    history = rest()
    for t in np.linspace(0, end, steps + 1)[1:]:
        _, P = go(history, path(t), end / steps)
    return P


@pytest.mark.parametrize("seed", range(3))
def test_stress_is_that_of_simos_convolution(seed):
    path = smooth_path(np.random.default_rng(seed))
    fine = 20_000
    expected = by_simo([path(t) for t in np.linspace(0, 0.4, fine + 1)], 0.4 / fine)
    P = after(path, 2000)
    assert np.abs(P - expected).max() <= 1e-5 * np.abs(expected).max()


def test_convergence_in_the_step_is_of_second_order():
    path = smooth_path(np.random.default_rng(5))
    exact = after(path, 4000)
    errors = [np.abs(after(path, steps) - exact).max() for steps in (20, 40, 80)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all(np.abs(orders - 2.0) < 0.15), orders


@pytest.mark.parametrize("dt", [1e-3, 0.07, 3.0])
def test_held_deformation_relaxes_as_the_prony_series_says(rng, dt):
    F = deformation(rng)
    history = rest()
    go(history, F, GLASSY)
    for step in range(1, 40):
        _, P = go(history, F, dt)
        lost = np.sum(SHARE * -np.expm1(-step * dt / TAU))
        expected = elastic(F) - lost * elastic_isochoric(F)
        assert np.abs(P - expected).max() <= 1e-12 * np.abs(expected).max()


def uniaxial(history, stretch, dt):
    """Stress along the axis of a bar with free sides, and its thickness; history not advanced."""
    B, thickness = predicted(history, dt), 1 / np.sqrt(stretch)
    for _ in range(50):
        F = np.diag([thickness, thickness, stretch])
        P, A = answer(F, B)[1], tangent(F, B)
        if abs(P[0, 0]) < 1e-13 * MU:
            return P[2, 2], thickness
        thickness -= P[0, 0] / (A[0, 0] + A[0, 4])
    raise AssertionError("no equilibrium")


def test_creep_of_a_bar_against_independent_integration():
    """Stretch under constant force; the other side integrates rates of Simo's stress in time."""
    force = 3.0

    def stretches(past):  # past: mean of S0 over history, of each term, axis and side
        """Stretch and thickness under the force for S0-means, by Newton on finite differences."""
        x = np.array([1.1, 0.95])
        for _ in range(60):
            r = residual(x, past)
            K = np.column_stack(
                [(residual(x + e, past) - residual(x - e, past)) / 2e-6 for e in 1e-6 * np.eye(2)]
            )
            step = np.linalg.solve(K, r)
            x -= step
            if np.abs(step).max() < 1e-12:
                break
        return x

    def driving(x):
        C = np.array([x[1] ** 2, x[1] ** 2, x[0] ** 2])
        return MU * (1 - C.sum() / 3 / C)

    def residual(x, past):
        f = np.array([x[1], x[1], x[0]])
        C, J = f * f, f.prod()
        S = -SHARE @ past.reshape(-1, 3)
        S = J ** (-2 / 3) * (S - (C @ S) / 3 / C)
        P = np.diag(elastic(np.diag(f))) + f * S
        return np.array([P[2] - force, P[0]])

    def rate(_, past):
        now = driving(stretches(past))
        return ((now - past.reshape(-1, 3)) / TAU[:, None]).ravel()

    end, steps = 2.0, 400
    expected = [
        stretches(past)[0]
        for past in solve_ivp(
            rate, (0, end), np.zeros(3 * len(TAU)), rtol=1e-9, atol=1e-9,
            t_eval=np.linspace(0, end, 5),
        ).y.T
    ]  # fmt: skip
    history, found = rest(), []
    for step in range(steps + 1):
        dt = end / steps if step else GLASSY
        low, high = 0.8, 3.0
        for _ in range(60):  # bisect for the stretch
            stretch = (low + high) / 2
            pull, thickness = uniaxial(history, stretch, dt)
            low, high = (stretch, high) if pull < force else (low, stretch)
        go(history, np.diag([thickness, thickness, stretch]), dt)
        if step % (steps // 4) == 0:
            found.append(stretch)
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert found[-1] - 1 > 1.5 * (found[0] - 1)


@pytest.fixture
def state(rng):
    """A deformation gradient and what a random history predicts for it."""
    history = rest()
    for dt in (0.01, 0.1, 0.3):
        go(history, deformation(rng), dt)
    return deformation(rng), predicted(history, 0.05)


def test_stress_is_the_derivative_of_the_potential(state):
    F, B = state
    P = answer(F, B)[1]
    difference = central_difference(lambda G: np.array(answer(G, B)[0]), F)
    assert np.abs(difference - P.ravel()).max() <= 1e-7 * np.abs(P).max()


def test_tangent_is_the_derivative_of_the_stress(state):
    F, B = state
    A = tangent(F, B)
    difference = central_difference(lambda G: answer(G, B)[1].ravel(), F)
    assert np.abs(difference - A).max() <= 1e-7 * np.abs(A).max()
    assert np.abs(A - A.T).max() <= 1e-14 * np.abs(A).max()


def test_instant_loading_is_elastic(rng):
    F = deformation(rng)
    _, P = go(rest(), F, GLASSY)
    np.testing.assert_array_equal(P, elastic(F))


def test_infinitely_slow_loading_leaves_what_does_not_relax(rng):
    F = deformation(rng)
    expected = elastic(F) - SHARE.sum() * elastic_isochoric(F)
    np.testing.assert_allclose(go(rest(), F, RELAXED)[1], expected, rtol=1e-12)
    history = rest()
    for share in np.linspace(0, 1, 101)[1:]:
        _, P = go(history, np.eye(3) + share * (F - np.eye(3)), 100.0)
    assert np.abs(P - expected).max() <= 5e-3 * np.abs(expected).max()


def test_without_terms_the_law_is_the_elastic_one_to_the_bit(rng):
    history = rest(terms=0)
    for dt in (0.0, 0.01, np.inf):
        F = deformation(rng)
        W, P = go(history, F, dt, prony=())
        J, square, expected = LAW.first_piola(tuple(F.ravel()))
        assert (W, tuple(P.ravel())) == (LAW.energy(J, square), expected)
        A = np.empty((9, 9))
        laws.tangent(LAW, tuple(F.ravel()), A)
        np.testing.assert_array_equal(tangent(F, predicted(history, dt, prony=())), A)


def test_law_is_objective(rng, state):
    F, B = state
    Q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    Q *= np.linalg.det(Q)
    (W, P), (W_turned, P_turned) = answer(F, B), answer(Q @ F, B)
    assert W_turned == pytest.approx(W, rel=1e-12)
    np.testing.assert_allclose(P_turned, Q @ P, rtol=0, atol=1e-12 * np.abs(P).max())


def random_history(rng, count=15):
    """Deformation gradients and the times to reach them, from far below to far above tau."""
    F = np.eye(3)
    for _ in range(count):
        jump = rng.random() < 0.3
        F = deformation(rng) if jump else F + 0.2 * (deformation(rng) - F)
        yield F, 10 ** rng.uniform(-3, 1)


def test_dissipation_is_never_negative_over_random_histories():
    rng = np.random.default_rng(11)
    smallest, largest = np.inf, 0.0
    for _ in range(1000):
        history = rest()
        for F, dt in random_history(rng):
            go(history, F, dt)
            power = past_energy_and_power(F, history, PRONY, MU)[1]
            smallest, largest = min(smallest, power), max(largest, power)
    assert smallest >= -1e-12 * largest
    assert largest > 0.0


def energy_balance(path, end, steps):
    """Work done along a path, and stored plus dissipated energy; trapezoidal rule."""
    history, F = rest(), path(0.0)
    work = lost = 0.0
    P, power = elastic(F), 0.0
    for t in np.linspace(0, end, steps + 1)[1:]:
        G = path(t)
        W, Q = go(history, G, end / steps)
        work += np.sum((P + Q) / 2 * (G - F))
        now = past_energy_and_power(G, history, PRONY, MU)[1]
        lost += (power + now) / 2 * end / steps
        F, P, power = G, Q, now
    return work, W + lost, lost


def test_work_is_stored_or_dissipated():
    path = smooth_path(np.random.default_rng(3))
    errors = []
    for steps in (200, 400):
        work, accounted, lost = energy_balance(path, 0.7, steps)
        errors.append(abs(work - accounted))
    assert lost > 0.05 * work
    assert errors[1] <= 1e-4 * work
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


def test_stored_energy_returns_to_zero_after_release_and_rest(rng):
    history = rest()
    for F, dt in random_history(rng):
        go(history, F, dt)
    stored = [go(history, np.eye(3), 0.5)[0] for _ in range(60)]
    assert stored[0] > 1e-4
    assert np.all(np.diff(stored) <= 0)
    assert stored[-1] >= -1e-14
    assert stored[-1] <= 1e-12


def test_steps_of_any_length_have_weights_that_sum_to_one():
    for dt in (0.0, 1e-12, 1e-7, 1e-5, 0.1, 1e6, np.inf):
        w = viscosity.step_weights(PRONY, dt)
        np.testing.assert_allclose(w.decay + w.old + w.new, 1.0, rtol=1e-15)
        assert np.all(w.old >= 0)
        assert np.all(w.new >= 0)
        assert np.all(np.isfinite(w.decay + w.old + w.new))


@pytest.mark.parametrize("dt", [-1e-9, np.nan])
def test_time_does_not_run_backwards(dt):
    with pytest.raises(ValueError, match="dt: must be >= 0 s"):
        viscosity.step_weights(PRONY, dt)
