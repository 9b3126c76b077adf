"""Histories that strain a method of visco-elastic tissue.

Some are so long that the full model follows a brief one instead.  Under a load that is held long
beside the time constants both end at rest in the relaxed tissue; of a periodic movement, later
periods repeat.  Then only the ends are compared.  Each kind is tried with footprints and, if the
scene has one, with the rigid tip, in the same places.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache, partial

import numpy as np

from palpate.offline.fem.problem import FullProblem
from palpate.offline.methods.method import Case
from palpate.offline.reduce.sampling import random_points_and_rim, tangents
from palpate.offline.run.streams import Stage, stream
from palpate.offline.studies.hard_cases import HardCase
from palpate.offline.studies.relaxation import load_steps
from palpate.offline.validate.queries import Place
from palpate.shared.arrays import Array
from palpate.shared.geometry.surface import Surface
from palpate.shared.model import ReducedModel

CONTROL = "press, hold, let go"

DEEP = 0.8  # load of most histories, over its limit
SMALL, LONG = 1e-5, 1e4  # shortest step and longest hold, s
SHORT = 100.0
"""Length of large steps, and of the hold in many steps, over the slowest time constant."""

TILT = 25.0  # degrees to either side of a load that is flipped
PERIOD, PERIODS = 50, 10
"""Steps in a period of the periodic movement, and periods after which the full model repeats."""

Step = tuple[Case, float]
Press = Callable[..., Step]
"""Step to a place (3,) mm, a level of the load (1 is the limit), in seconds, tilted (degrees)."""

Course = Callable[[Array], Iterable[Step]]
"""Steps of a kind of history in a place."""


def histories(
    atlas: ReducedModel, problem: FullProblem, tip: bool, cases: int, seed: int, many: int
) -> dict[str, list[HardCase]]:
    """Histories of every kind by its name; the longest of ``many`` steps in one place only.

    They are of footprints, or of the rigid tip.
    """
    rng = stream(atlas.scene.seed, Stage.HARD_CASES_IN_TIME, seed)
    # the first is on the rim
    places = list(random_points_and_rim(atlas.surface, cases, rng))
    press, tissue = _presser(atlas, problem, tip), atlas.scene.tissue
    large = SHORT * max(tau for _, tau in tissue.prony)
    case = partial(HardCase, poisson=tissue.poisson, history=True, tip=tip)
    found = {
        name: [case(list(course(at))) for at in places]
        for name, course in _courses(press, large, rng, places, atlas.surface).items()
        if not (tip and "direction" in name)
    }
    at, few = places[-1], many // 10
    for seconds, steps, shown in ((LONG, few, "10 000"), (large, many, f"{large:g}")):
        levels = _levels(press, np.full(steps, DEEP), seconds / steps, at)
        held = case([*_pressed(press, at), *levels], brief=list(_growing(press, seconds, at)))
        found[f"held for {shown} s, {steps} steps"] = [held]
    phase = 2 * np.pi * np.arange(1, PERIOD + 1) / PERIOD
    period = list(_levels(press, 0.5 + 0.3 * np.cos(phase), 0.02, at))
    repeats = max(many // PERIOD, 1)
    periodic = case(repeats * period, brief=min(repeats, PERIODS) * period)
    return found | {f"moves periodically, {many} steps": [periodic]}


def _presser(atlas: ReducedModel, problem: FullProblem, tip: bool) -> Press:
    @cache  # loads repeat in long histories
    def case(at: tuple[float, ...], level: float, tilt: float) -> Case:
        place, lean = Place.at(atlas, np.array(at)), np.radians(tilt)
        if tip:
            return Case.of_tip(place.touch(level).position, -place.normal)
        direction = np.sin(lean) * tangents(place.normal)[0] - np.cos(lean) * place.normal
        return Case.of(problem, place.press(direction, level))

    return lambda at, level, dt, tilt=0.0: (case(tuple(at.tolist()), float(level), tilt), dt)


def _levels(press: Press, shares: Array, dt: float | Array, at: Array) -> Iterator[Step]:
    """Press at a place to one level after the other."""
    times = np.broadcast_to(dt, len(shares)).tolist()
    return (press(at, share, seconds) for share, seconds in zip(shares, times, strict=True))


def _pressed(press: Press, at: Array) -> Iterator[Step]:
    return _levels(press, DEEP * np.array([0.25, 0.5, 0.75, 1.0]), 0.02, at)


def _growing(press: Press, seconds: float, at: Array) -> Iterator[Step]:
    yield from _pressed(press, at)
    ends = np.concatenate([[0.0], np.geomspace(0.01, seconds, 24)])
    yield from _levels(press, np.full(24, DEEP), np.diff(ends), at)


def _courses(
    press: Press,
    large: float,
    rng: np.random.Generator,
    places: Sequence[Array],
    surface: Surface,
) -> dict[str, Course]:
    """Kinds of histories that the full model follows step by step, by name."""

    def simple(at: Array) -> Iterator[Step]:
        phases = ((0.2, 6, DEEP), (2.0, 8, DEEP), (0.1, 4, 0.0), (2.0, 8, 0.0))
        return (press(at, share, dt) for dt, share in load_steps(phases))

    def slides(at: Array) -> Iterator[Step]:
        x, normal, _ = surface.project(at)
        for distance in 2.0 * np.sin(np.linspace(0.0, 1.5 * np.pi, 30)):
            yield press(surface.project(x + distance * tangents(normal)[0])[0], 0.6, 1e-3)

    def flipped(at: Array) -> Iterator[Step]:
        yield from _pressed(press, at)
        for side in (1.0, -1.0, 1.0, -1.0):
            yield press(at, DEEP, 0.0, side * TILT)
            yield press(at, DEEP, 0.1, side * TILT)

    def teleports(at: Array) -> Iterator[Step]:
        yield from _pressed(press, at)
        for i in range(12):
            other = places[i % len(places)] if i % 3 == 0 else _anywhere(places, rng)
            yield press(other, rng.uniform(0.3, 0.9), 0.02)

    def goes(step: float, at: Array) -> Iterator[Step]:
        yield from _pressed(press, at)
        yield press(at, DEEP, step)

    lengths = np.random.default_rng(1)
    sudden = np.tile([DEEP, 0.0, DEEP, 0.5 * DEEP], 4)
    series: dict[str, tuple[Array, float | Array]] = {
        "steps of 0.01 ms": (np.linspace(0.1, 1.0, 20) * DEEP, SMALL),
        "steps of 100 time constants": (np.tile([DEEP, 0.3, 0.0], 4), large),
        "steps of 0.01 ms, held": (np.full(40, DEEP), np.append(np.full(39, SMALL), 1.0)),
        "steps of a day": (np.tile([DEEP, 0.3], 5), 86400.0),
        "steps of all lengths": (lengths.uniform(0.2, 0.9, 40), 10 ** lengths.uniform(-6, 3, 40)),
        "taps at 20 Hz": (np.tile([0.4, DEEP, 0.4, 0.0], 12), 0.0125),
        "steps of no time": (np.append(sudden, DEEP), 0.0),
        "press, lift, press at once": (sudden, np.tile([0.0, 0.0, 0.0, 0.05], 4)),
        "1.5 x the limit": (np.linspace(0.2, 1.5, 10), 0.05),
        "3 x the limit": (np.linspace(0.2, 3.0, 16), 0.05),
    }
    return {
        CONTROL: simple,
        **{name: partial(_levels, press, *own) for name, own in series.items()},
        "slides at 300 mm per s": slides,
        "direction flipped at once": flipped,
        "contact teleports": teleports,
        "held for 10 000 s": partial(_growing, press, LONG),
        "time runs back": partial(goes, -0.1),
        "time is not a number": partial(goes, np.nan),
    }


def _anywhere(places: Sequence[Array], rng: np.random.Generator) -> Array:
    """Between two of the places."""
    one, other = rng.integers(len(places), size=2)
    return np.asarray(places[one] + rng.random() * (places[other] - places[one]))
