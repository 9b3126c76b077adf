"""Loads that strain a method of deforming tissue, and the full model's answers to hard cases.

The right answer is the equilibrium that tissue reaches when the load is raised from nothing.
Within a few times the trained range a single jump finds the same; beyond it the load path is
followed in small steps, and where the jump ends elsewhere the load has more than one equilibrium.
The same holds where a load that was raised beyond the range and lowered again leaves the tissue
elsewhere than one raised from nothing: there the right answer is the one that the path led to.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from palpate.offline.bench import walk
from palpate.offline.fem.mesh import accessible_surface
from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.norms import relative
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.methods.method import Case, Steps
from palpate.offline.reduce.sampling import cone, random_points
from palpate.offline.run.streams import Stage, stream
from palpate.offline.studies.references import Fields, followed, of_tissue
from palpate.offline.validate.queries import Place, random_loads
from palpate.shared.arrays import Array
from palpate.shared.model import ReducedModel

Rng = np.random.Generator

CONTROL, SEVERAL = "inside the range", "several equilibria"

LOWERED, HYSTERESIS = "raised, then lowered", "lowered, several equilibria"

FACTORS = (1.5, 2.0, 4.0, 8.0)  # pressures over the trained maximum, reached in one jump
RAISED, SNAPPED = (2.0, 2.0), (1.5, 4.0)
"""Least and largest peak, over the trained maximum, of loads that are lowered into the range again:
of all of them, and of those that are searched for several equilibria."""

SEARCHED = 3
"""How many of the latter are tried for each one wanted: on the turbinate about one in twenty stays
in another equilibrium."""

TILTS = (45.0, 60.0)  # degrees
RATIOS = (0.49, 0.499)  # Poisson's ratios of other tissues
STEPS = (0.05, 0.5, 2.0, 10.0)  # of a moving tool, mm
TELEPORT = "tool teleports"

WARM_UP = 4  # queries along the path of a moving tool before the one that counts
OFF = 0.5  # distance (mm) from the accessible surface at which a point counts as off it
PATH_STEPS = 8  # steps of a load path; of a load that is lowered again, half of them lead up
APART = 0.01  # relative difference of displacements beyond which two equilibria are not the same
FINEST = 0.25
"""Smallest load step, as a fraction, of the full model in range; out of range it takes no steps."""


@dataclass(frozen=True)
class HardCase:
    """Steps that strain a method: loads that take no time, or a history.

    A load path is followed from nothing, or through the steps before the last.
    """

    steps: Steps
    poisson: float  # of the tissue
    history: bool = False
    tip: bool = False  # whether the rigid tip presses
    follow: bool = False  # whether the full model follows the load path
    brief: Steps = ()  # fewer steps to the same end, which the full model follows instead

    @property
    def end_only(self) -> bool:
        """Whether only the answer to the last step counts."""
        return not self.history or bool(self.brief)


class Question(NamedTuple):
    """A hard case, and what the full model answers, None where it finds no equilibrium.

    ``exact`` is the right answer, ``jump`` that of one jump from rest.
    """

    case: HardCase
    exact: Fields | None
    jump: Fields | None

    @property
    def other(self) -> Fields | None:
        """The equilibrium of the jump where it is not the right one."""
        if self.exact is None or self.jump is None:
            return self.jump
        apart = relative(self.jump.displacements[-1], self.exact.displacements[-1])
        return self.jump if apart > APART else None

    @property
    def lost(self) -> bool:
        """Whether the full model cannot follow the path to a load that has an equilibrium.

        Where tissue has given way on the way, and comes back to, is not known then.
        """
        on_path = self.case.follow and len(self.case.steps) > 1
        return on_path and self.exact is None and self.jump is not None

    @property
    def several(self) -> bool:
        """Whether path and jump end in different equilibria."""
        return self.exact is not None and self.other is not None


def ask_full_model(problem: FullProblem, case: HardCase) -> Question:
    """Full solutions of a hard case; a task for ``run.workers``."""
    own = of_tissue(problem, poisson=case.poisson)
    if case.history:
        sensible = all(dt >= 0.0 for _, dt in case.steps)
        found = followed(own, case.brief or case.steps, case.tip) if sensible else None
        return Question(case, found, found)
    path = [step.load(len(own.mesh.nodes)) for step, _ in case.steps]
    load = path[-1]
    if not case.follow:
        jump = _lead(own, [load], FINEST)
        return Question(case, jump, jump)
    if len(path) == 1:
        path = [(i + 1) / PATH_STEPS * load for i in range(PATH_STEPS)]
    return Question(case, _lead(own, path, 1.0), _lead(own, [load], 1.0))


def _lead(problem: FullProblem, loads: Sequence[Array], finest: float) -> Fields | None:
    """Fields at the end of a path of loads from nothing."""
    u = None
    for load in loads:
        try:
            u = problem.model.solve(load, start=u, smallest_step=finest).displacement
        except NoEquilibrium:
            return None
    return None if u is None else Fields(u[None], problem.von_mises(u)[None])


def several(questions: Mapping[str, Sequence[Question]], most: int) -> dict[str, list[Question]]:
    """Of all loads that were followed, those of several equilibria: raised, and lowered again."""
    found: dict[str, list[Question]] = {}
    for own in questions.values():
        for question in own:
            if question.case.follow:
                kind = HYSTERESIS if len(question.case.steps) > 1 else SEVERAL
                found.setdefault(kind, []).extend([question] * question.several)
    return {name: own[:most] for name, own in found.items()}


class HardLoads:
    """Makes so many hard cases of every kind, for elastic tissue."""

    def __init__(self, atlas: ReducedModel, problem: FullProblem, count: int, seed: int) -> None:
        self._atlas, self._problem, self._count, self._seed = atlas, problem, count, seed
        self._poisson, self._endoscope = problem.scene.tissue.poisson, problem.scene.endoscope

    def cases(self) -> dict[str, list[HardCase]]:
        """Cases of every kind by its name; of several equilibria, candidates."""
        makers: dict[str, Callable[[Rng], Iterable[HardCase]]] = {
            CONTROL: partial(self._in_tissue, self._poisson),
            **{f"load x {x:g}": partial(self._raised, (x, x)) for x in FACTORS},
            SEVERAL: partial(self._raised, (FACTORS[0], FACTORS[-1])),
            **{f"tilt {tilt:g}°": partial(self._tilted, tilt) for tilt in TILTS},
            "off surface, in reach": partial(self._elsewhere, True),
            "off surface, out of reach": partial(self._elsewhere, False),
            "half the radius": partial(self._footprints, 0.5),
            "1.5 x the radius": partial(self._footprints, 1.5),
            "two contacts": self._pairs,
            **{f"Poisson {ratio:g}": partial(self._in_tissue, ratio) for ratio in RATIOS},
            **{f"tool moves {step:g} mm": partial(self._moves, step) for step in STEPS},
            TELEPORT: self._teleports,
            LOWERED: partial(self._lowered, RAISED, self._count),
            HYSTERESIS: partial(self._lowered, SNAPPED, SEARCHED * self._count),
        }
        seeds = self._problem.scene.seed, Stage.HARD_CASES, self._seed
        return {name: [*makers[name](stream(*seeds, i))] for i, name in enumerate(makers)}

    def _loads(self, rng: Rng, count: int | None = None) -> list[Load]:
        return random_loads(self._atlas, count or self._count, rng)

    def _through(self, *cases: Case, follow: bool = False) -> HardCase:
        """A case that is reached through others, all at once."""
        return HardCase([(case, 0.0) for case in cases], self._poisson, follow=follow)

    def _path(self, *loads: Load, follow: bool = False) -> HardCase:
        return self._through(*(Case.of(self._problem, load) for load in loads), follow=follow)

    def _peak(self, load: Load, factors: tuple[float, float], rng: Rng) -> float:
        return rng.uniform(*factors) * Place.at(self._atlas, load.position).limit(load.direction)

    def _in_tissue(self, poisson: float, rng: Rng) -> Iterator[HardCase]:
        return (replace(self._path(load), poisson=poisson) for load in self._loads(rng))

    def _raised(self, factors: tuple[float, float], rng: Rng) -> Iterator[HardCase]:
        for load in self._loads(rng):
            peak = replace(load, pressure=self._peak(load, factors, rng))
            yield self._path(peak, follow=True)

    def _lowered(self, peaks: tuple[float, float], count: int, rng: Rng) -> Iterator[HardCase]:
        """Loads in range that come down from a multiple of the limit."""
        turns = np.arange(1, PATH_STEPS + 1)
        for load in self._loads(rng, count):
            corners = (0.0, self._peak(load, peaks, rng), load.pressure)
            pressures = np.interp(turns, (0, PATH_STEPS // 2, PATH_STEPS), corners).tolist()
            yield self._path(*(replace(load, pressure=p) for p in pressures), follow=True)

    def _tilted(self, tilt: float, rng: Rng) -> Iterator[HardCase]:
        for load in self._loads(rng):
            place = Place.at(self._atlas, load.position)
            direction = cone(place.normal, tilt, 1, rng, border=True)[0]
            yield self._path(place.press(direction, np.sqrt(rng.random())))

    def _elsewhere(self, within: bool, rng: Rng) -> Iterator[HardCase]:
        """Presses other parts of the free boundary, straight in."""
        mesh, reach, found = self._problem.mesh, self._endoscope.reach, 0
        free = np.asarray(~mesh.clamped[mesh.faces].all(axis=1))
        surface = accessible_surface(replace(mesh, accessible=free))
        while found < self._count:
            point = random_points(surface, 1, rng)[0]
            _, _, distance = self._atlas.surface.project(point)
            if not (OFF < distance <= reach if within else distance > reach):
                continue
            x, normal, _ = surface.project(point)
            load = Place.at(self._atlas, point).press(-normal, np.sqrt(rng.random()))
            load, found = replace(load, position=x), found + 1
            yield self._through(Case.of(self._problem, load, feet=[(x, normal)]))

    def _footprints(self, share: float, rng: Rng) -> Iterator[HardCase]:
        radius = share * self._endoscope.radius
        loads = self._loads(rng)
        return (self._through(Case.of(self._problem, load, radius=radius)) for load in loads)

    def _pairs(self, rng: Rng) -> Iterator[HardCase]:
        pairs = zip(self._loads(rng), self._loads(rng), strict=True)
        return (self._through(Case.of(self._problem, *pair)) for pair in pairs)

    def _moves(self, step: float, rng: Rng) -> Iterator[HardCase]:
        loads = self._loads(rng)
        return (self._path(x, *walk(self._atlas, x, WARM_UP, rng, step)) for x in loads)

    def _teleports(self, rng: Rng) -> Iterator[HardCase]:
        return (self._path(*self._loads(rng, WARM_UP + 1)) for _ in range(self._count))
