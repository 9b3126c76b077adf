import math

import pytest
from pydantic import ValidationError

from palpate.shared.mechanics.mooney_rivlin import MooneyRivlinTissue

from .material_point import TISSUES, deformation, isochoric_invariants, law_of, stress

CONSTANTS = {"law": "mooney-rivlin", "c10": 2.0, "c01": 1.0, "poisson": 0.45}


def test_energy_is_the_formula(rng):
    law, tissue = law_of("mooney-rivlin"), TISSUES["mooney-rivlin"]
    for _ in range(5):
        F = deformation(rng)
        first, second, J = isochoric_invariants(F)
        expected = tissue.c10 * (first - 3) + tissue.c01 * (second - 3)
        expected += (law.lam + 2 / 3 * law.mu) / 4 * (J**2 - 1 - 2 * math.log(J))
        assert stress(law, F)[0] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"c10": 0.0}, "c10\n.*greater than 0"),
        ({"c01": -0.1}, "c01\n.*greater than or equal to 0"),
        ({"young": 15.0}, "young\n.*not permitted"),
        ({"prony": ((0.7, 0.1),)}, r"less than c10 / \(c10 \+ c01\) = 0.6667"),
    ],
)
def test_constants_that_make_no_tissue_are_refused(change, message):
    MooneyRivlinTissue(**CONSTANTS, prony=((0.6, 0.1),))
    with pytest.raises(ValidationError, match=message):
        MooneyRivlinTissue(**CONSTANTS | change)
