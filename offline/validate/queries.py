"""Random queries of every kind, over the whole surface and range of loads."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Self

import numpy as np

from palpate.offline.fem.problem import Load, Step, TipPosition
from palpate.offline.reduce.sampling import (
    cone,
    random_points,
    random_points_and_rim,
    random_tangent,
)
from palpate.offline.run.streams import Stage, stream
from palpate.shared.arrays import Array
from palpate.shared.mechanics.footprint import TIP_DEPTH, pressure_limit
from palpate.shared.model import ReducedModel
from palpate.shared.scene import Scene

MOVEMENTS = 4
"""Of the tool in a history, after it has been pressed on."""

FASTEST_STEP = 0.01
"""Shortest time step of a movement, s."""

DRAWS = 10
"""Times that positions of the tip are drawn, as many as are wanted, until enough are in range."""

LIFTED = 0.05
"""Millimetres between the surface at rest and a tip that does not press."""


class Place(NamedTuple):
    """A point of the surface, and what may press there."""

    position: Array  # (3,) mm
    normal: Array  # (3,), outward
    limits: Array  # (LIMIT_FIELDS,)
    radius: float  # mm, of the endoscope

    @classmethod
    def at(cls, model: ReducedModel, point: Array) -> Self:
        """The place nearest to a point (3,) mm."""
        x, normal, _, limits = model.surface.locate(point, model.limits)
        return cls(x, normal, limits, model.scene.endoscope.radius)

    def limit(self, direction: Array) -> float:
        """Largest trained pressure (kPa) along a direction."""
        return float(pressure_limit(self.limits, self.normal, direction))

    @property
    def depth(self) -> float:
        """Largest trained depth of the tip, mm."""
        return float(self.limits[TIP_DEPTH])

    def press(self, direction: Array, level: float, dt: float = 0.0) -> Load:
        """A footprint pressed to a level: 1 is the limit."""
        return Load(self.position, direction, float(level * self.limit(direction)), dt)

    def touch(self, level: float, dt: float = 0.0) -> TipPosition:
        """The rigid tip as deep as a level says; at 0 it does not touch."""
        depth = level * self.depth if level > 0.0 else -LIFTED
        return TipPosition(self.position + (self.radius - depth) * self.normal, dt)


def random_loads(model: ReducedModel, count: int, rng: np.random.Generator) -> list[Load]:
    """Random loads over the whole surface, cone of directions and range of pressures.

    Contact points are uniform over the area, one in four on the rim of the surface; directions are
    uniform in the cone, one in eight on its border; pressures are denser towards the limit.
    """
    loads, tilt = [], model.scene.endoscope.max_tilt
    for i, point in enumerate(random_points_and_rim(model.surface, count, rng)):
        place = Place.at(model, point)
        direction = cone(place.normal, tilt, 1, rng, border=i % 8 == 1)[0]
        loads.append(place.press(direction, np.sqrt(rng.random())))
    return loads


def random_positions(
    model: ReducedModel, count: int, rng: np.random.Generator
) -> list[TipPosition]:
    """Positions of the tip over the whole surface and range of depths.

    Contact points are uniform over the area, one in four on the rim of the surface; depths are
    denser towards the limit.  A tip that is deeper than that in another side of a cleft is left
    out, unless hardly any is not.
    """
    within, beyond = list[TipPosition](), list[TipPosition]()
    for _ in range(DRAWS):
        for point in random_points_and_rim(model.surface, count, rng):
            step = Place.at(model, point).touch(np.sqrt(rng.random()))
            nearest = Place.at(model, step.position)
            depth = nearest.radius - model.surface.height(step.position)
            kept = within if depth <= nearest.depth else beyond
            kept.append(step)
        if len(within) >= count:
            break
    return [*within, *beyond][:count]


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
        self._model, self._rng, self._tip, self._level = model, rng, tip, 0.0
        surface, self._most = model.surface, model.scene.endoscope.max_tilt
        if rim:
            self._go(surface.vertices[rng.choice(surface.rim())])
        else:
            self._go(random_points(surface, 1, rng)[0])
        self._lean = cone(self._place.normal, self._most, 1, rng)[0] + self._place.normal

    def history(self) -> list[Step]:
        """Press on, then make a few movements at random."""
        steps = list(self._ramp(0.3 + 0.7 * self._rng.random()))
        movements = (self._hold, self._release, self._tap, self._slide, self._slide)
        for number in self._rng.integers(len(movements), size=MOVEMENTS):
            steps += movements[number]()
        return steps

    def _go(self, x: Array) -> None:
        self._place = Place.at(self._model, x)

    def _step(self, dt: float) -> Step:
        """The tool where it is, after a time step."""
        if self._tip:
            return self._place.touch(self._level, dt)
        normal = self._place.normal
        direction = self._lean - normal
        direction /= np.linalg.norm(direction)
        tilt = np.degrees(np.arccos(np.clip(-direction @ normal, -1, 1)))
        return self._place.press(-normal if tilt > self._most else direction, self._level, dt)

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
        heading = random_tangent(self._place.normal, self._rng)
        count = int(np.ceil(length / 0.5))
        for _ in range(count):
            self._go(self._place.position + length / count * heading)
            heading -= heading @ self._place.normal * self._place.normal
            heading /= max(float(np.linalg.norm(heading)), 1e-9)
            yield self._step(length / count / speed)


def held_out(model: ReducedModel, seed: int) -> np.random.Generator:
    """Random numbers that training has not drawn, whatever the seed."""
    return stream(model.scene.seed, Stage.UNSEEN, seed)


def held_out_loads(model: ReducedModel, count: int, seed: int) -> list[Load]:
    """Random loads that training has not seen, whatever the seed."""
    return random_loads(model, count, held_out(model, seed))


class Kind(NamedTuple):
    """A kind of query."""

    name: str  # of its error estimate, see ``shared.local_models.Estimators``
    tip: bool  # whether the rigid tip presses, not a footprint
    in_time: bool  # whether over a history
    stage: Stage  # whose random numbers training draws
    document: str  # name of its summary in an artifact
    title: str  # what its full solutions are called
    damping: float  # of the error estimate, see ``calibrate``
    quantities: tuple[str, ...]  # what errors are estimated of; the force of a footprint is given
    others: tuple[str, ...]  # what a summary has statistics of beside the quantities

    def random(
        self, model: ReducedModel, count: int, rng: np.random.Generator
    ) -> list[Sequence[Any]]:
        """Queries over the whole surface and range of loads."""
        if self.in_time:
            return [*random_histories(model, count, rng, self.tip)]
        steps = random_positions if self.tip else random_loads
        return [[step] for step in steps(model, count, rng)]

    def of_young(self, queries: list[Sequence[Any]], ratio: float) -> list[Sequence[Any]]:
        """The same for tissue so many times as stiff, which moves as far under as much more."""
        if self.tip:
            return queries
        return [
            [replace(load, pressure=ratio * load.pressure) for load in query] for query in queries
        ]

    def lacks(self, scene: Scene) -> str | None:
        """What a scene lacks for queries of this kind."""
        if self.tip and not scene.endoscope.tip:
            return "was trained without a tip"
        return (
            "is elastic and has no histories" if self.in_time and not scene.tissue.prony else None
        )


FIELDS = "displacement", "von_mises"
LOADS = Kind(
    "loads", False, False, Stage.VALIDATION, "validation", "full solutions", 0.3,
    FIELDS, ("von_mises_p99",),
)  # fmt: skip
TIP = Kind(
    "touches", True, False, Stage.TIP_VALIDATION, "validation_tip",
    "full solutions under the tip", 1.0,
    (*FIELDS, "force"), ("tangent",),
)  # fmt: skip
HISTORIES = Kind(
    "histories", False, True, Stage.HISTORY_VALIDATION, "validation_histories",
    "full histories", 30.0,
    FIELDS, ("depth", "worst_displacement", "worst_von_mises", "last_displacement"),
)  # fmt: skip
TIP_HISTORIES = Kind(
    "courses", True, True, Stage.TIP_HISTORY_VALIDATION, "validation_tip_histories",
    "full histories under the tip", 30.0,
    TIP.quantities, tuple(f"{of}_{x}" for of in ("worst", "together") for x in TIP.quantities),
)  # fmt: skip

KINDS = (LOADS, TIP, HISTORIES, TIP_HISTORIES)
