"""What every method of deforming tissue has in common: it answers a case.

A study asks many methods the same cases.  ``solve`` is what is timed: everything that depends on
the load and that a user waits for, but no field of mesh size.  ``displacement`` recovers the field.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from offline.workshop import Load, Workshop

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
    """

    contacts: tuple[Load, ...]
    nodes: NDArray[np.int64]
    forces: Array = field(repr=False)

    @classmethod
    def of(cls, workshop: Workshop, *contacts: Load) -> Case:
        """Case of one or more pressed footprints on a scene's body."""
        total = np.sum([workshop.load_vector(contact) for contact in contacts], axis=0)
        nodes = np.flatnonzero(np.any(total != 0.0, axis=1))
        return cls(contacts, nodes, total[nodes])


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
    """

    state: Any = field(repr=False)
    converged: bool
    trusted: bool
    iterations: int = 0


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
