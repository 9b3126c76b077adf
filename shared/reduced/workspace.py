"""Working memory of one caller: last answers to start from, scratch and outcome.

It is disposable: without it an answer is sought from the trained first guess.  What the tissue
itself remembers is a value of its own, ``transfer.Past``.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np

from palpate.shared.arrays import Array
from palpate.shared.compiled import bind, room
from palpate.shared.geometry.surface import SurfaceIndex
from palpate.shared.mechanics.tip import Tip
from palpate.shared.mechanics.viscosity import step_weights
from palpate.shared.reduced.blend import MAX_ACTIVE, Active
from palpate.shared.reduced.features import (
    CHANGES,
    CHANGING,
    LOAD_FEATURES,
    RESIDUAL_FEATURES,
    RIM,
    TANGENT_FEATURES,
)
from palpate.shared.reduced.outcome import PRESS_FEATURES, Outcome, Solver
from palpate.shared.reduced.past import Elastic, Remembering, set_step
from palpate.shared.reduced.press import PressModels, PressScratch, PressWarm


class Workspace:
    """A caller's memory for one kind of load on tissue with or without a past.

    Parameters
    ----------
    models : PressModels
    tip : Tip
    index : SurfaceIndex
        With load range, curvature and distance from the rim.
    coefficients : ndarray, shape (2 or 3, features)
        Of the error estimate.
    past : Elastic or Remembering

    Attributes
    ----------
    solver : Bound of Solver
    active, warm, scratch, past, outcome
        Its members.
    features : int
        Of the error estimate.
    """

    def __init__(
        self,
        models: PressModels,
        tip: Tip,
        index: SurfaceIndex,
        coefficients: Array,
        past: Elastic | Remembering,
    ) -> None:
        r, c = models.points.gradients.shape[1], models.points.weights.shape[1]
        sizes = {"slots": MAX_ACTIVE, "r": r, "c": c, "p": models.centres.shape[1]}
        sizes |= {"clusters": len(index.radii), "residual_features": RESIDUAL_FEATURES}
        self.warm = room(PressWarm, **sizes)
        self.scratch = room(
            PressScratch, **sizes, features=LOAD_FEATURES, tangent_features=TANGENT_FEATURES,
            changing=CHANGING, changes=CHANGES, nodes=int(np.diff(models.node_from).max()),
        )  # fmt: skip
        self.past, self._dt = past, math.nan
        self.active = room(Active, **sizes)
        self.outcome = room(Outcome, features=PRESS_FEATURES, limits=RIM + 1)
        self.features = coefficients.shape[1]
        self.solver = bind(
            Solver(
                models, tip, index, np.ascontiguousarray(coefficients), past, self.active,
                self.warm, self.scratch, self.outcome,
            )
        )  # fmt: skip
        self.active.number[:] = -1
        self.forget()

    def begin_step(self, prony: Sequence[tuple[float, float]], dt: float) -> None:
        """Make the next answer that at the end of a time step (s) of tissue that remembers."""
        assert isinstance(self.past, Remembering)
        if dt != self._dt:
            self._weights, self._dt = step_weights(prony, dt), dt
        set_step(self.past, self._weights)

    def forget(self) -> None:
        """Make the next answer independent of the last."""
        self.warm.number[:] = -1
        self.warm.tip.known[0] = 0.0

    def answering(self) -> list[tuple[int, int, float]]:
        """Slot, number and weight of the local models that answer."""
        weights = self.active.weight.tolist()
        return [(s, k, weights[s]) for s, k in enumerate(self.active.number.tolist()) if k >= 0]


class Warm:
    """Working memory and last answers of one caller; not to be shared between threads.

    Parameters
    ----------
    make : callable
        Workspace for the tip or for loads, in time or at once; made when first needed.
    """

    def __init__(self, make: Callable[[bool, bool], Workspace]) -> None:
        self._make = make
        self._made: dict[tuple[bool, bool], Workspace] = {}

    def workspace(self, tip: bool, in_time: bool) -> Workspace:
        """For the tip or for loads, on tissue that remembers or not."""
        if (tip, in_time) not in self._made:
            self._made[tip, in_time] = self._make(tip, in_time)
        return self._made[tip, in_time]

    def forget(self) -> None:
        """Make the next answer independent of the last."""
        for part in self._made.values():
            part.forget()
