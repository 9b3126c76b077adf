"""Histories of visco-elastic tissue under the rigid tip, and their steps.

See ``reduced.touch_in_time`` for the theory.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.shared.compiled import Bound, bind
from palpate.shared.errors import QueryError
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.viscosity import Weights
from palpate.shared.reduced.history import History, HistoryTransfer, Local, ViscousModels, judge
from palpate.shared.reduced.touch import (
    BESIDE,
    DEPTH,
    ENERGY,
    ITERATIONS,
    MAX_ITERATIONS,
    PENETRATION,
    SKIN,
    SMALLEST_J,
    TOUCHED,
    TipState,
    Touch,
)
from palpate.shared.reduced.touch_in_time import (
    SHAPE,
    TipMemory,
    conclude,
    new_record,
    new_scratch,
    opened,
    place_tip,
    recall_tip_points,
    step_tip,
)

Array = NDArray[np.float64]
Field = NDArray[np.float32]


_NOWHERE = np.zeros(0)


class TipTimeStepper(HistoryTransfer):
    """Moves the tip over patches, step by step.

    Parameters
    ----------
    solver : Bound of reduced.touch.TipSolver
    models, prony, points
        See ``reduced.history.HistoryTransfer``.
    """

    def __init__(
        self,
        solver: Bound,
        models: ViscousModels,
        prony: Sequence[tuple[float, float]],
        points: int,
    ) -> None:
        super().__init__(models, prony, points)
        self._solver = solver
        self._scratch = new_scratch(self.modes, points)
        self._bound = bind(self._scratch)

    def press(
        self,
        history: History,
        active: Sequence[tuple[int, int]],
        position: Array,
        weights: Weights,
        most: int,
        begun: Mapping[int, Array],
    ) -> tuple[dict[int, Local], dict[int, Array]]:
        """Step patches (slot and number) where ``place_tip`` has found.

        ``begun`` (m,) are where searches that have begun go on.  Returns what the patches remember
        then, and where the search of one that has no answer has ended.
        """
        found: dict[int, Local] = {}
        for slot, k in active:
            local = history.locals.get(k) or self.follow(history, k)
            record = local.record.copy()
            status = step_tip(
                self._solver, slot, position, self._models.deviatoric[k], weights, most,
                begun.get(k, _NOWHERE), record, self._bound,
            )  # fmt: skip
            if status != newton.CONVERGED:
                return {}, {k: self._scratch.q.copy()}
            found[k] = Local(record, local.remains)
        return found, {}

    def conclude(self, position: Array) -> float:
        """Write where the force acts on the tip; return its size, mN."""
        size: float = conclude(self._solver, position)
        return size

    def _new_record(self) -> Array:
        return new_record(len(self._tau), self.modes, self._points)

    def opened(self, record: Array) -> TipMemory:
        """See ``HistoryTransfer``."""
        memory: TipMemory = opened(record, len(self._tau), self.modes, self._points)
        return memory

    def _take_over(self, k: int, new: Any, old: Any, overlap: Field | None) -> None:
        new.known[0] = SHAPE
        recall_tip_points(self._solver, k, new, self._bound)


def step(
    state: TipState,
    stepper: TipTimeStepper,
    history: History,
    dt: float,
    weights: Weights,
    position: Array,
    coefficients: Array,
    started: float,
    most: int = MAX_ITERATIONS,
    begun: Touch | None = None,
) -> tuple[Touch, History]:
    """Answer a finite position of the tip ``dt`` (s) after the end of a history.

    Parameters
    ----------
    state : TipState
        Working memory; it keeps nothing from step to step.
    stepper : TipTimeStepper
    history : History
        Not changed.
    dt : float, s
    weights : Weights
        Of ``dt``.
    position : ndarray, shape (3,), mm
    coefficients : ndarray, shape (3, HISTORY_FEATURES)
        Of the error estimate: displacement, von Mises stress, force.
    started : float, s
        When the clock began to run.
    most : int
        Iterations in one local model; see ``reduced.touch.query``.
    begun : Touch, optional
        Without an answer, from the same history: the search goes on where that ended.

    Returns
    -------
    touch : Touch
        Its estimated errors are the largest until now of displacement, stress and force, relative
        to the largest of these until now.  Without an answer its patches are where the search is.
    history : History
        To go on from; the old one if the answer did not converge.

    Raises
    ------
    QueryError
        If the tip's centre lies below the surface.
    """
    last = position if history.position is None else history.position
    place_tip(state.bound, position, last)
    outcome, radius = state.outcome, state.radius
    scalars, limit = outcome.scalars, outcome.limit.item()
    depth = scalars.item(DEPTH)
    if depth > radius:
        raise QueryError(
            "position",
            f"the tip's centre lies {depth - radius:.2f} mm below the accessible surface",
        )
    off = depth < -SKIN * radius
    active: list[tuple[int, int]] = []
    shares = outcome.weight.tolist()
    if not (off and history.main < 0):
        numbers = state.outcome.patch.tolist()
        active = [(slot, -2 - numbers[slot]) for slot, share in enumerate(shares) if share > 0.0]
    starts = {} if begun is None else {k: q for k, _, q in begun.patches}
    found, ended = stepper.press(history, active, position, weights, most, starts)
    converged = not ended
    if not converged:  # not even in part
        outcome.force[:] = 0.0
        outcome.tangent[:] = 0.0
    pushed = stepper.conclude(position)
    after = History(
        time=history.time + dt,
        locals=found,
        main=max(active, key=lambda pair: shares[pair[0]])[1] if active else -1,
        position=history.position if off else position,
        share=max(history.share, depth / limit),
        response=max(history.response, pushed),
        travel=history.travel + (0.0 if off else math.dist(position.tolist(), last.tolist())),
        smallest=min(history.smallest, scalars.item(SMALLEST_J)),
    )
    features, estimates = judge(
        coefficients, outcome.upward, after.share, after.response, after.travel, after.smallest
    )
    errors = estimates.tolist()
    contact = scalars.item(TOUCHED) > 0
    out_of_range: tuple[str, ...] = ()
    if contact and scalars.item(BESIDE):
        out_of_range += ("position",)
    if depth > limit * (1 + 1e-9):
        out_of_range += ("depth",)
    parts = tuple((k, shares[slot], found[k]) for slot, k in active if k in found)
    touch = Touch(
        position=position,
        contact=contact,
        force=outcome.force.copy(),
        tangent=outcome.tangent.copy(),
        contact_point=outcome.point.copy(),
        normal=outcome.normal.copy(),
        depth=depth,
        depth_limit=limit,
        penetration=scalars.item(PENETRATION),
        energy=scalars.item(ENERGY),
        converged=converged,
        iterations=int(scalars.item(ITERATIONS)),
        in_range=not out_of_range,
        out_of_range=out_of_range,
        error_displacement=errors[0],
        error_von_mises=errors[1],
        error_force=errors[2],
        min_jacobian=scalars.item(SMALLEST_J),
        features=features,
        patches=tuple((k, share, local.record[: stepper.modes]) for k, share, local in parts)
        + tuple((k, 0.0, q) for k, q in ended.items()),
        solve_seconds=time.perf_counter() - started,
        time=after.time,
        active=parts,
    )
    return touch, after if converged else history
