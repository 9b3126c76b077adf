"""Following a tool over tissue that remembers: its time is the client's.

The time since the last answer is that between the `client_time` of the two frames, so a client
gives its own time steps or, as a rule, its clock.  The tool moved evenly in it.  A way that is
walked in strides takes its time in the same parts; where it ends early (`CLAMPED`) the tissue is
so much behind and catches up with the next frame; without an answer (`FALLBACK`) its time stands
still.  A client that stalls would make one step of a long time, in which nobody knows where its
tool was: at most `LONGEST` passes between two answers, and `STALLED` says that it was cut.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.online.session.follower import MOST_ITERATIONS, Follower, Step, is_finite
from palpate.online.session.frames import Flag
from palpate.shared.model import ReducedModel
from palpate.shared.reduced.history import History
from palpate.shared.reduced.touch import Touch

Array = NDArray[np.float64]

LONGEST = 0.1
"""Seconds that pass between two answers at most."""

_STALLED = int(Flag.STALLED)


class Snapshot(NamedTuple):
    """State of the tissue, to go back to; nothing in it ever changes."""

    history: History
    good: Touch | None


class TimedFollower(Follower):
    """The tip of one session on tissue that remembers.

    Parameters
    ----------
    atlas : ReducedModel
    """

    def __init__(self, atlas: ReducedModel) -> None:
        super().__init__(atlas)
        self._rest()

    def restart(self) -> None:
        """Forget where the tip has been: the tissue is at rest."""
        super().restart()
        self._rest()

    def _rest(self) -> None:
        self._history = History()
        self._clock: float | None = None
        self._span = self._share = 0.0
        self._begun: Touch | None = None

    def snapshot(self) -> Snapshot:
        """Keep the state of the tissue, for `restore`."""
        return Snapshot(self._history, self._good)

    def restore(self, snapshot: Snapshot) -> None:
        """Go back to a snapshot; the client's time goes on from its last frame."""
        self._history, self._good = snapshot
        self._lost = 0
        self._begun = None

    def _follow(
        self, position: Sequence[float], may_go_on: Callable[[int], bool], now: float
    ) -> Step:
        passed = 0.0 if self._clock is None else now - self._clock
        self._span = min(max(passed, 0.0), LONGEST)
        self._share = 0.0
        step = super()._follow(position, may_go_on, now)
        # what has not passed yet is left for the next frame
        self._clock = now - (1.0 - self._share) * self._span
        if passed != self._span:
            step = step._replace(flags=step.flags | _STALLED)
        return step

    def _solve(self, position: Array, share: float) -> bool:
        dt = (share - self._share) * self._span
        begun = self._begun if self._lost else None
        touch, history = self._atlas.touch_step(self._history, dt, position, MOST_ITERATIONS, begun)
        if not (touch.converged and is_finite(touch)):
            self._begun = None if touch.converged else touch
            return False
        self._history, self._good, self._share = history, touch, share
        self._lost = 0
        return True

    def _search_on(self, where_it_ended: bool) -> None:
        if not where_it_ended:
            self._begun = None


def follower_of(atlas: ReducedModel) -> Follower:
    """Make the follower that the tissue of an atlas asks for."""
    return TimedFollower(atlas) if atlas.scene.tissue.prony else Follower(atlas)
