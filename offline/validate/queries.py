"""Random queries over the whole surface and range of loads: presses, tip positions, histories."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.problem import Load, Step, TipPosition
from palpate.offline.reduce.sampling import cone, random_points, random_points_and_rim, tangents
from palpate.shared.mechanics.footprint import TIP_DEPTH, pressure_limit
from palpate.shared.model import ReducedModel

Array = NDArray[np.float64]

MOVEMENTS = 4
"""Of the tool in a history, after it has been pressed on."""

FASTEST_STEP = 0.01
"""Shortest time step of a movement, s."""

LIFTED = 0.05
"""Millimetres between the surface at rest and a tip that does not press."""


def random_loads(model: ReducedModel, count: int, rng: np.random.Generator) -> list[Load]:
    """Random loads over the whole surface, cone of directions and range of pressures.

    Contact points are uniform over the area, one in eight on the rim of the surface; directions are
    uniform in the cone, one in eight on its border; pressures are denser towards the limit.
    """
    loads, tilt = [], model.scene.endoscope.max_tilt
    for i, point in enumerate(random_points_and_rim(model.surface, count, rng)):
        x, normal, _, fields = model.surface.locate(point, model.limits)
        direction = cone(normal, tilt, 1, rng, border=i % 8 == 1)[0]
        limit = pressure_limit(fields, normal, direction)
        loads.append(Load(x, direction, float(limit * np.sqrt(rng.random()))))
    return loads


def random_positions(
    model: ReducedModel, count: int, rng: np.random.Generator
) -> list[TipPosition]:
    """Positions of the tip over the whole surface and range of depths.

    Contact points are uniform over the area, one in eight on the rim of the surface; depths are
    denser towards the limit.
    """
    positions = []
    for point in random_points_and_rim(model.surface, count, rng):
        x, normal, _, fields = model.surface.locate(point, model.limits)
        depth = fields[TIP_DEPTH] * np.sqrt(rng.random())
        positions.append(TipPosition(x + (model.scene.endoscope.radius - depth) * normal))
    return positions


def random_histories(
    model: ReducedModel, count: int, rng: np.random.Generator, tip: bool = False
) -> list[list[Any]]:
    """Histories over the whole surface and range, of loads or of the rigid tip.

    They are made of ramps, holds, releases, taps and slides; one in eight begins on the rim.
    """
    return [Tool(model, rng, tip, rim=i % 8 == 0).history() for i in range(count)]


class Tool:
    """A footprint or the rigid tip on the surface, first on its rim if wanted, and how it moves on.

    A footprint leans as it did at the beginning, as far as it may.
    """

    def __init__(self, model: ReducedModel, rng: np.random.Generator, tip: bool, rim: bool) -> None:
        self._surface, self._ranges = model.surface, model.limits
        self._endoscope, self._rng, self._tip = model.scene.endoscope, rng, tip
        self._level = 0.0
        if rim:
            self._go(self._surface.vertices[rng.choice(self._surface.rim())])
        else:
            self._go(random_points(self._surface, 1, rng)[0])
        self._lean = cone(self._normal, self._endoscope.max_tilt, 1, rng)[0] + self._normal

    def history(self) -> list[Step]:
        """Press on, then make a few movements at random."""
        steps = list(self._ramp(0.3 + 0.7 * self._rng.random()))
        movements = (self._hold, self._release, self._tap, self._slide, self._slide)
        for number in self._rng.integers(len(movements), size=MOVEMENTS):
            steps += movements[number]()
        return steps

    def _go(self, x: Array) -> None:
        self._x, self._normal, _, self._limits = self._surface.locate(x, self._ranges)

    def _step(self, dt: float) -> Step:
        """The tool where it is, after a time step."""
        if self._tip:
            depth = self._level * self._limits[TIP_DEPTH] if self._level > 0.0 else -LIFTED
            return TipPosition(self._x + (self._endoscope.radius - depth) * self._normal, dt)
        direction = self._lean - self._normal
        direction /= np.linalg.norm(direction)
        tilt = np.degrees(np.arccos(np.clip(-direction @ self._normal, -1, 1)))
        if tilt > self._endoscope.max_tilt:
            direction = -self._normal
        limit = pressure_limit(self._limits, self._normal, direction)
        return Load(self._x.copy(), direction, float(self._level * limit), dt)

    def _ramp(self, level: float, seconds: float | None = None) -> Iterator[Step]:
        """Press harder or softer, evenly."""
        seconds = 10 ** self._rng.uniform(-1.3, 0.0) if seconds is None else seconds
        count = 5
        for share in np.linspace(self._level, level, count + 1)[1:]:
            self._level = share
            yield self._step(max(seconds / count, FASTEST_STEP))

    def _hold(self) -> Iterator[Step]:
        """Stay; steps grow as less happens."""
        seconds = 10 ** self._rng.uniform(-1.0, 0.5)
        for share in np.diff(np.linspace(0, 1, 7) ** 2):
            yield self._step(seconds * share)

    def _release(self) -> Iterator[Step]:
        """Lift the tool at once, wait, press again."""
        level = self._level
        yield from self._ramp(0.0, 0.05)
        yield from self._hold()
        yield from self._ramp(level)

    def _tap(self) -> Iterator[Step]:
        """Twice, quickly."""
        for _ in range(2):
            yield from self._ramp(0.0, 0.05)
            yield from self._ramp(0.3 + 0.7 * self._rng.random(), 0.05)

    def _slide(self) -> Iterator[Step]:
        """Move over the surface at 3 to 30 mm/s, as far as 8 mm or to where it ends."""
        speed, length = 10 ** self._rng.uniform(0.5, 1.5), self._rng.uniform(2.0, 8.0)
        turn = self._rng.uniform(0, 2 * np.pi)
        heading = np.array([np.cos(turn), np.sin(turn)]) @ np.array(tangents(self._normal))
        count = int(np.ceil(length / 0.5))
        for _ in range(count):
            self._go(self._x + length / count * heading)
            heading -= heading @ self._normal * self._normal
            heading /= max(float(np.linalg.norm(heading)), 1e-9)
            yield self._step(length / count / speed)
