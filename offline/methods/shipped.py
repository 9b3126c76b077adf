"""The artifact itself as a method: what is served, with the trust it states."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.offline.methods.method import Answer, Case
from palpate.shared.errors import QueryError
from palpate.shared.model import ReducedModel, State

Array = NDArray[np.float64]


class Shipped:
    """An artifact's atlas for a single contact; it refuses several.

    It finds the contact point and its load by itself, which the other methods are given.

    Parameters
    ----------
    atlas : ReducedModel
    state : State, optional
        Where every answer starts from the last; without it each is cold.
    """

    family = label = "artifact"

    def __init__(self, atlas: ReducedModel, state: State | None = None) -> None:
        self.unknowns = int(atlas.info["training"]["layout"]["narrow_modes"])
        self._atlas, self._state = atlas, state

    def solve(self, case: Case) -> Answer:
        """Query the atlas; the state is its solution, None if it refuses."""
        if len(case.contacts) != 1:
            return Answer(None, False, False, refused=True)
        contact = case.contacts[0]
        try:
            solution = self._atlas.solve(
                contact.position, contact.pressure, contact.direction, case.radius, self._state
            )
        except QueryError:
            return Answer(None, False, False, refused=True)
        tolerance = self._atlas.scene.tolerance
        trusted = (
            solution.converged
            and solution.in_range
            and solution.error_displacement <= tolerance.displacement
            and solution.error_von_mises <= tolerance.von_mises
        )
        return Answer(solution, solution.converged, trusted, solution.iterations)

    def displacement(self, answer: Answer) -> Array:
        """Nodal displacement (n, 3) mm; none of a refused case."""
        if answer.state is None:
            return np.zeros_like(self._atlas.nodes)
        return self._atlas.displacement(answer.state).astype(float)
