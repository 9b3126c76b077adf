"""The artifact itself in time, under footprints and under the rigid tip, with the trust it states.

It finds the contact by itself: of a case it takes the one contact, whose position is that of the
tip's centre if there is a tip.  See ``offline.methods.in_time.InTime``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from offline.methods.method import Case
from shared.atlas import Atlas, Solution
from shared.history import History, Moment
from shared.touch import Touch

Array = NDArray[np.float64]


class Past(NamedTuple):
    """What the tissue remembers, and the last answer."""

    history: History
    moment: Moment | None


class TipPast(NamedTuple):
    """The same under the tip."""

    history: History
    touch: Touch | None


class ShippedInTime:
    """An artifact's atlas under footprints.

    Parameters
    ----------
    atlas : Atlas
    """

    family = label = "artifact"

    def __init__(self, atlas: Atlas) -> None:
        assert atlas.models.viscous is not None, "elastic tissue has no past"
        self.unknowns = atlas.models.viscous.deviatoric.shape[1]
        self._atlas = atlas

    def at_rest(self) -> Past:
        """See ``InTime``."""
        return Past(History(), None)

    def step(self, past: Past, case: Case, dt: float) -> tuple[bool, Past]:
        """See ``InTime``; raises ``QueryError`` for what the atlas refuses."""
        (contact,) = case.contacts
        moment, history = self._atlas.step(
            past.history, dt, contact.position, contact.pressure, contact.direction
        )
        return moment.converged, Past(history, moment) if moment.converged else past

    def trusted(self, past: Past) -> bool:
        """In range: histories of loads have no error estimate."""
        return past.moment is not None and past.moment.in_range

    def displacement(self, past: Past) -> Array:
        """See ``InTime``."""
        if past.moment is None:
            return np.zeros_like(self._atlas.nodes)
        return self._atlas.displacement(past.moment).astype(float)

    def von_mises(self, past: Past) -> Array:
        """See ``InTime``."""
        if past.moment is None:
            return np.zeros(len(self._atlas.nodes))
        return self._atlas.von_mises(past.moment).astype(float)


class ElasticTwin:
    """The same local models asked as if there were no past: warm queries of elastic tissue.

    Parameters
    ----------
    atlas : Atlas
    """

    family = label = "elastic twin"

    def __init__(self, atlas: Atlas) -> None:
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


class TipInTime:
    """An artifact's atlas under the rigid tip.

    Parameters
    ----------
    atlas : Atlas
    """

    family = label = "artifact, tip"

    def __init__(self, atlas: Atlas) -> None:
        assert atlas.models.viscous_tips is not None, "the scene has a tip that knows of time"
        self.unknowns = atlas.models.viscous_tips.deviatoric.shape[1]
        self._atlas = atlas

    def at_rest(self) -> TipPast:
        """See ``InTime``."""
        return TipPast(History(), None)

    def step(self, past: TipPast, case: Case, dt: float) -> tuple[bool, TipPast]:
        """See ``InTime``; raises ``QueryError`` for what the atlas refuses."""
        (contact,) = case.contacts
        touch, history = self._atlas.touch_step(past.history, dt, contact.position)
        return touch.converged, TipPast(history, touch) if touch.converged else past

    def trusted(self, past: TipPast) -> bool:
        """In range, and estimated within the scene's tolerance."""
        touch, tolerance = past.touch, self._atlas.scene.tolerance
        return (
            touch is not None
            and touch.in_range
            and touch.error_displacement <= tolerance.displacement
            and touch.error_von_mises <= tolerance.von_mises
        )

    def displacement(self, past: TipPast) -> Array:
        """See ``InTime``."""
        if past.touch is None:
            return np.zeros_like(self._atlas.nodes)
        return self._atlas.displacement(past.touch).astype(float)

    def von_mises(self, past: TipPast) -> Array:
        """See ``InTime``."""
        if past.touch is None:
            return np.zeros(len(self._atlas.nodes))
        return self._atlas.von_mises(past.touch).astype(float)
