"""The haptic side of a session: a force for every tick of the device, between and after replies.

A haptic device wants a force every millisecond; replies come late and not always. In between, the
last reply gives the force at the device's own position, F(x) = F_0 + K (x - x_0), with the step
x - x_0 held to the reply's valid radius, and without what would pull the tip into the tissue. When
a reply comes in, the difference to what the device felt before dwindles during `BLEND` seconds;
when replies stop, or only repeat the last good answer, the force fades away.

Times are of the client's clock, s; lengths mm; forces mN.
"""

import math
from collections.abc import Sequence

import numpy as np

from palpate.online.session.frames import Flag, Reply
from palpate.shared.arrays import Array, Field

BLEND = 5e-3
"""Seconds over which a new reply takes over."""

HOLD = 50e-3
"""Age of a reply, s, up to which its force stands."""

RAMP = 100e-3
"""Seconds over which the force then fades to zero."""


def linear_force(reply: Reply, position: Array) -> Array:
    """Linearised force (3,) of a reply at most its valid radius away; it never points inwards."""
    step = position - reply.position
    length = math.sqrt(step @ step)
    if length > reply.valid_radius:
        step = step * (reply.valid_radius / length)
    return without_pull(reply.force + reply.tangent @ step, reply.normal)


def without_pull(force: Array, normal: Field) -> Array:
    """Drop the part of a force (3,) that points against the outward normal (3,)."""
    outward = normal.astype(np.float64)
    push = float(force @ outward)
    return force if push >= 0.0 else force - push / (outward @ outward) * outward


def fade(age: float) -> float:
    """Share of its force that a reply of some age (s) still has."""
    return min(1.0, max(0.0, 1.0 - (age - HOLD) / RAMP))


class Extrapolator:
    """The force on a device between replies; `most` is the largest, mN.

    Examples
    --------
    >>> extrapolator = Extrapolator(most=3000.0)        # doctest: +SKIP
    >>> while device.running:                           # 1 kHz
    ...     now, position = perf_counter(), device.position()
    ...     session.send(position)
    ...     while (reply := session.poll()) is not None:
    ...         extrapolator.update(reply, now)
    ...     device.push(extrapolator.force(position, now))
    """

    def __init__(self, most: float) -> None:
        self._most = most
        self._reply: Reply | None = None
        self._since = 0.0
        self._position: Array | None = None
        self._offset = np.zeros(3)

    def update(self, reply: Reply, now: float) -> None:
        """Take over a reply that came at `now`; one with `Flag.FALLBACK` tells nothing new."""
        if reply.flags & Flag.FALLBACK:
            return
        position = reply.position if self._position is None else self._position
        self._offset = self._force(position, now) - linear_force(reply, position)
        self._reply = reply
        self._since = now

    def force(self, position: Sequence[float], now: float) -> Array:
        """Force (3,) mN on the device at a position (mm) at `now` (s)."""
        self._position = np.array(position, np.float64)
        return self._force(self._position, now)

    def _force(self, position: Array, now: float) -> Array:
        if self._reply is None:
            return np.zeros(3)
        age = now - self._since
        left = max(0.0, 1.0 - age / BLEND) * self._offset
        force = without_pull(linear_force(self._reply, position) + left, self._reply.normal)
        force = fade(age) * force
        size = math.sqrt(force @ force)
        return force if size <= self._most else force * (self._most / size)
