"""The artifact as a method: what is served, with the trust that it states.

It finds the contact and its load by itself; the other methods are given them.  It knows a single
contact at a time and refuses several.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.offline.methods.method import Answer, Case, Method
from palpate.shared.answer import Answer as Found
from palpate.shared.errors import QueryError
from palpate.shared.model import ReducedModel
from palpate.shared.reduced.transfer import REST

Array = NDArray[np.float64]


class Shipped(Method):
    """Cold queries of a reduced model: elastic tissue, every answer from scratch.

    The state is the last answer, or None at rest.

    Parameters
    ----------
    atlas : ReducedModel
    """

    label = "artifact"

    def __init__(self, atlas: ReducedModel) -> None:
        self.unknowns = atlas.models.mix.shape[-1]
        self._atlas, self._warm = atlas, atlas.new_warm()

    def at_rest(self) -> None:
        """See ``Method``; what the next answer would have started from is forgotten."""
        self._warm.forget()

    def step(self, state: Found | None, case: Case, dt: float = 0.0) -> Answer:
        """See ``Method``; the case is refused where the service would refuse it."""
        if len(case.contacts) != 1:
            return Answer(state, False, False, refused=True)
        try:
            found = self._ask(state, case, dt)
        except QueryError:
            return Answer(state, False, False, refused=True)
        if not found.converged:
            return Answer(state, False, False, found.iterations)
        tolerance = self._atlas.scene.tolerance
        trusted = (
            found.in_range
            and found.error_displacement <= tolerance.displacement
            and found.error_von_mises <= tolerance.von_mises
        )
        return Answer(found, True, trusted, found.iterations)

    def _ask(self, state: Found | None, case: Case, dt: float) -> Found:
        """Put a case of one contact to the reduced model."""
        (contact,) = case.contacts
        return self._atlas.press(contact.position, contact.pressure, contact.direction, case.radius)

    def displacement(self, state: Found | None) -> Array:
        """See ``Method``."""
        if state is None:
            return np.zeros_like(self._atlas.nodes)
        return self._atlas.displacement(state).astype(float)

    def von_mises(self, state: Found | None) -> Array:
        """See ``Method``."""
        if state is None:
            return np.zeros(len(self._atlas.nodes))
        return self._atlas.von_mises(state).astype(float)


class Warm(Shipped):
    """Warm queries: every answer starts from the last one, until a new start from rest.

    On visco-elastic tissue they are the *elastic twin* of ``ShippedInTime``: the same local models
    and points, asked as if there were no past.
    """

    label = "artifact, warm"

    def _ask(self, state: Found | None, case: Case, dt: float) -> Found:
        (contact,) = case.contacts
        return self._atlas.press(
            contact.position, contact.pressure, contact.direction, case.radius, warm=self._warm
        )


class ShippedInTime(Shipped):
    """Steps in time of visco-elastic tissue under footprints."""

    def _ask(self, state: Found | None, case: Case, dt: float) -> Found:
        (contact,) = case.contacts
        past = REST if state is None else state.past
        return self._atlas.press(
            contact.position, contact.pressure, contact.direction, case.radius, past=past, dt=dt,
            warm=self._warm,
        )  # fmt: skip


class TipInTime(Shipped):
    """Steps in time of visco-elastic tissue under the rigid tip, whose centre a case tells."""

    label = "artifact, tip"

    def __init__(self, atlas: ReducedModel) -> None:
        super().__init__(atlas)
        assert atlas.models.tips is not None, "the scene has no tip"
        self.unknowns = atlas.models.tips.modes.shape[-1]

    def _ask(self, state: Found | None, case: Case, dt: float) -> Found:
        (contact,) = case.contacts
        past = REST if state is None else state.past
        return self._atlas.touch(contact.position, past=past, dt=dt, warm=self._warm)
