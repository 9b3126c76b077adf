"""Following a tool: from one position of its tip to the next, whatever the next one is.

A position is first tried as it is, from the warm start of the last. If no equilibrium is found
there, the way to it from the last good position is walked in ever smaller strides, for as long as
there is time. What is answered is then the farthest good position, with a flag, and never a state
that is no equilibrium. Where tissue snaps there is no such way: the search for where it comes to
rest goes on from position to position.
"""

import math
from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.online.session.frames import Flag
from palpate.shared.errors import QueryError
from palpate.shared.model import ReducedModel
from palpate.shared.reduced.touch import Touch

Array = NDArray[np.float64]

VALID = 0.2
"""Share of the depth over which force and tangent of an answer serve.

In Hertz's theory the force goes with the depth d as d^1.5; linearised at d, it is wrong by
0.375 (s / d)^2 of itself after a step s, which makes 1.5 % here. What a thin fold makes of it was
measured on the turbinate: up to 5 % for 95 % of steps of this length in any direction.
"""

MOST_ITERATIONS = 8
"""Of one solve: a step that takes more is walked in shorter strides, within the time there is."""

PATIENCE = 6
"""Positions over which the search for an equilibrium goes on before it starts from rest."""

SHORTEST = 1.0 / 64.0
"""Stride, as a part of the way, that is not halved any more."""

_CONTACT, _CONVERGED, _IN_RANGE = map(int, (Flag.CONTACT, Flag.CONVERGED, Flag.IN_RANGE))
_CLAMPED, _FALLBACK = int(Flag.CLAMPED), int(Flag.FALLBACK)


class Step(NamedTuple):
    """The answer to a position of the tip.

    Parameters
    ----------
    touch : Touch
    flags : int
        Bits of `session.frames.Flag`.
    steps : int
        Positions solved on the way.
    valid_radius : float, mm
        How far from the position force and tangent may serve.
    solve_seconds : float
    reason : str
        Why there is no answer to the position itself, if so.
    """

    touch: Touch
    flags: int
    steps: int
    valid_radius: float
    solve_seconds: float
    reason: str = ""


class Follower:
    """The tip of one session and where it has been.

    Parameters
    ----------
    atlas : ReducedModel
    """

    def __init__(self, atlas: ReducedModel) -> None:
        self._atlas = atlas
        self._state = atlas.new_state()
        self._good: Touch | None = None
        self._lost = 0

    def restart(self) -> None:
        """Forget where the tip has been: answers are then those of a new follower."""
        self._state.forget()
        self._good = None
        self._lost = 0

    def follow(self, position: Sequence[float], budget: float, now: float = 0.0) -> Step:
        """Answer a position at a client's time `now` (s).

        No new solve is begun after `budget` seconds.
        """
        end = perf_counter() + budget
        return self._follow(position, lambda steps: perf_counter() < end, now)

    def repeat(self, position: Sequence[float], steps: int, now: float = 0.0) -> Step:
        """Answer a position as a session did that solved `steps` positions on the way.

        With the same atlas and the same positions and times before it, the answer is the same, bit
        for bit.
        """
        return self._follow(position, lambda taken: taken < steps, now)

    def snapshot(self) -> Any:
        """Keep the state of the tissue, for `restore`."""
        return self._good

    def restore(self, snapshot: Any) -> None:
        """Go back to a snapshot of this follower. Elastic tissue has no state but its answer."""
        self.restart()
        self._good = snapshot

    def _follow(
        self, position: Sequence[float], may_go_on: Callable[[int], bool], now: float
    ) -> Step:
        start = perf_counter()
        target = np.array(position, np.float64)
        share, steps, reason = 1.0, 1, ""
        try:
            if not self._solve(target, 1.0):
                reason = "no equilibrium was found there"
                share, steps = self._catch_up(target, may_go_on)
        except QueryError as error:
            reason, share = error.message, 0.0
        touch = self._good or _nothing(target)
        flags = _CONTACT * touch.contact + _CONVERGED * touch.converged + _IN_RANGE * touch.in_range
        if share == 0.0:
            flags |= _FALLBACK
        elif share < 1.0:
            flags |= _CLAMPED
        else:
            reason = ""
        return Step(touch, flags, steps, _valid_radius(touch), perf_counter() - start, reason)

    def _catch_up(self, target: Array, may_go_on: Callable[[int], bool]) -> tuple[float, int]:
        """Get nearer to a target that was missed: share of the way, steps tried.

        Where there is no way the tissue snaps: equilibria end, and the next is far off.
        """
        share, steps = (0.0, 1) if self._lost else self._walk(target, may_go_on)
        if share > 0.0:
            return share, steps
        self._lost += 1
        self._search_on(self._lost % PATIENCE != 0)
        return share, steps

    def _search_on(self, where_it_ended: bool) -> None:
        """Let the search for a position go on with the next, or start anew."""
        if where_it_ended:
            self._state.go_on()
        else:
            self._state.forget()

    def _walk(self, target: Array, may_go_on: Callable[[int], bool]) -> tuple[float, int]:
        """Go towards the target from the last good position: share of the way, steps tried."""
        share, stride, steps = 0.0, 0.5, 1
        if self._good is None:
            return share, steps
        start = self._good.position
        while share < 1.0 and stride >= SHORTEST and may_go_on(steps):
            steps += 1
            ahead = min(share + stride, 1.0)
            if self._solves((1.0 - ahead) * start + ahead * target, ahead):
                share = ahead
            else:
                stride *= 0.5
        return share, steps

    def _solves(self, position: Array, share: float) -> bool:
        """Solve a position that may have no answer at all."""
        try:
            return self._solve(position, share)
        except QueryError:
            return False

    def _solve(self, position: Array, share: float) -> bool:
        """Solve a position; tell whether that led to an equilibrium, which is then the last.

        It is at a share of the way, which matters to tissue that remembers.
        """
        touch = self._atlas.touch(position, self._state, MOST_ITERATIONS)
        if not (touch.converged and is_finite(touch)):
            return False
        self._good = touch
        self._lost = 0
        return True


def is_finite(touch: Touch) -> bool:
    """Whether an answer holds no NaN, and no infinity but in its error estimates."""
    numbers = (
        *touch.force.tolist(),
        *touch.tangent.ravel().tolist(),
        *touch.contact_point.tolist(),
        *touch.normal.tolist(),
        touch.energy,
        touch.depth,
        touch.penetration,
        touch.min_jacobian,
    )
    # an estimate may be infinite: nothing is known of the error then
    estimates = touch.error_displacement + touch.error_von_mises + touch.error_force
    return math.isfinite(sum(numbers)) and not math.isnan(estimates)


def _nothing(position: Array) -> Touch:
    """No force and no claim, for when there has been no good answer yet."""
    return Touch(
        position=position,
        contact=False,
        force=np.zeros(3),
        tangent=np.zeros((3, 3)),
        contact_point=position,
        normal=np.zeros(3),
        depth=0.0,
        depth_limit=0.0,
        penetration=0.0,
        energy=0.0,
        converged=False,
        iterations=0,
        in_range=False,
        out_of_range=(),
        error_displacement=0.0,
        error_von_mises=0.0,
        error_force=0.0,
        min_jacobian=1.0,
        features=np.zeros(0),
        patches=(),
        solve_seconds=0.0,
    )


def _valid_radius(touch: Touch) -> float:
    """How far force and tangent serve (mm); without contact, the way to it."""
    return VALID * touch.depth if touch.contact else max(0.0, -touch.depth)
