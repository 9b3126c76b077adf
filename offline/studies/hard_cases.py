"""Loads that strain a method of deforming tissue, and the full model's answers to them.

The right answer is the equilibrium that tissue reaches when the load is raised from nothing.
Within a few times the trained range a single jump finds the same; beyond it the load path is
followed in small steps, and where the jump ends elsewhere the load has more than one equilibrium.
The same holds where a load that was raised beyond the range and lowered again leaves the tissue
elsewhere than one raised from nothing: there the right answer is the one that the path led to.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from palpate.offline.bench import limit_at, walk
from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.norms import relative
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.fem.surface import accessible_surface
from palpate.offline.methods.method import Case
from palpate.offline.reduce.queries import random_loads
from palpate.offline.reduce.sampling import cone, random_points
from palpate.offline.run.checkpoint import Checkpoint
from palpate.offline.run.streams import Stage, stream
from palpate.offline.run.workers import resume
from palpate.shared.mechanics.footprint import footprint
from palpate.shared.model import ReducedModel

Array = NDArray[np.float64]

CONTROL, SEVERAL = "inside the range", "several equilibria"

LOWERED, HYSTERESIS = "raised, then lowered", "lowered, several equilibria"

FACTORS = (1.5, 2.0, 4.0, 8.0)
"""Pressures over the trained maximum, reached in one jump."""

RAISED, SNAPPED = (2.0, 2.0), (1.5, 4.0)
"""Least and largest peak, over the trained maximum, of loads that are lowered into the range again:
of all of them, and of those that are searched for several equilibria."""

SEARCHED = 3
"""How many of the latter are tried for each one wanted: on the turbinate about one in twenty stays
in another equilibrium."""

TILTS = (45.0, 60.0)
"""Degrees."""

RATIOS = (0.49, 0.499)
"""Poisson's ratios of other tissues."""

STEPS = (0.05, 0.5, 2.0, 10.0)
"""Of a moving tool, mm."""

TELEPORT = "tool teleports"

WARM_UP = 4
"""Queries along the path of a moving tool before the one that counts."""

OFF = 0.5
"""Distance (mm) from the accessible surface at which a point counts as off it."""

PATH_STEPS = 8
"""Steps of a load path; of a load that is lowered again, half of them lead up."""

APART = 0.01
"""Relative difference of displacements beyond which two equilibria are not the same."""

FINEST = 0.25
"""Smallest load step, as a fraction, of the full model in range; out of range it takes no steps."""


@dataclass(frozen=True)
class HardCase:
    """Steps that strain a method, and how the full model answers them.

    Attributes
    ----------
    steps : tuple of (Case, float)
        Cases and the times (s) in which they are reached.
    poisson : float
        Of the tissue.
    follow : bool
        Whether the full model follows the load path, from nothing or through the steps before the
        last; loads only.
    brief : tuple of (Case, float)
        Fewer steps to the same end, which the full model follows instead, if any; in time only.
    end_only : bool
        Whether only the answer to the last step counts.
    nonsense : bool
        Whether the right answer is to refuse.
    """

    steps: tuple[tuple[Case, float], ...]
    poisson: float
    follow: bool = False
    brief: tuple[tuple[Case, float], ...] = ()
    end_only: bool = False
    nonsense: bool = False

    @property
    def last(self) -> Case:
        """The case at the end."""
        return self.steps[-1][0]


@dataclass(frozen=True)
class Equilibria:
    """The full model's displacements (3 n,) mm under a load, None where it finds no equilibrium.

    Attributes
    ----------
    path, jump : ndarray or None
        At the end of the load path, which is the right answer, and in one jump from rest.
    """

    path: Array | None
    jump: Array | None

    @property
    def several(self) -> bool:
        """Whether path and jump end in different equilibria."""
        return self.path is not None and self.other is not None

    @property
    def other(self) -> Array | None:
        """The equilibrium of the jump where it is not that of the path."""
        if self.path is None or self.jump is None or relative(self.jump, self.path) > APART:
            return self.jump
        return None


Followed = tuple[HardCase, Equilibria]


class HardLoads:
    """Makes the hard cases of every kind, for elastic tissue.

    Parameters
    ----------
    problem : FullProblem
        Of the artifact's mesh.
    count : int
        Cases of each kind.
    """

    def __init__(self, atlas: ReducedModel, problem: FullProblem, count: int, seed: int) -> None:
        self._atlas, self._problem, self._count, self._seed = atlas, problem, count, seed
        self._scene = problem.scene
        self._poisson = self._scene.tissue.poisson

    @property
    def makers(self) -> dict[str, Callable[[np.random.Generator], list[HardCase]]]:
        """What makes the cases of each kind, by its name."""
        radius = self._scene.endoscope.radius
        return {
            CONTROL: partial(self._in_tissue, self._poisson),
            **{f"load x {x:g}": partial(self._raised, (x, x)) for x in FACTORS},
            SEVERAL: partial(self._raised, (FACTORS[0], FACTORS[-1])),
            **{f"tilt {tilt:g}°": partial(self._tilted, tilt) for tilt in TILTS},
            "off surface, in reach": partial(self._elsewhere, True),
            "off surface, out of reach": partial(self._elsewhere, False),
            "half the radius": partial(self._footprints, 0.5 * radius),
            "1.5 x the radius": partial(self._footprints, 1.5 * radius),
            "two contacts": self._pairs,
            **{f"Poisson {ratio:g}": partial(self._in_tissue, ratio) for ratio in RATIOS},
            **{f"tool moves {step:g} mm": partial(self._moves, step) for step in STEPS},
            TELEPORT: self._teleports,
            LOWERED: partial(self._lowered, RAISED, self._count),
            HYSTERESIS: partial(self._lowered, SNAPPED, SEARCHED * self._count),
        }

    def cases(self) -> dict[str, list[HardCase]]:
        """Cases of every kind by its name; of several equilibria, candidates."""
        return {
            name: make(stream(self._scene.seed, Stage.HARD_CASES, self._seed, i))
            for i, (name, make) in enumerate(self.makers.items())
        }

    def _loads(self, rng: np.random.Generator, count: int | None = None) -> list[Load]:
        atlas, count = self._atlas, self._count if count is None else count
        return random_loads(atlas, count, rng)

    def _through(self, *cases: Case, follow: bool = False) -> HardCase:
        """A case that is reached through others, all at once."""
        steps = tuple((case, 0.0) for case in cases)
        return HardCase(steps, self._poisson, follow, end_only=True)

    def _path(self, loads: Sequence[Load], follow: bool = False) -> HardCase:
        return self._through(*(Case.of(self._problem, load) for load in loads), follow=follow)

    def _in_tissue(self, poisson: float, rng: np.random.Generator) -> list[HardCase]:
        return [replace(self._path([load]), poisson=poisson) for load in self._loads(rng)]

    def _raised(self, factors: tuple[float, float], rng: np.random.Generator) -> list[HardCase]:
        return [
            self._path([replace(load, pressure=self._peak(load, factors, rng))], follow=True)
            for load in self._loads(rng)
        ]

    def _peak(self, load: Load, factors: tuple[float, float], rng: np.random.Generator) -> float:
        return rng.uniform(*factors) * limit_at(self._atlas, load.position, load.direction)

    def _lowered(
        self, peaks: tuple[float, float], count: int, rng: np.random.Generator
    ) -> list[HardCase]:
        """Loads in range that come down from a multiple of the limit."""
        found, turns = [], np.arange(1, PATH_STEPS + 1)
        for load in self._loads(rng, count):
            corners = (0.0, self._peak(load, peaks, rng), load.pressure)
            pressures = np.interp(turns, (0, PATH_STEPS // 2, PATH_STEPS), corners)
            path = [replace(load, pressure=float(pressure)) for pressure in pressures]
            found.append(self._path(path, follow=True))
        return found

    def _tilted(self, tilt: float, rng: np.random.Generator) -> list[HardCase]:
        cases = []
        for load in self._loads(rng):
            normal = self._atlas.surface.project(load.position)[1]
            direction = cone(normal, tilt, 1, rng, border=True)[0]
            pressure = limit_at(self._atlas, load.position, direction) * np.sqrt(rng.random())
            cases.append(self._path([Load(load.position, direction, float(pressure))]))
        return cases

    def _elsewhere(self, within: bool, rng: np.random.Generator) -> list[HardCase]:
        """Presses other parts of the free boundary, straight in."""
        mesh, reach = self._problem.mesh, self._scene.endoscope.reach
        free = np.asarray(~mesh.clamped[mesh.faces].all(axis=1))
        surface, cases = accessible_surface(replace(mesh, accessible=free)), list[HardCase]()
        while len(cases) < self._count:
            point = random_points(surface, 1, rng)[0]
            _, _, distance = self._atlas.surface.project(point)
            if not (OFF < distance <= reach if within else distance > reach):
                continue
            x, normal, _ = surface.project(point)
            pressure = limit_at(self._atlas, point, -normal) * np.sqrt(rng.random())
            load = Load(x, -normal, float(pressure))
            cases.append(self._pressed(load, normal, self._scene.endoscope.radius))
        return cases

    def _footprints(self, radius: float, rng: np.random.Generator) -> list[HardCase]:
        project = self._atlas.surface.project
        return [self._pressed(x, project(x.position)[1], radius) for x in self._loads(rng)]

    def _pressed(self, load: Load, normal: Array, radius: float) -> HardCase:
        nodal = np.zeros(len(self._problem.mesh.nodes))
        footprint(self._problem.body.boundary, load.position, normal, radius, nodal)
        own = None if radius == self._scene.endoscope.radius else radius
        return self._through(Case.pressed((load,), [nodal], own))

    def _pairs(self, rng: np.random.Generator) -> list[HardCase]:
        pairs = zip(self._loads(rng), self._loads(rng), strict=True)
        return [self._through(Case.of(self._problem, *pair)) for pair in pairs]

    def _moves(self, step: float, rng: np.random.Generator) -> list[HardCase]:
        loads = self._loads(rng)
        return [self._path([x, *walk(self._atlas, x, WARM_UP, rng, step)]) for x in loads]

    def _teleports(self, rng: np.random.Generator) -> list[HardCase]:
        return [self._path(self._loads(rng, WARM_UP + 1)) for _ in range(self._count)]


@lru_cache(maxsize=1 + len(RATIOS))
def tissue(problem: FullProblem, poisson: float) -> FullProblem:
    """The same body of tissue of another Poisson's ratio."""
    scene = problem.scene
    if poisson == scene.tissue.poisson:
        return problem
    other = scene.tissue.model_copy(update={"poisson": poisson})
    return FullProblem(scene.model_copy(update={"tissue": other}), problem.mesh)


def several(pairs: Mapping[str, Sequence[Followed]], most: int) -> dict[str, list[Followed]]:
    """Of all loads that were followed, those of several equilibria: raised, and lowered again."""
    followed: dict[str, list[Followed]] = {}
    for own in pairs.values():
        for case, truth in own:
            if case.follow:
                kind = followed.setdefault(HYSTERESIS if len(case.steps) > 1 else SEVERAL, [])
                kind += [(case, truth)] if truth.several else []
    return {name: own[:most] for name, own in followed.items()}


def equilibria(problem: FullProblem, case: HardCase) -> Equilibria:
    """Full solutions of a hard case; a task for ``run.workers``."""
    own = tissue(problem, case.poisson)
    path = [step.load(len(own.mesh.nodes)) for step, _ in case.steps]
    load = path[-1]
    if not case.follow:
        jump = _lead(own, [load], FINEST)
        return Equilibria(jump, jump)
    if len(path) == 1:
        path = [(i + 1) / PATH_STEPS * load for i in range(PATH_STEPS)]
    return Equilibria(_lead(own, path, 1.0), _lead(own, [load], 1.0))


def _lead(problem: FullProblem, loads: Sequence[Array], finest: float) -> Array | None:
    """Displacement (3 n,) mm at the end of a path of loads from nothing."""
    u = None
    for load in loads:
        try:
            u = problem.model.solve(load, start=u, smallest_step=finest).displacement
        except NoEquilibrium:
            return None
    return None if u is None else u.ravel()


def all_equilibria(
    cases: Mapping[str, Sequence[HardCase]], pool: Executor, checkpoint: Checkpoint
) -> dict[str, list[Followed]]:
    """Cases of each kind with their full solutions."""
    tasks = {
        f"{name}-{i}": (equilibria, x) for name, own in cases.items() for i, x in enumerate(own)
    }

    found = resume("full solutions", pool, checkpoint, tasks)
    return {
        name: [(case, found[f"{name}-{i}"]) for i, case in enumerate(own)]
        for name, own in cases.items()
    }
