"""The law of Mooney and Rivlin, compressible: isochoric and volumetric energy are separate.

With ``C = cof F``, ``i1 = F:F``, ``i2 = C:C`` (invariants of F^T F), ``K = lam + 2/3 mu`` and
``mu = 2 (c10 + c01)``::

    W = c10 (J^-2/3 i1 - 3) + c01 (J^-4/3 i2 - 3) + K/4 (J^2 - 1 - 2 ln J)
    P = 2 W1 F + 2 W2 C x F + WJ C
    A : H = 2 W1 H + 2 W2 ((F x H) x F + C x H) + WJ F x H
          + 2 W1J (dJ F + dF C) + 2 W2J (dJ C x F + dC C) + WJJ dJ C

where indices are derivatives of ``W(i1, i2, J)``, ``dF = F:H``, ``dC = C:(F x H)``, ``dJ = C:H``,
and ``A x B`` is the tensor cross product, ``F x F = 2 C`` (Bonet, Gil & Ortigosa, Comput. Methods
Appl. Mech. Engrg. 283 (2015) 1061-1094).

Mooney, J. Appl. Phys. 11 (1940) 582-592; Rivlin, Phil. Trans. R. Soc. A 241 (1948) 379-397; the
separation and the volumetric energy: Simo & Hughes, Computational Inelasticity, ch. 9.
"""

import math
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

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
    scale,
)
from palpate.shared.mechanics.tissue import REGIONS, Constants, Region, Tissue
from palpate.shared.part import Positive


@methods(forceinline=True)
class MooneyRivlin(NamedTuple):
    """Parameters and functions of the law; see ``mechanics.laws``."""

    mu: Any  # kPa
    lam: Any  # kPa
    c01: Any  # kPa

    def parts(self):
        """See ``tissue.Law``."""
        lam = np.minimum(self.lam, self.mu)
        bulk = MooneyRivlin(0.0 * self.mu, self.lam - lam, 0.0 * self.c01)
        return self, MooneyRivlin(self.mu, lam, self.c01), bulk

    def at(self, i):
        """Take the parameters at a point."""
        return MooneyRivlin(self.mu[i], self.lam[i], self.c01[i])

    def first_piola(self, F):
        """Return J, isochoric energy and P."""
        C = cofactor(F)
        J = det(F, C)
        first, second, slope, _, _, _ = _derivatives(self, F, C, J)
        part = 0.5 * (first * ddot(F, F) + second * ddot(C, C)) - 1.5 * self.mu
        return J, part, add(scale(slope, C), combine(first, F, second, cross(C, F)))

    def energy(self, J, part):
        """Return W; ``part`` is the isochoric energy."""
        return part + 0.25 * (self.lam + 2.0 / 3.0 * self.mu) * (J * J - 1.0 - 2.0 * math.log(J))

    def linearise(self, F):
        """Return F and ``2 W1, 2 W2, WJ, 2 W1J, 2 W2J, WJJ``."""
        C = cofactor(F)
        return F, (self.mu, self.lam, *_derivatives(self, F, C, det(F, C)), 0.0)

    def increment(self, state, H):
        """Return ``A : H``."""
        F, (_, _, first, second, slope, first_J, second_J, curvature, _) = state
        C, X = cofactor(F), cross(F, H)
        dF, dC, dJ = ddot(F, H), ddot(C, X), ddot(C, H)
        D = combine(first, H, first_J * dJ, F)
        D = add(D, cross(combine(second, X, second_J * dJ, C), F))
        D = add(D, combine(slope, X, first_J * dF + second_J * dC + curvature * dJ, C))
        return add(D, scale(second, cross(C, H)))


@inline
def _derivatives(law, F, C, J):
    """``2 W1, 2 W2, WJ, 2 W1J, 2 W2J, WJJ`` in kPa."""
    r, i = isochoric(J), 1.0 / J
    bulk = 0.5 * (law.lam + 2.0 / 3.0 * law.mu)
    first, second = (law.mu - 2.0 * law.c01) * r, 2.0 * law.c01 * r * r
    one, two = first * ddot(F, F) * i, second * ddot(C, C) * i
    return (
        first, second, bulk * (J - i) - one / 3.0 - 2.0 / 3.0 * two,
        -2.0 / 3.0 * first * i, -4.0 / 3.0 * second * i,
        bulk * (1.0 + i * i) + (5.0 * one + 14.0 * two) * i / 9.0,
    )  # fmt: skip


class MooneyRivlinConstants(Constants):
    """Constants of the law."""

    parameters = MooneyRivlin
    moduli = "c10", "c01"

    c10: Positive = Field(description="factor of the first invariant, kPa")
    c01: Annotated[float, Field(ge=0)] = Field(description="factor of the second invariant, kPa")

    @property
    def young(self) -> float:
        """Young's modulus at rest, kPa."""
        return 4.0 * (self.c10 + self.c01) * (1.0 + self.poisson)


class MooneyRivlinRegion(Region, MooneyRivlinConstants):
    """Part of a body of this law."""


class MooneyRivlinTissue(Tissue, MooneyRivlinConstants):
    """Tissue of this law."""

    law: Literal["mooney-rivlin"] = Field(description="compressible, linear in two invariants")
    region: tuple[MooneyRivlinRegion, ...] = REGIONS

    @model_validator(mode="after")
    def _both_invariants_stay_stiff(self) -> Self:
        """Relaxation takes the share of ``mu`` from the first invariant alone."""
        parts: list[MooneyRivlinConstants] = [self, *self.region]
        most = min(own.c10 / (own.c10 + own.c01) for own in parts)
        if not sum(share for share, _ in self.prony) < most:
            raise PydanticCustomError(
                "prony",
                "the shares of prony must sum to less than c10 / (c10 + c01) = {most}: what is "
                "lost is taken from the first invariant",
                {"most": round(most, 4)},
            )
        return self
