"""The kinds of queries that a reduced model answers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from palpate.offline.fem.problem import Step
from palpate.offline.run.streams import Stage
from palpate.offline.validate.queries import random_histories, random_loads, random_positions
from palpate.shared.local_models import LocalModels
from palpate.shared.model import ReducedModel


class Kind(NamedTuple):
    """A kind of query."""

    name: str  # of its error estimate, see ``shared.local_models.Estimators``
    tip: bool  # whether the rigid tip presses, not a footprint
    in_time: bool  # whether over a history
    stage: Stage  # whose random numbers training draws
    damping: float  # of the error estimate, see ``calibrate``
    others: tuple[str, ...]  # what a summary has statistics of beside the quantities

    @property
    def document(self) -> str:
        """Name of its summary in an artifact."""
        return "validation" + "_tip" * self.tip + "_histories" * self.in_time

    @property
    def title(self) -> str:
        """What its full solutions are called."""
        return f"full {'histories' if self.in_time else 'solutions'}" + " under the tip" * self.tip

    @property
    def quantities(self) -> tuple[str, ...]:
        """What errors are estimated of; the force of a footprint is given."""
        return ("displacement", "von_mises", "force")[: 3 if self.tip else 2]

    @property
    def coverage(self) -> float:
        """Of the error estimate, so that it covers 95 % of unseen errors; see ``calibrate``.

        Answers within one history err alike.
        """
        return 0.97 if self.in_time else 0.96

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


LOADS = Kind("loads", False, False, Stage.VALIDATION, 0.3, ("von_mises_p99",))
TIP = Kind("touches", True, False, Stage.TIP_VALIDATION, 1.0, ("tangent", "penetration_over_depth"))
HISTORIES = Kind(
    "histories", False, True, Stage.HISTORY_VALIDATION, 30.0,
    ("depth", "worst_displacement", "worst_von_mises", "last_displacement"),
)  # fmt: skip
TIP_HISTORIES = Kind(
    "courses", True, True, Stage.TIP_HISTORY_VALIDATION, 30.0,
    tuple(f"{of}_{name}" for of in ("worst", "together") for name in TIP.quantities),
)  # fmt: skip

KINDS = (LOADS, TIP, HISTORIES, TIP_HISTORIES)
