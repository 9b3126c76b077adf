import math

import numpy as np
import pytest

from .material_point import deformation, law_of, stress


def test_energy_is_the_formula(rng):
    law = law_of("neo-hookean")
    for _ in range(5):
        F = deformation(rng)
        C, J = F.T @ F, np.linalg.det(F)
        expected = law.mu / 2 * (np.trace(C) - 3 - 2 * math.log(J))
        expected += law.lam / 4 * (J**2 - 1 - 2 * math.log(J))
        assert stress(law, F)[0] == pytest.approx(expected, rel=1e-13)
