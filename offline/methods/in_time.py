"""What every method that knows of time has in common: it goes on from what tissue remembers."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.model import History, NoEquilibrium
from palpate.offline.methods.method import Case
from palpate.offline.run.workshop import Workshop

Array = NDArray[np.float64]


class InTime(Protocol):
    """A way to answer cases one after the other in visco-elastic tissue.

    Attributes
    ----------
    family : str
    label : str
        Of this size, for people.
    unknowns : int
        Numbers solved for per step.
    """

    family: str
    label: str
    unknowns: int

    def at_rest(self) -> Any:
        """Past of tissue that nothing has happened to."""
        ...

    def step(self, past: Any, case: Case, dt: float) -> tuple[bool, Any]:
        """Answer a case ``dt`` (s) after a past, which is not changed.

        Returns whether there is an answer, and the longer past or, without one, the same.
        """
        ...

    def trusted(self, past: Any) -> bool:
        """Whether it vouches for the end of a past; without any means to tell, it does."""
        ...

    def displacement(self, past: Any) -> Array:
        """Nodal displacement (n, 3) mm there."""
        ...

    def von_mises(self, past: Any) -> Array:
        """Nodal von Mises stress (n,) kPa there."""
        ...


class FullInTime:
    """The full model; its past is its history.

    Parameters
    ----------
    workshop : Workshop
    """

    family = label = "full"

    def __init__(self, workshop: Workshop) -> None:
        self.unknowns = len(workshop.model.free)
        self._workshop = workshop

    def at_rest(self) -> History:
        """See ``InTime``."""
        return self._workshop.model.at_rest

    def step(self, past: History, case: Case, dt: float) -> tuple[bool, History]:
        """See ``InTime``."""
        load = np.zeros_like(past.displacement)
        load[case.nodes] = case.forces
        try:
            return True, self._workshop.model.step(past, load, dt)[1]
        except NoEquilibrium:
            return False, past

    def trusted(self, past: History) -> bool:
        """See ``InTime``."""
        return True

    def displacement(self, past: History) -> Array:
        """See ``InTime``."""
        return past.displacement

    def von_mises(self, past: History) -> Array:
        """See ``InTime``."""
        return self._workshop.von_mises_after(past)
