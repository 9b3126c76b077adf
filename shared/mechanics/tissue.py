"""What tissue of every law is: its table in a scene, its parameters, its answer at rest."""

import math
from typing import Annotated, Any, ClassVar, Protocol, Self

from numba import njit
from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from palpate.shared.arrays import Array
from palpate.shared.mechanics.tensors import dot, trace, transposed
from palpate.shared.part import Fraction, Part, Positive, optional
from palpate.shared.place import Place

WHOLE, COMPRESSIBLE, BULK = range(3)
"""Parts of a law: all of it; with ``lam`` at most ``mu``, a Poisson's ratio of .25; and what that
lacks, which depends on the volume alone."""

STIFFEST = 1000.0
"""Ratio of Young's moduli of a region and the tissue round it, or the other way round."""

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


class Constants(Part):
    """Constants of a law; with ``young``, Young's modulus at rest, kPa."""

    parameters: ClassVar[Any]
    """Named tuple of the law's parameters: mu, lam, and constants named as in the scene."""

    moduli: ClassVar[tuple[str, ...]] = ("young",)
    """Constants in kPa, with which all stresses go."""

    poisson: Annotated[float, Field(ge=0, lt=0.5)] = Field(description="Poisson's ratio at rest")

    def scaled(self, ratio: float) -> Self:
        """The same law of moduli so many times as large."""
        return self.model_copy(update={key: ratio * getattr(self, key) for key in self.moduli})


class Region(Place):
    """Part of the body of the same law with constants of its own; it relaxes as the rest does."""

    name: str = Field(min_length=1, max_length=40, description="what the region is, for people")
    inside: str | None = optional(
        "all of it", "file of a closed surface (STL, OBJ, PLY), in the unit of the body's own"
    )

    @classmethod
    def places(cls) -> tuple[str, ...]:
        """Keys that say where."""
        return (*Place.model_fields, "inside")

    def in_words(self) -> str:
        """Where it is, in a line for people."""
        return ", ".join([*self.said(), *([f"inside {self.inside}"] if self.inside else [])])


REGIONS: Any = Field((), max_length=20, description="parts of the body with constants of their own")
"""Field of a law's tissue."""


class Tissue(Constants):
    """What the body is made of; every law has a kind of its own, with its constants.

    And ``region``, parts of the body with others, of which the last that holds counts.
    """

    law: str
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

    @model_validator(mode="after")
    def _regions_are_of_a_kind(self) -> Self:
        own: Any = self
        for region in own.region:
            ratio = region.young / own.young
            if not 1.0 / STIFFEST <= ratio <= STIFFEST:
                raise PydanticCustomError(
                    "stiffness",
                    "region '{name}' is {ratio} times as stiff as the rest, but 1/{most} to {most} "
                    "times are allowed",
                    {"name": region.name, "ratio": f"{ratio:.3g}", "most": f"{STIFFEST:g}"},
                )
        return self

    def scaled(self, ratio: float) -> Self:
        """The same, all regions so many times as stiff."""
        own: Any = super().scaled(ratio)
        regions = tuple(region.scaled(ratio) for region in own.region)
        scaled: Self = own.model_copy(update={"region": regions})
        return scaled


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
