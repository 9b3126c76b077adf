"""The visco-elastic law: an exact recurrence, a potential, limits, and no energy out of nothing.

What the law should give is computed from Simo's own form, a convolution of the isochoric stress of
the modified Neo-Hookean law, in which the tensors of the implementation do not appear.
"""

import numpy as np
import pytest

from palpate.shared.mechanics import viscosity
from palpate.shared.mechanics.tensors import unpacked

from ..energies import advance, past_energy_and_power
from . import material_point
from .material_point import central_difference, law_of, rotation, stress

LAW = law_of("neo-hookean")
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
    A = material_point.tangent(LAW, F)
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
    return stress(LAW, F)[1]


def deformation(rng):
    return material_point.deformation(rng, size=0.35, least=0.4)


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


@pytest.mark.parametrize("seed", [0, 1, 5])
def test_stress_converges_to_that_of_simos_convolution_with_second_order(seed):
    path = smooth_path(np.random.default_rng(seed))
    fine = 20_000
    expected = by_simo([path(t) for t in np.linspace(0, 0.4, fine + 1)], 0.4 / fine)
    errors = [np.abs(after(path, steps) - expected).max() for steps in (20, 40, 80, 2000)]
    assert errors[-1] <= 1e-5 * np.abs(expected).max()
    orders = np.log2(np.divide(errors[:2], errors[1:3]))
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


def test_instant_loading_is_elastic_and_infinitely_slow_loading_leaves_what_does_not_relax(rng):
    F = deformation(rng)
    np.testing.assert_array_equal(go(rest(), F, GLASSY)[1], elastic(F))
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
        expected = *stress(LAW, F), material_point.tangent(LAW, F)
        for one, other in zip(
            (W, P, tangent(F, predicted(history, dt, ()))), expected, strict=True
        ):
            np.testing.assert_array_equal(one, other)


def test_law_is_objective(rng, state):
    F, B = state
    Q = rotation(rng)
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


def test_steps_of_any_length_have_weights_that_sum_to_one_and_time_does_not_run_backwards():
    for dt in (0.0, 1e-12, 1e-7, 1e-5, 0.1, 1e6, np.inf):
        w = viscosity.step_weights(PRONY, dt)
        np.testing.assert_allclose(w.decay + w.old + w.new, 1.0, rtol=1e-15)
        assert np.all(w.old >= 0)
        assert np.all(w.new >= 0)
        assert np.all(np.isfinite(w.decay + w.old + w.new))
    for dt in (-1e-9, np.nan):
        with pytest.raises(ValueError, match="dt: must be >= 0 s"):
            viscosity.step_weights(PRONY, dt)
