"""Recorded sessions answered again, bit for bit."""

import math
from typing import Any

import numpy as np

from palpate.online.session import frames
from palpate.online.session.frames import REPLY
from palpate.online.session.recording import Recording
from palpate.online.session.tracker import Snapshot, ToolTracker, recover
from palpate.shared.errors import PalpateError
from palpate.shared.model import ReducedModel

VOLATILE = ("server_received", "server_sent", "solve_time", "superseded")
"""Fields of a reply that depend on the clock and on the network."""


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
    snapshots: dict[int, Snapshot] = {}
    again = np.zeros_like(recording.replies)
    for i, request in enumerate(recording.requests):
        while commands and commands[0][0] <= i:
            _, restores, number = commands.pop(0)
            if restores:
                tracker.restore(snapshots[number])
            else:
                snapshots[number] = tracker.snapshot()
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
