"""The tissue law: stress and tangent are derivatives of the energy, and the limits are right."""

import math

import numpy as np
import pytest

from palpate.shared.mechanics import tissue

from .differences import central_difference

MU, LAM = tissue.lame(15.0, 0.45)


def stress(F):
    """Energy density and stress (3, 3) of a deformation gradient (3, 3)."""
    J, square, P = tissue.first_piola(tuple(F.ravel()), MU, LAM)
    return tissue.energy(J, square, MU, LAM), np.reshape(P, (3, 3))


def tangent(F):
    """Material tangent (9, 9)."""
    A = np.empty((9, 9))
    tissue.tangent(tuple(F.ravel()), MU, LAM, A)
    return A


def rotation(rng):
    Q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    return Q * np.linalg.det(Q)


@pytest.fixture(params=range(5))
def F(request):
    """Deformations of 40 % in each component, det F > 0."""
    rng = np.random.default_rng(request.param)
    while True:
        F = np.eye(3) + rng.uniform(-0.4, 0.4, (3, 3))
        if np.linalg.det(F) > 0.2:
            return F


def test_energy_is_the_formula(F):
    C, J = F.T @ F, np.linalg.det(F)
    expected = MU / 2 * (np.trace(C) - 3 - 2 * math.log(J))
    expected += LAM / 4 * (J**2 - 1 - 2 * math.log(J))
    assert stress(F)[0] == pytest.approx(expected, rel=1e-13)


def test_stress_is_the_derivative_of_the_energy(F):
    P = stress(F)[1]
    difference = central_difference(lambda G: np.array(stress(G)[0]), F)
    assert np.abs(difference - P.ravel()).max() <= 1e-7 * np.abs(P).max()


def test_tangent_is_the_derivative_of_the_stress(F):
    A = tangent(F)
    difference = central_difference(lambda G: stress(G)[1].ravel(), F)
    assert np.abs(difference - A).max() <= 1e-7 * np.abs(A).max()


def test_tangent_is_symmetric(F):
    A = tangent(F)
    assert np.abs(A - A.T).max() <= 1e-14 * np.abs(A).max()


def test_rest_is_free_of_stress_and_energy():
    W, P = stress(np.eye(3))
    assert W == 0.0
    assert not P.any()


def test_rigid_rotation_is_free_of_stress_and_energy(rng):
    for _ in range(5):
        W, P = stress(rotation(rng))
        assert abs(W) <= 1e-12
        assert np.abs(P).max() <= 1e-12 * (MU + LAM)


def test_law_is_objective(F, rng):
    Q = rotation(rng)
    (W, P), (W_turned, P_turned) = stress(F), stress(Q @ F)
    assert W_turned == pytest.approx(W, rel=1e-12)
    np.testing.assert_allclose(P_turned, Q @ P, rtol=0, atol=1e-12 * np.abs(P).max())


def test_small_strain_is_hooke(rng):
    gradient = rng.standard_normal((3, 3))
    strain = (gradient + gradient.T) / 2
    hooke = 2 * MU * strain + LAM * np.trace(strain) * np.eye(3)
    for size in (1e-4, 1e-6):
        P = stress(np.eye(3) + size * gradient)[1] / size
        assert np.abs(P - hooke).max() < 100 * size * np.abs(hooke).max()


def test_lame_parameters_give_back_the_engineering_ones():
    young = MU * (3 * LAM + 2 * MU) / (LAM + MU)
    assert (young, LAM / (2 * (LAM + MU))) == pytest.approx((15.0, 0.45))


def test_rest_stress_is_the_tangent_at_rest(rng):
    H = rng.standard_normal(9)
    W, P = tissue.rest_stress(tuple(H), MU, LAM)
    expected = tangent(np.eye(3)) @ H
    np.testing.assert_allclose(P, expected, rtol=1e-12)
    assert pytest.approx(expected @ H / 2, rel=1e-12) == W


def test_von_mises_against_the_textbook(F):
    P = stress(F)[1]
    J = np.linalg.det(F)
    cauchy = P @ F.T / J
    deviator = cauchy - np.trace(cauchy) / 3 * np.eye(3)
    expected = math.sqrt(1.5 * np.sum(deviator**2))
    assert tissue.von_mises(tuple(F.ravel()), MU, LAM) == pytest.approx(expected, rel=1e-12)


def test_von_mises_of_uniaxial_stress_is_that_stress():
    along, across = 1.3, 0.9
    F = np.diag([across, across, along])
    P = stress(F)[1]
    expected = abs(P[2, 2] / across**2 - P[0, 0] / (across * along))
    assert tissue.von_mises(tuple(F.ravel()), MU, LAM) == pytest.approx(expected)
