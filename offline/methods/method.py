"""What every method of deforming tissue has in common: it answers a case.

A study asks many methods the same cases.  ``solve`` is what is timed: everything that depends on
the load and that a user waits for, but no field of mesh size.  ``displacement`` recovers the field.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from palpate.offline.run.workshop import Load, Workshop

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """Footprints that press at once, and the nodal forces they amount to.

    Attributes
    ----------
    contacts : tuple of Load
    nodes : ndarray, shape (k,), int
        The nodes that are loaded.
    forces : ndarray, shape (k, 3), mN
        On those.
    shares : ndarray, shape (contacts, k), mN
        What each contact presses them with, in its direction.
    radius : float, optional
        Of the footprints, mm; the scene's if absent.
    """

    contacts: tuple[Load, ...]
    nodes: NDArray[np.int64]
    forces: Array = field(repr=False)
    shares: Array = field(default_factory=lambda: np.empty((0, 0)), repr=False)
    radius: float | None = None

    @classmethod
    def of(cls, workshop: Workshop, *contacts: Load) -> Case:
        """Case of one or more pressed footprints on a scene's body."""
        return cls.pressed(contacts, [workshop.unit_load(x.position)[0] for x in contacts])

    @classmethod
    def pressed(
        cls, contacts: tuple[Load, ...], weights: Sequence[Array], radius: float | None = None
    ) -> Case:
        """Case of contacts, each with the nodal weights (n,) mm^2 of its unit pressure."""
        shares = np.array([x.pressure * own for x, own in zip(contacts, weights, strict=True)])
        nodes = np.flatnonzero(np.any(shares != 0.0, axis=0))
        shares = shares[:, nodes]
        directions = np.array([contact.direction for contact in contacts])
        return cls(contacts, nodes, shares.T @ directions, shares, radius)


@dataclass(frozen=True)
class Answer:
    """What a method makes of a case.

    Attributes
    ----------
    state : object
        Whatever ``Method.displacement`` needs.
    converged : bool
        Whether the method itself reports an answer at all.
    trusted : bool
        Whether it vouches for it: in range, and estimated within the scene's tolerance.  Methods
        that cannot tell vouch for whatever converged.
    iterations : int
    refused : bool
        Whether it declined the case instead of trying.
    """

    state: Any = field(repr=False)
    converged: bool
    trusted: bool
    iterations: int = 0
    refused: bool = False


class Method(Protocol):
    """A way to answer cases.

    Attributes
    ----------
    family : str
        ``"pod"``, ``"mass-spring"``, ...; one colour on a chart.
    label : str
        Of this size, for people.
    unknowns : int
        Numbers solved for per query.
    """

    family: str
    label: str
    unknowns: int

    def solve(self, case: Case) -> Answer:
        """Answer a case from rest; never raises for a case it cannot answer."""
        ...

    def displacement(self, answer: Answer) -> Array:
        """Nodal displacement (n, 3) mm."""
        ...
