"""The artifact itself in time, under footprints and under the rigid tip, with the trust it states.

It finds the contact by itself: of a case it takes the one contact, whose position is that of the
tip's centre if there is a tip.  See ``offline.methods.in_time.InTime``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.offline.methods.method import Case
from palpate.offline.run.workshop import Load
from palpate.shared.model import ReducedModel, Solution
from palpate.shared.reduced.history import History, Moment
from palpate.shared.reduced.touch import Touch

Array = NDArray[np.float64]


class Past(NamedTuple):
    """What the tissue remembers, and the last answer."""

    history: History
    answer: Moment | Touch | None


class ShippedInTime:
    """An artifact's atlas under footprints.

    Parameters
    ----------
    atlas : ReducedModel
    """

    family = label = "artifact"

    def __init__(self, atlas: ReducedModel) -> None:
        assert atlas.models.viscous is not None, "elastic tissue has no past"
        self.unknowns = atlas.models.viscous.deviatoric.shape[1]
        self._atlas = atlas

    def at_rest(self) -> Past:
        """See ``InTime``."""
        return Past(History(), None)

    def step(self, past: Past, case: Case, dt: float) -> tuple[bool, Past]:
        """See ``InTime``; raises ``QueryError`` for what the atlas refuses."""
        answer, history = self._answer(past.history, case.contacts[0], dt)
        return answer.converged, Past(history, answer) if answer.converged else past

    def _answer(self, history: History, contact: Load, dt: float) -> tuple[Moment | Touch, History]:
        return self._atlas.step(history, dt, contact.position, contact.pressure, contact.direction)

    def trusted(self, past: Past) -> bool:
        """In range, and estimated within the scene's tolerance."""
        answer, tolerance = past.answer, self._atlas.scene.tolerance
        return (
            answer is not None
            and answer.in_range
            and answer.error_displacement <= tolerance.displacement
            and answer.error_von_mises <= tolerance.von_mises
        )

    def displacement(self, past: Past) -> Array:
        """See ``InTime``."""
        if past.answer is None:
            return np.zeros_like(self._atlas.nodes)
        return self._atlas.displacement(past.answer).astype(float)

    def von_mises(self, past: Past) -> Array:
        """See ``InTime``."""
        if past.answer is None:
            return np.zeros(len(self._atlas.nodes))
        return self._atlas.von_mises(past.answer).astype(float)


class TipInTime(ShippedInTime):
    """An artifact's atlas under the rigid tip."""

    family = label = "artifact, tip"

    def __init__(self, atlas: ReducedModel) -> None:
        super().__init__(atlas)
        assert atlas.models.viscous_tips is not None, "the scene has a tip that knows of time"
        self.unknowns = atlas.models.viscous_tips.deviatoric.shape[1]

    def _answer(self, history: History, contact: Load, dt: float) -> tuple[Moment | Touch, History]:
        return self._atlas.touch_step(history, dt, contact.position)


class ElasticTwin:
    """The same local models asked as if there were no past: warm queries of elastic tissue.

    Parameters
    ----------
    atlas : ReducedModel
    """

    family = label = "elastic twin"

    def __init__(self, atlas: ReducedModel) -> None:
        self.unknowns = atlas.models.mix.shape[-1]
        self._atlas, self._state = atlas, atlas.new_state()

    def at_rest(self) -> Solution | None:
        """See ``InTime``; the state it starts from forgets the last answer."""
        self._state.forget()
        return None

    def step(self, past: Solution | None, case: Case, dt: float) -> tuple[bool, Solution]:
        """Answer a case at once, whatever the past and the time."""
        (contact,) = case.contacts
        solution = self._atlas.solve(
            contact.position, contact.pressure, contact.direction, state=self._state
        )
        return solution.converged, solution

    def trusted(self, past: Solution) -> bool:
        """See ``InTime``."""
        return past.in_range

    def displacement(self, past: Solution) -> Array:
        """See ``InTime``."""
        return self._atlas.displacement(past).astype(float)

    def von_mises(self, past: Solution) -> Array:
        """See ``InTime``."""
        return self._atlas.von_mises(past).astype(float)
