"""The exponential law of Demiray, compressible: isochoric and volumetric energy are separate.

With ``C = cof F``, ``i = F:F``, ``s = J^-2/3 i - 3`` and ``K = lam + 2/3 mu``::

    W = mu/(2 b) (exp(b s) - 1) + K/4 (J^2 - 1 - 2 ln J)
    P = 2 W1 F + WJ C
    A : H = 2 W1 H + WJ F x H + (4 W11 dF + 2 W1J dJ) F + (2 W1J dF + WJJ dJ) C

where indices are derivatives of ``W(i, J)``, ``dF = F:H``, ``dJ = C:H``, and ``A x B`` is the
tensor cross product, ``F x F = 2 C``: Fung's exponential for isotropic tissue.

Demiray, J. Biomech. 5 (1972) 309-311; the separation and the volumetric energy: Simo & Hughes,
Computational Inelasticity, ch. 9.
"""

import math
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from palpate.shared.compiled import methods
from palpate.shared.mechanics.tensors import (
    add,
    cofactor,
    combine,
    cross,
    ddot,
    det,
    inline,
    isochoric,
)
from palpate.shared.mechanics.tissue import REGIONS, Constants, Region, Tissue
from palpate.shared.part import Positive


@methods(forceinline=True)
class Demiray(NamedTuple):
    """Parameters and functions of the law; see ``mechanics.laws``."""

    mu: Any  # kPa
    lam: Any  # kPa
    b: Any

    def parts(self):
        """See ``tissue.Law``."""
        lam = np.minimum(self.lam, self.mu)
        bulk = Demiray(0.0 * self.mu, self.lam - lam, self.b)
        return self, Demiray(self.mu, lam, self.b), bulk

    def at(self, i):
        """Take the parameters at a point."""
        return Demiray(self.mu[i], self.lam[i], self.b[i])

    def first_piola(self, F):
        """Return J, s and P."""
        C = cofactor(F)
        J = det(F, C)
        first, slope, _, _, _ = _derivatives(self, F, J)
        return J, isochoric(J) * ddot(F, F) - 3.0, combine(first, F, slope, C)

    def energy(self, J, part):
        """Return W; ``part`` is s."""
        volumetric = 0.25 * (self.lam + 2.0 / 3.0 * self.mu) * (J * J - 1.0 - 2.0 * math.log(J))
        return 0.5 * self.mu / self.b * math.expm1(self.b * part) + volumetric

    def linearise(self, F):
        """Return F and ``2 W1, WJ, 4 W11, 2 W1J, WJJ``."""
        return F, (self.mu, self.lam, *_derivatives(self, F, det(F, cofactor(F))), 0.0, 0.0)

    def increment(self, state, H):
        """Return ``A : H``."""
        F, (_, _, first, slope, along, mixed, curvature, _, _) = state
        C = cofactor(F)
        dF, dJ = ddot(F, H), ddot(C, H)
        D = combine(first, H, slope, cross(F, H))
        return add(D, combine(along * dF + mixed * dJ, F, mixed * dF + curvature * dJ, C))


@inline
def _derivatives(law, F, J):
    """``2 W1, WJ, 4 W11, 2 W1J, WJJ`` in kPa."""
    r, i = isochoric(J), 1.0 / J
    stretch = r * ddot(F, F)  # s + 3
    first = law.mu * math.exp(law.b * (stretch - 3.0)) * r
    one, bulk = first * ddot(F, F) * i / 3.0, 0.5 * (law.lam + 2.0 / 3.0 * law.mu)
    return (
        first, bulk * (J - i) - one, 2.0 * law.b * first * r,
        -2.0 / 3.0 * first * i * (1.0 + law.b * stretch),
        bulk * (1.0 + i * i) + one * i * (5.0 + 2.0 * law.b * stretch) / 3.0,
    )  # fmt: skip


class DemirayConstants(Constants):
    """Constants of the law."""

    parameters = Demiray

    young: Positive = Field(description="Young's modulus at rest, kPa")
    b: Positive = Field(description="exponential stiffening over strain")


class DemirayRegion(Region, DemirayConstants):
    """Part of a body of this law."""


class DemirayTissue(Tissue, DemirayConstants):
    """Tissue of this law."""

    law: Literal["demiray"] = Field(description="exponential, compressible")
    region: tuple[DemirayRegion, ...] = REGIONS
