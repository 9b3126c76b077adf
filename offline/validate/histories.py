"""The reduced against the full model over histories it has not seen."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.offline.reduce.sampling import cone, random_points, tangents
from palpate.offline.run.workshop import Load, Workshop
from palpate.offline.validate.loads import ESTIMATED, unseen, verdict
from palpate.offline.validate.moments import (
    KnownMoment,
    covered_moments,
    errors_so_far,
    known_moments,
)
from palpate.offline.validate.norms import relative, statistics
from palpate.shared.answer import Answer
from palpate.shared.errors import QueryError
from palpate.shared.geometry.surface import Surface
from palpate.shared.local_models import Estimator
from palpate.shared.mechanics.footprint import pressure_limit
from palpate.shared.model import ReducedModel
from palpate.shared.reduced.transfer import REST
from palpate.shared.scene import Scene

Array = NDArray[np.float64]

NONE_FOLLOWED = "the full model could follow none of the histories"

SEGMENTS = 4
"""Movements in a history."""

FASTEST_STEP = 0.01
"""Shortest time step of a movement, s."""


class Press(NamedTuple):
    """What happens in one time step, and until when it has."""

    dt: float  # s
    position: Array  # (3,) mm
    direction: Array  # (3,)
    pressure: float  # kPa


def random_history(atlas: ReducedModel, rng: np.random.Generator, rim: bool) -> list[Press]:
    """Ramps, holds, releases, taps and slides, as a tool would move.

    Parameters
    ----------
    rim : bool
        Whether to begin on the rim of the surface.
    """
    return random_course(Hand(atlas.surface, atlas.limits, atlas.scene, rng, rim))


def random_histories(
    atlas: ReducedModel, count: int, rng: np.random.Generator
) -> list[list[Press]]:
    """Histories over the whole surface and range of loads; one in eight begins on the rim."""
    return [random_history(atlas, rng, rim=i % 8 == 0) for i in range(count)]


def loads_of(presses: Sequence[Press]) -> tuple[list[Load], list[float]]:
    """What ``Workshop.follow`` is told of a history."""
    return [Load(p.position, p.direction, p.pressure) for p in presses], [p.dt for p in presses]


def random_course(hand: Hand) -> list[Press]:
    """What a hand does, at random."""
    rng = hand.rng
    steps = list(hand.ramp(0.3 + 0.7 * rng.random()))
    movements = (hand.hold, hand.release, hand.tap, hand.slide, hand.slide)
    for number in rng.integers(len(movements), size=SEGMENTS):
        steps += movements[number]()
    return steps


class Hand:
    """A tool on the surface, with what it does next.

    Parameters
    ----------
    surface : Surface
        Accessible.
    limits : ndarray, shape (v, LIMIT_FIELDS)
    scene : Scene
    rng : Generator
    rim : bool
        Whether to begin on the rim of the surface.
    """

    def __init__(
        self, surface: Surface, limits: Array, scene: Scene, rng: np.random.Generator, rim: bool
    ) -> None:
        self._surface, self._ranges, self._endoscope = surface, limits, scene.endoscope
        self.rng = rng
        self._level = 0.0
        self._go(
            surface.vertices[rng.choice(surface.rim())]
            if rim
            else random_points(surface, 1, rng)[0]
        )
        self._lean = cone(self._normal, scene.endoscope.max_tilt, 1, rng)[0] + self._normal

    def _go(self, x: Array) -> None:
        self._x, self._normal, _, self._limits = self._surface.locate(x, self._ranges)

    def _press(self, dt: float) -> Press:
        direction = self._lean - self._normal
        direction /= np.linalg.norm(direction)
        tilt = np.degrees(np.arccos(np.clip(-direction @ self._normal, -1, 1)))
        if tilt > self._endoscope.max_tilt:
            direction = -self._normal
        limit = pressure_limit(self._limits, self._normal, direction)
        return Press(dt, self._x.copy(), direction, float(self._level * limit))

    def ramp(self, level: float, seconds: float | None = None) -> Iterator[Press]:
        """Press harder or softer, evenly."""
        seconds = 10 ** self.rng.uniform(-1.3, 0.0) if seconds is None else seconds
        count = 5
        for share in np.linspace(self._level, level, count + 1)[1:]:
            self._level = share
            yield self._press(max(seconds / count, FASTEST_STEP))

    def hold(self) -> Iterator[Press]:
        """Stay; steps grow as less happens."""
        seconds = 10 ** self.rng.uniform(-1.0, 0.5)
        for share in np.diff(np.linspace(0, 1, 7) ** 2):
            yield self._press(seconds * share)

    def release(self) -> Iterator[Press]:
        """Lift the tool at once, wait, press again."""
        level = self._level
        yield from self.ramp(0.0, 0.05)
        yield from self.hold()
        yield from self.ramp(level)

    def tap(self) -> Iterator[Press]:
        """Twice, quickly."""
        for _ in range(2):
            yield from self.ramp(0.0, 0.05)
            yield from self.ramp(0.3 + 0.7 * self.rng.random(), 0.05)

    def slide(self) -> Iterator[Press]:
        """Move over the surface at 3 to 30 mm/s, as far as 8 mm or to where it ends."""
        speed, length = 10 ** self.rng.uniform(0.5, 1.5), self.rng.uniform(2.0, 8.0)
        turn = self.rng.uniform(0, 2 * np.pi)
        heading = np.array([np.cos(turn), np.sin(turn)]) @ np.array(tangents(self._normal))
        count = int(np.ceil(length / 0.5))
        for _ in range(count):
            self._go(self._x + length / count * heading)
            heading -= heading @ self._normal * self._normal
            heading /= max(float(np.linalg.norm(heading)), 1e-9)
            yield self._press(length / count / speed)


@dataclass
class HistoryComparison:
    """One history answered by both models.

    Attributes
    ----------
    steps : int
    seconds : float
    travel : float, mm
        Of the contact.
    displacement, von_mises : float
        Relative L2 errors over all nodes (outside the clamped layer) and all moments.
    depth : float
        The same of the contact's displacement.
    worst_displacement, worst_von_mises : float
        Largest error of a moment, over the largest norm in the history.
    last_displacement : float
        Error of the last moment over the largest norm.
    unconverged : int
    moments : list of KnownMoment
    """

    steps: int
    seconds: float
    travel: float
    displacement: float
    von_mises: float
    depth: float
    worst_displacement: float
    worst_von_mises: float
    last_displacement: float
    unconverged: int
    moments: list[KnownMoment] = field(repr=False)

    def estimate(self, estimator: Estimator) -> None:
        """Fill in the estimated errors of its moments."""
        for moment in self.moments:
            moment.estimate(estimator)


def play(atlas: ReducedModel, presses: Sequence[Press]) -> list[Answer]:
    """Answers of the reduced model."""
    past, warm, moments = REST, atlas.new_warm(), []
    for press in presses:
        moment = atlas.press(
            press.position, press.pressure, press.direction, past=past, dt=press.dt, warm=warm
        )
        assert moment.past is not None
        past = moment.past
        moments.append(moment)
    return moments


def compare_history(
    workshop: Workshop,
    atlas: ReducedModel,
    presses: Sequence[Press],
    displacements: Array,
    stresses: Array,
) -> HistoryComparison:
    """Answer a history with the reduced model and compare with full solutions (t, n, 3), (t, n)."""
    moments = play(atlas, presses)
    kept = workshop.beyond_clamped_layer
    u = np.array([atlas.displacement(moment) for moment in moments], float)
    s = np.array([atlas.von_mises(moment) for moment in moments], float)[:, kept]
    U, S = displacements.astype(float), stresses[:, kept].astype(float)
    depth = np.array([moment.contact_displacement for moment in moments])
    exact = np.array(
        [workshop.under(p.position, field) for p, field in zip(presses, U, strict=True)]
    )
    away, off = (np.linalg.norm((a - b).reshape(len(a), -1), axis=1) for a, b in ((u, U), (s, S)))
    sizes = [np.linalg.norm(a.reshape(len(a), -1), axis=1).max() for a in (U, S)]
    positions = np.array([press.position for press in presses])
    return HistoryComparison(
        steps=len(presses),
        seconds=float(sum(press.dt for press in presses)),
        travel=float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()),
        displacement=relative(u, U),
        von_mises=relative(s, S),
        depth=relative(depth, exact),
        worst_displacement=float(away.max() / sizes[0]),
        worst_von_mises=float(off.max() / sizes[1]),
        last_displacement=float(away[-1] / sizes[0]),
        unconverged=sum(not moment.converged for moment in moments),
        moments=known_moments(errors_so_far(((u, U), (s, S))), moments),
    )


def validate_histories(
    artifact: Path, count: int, seed: int, csv: Path | None = None
) -> dict[str, Any]:
    """Compare an artifact with its full model over new random histories.

    Parameters
    ----------
    artifact : Path
    count : int
        Histories, over the whole surface and range of loads; one in eight begins on the rim.
    seed : int
    csv : Path, optional
        Where to write one row per history.

    Returns
    -------
    dict
        Statistics of what ``HistoryComparison`` holds, and ``without_equilibrium``: histories that
        the full model could not follow, and which count in nothing else.
    """
    atlas, workshop, rng = unseen(artifact, seed)
    if atlas.models.viscous is None:
        raise QueryError("histories", f"scene {atlas.name!r} is elastic and has none")
    histories = random_histories(atlas, count, rng)

    def judge(i: int, found: tuple[Array, Array] | None) -> HistoryComparison | None:
        return None if found is None else compare_history(workshop, atlas, histories[i], *found)

    tasks = [(Workshop.follow, *loads_of(presses)) for presses in histories]
    return verdict(artifact, tasks, judge, summarise_histories, NONE_FOLLOWED, csv)


def summarise_histories(rows: Sequence[HistoryComparison]) -> dict[str, Any]:
    """Statistics over histories.

    ``covered``: the share of all converged moments that are within both estimates.
    """
    names = (
        "displacement", "von_mises", "depth", "worst_displacement", "worst_von_mises",
        "last_displacement",
    )  # fmt: skip
    return {
        "histories": len(rows),
        "steps": sum(row.steps for row in rows),
        "unconverged": sum(row.unconverged for row in rows),
        **covered_moments(rows, ESTIMATED),
    } | {name: statistics([getattr(row, name) for row in rows]) for name in names}
