"""Recorded sessions answered again, bit for bit."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.online.session import frames
from palpate.online.session.frames import REPLY
from palpate.online.session.recording import Recording, RecordingError
from palpate.online.session.tracker import Snapshot, ToolTracker, recover
from palpate.shared.model import ReducedModel

VOLATILE = ("server_received", "server_sent", "solve_time", "superseded")
"""Fields of a reply that depend on the clock and on the network."""


class Replay(NamedTuple):
    """How a replay compares with its recording."""

    replies: int
    different: int  # replies that are not the same, bit for bit
    first_different: int | None  # number of the first of them
    force_difference: float  # largest of a component, mN


def replay(recording: Recording, model: ReducedModel) -> Replay:
    """Answer a recorded session again and compare.

    The bits are those of compiled kernels from the cache: a process that has compiled some itself,
    a server at its very first start, may differ from them in the last ones.

    Raises
    ------
    RecordingError
        If the recording is of another scene.
    """
    if model.name != recording.scene:
        raise RecordingError(
            f"the recording is of scene {recording.scene!r}, the artifact of {model.name!r}"
        )
    tracker = ToolTracker(model)
    snapshots: dict[int, Snapshot] = {}
    commands = list(recording.commands)
    again = np.zeros_like(recording.replies)
    for i, request in enumerate(recording.requests):
        while commands and commands[0].replies <= i:
            command = commands.pop(0)
            if command.restores:
                tracker.restore(snapshots[command.number])
            else:
                snapshots[command.number] = tracker.snapshot()
        steps = int(recording.replies["steps"][i])
        answer = tracker.repeat(request.position, steps, request.client_time)
        extras = recover(model, answer.touch, request.outputs)
        frame = frames.encode_reply(request, answer, extras)
        again[i] = np.frombuffer(frame, REPLY, 1)[0]
    for name in VOLATILE:
        again[name] = recording.replies[name]
    different = np.flatnonzero(_bytes(again) != _bytes(recording.replies))
    forces = np.abs(again["force"] - recording.replies["force"])
    return Replay(
        replies=len(again),
        different=len(different),
        first_different=int(different[0]) if len(different) else None,
        force_difference=float(forces.max(initial=0.0)),
    )


def _bytes(replies: NDArray[Any]) -> NDArray[Any]:
    """Rows as opaque bytes, for which a NaN is equal to itself and -0 is not 0."""
    return np.ascontiguousarray(replies).view(f"V{REPLY.itemsize}")
