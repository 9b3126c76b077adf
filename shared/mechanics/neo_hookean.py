"""The compressible Neo-Hookean law of FEAP.

With ``J = det F``::

    W = mu/2 (F:F - 3 - 2 ln J) + lam/4 (J^2 - 1 - 2 ln J)
    P = mu (F - F^-T) + lam/2 (J^2 - 1) F^-T
    A : H = mu H + (mu - lam/2 (J^2 - 1)) F^-T H^T F^-T + lam J^2 (F^-T : H) F^-T

Taylor, FEAP Theory Manual, finite elasticity.
"""

import math
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from palpate.shared.compiled import methods
from palpate.shared.mechanics.tensors import (
    add,
    add_identity,
    cofactor,
    combine,
    ddot,
    det,
    dot,
    scale,
    trace,
    transposed,
)
from palpate.shared.mechanics.tissue import REGIONS, Constants, Region, Tissue
from palpate.shared.part import Positive


@methods(forceinline=True)
class NeoHookean(NamedTuple):
    """Parameters and functions of the law; see ``mechanics.laws``."""

    mu: Any  # kPa
    lam: Any  # kPa

    def parts(self):
        """See ``tissue.Law``."""
        lam = np.minimum(self.lam, self.mu)
        return self, NeoHookean(self.mu, lam), NeoHookean(0.0 * self.mu, self.lam - lam)

    def at(self, i):
        """Take the parameters at a point."""
        return NeoHookean(self.mu[i], self.lam[i])

    def first_piola(self, F):
        """Return J, ``F : F`` and P."""
        C = cofactor(F)  # J F^-T
        J = det(F, C)
        s = (0.5 * self.lam * (J * J - 1.0) - self.mu) / J
        return J, ddot(F, F), combine(self.mu, F, s, C)

    def energy(self, J, part):
        """Return W; ``part`` is ``F : F``."""
        log = math.log(J)
        return 0.5 * self.mu * (part - 3.0 - 2.0 * log) + 0.25 * self.lam * (
            J * J - 1.0 - 2.0 * log
        )

    def linearise(self, F):
        """Return ``F^-T`` and the factors of the last two terms."""
        C = cofactor(F)
        J = det(F, C)
        geometric, bulk = self.mu - 0.5 * self.lam * (J * J - 1.0), self.lam * J * J
        return scale(1.0 / J, C), (self.mu, self.lam, geometric, bulk, 0.0, 0.0, 0.0, 0.0, 0.0)

    def increment(self, state, H):
        """Return ``A : H``."""
        T, moduli = state
        X = dot(T, transposed(H))
        X = add_identity(scale(moduli[2], X), moduli[3] * trace(X))
        return add(scale(moduli[0], H), dot(X, T))


class NeoHookeanConstants(Constants):
    """Constants of the law."""

    parameters = NeoHookean

    young: Positive = Field(description="Young's modulus at rest, kPa")


class NeoHookeanRegion(Region, NeoHookeanConstants):
    """Part of a body of this law."""


class NeoHookeanTissue(Tissue, NeoHookeanConstants):
    """Tissue of this law."""

    law: Literal["neo-hookean"] = Field(description="FEAP's compressible law")
    region: tuple[NeoHookeanRegion, ...] = REGIONS
