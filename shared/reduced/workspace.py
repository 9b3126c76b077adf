"""Working memory of one caller: last answers to start from, scratch and outcome.

It is disposable: without it an answer is sought from the trained first guess.  What the tissue
itself remembers is a value of its own, ``transfer.Past``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.shared.compiled import bind
from palpate.shared.geometry.surface import SurfaceIndex
from palpate.shared.mechanics.sphere import room_for
from palpate.shared.reduced.blend import MAX_ACTIVE, Active, new_active
from palpate.shared.reduced.features import (
    CHANGES,
    CHANGING,
    LOAD_FEATURES,
    RESIDUAL_FEATURES,
    TANGENT_FEATURES,
    TIP_FEATURES,
)
from palpate.shared.reduced.outcome import ARRAYS, NUMBERS, Outcome, new_outcome
from palpate.shared.reduced.past import Remembering
from palpate.shared.reduced.points import LANES, STATE, TILE
from palpate.shared.reduced.press import PressModels, PressScratch, PressSolver, PressWarm
from palpate.shared.reduced.problem import Work
from palpate.shared.reduced.terms import Elastic
from palpate.shared.reduced.touch import TouchModels, TouchScratch, TouchSolver, TouchWarm

Array = NDArray[np.float64]


@dataclass
class Workspace:
    """A caller's memory for one kind of load on tissue with or without a past.

    Attributes
    ----------
    solver : Bound of PressSolver or TouchSolver
    active : Active
    warm : PressWarm or TouchWarm
    scratch : PressScratch or TouchScratch
    past : Elastic or Remembering
    record : ndarray
        What an answer is made of; see ``reduced.outcome``.
    outcome : Outcome
        Its views.
    """

    active: Active
    warm: Any
    scratch: Any
    past: Elastic | Remembering
    record: Array
    outcome: Outcome
    solver: Any = field(init=False)

    def forget(self) -> None:
        """Make the next answer independent of the last."""
        self.warm.number[:] = -1

    def answering(self) -> list[tuple[int, int, float]]:
        """Slot, number and weight of the local models that answer."""
        weights = self.active.weight.tolist()
        return [(s, k, weights[s]) for s, k in enumerate(self.active.number.tolist()) if k >= 0]

    def result(self) -> Outcome:
        """Copy of the outcome, with plain numbers."""
        record = self.record.copy()
        return Outcome._make([*record[:NUMBERS].tolist(), *[record[place] for place in ARRAYS]])


def new_work(r: int, count: int) -> Work:
    """Working memory of an evaluation with r modes at so many points."""
    return Work(
        H=np.zeros(9 * count, np.float32),
        P=np.zeros(9 * count, np.float32),
        J=np.zeros(count),
        part=np.zeros(count),
        linear=np.zeros(count),
        stepped=np.zeros(r, np.float32),
        latest=np.zeros(r),
    )


def press_workspace(
    models: PressModels,
    index: SurfaceIndex,
    max_tilt: float,
    coefficients: Array,
    past: Elastic | Remembering,
) -> Workspace:
    """For loads; ``coefficients`` (2, PRESS_FEATURES) are of the error estimate."""
    r = models.points.gradients.shape[1]
    warm = PressWarm(
        number=np.full(MAX_ACTIVE, -1, np.int64),
        q=np.zeros((MAX_ACTIVE, r)),
        guess=np.zeros((MAX_ACTIVE, r)),
        past=np.zeros((MAX_ACTIVE, r)),
        inverse=np.zeros((MAX_ACTIVE, r, r)),
        origin=np.zeros((MAX_ACTIVE, 2, r)),
    )
    scratch = PressScratch(
        work=new_work(r, models.points.weights.shape[1]),
        newton=np.zeros((4, r)),
        start=np.zeros(r),
        load=np.zeros(r),
        guess=np.zeros(r),
        external=np.zeros(r),
        change=np.zeros(r),
        unit_loads=np.zeros(3 * r, np.float32),
        fitted=np.zeros(r, np.float32),
        scaled_load=np.zeros(3),
        features=np.zeros(LOAD_FEATURES),
        tangent_features=np.zeros(TANGENT_FEATURES),
        fitted_change=np.zeros(CHANGES, np.float32),
        tangent=np.zeros((CHANGING, CHANGING)),
        factor=np.zeros((CHANGING, CHANGING)),
        turned=np.zeros((CHANGING, r), np.float32),
        residual_features=np.zeros(RESIDUAL_FEATURES),
        nodal=np.zeros(int(np.diff(models.node_from).max())),
        surface=np.zeros(len(index.radii) + 3),
    )
    active = new_active(models.centres.shape[1])
    record, outcome = new_outcome()
    workspace = Workspace(active, warm, scratch, past, record, outcome)
    workspace.solver = bind(
        PressSolver(models, index, max_tilt, coefficients, past, active, warm, scratch, outcome)
    )
    return workspace


class TouchWorkspace(Workspace):
    """A caller's memory under the tip."""

    def resume(self) -> None:
        """Start the next search where the last one ended, which found no equilibrium."""
        warm = self.warm
        warm.number[:] = self.active.number
        warm.q[:] = self.scratch.q
        warm.formed[:] = np.inf
        warm.factor[:] = np.eye(warm.q.shape[1])
        warm.coupling[:] = 0.0  # the answer to another position is unknown


def touch_workspace(
    models: TouchModels, index: SurfaceIndex, coefficients: Array, past: Elastic | Remembering
) -> TouchWorkspace:
    """For the tip; ``coefficients`` (3, TOUCH_FEATURES) are of the error estimate."""
    r = models.points.gradients.shape[1]
    entries = models.tangent_points.gradients.shape[2]
    faces, rows = int(np.diff(models.face_from).max()), 3 * models.corners.shape[1]
    warm = TouchWarm(
        number=np.full(MAX_ACTIVE, -1, np.int64),
        q=np.zeros((MAX_ACTIVE, r)),
        factor=np.zeros((MAX_ACTIVE, r, r)),
        coupling=np.zeros((MAX_ACTIVE, 3, r)),
        position=np.zeros(3),
        bulk=np.zeros((MAX_ACTIVE, r, r)),
        formed=np.full((MAX_ACTIVE, 2 * r + 1), np.inf),
    )
    scratch = TouchScratch(
        work=new_work(r, models.points.weights.shape[1]),
        newton=np.zeros((4, r)),
        x=np.zeros(3),
        q=np.zeros((MAX_ACTIVE, r)),
        factor=np.zeros((MAX_ACTIVE, r, r)),
        coupling=np.zeros((MAX_ACTIVE, 3, r)),
        forces=np.zeros((MAX_ACTIVE, 3)),
        tangents=np.zeros((MAX_ACTIVE, 3, 3)),
        state=np.zeros(STATE * LANES * (entries // TILE), np.float32),
        units=np.tile(np.repeat(np.eye(9, dtype=np.float32), LANES, axis=1), entries // TILE),
        moduli=np.zeros((9, entries), np.float32),
        products=np.zeros((r, entries), np.float32),
        whole=np.zeros((r, r)),
        moved=np.zeros(models.surface.nodes.shape),
        own=np.zeros((rows * faces, r)),
        folded=np.zeros((rows * faces, r)),
        square=np.zeros((rows, rows)),
        product=np.zeros((r, r)),
        touching=room_for(models.surface, faces),
        latest=np.zeros(r),
        features=np.zeros(TIP_FEATURES),
        residual_features=np.zeros(RESIDUAL_FEATURES),
        inward=np.zeros(3),
        surface=np.zeros(len(index.radii) + 3),
    )
    active = new_active(models.centres.shape[1])
    record, outcome = new_outcome()
    workspace = TouchWorkspace(active, warm, scratch, past, record, outcome)
    workspace.solver = bind(
        TouchSolver(models, index, coefficients, past, active, warm, scratch, outcome)
    )
    return workspace


class Warm:
    """Working memory and last answers of one caller; not to be shared between threads.

    Parts for loads and for the tip, at once and in time, are made when first needed.

    Parameters
    ----------
    make : callable
        Workspace for the tip or for loads, in time or at once.
    """

    def __init__(self, make: Callable[[bool, bool], Workspace]) -> None:
        self._make = make
        self._made: dict[tuple[bool, bool], Workspace] = {}

    def press(self, in_time: bool) -> Workspace:
        """For loads."""
        return self._part(tip=False, in_time=in_time)

    def touch(self, in_time: bool) -> TouchWorkspace:
        """For the tip."""
        part = self._part(tip=True, in_time=in_time)
        assert isinstance(part, TouchWorkspace)
        return part

    def _part(self, tip: bool, in_time: bool) -> Workspace:
        if (tip, in_time) not in self._made:
            self._made[tip, in_time] = self._make(tip, in_time)
        return self._made[tip, in_time]

    def forget(self) -> None:
        """Make the next answer independent of the last."""
        for part in self._made.values():
            part.forget()

    def resume(self) -> None:
        """Start under the tip where the last search ended, which found no equilibrium."""
        for part in self._made.values():
            if isinstance(part, TouchWorkspace):
                part.resume()
