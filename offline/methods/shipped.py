"""The artifact as a method: what is served, with the trust that it states.

It finds the contact and its load by itself; the other methods are given them.  It knows a single
contact at a time and refuses several.
"""

from typing import Any, Literal

import numpy as np

from palpate.offline.fem.problem import FullProblem
from palpate.offline.methods.method import Answer, Case, Method
from palpate.shared.answer import Answer as Found
from palpate.shared.arrays import Array
from palpate.shared.errors import QueryError
from palpate.shared.model import ReducedModel
from palpate.shared.reduced.transfer import REST

Way = Literal["cold", "warm", "in time", "tip"]


class Shipped(Method):
    """Queries of a reduced model; the state is the last answer, or None at rest.

    Ways are: elastic tissue, every answer from scratch or from the last one; steps in time of
    visco-elastic tissue under footprints, or under the rigid tip, whose centre a case tells.  On
    visco-elastic tissue warm queries are those of its *elastic twin*: the same local models and
    points, asked as if there were no past.
    """

    def __init__(self, problem: FullProblem, atlas: ReducedModel, way: Way = "cold") -> None:
        label = {"cold": "artifact", "in time": "artifact"}.get(way, f"artifact, {way}")
        super().__init__(problem, atlas.models.mix.shape[-1], label)
        self._atlas, self._way = atlas, way
        self._warm = None if way == "cold" else atlas.new_warm()

    def at_rest(self) -> None:
        """See ``Method``; what the next answer would have started from is forgotten."""
        if self._warm is not None:
            self._warm.forget()

    def step(self, state: Found | None, case: Case, dt: float = 0.0) -> Answer:
        """See ``Method``; the case is refused where the service would refuse it."""
        if len(case.contacts) != 1:
            return Answer(state, False, refused=True)
        try:
            found = self._ask(state, case, dt)
        except QueryError:
            return Answer(state, False, refused=True)
        if not found.converged:
            return Answer(state, False)
        return Answer(found, doubted=bool(self._atlas.doubts(found)))

    def _ask(self, state: Found | None, case: Case, dt: float) -> Found:
        """Put a case of one contact to the reduced model."""
        (contact,), time = case.contacts, dict[str, Any](warm=self._warm)
        if self._way in ("in time", "tip"):
            time |= {"past": REST if state is None else state.past, "dt": dt}
        if self._way == "tip":
            return self._atlas.touch(contact.position, **time)
        where = contact.position, contact.pressure, contact.direction, case.radius
        return self._atlas.press(*where, **time)

    def field(self, state: Found) -> Array:
        """See ``Method``; as of all others without the dent of a tip, which is the same for all."""
        return self._atlas.fields.of_mesh(state).astype(float)

    def von_mises(self, state: Found | None) -> Array:
        """See ``Method``; as of all others without the near field, which is the same for all."""
        if state is None:
            return np.zeros(len(self._atlas.nodes))
        return self._atlas.von_mises(state._replace(footprint=None)).astype(float)
