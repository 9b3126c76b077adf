import math

import numpy as np
import pytest
from pydantic import ValidationError

from palpate.shared.mechanics.demiray import DemirayTissue

from .material_point import deformation, isochoric_invariants, law_of, stress

CONSTANTS = {"law": "demiray", "young": 15.0, "poisson": 0.45}


def test_energy_is_the_formula(rng):
    law = law_of("demiray")
    for _ in range(5):
        F = deformation(rng)
        first, _, J = isochoric_invariants(F)
        expected = law.mu / (2 * law.b) * (math.exp(law.b * (first - 3)) - 1)
        expected += (law.lam + 2 / 3 * law.mu) / 4 * (J**2 - 1 - 2 * math.log(J))
        assert stress(law, F)[0] == pytest.approx(expected, rel=1e-12)


def test_in_shear_it_stiffens_exponentially():
    law = law_of("demiray")
    for shear in (0.2, 0.5, 1.0):
        F = np.eye(3)
        F[0, 1] = shear
        expected = law.mu * shear * math.exp(law.b * shear**2)
        assert stress(law, F)[1][0, 1] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("b", "message"), [({"b": 0.0}, "greater than 0"), ({}, "required")])
def test_constants_that_make_no_tissue_are_refused(b, message):
    with pytest.raises(ValidationError, match=message):
        DemirayTissue(**CONSTANTS, **b)
