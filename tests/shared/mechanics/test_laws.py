"""Every law: stress and tangent are derivatives of the energy, and the limits are right."""

import math
from typing import get_args

import numpy as np
import pytest
from pydantic import ValidationError

from palpate.shared.mechanics import laws, tissue
from palpate.shared.mechanics.demiray import DemirayTissue
from palpate.shared.mechanics.mooney_rivlin import MooneyRivlinTissue
from palpate.shared.mechanics.tensors import isochoric

from .material_point import (
    TISSUES,
    central_difference,
    deformation,
    law_of,
    rotation,
    stress,
    tangent,
)


@pytest.fixture(params=TISSUES)
def law(request):
    return law_of(request.param)


@pytest.fixture(params=range(5))
def F(request):
    return deformation(np.random.default_rng(request.param))


def test_every_law_of_the_table_has_a_scene_to_test_it_by():
    assert {type(own) for own in TISSUES.values()} == set(get_args(laws.AnyTissue))


def test_the_parts_of_a_law_add_up_and_one_knows_the_volume_alone(law, F):
    whole, compressible, bulk = law.parts()
    assert whole is law
    for of_whole, one, other in zip(*(stress(part, F) for part in law.parts()), strict=True):
        scale = np.abs(of_whole).max()
        np.testing.assert_allclose(np.add(one, other), of_whole, atol=1e-12 * scale)
    assert 0 < compressible.lam <= compressible.mu == law.mu
    P = stress(bulk, F)[1] @ F.T
    np.testing.assert_allclose(P, np.trace(P) / 3 * np.eye(3), atol=1e-10 * np.abs(P).max())


def textbook_energy(own, law, F):
    """Energy density of a tissue, kPa."""
    squares, J = np.linalg.svd(F, compute_uv=False) ** 2, np.linalg.det(F)
    first, second = squares.sum() / J ** (2 / 3), J ** (2 / 3) * (1 / squares).sum()
    volume = J**2 - 1 - 2 * math.log(J)
    if own.law == "neo-hookean":
        return law.mu / 2 * (squares.sum() - 3 - 2 * math.log(J)) + law.lam / 4 * volume
    bulk = (law.lam + 2 / 3 * law.mu) / 4 * volume
    if own.law == "mooney-rivlin":
        return own.c10 * (first - 3) + own.c01 * (second - 3) + bulk
    assert own.law == "demiray"
    return law.mu / (2 * law.b) * (math.exp(law.b * (first - 3)) - 1) + bulk


@pytest.mark.parametrize("name", TISSUES)
def test_energy_is_the_formula(name, F):
    law = law_of(name)
    expected = textbook_energy(TISSUES[name], law, F)
    assert stress(law, F)[0] == pytest.approx(expected, rel=1e-13)


def test_in_shear_demiray_stiffens_exponentially():
    law = law_of("demiray")
    for shear in (0.2, 0.5, 1.0):
        F = np.eye(3)
        F[0, 1] = shear
        expected = law.mu * shear * math.exp(law.b * shear**2)
        assert stress(law, F)[1][0, 1] == pytest.approx(expected, rel=1e-12)


DEMIRAY = DemirayTissue, {"law": "demiray", "young": 15.0, "poisson": 0.45, "b": 1.0}
MOONEY = MooneyRivlinTissue, {"law": "mooney-rivlin", "c10": 2.0, "c01": 1.0, "poisson": 0.45}


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        (DEMIRAY, {"b": 0.0}, "greater than or equal to"),
        (MOONEY, {"c10": 0.0}, "c10\n.*greater than or equal to"),
        (MOONEY, {"c01": -0.1}, "c01\n.*greater than or equal to 0"),
        (MOONEY, {"young": 15.0}, "young\n.*not permitted"),
        (MOONEY, {"prony": ((0.7, 0.1),)}, r"less than c10 / \(c10 \+ c01\) = 0.6667"),
    ],
)
def test_constants_that_make_no_tissue_are_refused(kind, change, message):
    make, constants = kind
    make(**constants, prony=((0.6, 0.1),))
    with pytest.raises(ValidationError, match=message):
        make(**constants | change)


def test_stress_is_the_derivative_of_the_energy(law, F):
    P = stress(law, F)[1]
    difference = central_difference(lambda G: np.array(stress(law, G)[0]), F)
    assert np.abs(difference - P.ravel()).max() <= 1e-7 * np.abs(P).max()


def test_tangent_is_the_derivative_of_the_stress(law, F):
    A = tangent(law, F)
    difference = central_difference(lambda G: stress(law, G)[1].ravel(), F)
    assert np.abs(difference - A).max() <= 1e-7 * np.abs(A).max()
    assert np.abs(A - A.T).max() <= 1e-14 * np.abs(A).max()


def test_rest_and_rigid_rotation_are_free_of_stress_and_energy(law, rng):
    W, P = stress(law, np.eye(3))
    assert abs(W) <= 1e-15 * law.mu
    assert np.abs(P).max() <= 1e-15 * law.lam
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


def test_von_mises_against_the_textbook(law, F):
    cauchy = stress(law, F)[1] @ F.T / np.linalg.det(F)
    deviator = cauchy - np.trace(cauchy) / 3 * np.eye(3)
    expected = math.sqrt(1.5 * np.sum(deviator**2))
    assert laws.von_mises(law, tuple(F.ravel())) == pytest.approx(expected, rel=1e-12)


def test_the_isochoric_factor_is_exact_to_round_off(rng):
    for J in np.exp(rng.uniform(-15, 15, 1000)):
        assert isochoric(J) == pytest.approx(np.cbrt(J) ** -2, rel=2e-15, abs=0)
