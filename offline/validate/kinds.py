"""The kinds of queries that a reduced model answers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from palpate.offline.fem.problem import Step
from palpate.offline.reduce.queries import random_histories, random_loads, random_positions
from palpate.offline.run.streams import Stage
from palpate.shared.errors import QueryError
from palpate.shared.local_models import LocalModels
from palpate.shared.model import ReducedModel


class Kind(NamedTuple):
    """A kind of query.

    Attributes
    ----------
    name : str
        Of its error estimate, see ``shared.local_models.Estimators``.
    document, title : str
        Of its summary in an artifact, and of its full solutions.
    tip, in_time : bool
        Whether the rigid tip presses, not a footprint, and whether over a history.
    stage : Stage
        Whose random numbers training draws.
    coverage, damping : float
        Of the error estimate, see ``calibrate``.  For 95 % of unseen errors to be covered, some
        more of the known ones must be; answers within one history err alike.
    quantities : tuple of str
        What errors are estimated of; the force of a footprint is given.
    columns : tuple of str
        What a summary has statistics of.
    """

    name: str
    document: str
    title: str
    tip: bool
    in_time: bool
    stage: Stage
    coverage: float
    damping: float
    quantities: tuple[str, ...]
    columns: tuple[str, ...]

    def random(
        self, model: ReducedModel, count: int, rng: np.random.Generator
    ) -> list[Sequence[Step]]:
        """Queries over the whole surface and range of loads."""
        if self.in_time:
            return [*random_histories(model, count, rng, self.tip)]
        steps = random_positions if self.tip else random_loads
        return [[step] for step in steps(model, count, rng)]

    def lacks(self, models: LocalModels) -> str | None:
        """What local models lack to answer this kind."""
        if self.tip and models.tips is None:
            return "was trained without a tip"
        return "is elastic and has no histories" if self.in_time and not models.viscous else None

    def check(self, model: ReducedModel) -> None:
        """Raise ``QueryError`` if a model has no answers to this kind."""
        lack = self.lacks(model.models)
        if lack:
            raise QueryError("scene", f"{model.name!r} {lack}")


FIELDS = ("displacement", "von_mises")
QUANTITIES = (*FIELDS, "force")

LOADS = Kind(
    "loads", "validation", "full solutions", False, False, Stage.VALIDATION, 0.96, 0.3,
    FIELDS, (*FIELDS, "von_mises_p99"),
)  # fmt: skip
TIP = Kind(
    "touches", "validation_tip", "full solutions under the tip", True, False,
    Stage.TIP_VALIDATION, 0.96, 1.0,
    QUANTITIES, (*QUANTITIES, "tangent", "penetration_over_depth"),
)  # fmt: skip
HISTORIES = Kind(
    "histories", "validation_histories", "full histories", False, True,
    Stage.HISTORY_VALIDATION, 0.97, 30.0,
    FIELDS, (*FIELDS, "depth", "worst_displacement", "worst_von_mises", "last_displacement"),
)  # fmt: skip
TIP_HISTORIES = Kind(
    "courses", "validation_tip_histories", "full histories under the tip", True, True,
    Stage.TIP_HISTORY_VALIDATION, 0.97, 30.0,
    QUANTITIES, tuple(f"{of}{name}" for of in ("", "worst_", "together_") for name in QUANTITIES),
)  # fmt: skip

KINDS = (LOADS, TIP, HISTORIES, TIP_HISTORIES)
