"""Cases that strain a method of deforming tissue, and what the full model makes of them.

The answer that counts is the one tissue comes to when the load is raised from nothing.  Within a
few times the trained range a single jump finds the same; beyond it the load path is followed in
small steps, and where the jump ends elsewhere the load has more than one equilibrium.  So it has
where a load that was raised beyond the range and lowered again leaves the tissue elsewhere than
one raised from nothing does: there what counts is where the way has led.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.surface import accessible_surface
from palpate.offline.methods.method import Case
from palpate.offline.reduce.sampling import cone, random_points, tangents
from palpate.offline.run.checkpoint import Checkpoint
from palpate.offline.run.workers import resume
from palpate.offline.run.workshop import Load, Workshop
from palpate.offline.validate.loads import random_loads
from palpate.offline.validate.norms import relative
from palpate.shared.geometry.surface import Surface
from palpate.shared.mechanics.footprint import footprint, pressure_limit
from palpate.shared.model import ReducedModel

Array = NDArray[np.float64]

STRESS = 102
"""Sets these random numbers apart, as ``validate.loads.UNSEEN`` does those of the queries."""

CONTROL, SEVERAL = "inside the range", "several equilibria"

LOWERED, HYSTERESIS = "raised, then lowered", "lowered, several equilibria"

FACTORS = (1.5, 2.0, 4.0, 8.0)
"""Load jumps: pressures over the trained maximum."""

RAISED, SNAPPED = (2.0, 2.0), (1.5, 4.0)
"""The highest pressure over the trained maximum of a load that is lowered into the range again, at
random between two: of any, and of those that are searched for several equilibria."""

SEARCHED = 3
"""Of the latter, for each one wanted: about one in twenty on the turbinate stays elsewhere."""

TILTS = (45.0, 60.0)
"""Degrees."""

RATIOS = (0.49, 0.499)
"""Poisson's ratios of other tissues."""

STEPS = (0.05, 0.5, 2.0, 10.0)
"""Of a moving tool, mm."""

TELEPORT = "tool teleports"

WARM_UP = 4
"""Queries on the way of a moving tool before the one that is judged."""

TURNS = 20
"""Headings tried where the surface ends; on one smaller than a step the last is taken."""

OFF = 0.5
"""Points as far from the accessible surface (mm) count as off it."""

PATH_STEPS = 8
"""Of a load path; of one that is lowered again half of them lead up."""

APART = 0.01
"""Two equilibria that differ by more are not the same."""

FINEST = 0.25
"""Part of a load in range below which a full solution gives up; others are not divided further."""


@dataclass(frozen=True)
class Trial:
    """A case, and what else it depends on.

    Attributes
    ----------
    case : Case
    poisson : float
        Of the tissue.
    before : tuple of Case
        Where the tool has been.
    follow : bool
        Whether the full model follows the load path: from nothing, or through the loads before.
    """

    case: Case
    poisson: float
    before: tuple[Case, ...] = ()
    follow: bool = False


@dataclass(frozen=True)
class Truth:
    """Full model's displacements (3 n,) mm, None where no equilibrium is found.

    Attributes
    ----------
    path, jump : ndarray or None
        At the end of the load path, which is the answer that counts, and in one jump from rest.
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


class Stressors:
    """Makes the trials of every stressor.

    Parameters
    ----------
    atlas : ReducedModel
    workshop : Workshop
        Of the artifact's mesh.
    count : int
        Trials of each.
    seed : int
    """

    def __init__(self, atlas: ReducedModel, workshop: Workshop, count: int, seed: int) -> None:
        self._atlas, self._workshop, self._count, self._seed = atlas, workshop, count, seed
        self._scene = workshop.scene
        self._poisson = self._scene.tissue.poisson

    @property
    def makers(self) -> dict[str, Callable[[np.random.Generator], list[Trial]]]:
        """What makes the trials of each stressor, by its name."""
        radius = self._scene.endoscope.radius
        return {
            CONTROL: partial(self._in_tissue, self._poisson),
            **{f"load x {factor:g}": partial(self._jumps, factor) for factor in FACTORS},
            SEVERAL: self._extreme,
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

    def trials(self) -> dict[str, list[Trial]]:
        """Trials of every stressor by its name; of several equilibria those that may be."""
        return {
            name: make(np.random.default_rng([self._scene.seed, STRESS, self._seed, i]))
            for i, (name, make) in enumerate(self.makers.items())
        }

    def _loads(self, rng: np.random.Generator, count: int | None = None) -> list[Load]:
        atlas, count = self._atlas, self._count if count is None else count
        return random_loads(atlas.surface, atlas.limits, atlas.scene, count, rng)

    def _limit(self, position: Array, direction: Array) -> float:
        _, normal, _, fields = self._atlas.surface.locate(position, self._atlas.limits)
        return float(pressure_limit(fields, normal, direction))

    def _case(self, *loads: Load) -> Case:
        return Case.of(self._workshop, *loads)

    def _single(self, loads: list[Load]) -> list[Trial]:
        return [Trial(self._case(load), self._poisson) for load in loads]

    def _in_tissue(self, poisson: float, rng: np.random.Generator) -> list[Trial]:
        return [Trial(self._case(load), poisson) for load in self._loads(rng)]

    def _raised(self, load: Load, factor: float) -> Trial:
        pressure = factor * self._limit(load.position, load.direction)
        return Trial(self._case(replace(load, pressure=pressure)), self._poisson, follow=True)

    def _jumps(self, factor: float, rng: np.random.Generator) -> list[Trial]:
        return [self._raised(load, factor) for load in self._loads(rng)]

    def _extreme(self, rng: np.random.Generator) -> list[Trial]:
        loads = self._loads(rng)
        return [self._raised(load, rng.uniform(FACTORS[0], FACTORS[-1])) for load in loads]

    def _lowered(
        self, peaks: tuple[float, float], count: int, rng: np.random.Generator
    ) -> list[Trial]:
        loads = self._loads(rng, count)
        return [self._up_and_down(load, rng.uniform(*peaks)) for load in loads]

    def _up_and_down(self, load: Load, factor: float) -> Trial:
        """A load in range that comes down from a multiple of the limit."""
        peak, half = factor * self._limit(load.position, load.direction), PATH_STEPS // 2
        turns = np.interp(
            np.arange(1, PATH_STEPS + 1), (0, half, PATH_STEPS), (0, peak, load.pressure)
        )
        way = [replace(load, pressure=float(pressure)) for pressure in turns]
        return replace(self._way(way), follow=True)

    def _tilted(self, tilt: float, rng: np.random.Generator) -> list[Trial]:
        loads = []
        for load in self._loads(rng):
            normal = self._atlas.surface.project(load.position)[1]
            direction = cone(normal, tilt, 1, rng, border=True)[0]
            pressure = self._limit(load.position, direction) * np.sqrt(rng.random())
            loads.append(Load(load.position, direction, float(pressure)))
        return self._single(loads)

    def _elsewhere(self, within: bool, rng: np.random.Generator) -> list[Trial]:
        """Presses other parts of the boundary, straight in."""
        surface, reach = self._boundary(), self._scene.endoscope.reach
        trials: list[Trial] = []
        while len(trials) < self._count:
            point = random_points(surface, 1, rng)[0]
            _, _, distance = self._atlas.surface.project(point)
            if not (OFF < distance <= reach if within else distance > reach):
                continue
            x, normal, _ = surface.project(point)
            pressure = self._limit(point, -normal) * np.sqrt(rng.random())
            load = Load(x, -normal, float(pressure))
            trials.append(self._pressed(load, normal, self._scene.endoscope.radius))
        return trials

    def _boundary(self) -> Surface:
        """All of the boundary that is free."""
        mesh = self._workshop.mesh
        free = np.asarray(~mesh.clamped[mesh.faces].all(axis=1))
        return accessible_surface(replace(mesh, accessible=free))

    def _footprints(self, radius: float, rng: np.random.Generator) -> list[Trial]:
        normals = self._atlas.surface.project
        return [self._pressed(x, normals(x.position)[1], radius) for x in self._loads(rng)]

    def _pressed(self, load: Load, normal: Array, radius: float) -> Trial:
        nodal = np.zeros(len(self._workshop.mesh.nodes))
        footprint(self._workshop.body.boundary, load.position, normal, radius, nodal)
        own = None if radius == self._scene.endoscope.radius else radius
        return Trial(Case.pressed((load,), [nodal], own), self._poisson)

    def _pairs(self, rng: np.random.Generator) -> list[Trial]:
        pairs = zip(self._loads(rng), self._loads(rng), strict=True)
        return [Trial(self._case(*pair), self._poisson) for pair in pairs]

    def _moves(self, step: float, rng: np.random.Generator) -> list[Trial]:
        return [self._way(self._glide(load, step, rng)) for load in self._loads(rng)]

    def _glide(self, start: Load, step: float, rng: np.random.Generator) -> list[Load]:
        """Contacts a step apart along the surface, turning where it ends."""
        surface, way = self._atlas.surface, [start]
        share = start.pressure / self._limit(start.position, start.direction)
        cosine = min(1.0, float(-start.direction @ surface.project(start.position)[1]))
        heading = rng.standard_normal(3)
        while len(way) <= WARM_UP:
            x = way[-1].position
            for wanted in (heading, *rng.standard_normal((TURNS, 3))):
                reached, normal, _ = surface.project(
                    x + step * _along(surface.project(x)[1], wanted)
                )
                if np.linalg.norm(reached - x) > 0.8 * step:
                    break
            heading = _along(normal, reached - x)
            direction = np.sqrt(1 - cosine**2) * heading - cosine * normal
            way.append(Load(reached, direction, share * self._limit(reached, direction)))
        return way

    def _teleports(self, rng: np.random.Generator) -> list[Trial]:
        return [self._way(self._loads(rng, WARM_UP + 1)) for _ in range(self._count)]

    def _way(self, loads: list[Load]) -> Trial:
        *before, last = (self._case(load) for load in loads)
        return Trial(last, self._poisson, tuple(before))


def _along(normal: Array, heading: Array) -> Array:
    """Unit tangent nearest to a heading."""
    t, b = tangents(normal)
    tangent = heading @ t * t + heading @ b * b
    return tangent / np.linalg.norm(tangent)


@lru_cache(maxsize=1 + len(RATIOS))
def tissue(workshop: Workshop, poisson: float) -> Workshop:
    """The same body of tissue of another Poisson's ratio."""
    scene = workshop.scene
    if poisson == scene.tissue.poisson:
        return workshop
    other = scene.tissue.model_copy(update={"poisson": poisson})
    return Workshop(scene.model_copy(update={"tissue": other}), workshop.mesh)


def press(workshop: Workshop, trial: Trial) -> Truth:
    """What the full model makes of a trial, on the path to it and in one jump."""
    own = tissue(workshop, trial.poisson)
    load = _forces(own, trial.case)
    if not trial.follow:
        jump = _lead(own, [load], FINEST)
        return Truth(jump, jump)
    path = [_forces(own, case) for case in (*trial.before, trial.case)]
    if not trial.before:
        path = [(i + 1) / PATH_STEPS * load for i in range(PATH_STEPS)]
    return Truth(_lead(own, path, 1.0), _lead(own, [load], 1.0))


def _forces(workshop: Workshop, case: Case) -> Array:
    """Nodal forces (n, 3) mN."""
    load = np.zeros((len(workshop.mesh.nodes), 3))
    load[case.nodes] = case.forces
    return load


def _lead(workshop: Workshop, loads: Sequence[Array], finest: float) -> Array | None:
    """Displacement (3 n,) mm at the end of a path of loads from nothing."""
    u = None
    for load in loads:
        try:
            found = workshop.model.solve(load, u, smallest_step=finest)
        except NoEquilibrium:
            return None
        u = found.displacement
    return None if u is None else u.ravel()


def truths(
    trials: Mapping[str, Sequence[Trial]], pool: Executor, checkpoint: Checkpoint
) -> dict[str, list[Truth]]:
    """What the full model makes of the trials of each stressor."""
    names = {(name, i): f"{name}-{i}" for name, own in trials.items() for i in range(len(own))}
    tasks = {text: (press, trials[name][i]) for (name, i), text in names.items()}
    found = resume("full solutions", pool, checkpoint, tasks, _pack)
    answers: dict[str, list[Truth]] = {name: [] for name in trials}
    for (name, _), text in names.items():
        answers[name].append(Truth(*(found[text].get(key) for key in KEYS)))
    return answers


KEYS = ("path", "jump")


def _pack(truth: Truth) -> dict[str, Array]:
    return {key: u for key in KEYS if (u := getattr(truth, key)) is not None}
