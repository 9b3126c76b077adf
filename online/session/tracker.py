"""Following a tool, in a session or its recording: from one position to the next, whatever it is.

A position is first tried as it is, from the warm start of the last. If no equilibrium is found
there, the way to it from the last good position is walked in smaller and smaller strides, for as
long as there is time; the answer is the farthest good position. Where tissue snaps there is no such
way: the next position is searched for from rest.

In visco-elastic tissue as much time passes between two answers as between the `client_time` of
their frames, and the tool moved evenly in it. A way that is walked in strides takes its time in the
same parts; where it ends early (`CLAMPED`) the rest passes with the next frame; without an answer
(`FALLBACK`) time stands still. After a pause nobody knows where the tool was: at most `LONGEST`
passes between two answers, and `STALLED` says that it was cut.
"""

import math
from collections.abc import Sequence
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.online.session import frames
from palpate.online.session.frames import REPLY, Extras, Flag, Output, Reason, ToolAnswer
from palpate.online.session.recording import Recording
from palpate.shared.answer import Answer
from palpate.shared.arrays import Array
from palpate.shared.errors import PalpateError, QueryError
from palpate.shared.model import ReducedModel
from palpate.shared.reduced.transfer import REST, Past

VALID = 0.2
"""Share of the depth over which force and tangent of an answer hold.

In Hertz's theory the force goes with the depth d as d^1.5; linearised at d, it is wrong by
0.375 (s / d)^2 of itself after a step s, which makes 1.5 % here. On the thin folds of the turbinate
it was measured to be wrong by up to 5 % for 95 % of steps of this length in any direction.
"""

SHORTEST = 1.0 / 64.0
"""Stride, as a part of the way, that is not halved any more."""

LONGEST = 0.1
"""Largest time that passes between two answers, s."""

VOLATILE = ("server_received", "server_sent", "solve_time", "superseded")
"""Fields of a reply that depend on the clock and on the network."""

# enumerations are slow to calculate with
_CONTACT, _CONVERGED, _IN_RANGE, _CLAMPED, _FALLBACK, _STALLED, _FIRST, _TOO_DEEP, _BESIDE = map(
    int, Flag
)
_COORDINATES, _DISPLACEMENT, _VON_MISES, _STRESS, _HALF, _PARTS = map(int, Output)
_SOLVED, _NO_EQUILIBRIUM, _BELOW_SURFACE = map(int, Reason)


class ToolTracker:
    """The tool of one session, and where it has been."""

    def __init__(self, model: ReducedModel) -> None:
        self._model = model
        self._rest = REST if model.scene.tissue.prony else None
        self._warm = model.new_warm()
        self.restart()

    def restart(self) -> None:
        """Forget where the tool has been: answers are then those of a new tracker."""
        self.snapshots: dict[int, tuple[Past | None, Answer | None]] = {}
        self._past: Past | None = self._rest
        self._good: Answer | None = None
        self._young: float | None = None
        self._lost = False
        self._warm.forget()
        self._clock: float | None = None
        self._span = self._reached = 0.0

    def obey(self, command: str, value: float) -> None:
        """Keep the state of the tissue by a number, go back to one, or make the tissue as stiff.

        After ``restore`` the search goes on from there, and so does the client's time; ``young`` is
        in kPa, from the next position on.
        """
        if command == "young":
            self._young = value
        elif command == "snapshot":
            self.snapshots[int(value)] = self._past, self._good
        else:
            self._past, self._good = self.snapshots[int(value)]
            self._lost = False
            self._warm.forget()

    def follow(
        self, position: Sequence[float], budget: float, now: float = 0.0, most: float = math.inf
    ) -> ToolAnswer:
        """Answer a position at a client's time `now` (s).

        No new solve is begun after `budget` seconds or `most` solves. With the same model, number
        of solves, positions and times before it, the answer is the same, bit for bit.
        """
        start = perf_counter()
        target = np.array(position, np.float64)
        first, passed = (True, 0.0) if self._clock is None else (False, now - self._clock)
        self._span, self._reached = min(max(passed, 0.0), LONGEST), 0.0
        reason, steps = self._solve(target, 1.0), 1
        if reason == _NO_EQUILIBRIUM:
            steps = self._catch_up(target, start + budget, most)
        # the time that has not passed yet is left for the next frame
        self._clock = now - (1.0 - self._reached) * self._span
        # before the first good answer, one without force and without any claim
        touch = self._good or Answer(position=target, contact_point=target)
        flags = _CONTACT * touch.contact | _FIRST * first
        if self._reached == 0.0:
            flags |= _FALLBACK
        else:
            flags |= _CONVERGED | _IN_RANGE * touch.in_range | _CLAMPED * (self._reached < 1.0)
            flags |= _TOO_DEEP * ("depth" in touch.out_of_range)
            flags |= _BESIDE * ("position" in touch.out_of_range)
        if self._past is not None and passed != self._span:
            flags |= _STALLED
        if self._reached == 1.0:
            reason = _SOLVED
        # without contact an answer holds on the way to it
        valid = VALID * touch.depth if touch.contact else max(0.0, -touch.depth)
        return ToolAnswer(touch, flags, steps, valid, perf_counter() - start, reason)

    def _catch_up(self, target: Array, end: float, most: float) -> int:
        """Get nearer to a target that was missed; return the number of positions tried."""
        steps, stride = 1, 0.5
        if self._good is not None and not self._lost:
            last = self._good.position
            while (
                self._reached < 1.0 and stride >= SHORTEST and steps < most and perf_counter() < end
            ):
                steps += 1
                ahead = min(self._reached + stride, 1.0)
                if self._solve((1.0 - ahead) * last + ahead * target, ahead) != _SOLVED:
                    stride *= 0.5
        if self._reached == 0.0:
            self._lost = True
            self._warm.forget()
        return steps

    def _solve(self, position: Array, share: float) -> int:
        """Solve a position at a share of the way; keep its answer or return why there is none."""
        dt = 0.0 if self._past is None else (share - self._reached) * self._span
        try:
            touch = self._model.touch(
                position, young=self._young, past=self._past, dt=dt, warm=self._warm
            )
        except QueryError:
            return _BELOW_SURFACE
        if not (touch.converged and _is_finite(touch)):
            return _NO_EQUILIBRIUM
        self._past, self._good = touch.past, touch
        self._reached, self._lost = share, False
        return _SOLVED


def _is_finite(touch: Answer) -> bool:
    """Whether an answer holds no NaN, and no infinity but in its error estimates."""
    vectors = (touch.force, touch.tangent.ravel(), touch.contact_point, touch.normal)
    numbers = touch.energy + touch.depth + touch.penetration + touch.min_jacobian
    numbers += sum(sum(vector.tolist()) for vector in vectors)
    estimates = touch.error_displacement + touch.error_von_mises + touch.error_force
    return math.isfinite(numbers) and not math.isnan(estimates)


def recover(model: ReducedModel, touch: Answer, outputs: int) -> Extras:
    """Get what a request asked for beyond force and tangent."""
    if not outputs & ~_HALF:
        return frames.NO_EXTRAS
    kind = np.float16 if outputs & _HALF else np.float32
    surface = model.surface_nodes
    fields: list[NDArray[Any]] = []
    coordinates, nodes = 0, len(surface) if outputs & (_DISPLACEMENT | _VON_MISES) else 0
    largest = percentile = 0.0
    if outputs & _COORDINATES:
        states = [state for _, _, state in touch.parts]
        coordinates = max(map(len, states), default=0)
        rows = np.zeros((frames.MODELS, coordinates), np.float32)
        for row, state in zip(rows, states, strict=False):
            row[:] = state
        fields.append(rows)
    if outputs & _PARTS:
        made = model.composition(touch)
        counts = np.array([*made.states.shape, len(made.dented), 0], np.uint32)
        fields += [counts, *made]
    if outputs & (_DISPLACEMENT | _VON_MISES | _STRESS):
        everywhere = model.displacement(touch)
    if outputs & _DISPLACEMENT:
        fields.append(everywhere[surface].astype(kind))
    if outputs & _VON_MISES:
        stress = model.von_mises(touch, "all", everywhere)
        fields.append(stress[surface].astype(kind))
    if outputs & _STRESS:
        largest, percentile = model.peaks(touch, everywhere)
    return Extras(outputs, coordinates, nodes, largest, percentile, fields)


def replay(recording: Recording, model: ReducedModel) -> dict[str, Any]:
    """Answer a recorded session again and compare.

    Returns the number of ``replies``, of those that are ``different``, that of the first of them
    and the largest difference of a component of the force, mN.

    The bits are those of compiled kernels from the cache: a process that has compiled some itself,
    a server at its very first start, may differ from them in the last ones. Raises `PalpateError`
    if the recording is of another scene.
    """
    if model.name != recording.scene:
        raise PalpateError(
            f"the recording is of scene {recording.scene!r}, the artifact of {model.name!r}"
        )
    tracker, commands = ToolTracker(model), list(recording.commands)
    again = np.zeros_like(recording.replies)
    for i, request in enumerate(recording.requests):
        if recording.replies["flags"][i] & _FIRST:  # of one of the sessions of a client
            tracker.restart()
        while commands and commands[0][0] <= i:
            tracker.obey(*commands.pop(0)[1:])
        steps = int(recording.replies["steps"][i])
        answer = tracker.follow(request.position, math.inf, request.client_time, steps)
        extras = recover(model, answer.touch, request.outputs)
        again[i] = np.frombuffer(frames.encode_reply(request, answer, extras), REPLY, 1)[0]
    for name in VOLATILE:
        again[name] = recording.replies[name]
    # as opaque bytes, for which a NaN is equal to itself and -0 is not 0
    one, other = (table.view(f"V{REPLY.itemsize}") for table in (again, recording.replies))
    different = np.flatnonzero(one != other).tolist()
    forces = np.abs(again["force"] - recording.replies["force"])
    return {
        "replies": len(again),
        "different": len(different),
        "first_different": different[0] if different else None,
        "force_difference": float(forces.max(initial=0.0)),
    }
