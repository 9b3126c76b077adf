"""Every law: stress and tangent are derivatives of the energy, and the limits are right."""

import math
from typing import get_args

import numpy as np
import pytest

from palpate.shared.mechanics import laws, tissue
from palpate.shared.mechanics.tensors import isochoric
from palpate.shared.reduced.points import LANES, STATE, increments, linearise, nonlinear_stress

from .differences import central_difference
from .material_point import TISSUES, deformation, law_of, stress, tangent


@pytest.fixture(params=TISSUES)
def law(request):
    return law_of(request.param)


@pytest.fixture(params=range(5))
def F(request):
    return deformation(np.random.default_rng(request.param))


def rotation(rng):
    Q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    return Q * np.linalg.det(Q)


def test_every_law_of_the_table_has_a_scene_to_test_it_by():
    assert {type(own) for own in TISSUES.values()} == set(get_args(laws.AnyTissue))


def test_stress_is_the_derivative_of_the_energy(law, F):
    P = stress(law, F)[1]
    difference = central_difference(lambda G: np.array(stress(law, G)[0]), F)
    assert np.abs(difference - P.ravel()).max() <= 1e-7 * np.abs(P).max()


def test_tangent_is_the_derivative_of_the_stress(law, F):
    A = tangent(law, F)
    difference = central_difference(lambda G: stress(law, G)[1].ravel(), F)
    assert np.abs(difference - A).max() <= 1e-7 * np.abs(A).max()


def test_tangent_is_symmetric(law, F):
    A = tangent(law, F)
    assert np.abs(A - A.T).max() <= 1e-14 * np.abs(A).max()


def test_rest_is_free_of_stress_and_energy(law):
    W, P = stress(law, np.eye(3))
    assert abs(W) <= 1e-15 * law.mu
    assert np.abs(P).max() <= 1e-15 * law.lam


def test_rigid_rotation_is_free_of_stress_and_energy(law, rng):
    for _ in range(5):
        W, P = stress(law, rotation(rng))
        assert abs(W) <= 1e-12
        assert np.abs(P).max() <= 1e-12 * (law.mu + law.lam)


def test_law_is_objective_and_isotropic(law, F, rng):
    W, P = stress(law, F)
    Q, R = rotation(rng), rotation(rng)
    turned, P_turned = stress(law, Q @ F @ R)
    assert turned == pytest.approx(W, rel=1e-12)
    np.testing.assert_allclose(P_turned, Q @ P @ R, rtol=0, atol=1e-12 * np.abs(P).max())


def test_small_strain_is_hooke(law, rng):
    gradient = rng.standard_normal((3, 3))
    strain = (gradient + gradient.T) / 2
    hooke = 2 * law.mu * strain + law.lam * np.trace(strain) * np.eye(3)
    for size in (1e-4, 1e-6):
        P = stress(law, np.eye(3) + size * gradient)[1] / size
        assert np.abs(P - hooke).max() < 100 * size * np.abs(hooke).max()


def test_young_and_poisson_are_those_at_rest(law):
    own = next(own for own in TISSUES.values() if own.parameters is type(law))
    young = law.mu * (3 * law.lam + 2 * law.mu) / (law.lam + law.mu)
    assert (young, law.lam / (2 * (law.lam + law.mu))) == pytest.approx((own.young, own.poisson))


def test_rest_stress_is_the_tangent_at_rest(law, rng):
    H = rng.standard_normal(9)
    W, P = tissue.rest_stress(tuple(H), law.mu, law.lam)
    expected = tangent(law, np.eye(3)) @ H
    np.testing.assert_allclose(P, expected, rtol=1e-12)
    assert pytest.approx(expected @ H / 2, rel=1e-12) == W


def test_loops_over_many_points_are_the_law_at_each(law, rng):
    count, modes = 2 * LANES, 4
    many = type(law)(*(np.full(count, value) for value in law))
    H, gradients = rng.uniform(-0.2, 0.2, (count, 9)), rng.standard_normal((modes, count, 9))

    def tiles(T):
        tiled = T.reshape(*T.shape[:-2], -1, LANES, 9).swapaxes(-1, -2)
        return np.ascontiguousarray(tiled.reshape(*T.shape[:-2], -1), dtype=np.float32)

    weights, (J, part, linear) = rng.uniform(0.5, 1.0, count), np.empty((3, count))
    P, state = np.empty(9 * count, np.float32), np.empty(STATE * count, np.float32)
    increased = np.empty((modes, 9 * count), np.float32)
    nonlinear_stress(tiles(H), weights, many, J, part, linear, P)
    linearise(tiles(H), weights, many, state)
    increments(many, state, tiles(gradients), increased)
    F, rest = np.eye(3) + H.reshape(-1, 3, 3), tangent(law, np.eye(3))
    found = [law.energy(*pair) for pair in zip(J, part, strict=True)]
    np.testing.assert_allclose(found, [stress(law, f)[0] for f in F], rtol=1e-5)
    expected = [stress(law, f)[1].ravel() - rest @ (f - np.eye(3)).ravel() for f in F]
    expected = tiles(weights[:, None] * expected)
    np.testing.assert_allclose(P, expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    A = np.array([w * (tangent(law, f) - rest) for w, f in zip(weights, F, strict=True)])
    expected = tiles(np.einsum("cij,mcj->mci", A, gradients))
    np.testing.assert_allclose(increased, expected, rtol=0, atol=3e-6 * np.abs(expected).max())


def test_von_mises_against_the_textbook(law, F):
    cauchy = stress(law, F)[1] @ F.T / np.linalg.det(F)
    deviator = cauchy - np.trace(cauchy) / 3 * np.eye(3)
    expected = math.sqrt(1.5 * np.sum(deviator**2))
    assert laws.von_mises(law, tuple(F.ravel())) == pytest.approx(expected, rel=1e-12)


def test_von_mises_of_uniaxial_stress_is_that_stress(law):
    along, across = 1.3, 0.9
    F = np.diag([across, across, along])
    P = stress(law, F)[1]
    expected = abs(P[2, 2] / across**2 - P[0, 0] / (across * along))
    assert laws.von_mises(law, tuple(F.ravel())) == pytest.approx(expected)


def test_the_isochoric_factor_is_exact_to_round_off(rng):
    for J in np.exp(rng.uniform(-15, 15, 1000)):
        assert isochoric(J) == pytest.approx(np.cbrt(J) ** -2, rel=2e-15, abs=0)
