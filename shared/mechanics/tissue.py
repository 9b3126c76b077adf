"""What tissue of every law is: its table in a scene, its parameters, its answer at rest."""

import math
from typing import Annotated, Any, ClassVar, Protocol, Self

from numba import njit
from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from palpate.shared.arrays import Array
from palpate.shared.mechanics.tensors import dot, trace, transposed
from palpate.shared.part import Fraction, Part, Positive

WHOLE, COMPRESSIBLE, BULK = range(3)
"""Parts of a law: all of it; with ``lam`` at most ``mu``, a Poisson's ratio of .25; and what that
lacks, which depends on the volume alone."""

INVERTED = math.inf
"""Energy returned where det F <= 0: a barrier every line search respects."""


class Law(Protocol):
    """Parameters of a law, arrays of many points, and what it does at one point."""

    @property
    def mu(self) -> Array:
        """Shear modulus at rest, kPa."""

    @property
    def lam(self) -> Array:
        """Lamé's first parameter at rest, kPa."""

    def parts(self) -> tuple[Any, Any, Any]:
        """The law itself and its two parts; see ``BULK``."""

    def at(self, i: Any) -> Any:
        """Parameters at one point, or at those of an index that NumPy understands."""

    def first_piola(self, F: Any) -> Any:
        """``J``, what ``energy`` needs besides, and the stress P (kPa), meaningless if J <= 0."""

    def energy(self, J: Any, part: Any) -> Any:
        """Energy density (kPa) at ``J > 0``; see ``first_piola``."""

    def linearise(self, F: Any) -> Any:
        """What ``increment`` needs of a state: a tensor and nine moduli (kPa), mu and lam first."""

    def increment(self, state: Any, H: Any) -> Any:
        """``A : H`` (kPa), linear in the moduli of the state."""


class Tissue(Part):
    """What the body is made of; every law has a kind of its own, with its constants."""

    parameters: ClassVar[Any]
    """Named tuple of the law's parameters: mu, lam, and constants named as in the scene."""

    law: str
    poisson: Annotated[float, Field(ge=0, lt=0.5)] = Field(description="Poisson's ratio at rest")
    prony: tuple[tuple[Fraction, Positive], ...] = Field(
        (),
        max_length=6,
        description="[[share of the isochoric stress that is lost, time constant in s], ...]",
    )

    @model_validator(mode="after")
    def _some_stiffness_stays(self) -> Self:
        total = sum(share for share, _ in self.prony)
        if not total < 1.0:
            raise PydanticCustomError(
                "prony",
                "the shares of prony must sum to less than 1, not {total}",
                {"total": total},
            )
        return self


def lame(young: float, poisson: float) -> tuple[float, float]:
    """Lamé parameters ``(mu, lambda)`` in the unit of ``young`` (kPa)."""
    mu = young / (2.0 * (1.0 + poisson))
    return mu, young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))


@njit(cache=True, error_model="numpy", forceinline=True)
def rest_stress(H, mu, lam):
    """Linear elasticity at rest: energy density (kPa) and stress ``A(I) : H`` (kPa)."""
    pressure = lam * trace(H)
    s1, s2, s5 = H[1] + H[3], H[2] + H[6], H[5] + H[7]
    W = (H[0] * H[0] + H[4] * H[4] + H[8] * H[8]) * mu + (
        pressure * trace(H) + mu * (s1 * s1 + s2 * s2 + s5 * s5)
    ) / 2
    two = mu + mu
    return W, (
        two * H[0] + pressure, mu * s1, mu * s2,
        mu * s1, two * H[4] + pressure, mu * s5,
        mu * s2, mu * s5, two * H[8] + pressure,
    )  # fmt: skip


@njit(cache=True, error_model="numpy", forceinline=True)
def equivalent(F, P, J):
    """Von Mises equivalent of the Cauchy stress ``P F^T / J``, in the unit of ``P``."""
    S = dot(P, transposed(F))
    a, b, c = S[0] - S[4], S[4] - S[8], S[8] - S[0]
    normal = a * a + b * b + c * c
    return math.sqrt(0.5 * normal + 3.0 * (S[1] * S[1] + S[2] * S[2] + S[5] * S[5])) / abs(J)
