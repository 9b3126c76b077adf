"""Histories that strain a method of visco-elastic tissue.

A *trial* is one history.  Some are so long that the full model follows a brief one instead, in
growing steps: under a load that is held long beside the time constants both end at rest in the
relaxed tissue, so only the ends are compared.  Each stressor is tried with footprints and, if the
scene has one, with the rigid tip, in the same places.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from palpate.offline.reduce.sampling import random_points_and_rim, tangents
from palpate.offline.studies.relaxation import course
from palpate.offline.validate.histories import Press
from palpate.offline.validate.tip_histories import OFF
from palpate.shared.mechanics.footprint import TIP_DEPTH, pressure_limit
from palpate.shared.model import ReducedModel

Array = NDArray[np.float64]

STRESS = 104
"""Sets these random numbers apart."""

CONTROL = "press, hold, let go"

DEEP = 0.8
"""Load of most trials over its limit."""

SMALL, LONG = 1e-5, 1e4
"""Shortest step and longest hold, s."""

SHORT = 100.0
"""Of the slowest time constant: steps that are large beside it, and the hold in many steps."""

TILT = 25.0
"""Degrees to either side of a load that is flipped."""


@dataclass(frozen=True)
class Trial:
    """A history.

    Attributes
    ----------
    presses : tuple of Press
        Of the tip, ``position`` is its centre.
    brief : tuple of Press
        What the full model follows instead to the same end, if anything.
    nonsense : bool
        Whether it must be refused.
    """

    presses: tuple[Press, ...]
    brief: tuple[Press, ...] = ()
    nonsense: bool = False


Maker = Callable[[Array], Trial]
"""Makes the trial of a stressor in a place."""


class Presser:
    """Turns levels of a load at places into what is pressed.

    Parameters
    ----------
    atlas : ReducedModel
    tip : bool
        Whether by the rigid tip.
    """

    def __init__(self, atlas: ReducedModel, tip: bool) -> None:
        self._atlas, self.tip = atlas, tip

    def __call__(self, at: Array, level: float, dt: float, tilt: float = 0.0) -> Press:
        """Press at a place to a level (1 is the limit), leaning by ``tilt`` degrees."""
        atlas = self._atlas
        x, normal, _, fields = atlas.surface.locate(at, atlas.limits)
        if self.tip:
            depth = level * fields[TIP_DEPTH] if level > 0.0 else -OFF
            return Press(dt, x + (atlas.scene.endoscope.radius - depth) * normal, -normal, 0.0)
        lean = np.radians(tilt)
        direction = np.sin(lean) * tangents(normal)[0] - np.cos(lean) * normal
        limit = pressure_limit(fields, normal, direction)
        return Press(dt, x, direction, float(level * limit))


def trials(
    atlas: ReducedModel, tip: bool, cases: int, seed: int, many: int
) -> dict[str, list[Trial]]:
    """Trials of every stressor by its name.

    Parameters
    ----------
    atlas : ReducedModel
    tip : bool
        With the rigid tip instead of footprints.
    cases : int
        Places.
    seed : int
    many : int
        Steps of the longest; these are tried in one place.
    """
    rng = np.random.default_rng([atlas.scene.seed, STRESS, seed])
    # the first is on the rim
    places = list(random_points_and_rim(atlas.surface, cases, rng))
    press = Presser(atlas, tip)
    slowest = max(tau for _, tau in atlas.scene.tissue.prony)
    makers = _makers(press, slowest, rng, places, many)
    return {
        name: [make(at) for at in (places[-1:] if name.endswith("steps") else places)]
        for name, make in makers.items()
        if not (tip and "direction" in name)
    }


def _makers(
    press: Presser, slowest: float, rng: np.random.Generator, places: Sequence[Array], many: int
) -> dict[str, Maker]:
    def of(steps: Callable[[Array], Iterator[Press]], nonsense: bool = False) -> Maker:
        return lambda at: Trial(tuple(steps(at)), nonsense=nonsense)

    def levels(shares: Sequence[float] | Array, dt: float | Array, at: Array) -> Iterator[Press]:
        for share, step in zip(shares, np.broadcast_to(dt, len(shares)), strict=True):
            yield press(at, float(share), float(step))

    def pressed(at: Array) -> Iterator[Press]:
        return levels([0.25 * DEEP, 0.5 * DEEP, 0.75 * DEEP, DEEP], 0.02, at)

    def simple(at: Array) -> Iterator[Press]:
        phases = ((0.2, 6, DEEP), (2.0, 8, DEEP), (0.1, 4, 0.0), (2.0, 8, 0.0))
        return (press(at, share, dt) for dt, share in course(phases))

    def growing(seconds: float, at: Array) -> Iterator[Press]:
        yield from pressed(at)
        ends = np.concatenate([[0.0], np.geomspace(0.01, seconds, 24)])
        yield from levels(np.full(24, DEEP), np.diff(ends), at)

    def even(seconds: float, steps: int, at: Array) -> Trial:
        held = levels(np.full(steps, DEEP), seconds / steps, at)
        return Trial((*pressed(at), *held), tuple(growing(seconds, at)))

    def flipped(at: Array) -> Iterator[Press]:
        yield from pressed(at)
        for side in (1.0, -1.0, 1.0, -1.0):
            yield press(at, DEEP, 0.0, side * TILT)
            yield press(at, DEEP, 0.1, side * TILT)

    def teleports(at: Array) -> Iterator[Press]:
        yield from pressed(at)
        for i in range(12):
            other = places[i % len(places)] if i % 3 == 0 else _anywhere(places, rng)
            yield press(other, rng.uniform(0.3, 0.9), 0.02)

    def goes(step: float, at: Array) -> Iterator[Press]:
        yield from pressed(at)
        yield press(at, DEEP, step)

    sudden = np.tile([DEEP, 0.0, DEEP, 0.5 * DEEP], 4)
    return {
        CONTROL: of(simple),
        "steps of 0.01 ms": of(partial(levels, np.linspace(0.1, 1.0, 20) * DEEP, SMALL)),
        "steps of 100 time constants": of(
            partial(levels, np.tile([DEEP, 0.3, 0.0], 4), SHORT * slowest)
        ),
        "steps of no time": of(partial(levels, np.append(sudden, DEEP), 0.0)),
        "press, lift, press at once": of(
            partial(levels, sudden, np.tile([0.0, 0.0, 0.0, 0.05], 4))
        ),
        "direction flipped at once": of(flipped),
        "contact teleports": of(teleports),
        "held for 10 000 s": of(partial(growing, LONG)),
        f"held for 10 000 s, {many // 10} steps": partial(even, LONG, many // 10),
        f"held for {SHORT * slowest:g} s, {many} steps": partial(even, SHORT * slowest, many),
        "1.5 x the limit": of(partial(levels, np.linspace(0.2, 1.5, 10), 0.05)),
        "3 x the limit": of(partial(levels, np.linspace(0.2, 3.0, 16), 0.05)),
        "time runs back": of(partial(goes, -0.1), nonsense=True),
        "time is not a number": of(partial(goes, np.nan), nonsense=True),
    }


def _anywhere(places: Sequence[Array], rng: np.random.Generator) -> Array:
    """Between two of the places."""
    one, other = rng.integers(len(places), size=2)
    return np.asarray(places[one] + rng.random() * (places[other] - places[one]))
