"""What the mesh errs by: full solutions beside others on meshes graded towards the contact.

The errors found make the mesh's part of every answer's error estimate, as those of random queries
make the reduction's.  Those under the tip are found beside the sphere integrated over the faces of
such meshes, so that what the law of the tip and its dent in the fields err by is in them.

A finer mesh shows folds of the surface that coarse faces bridge: nearly incompressible tissue jumps
to half as deep again under four fifths of a pressure that the scene's own mesh bears.  The load
range is lowered to end before that.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from palpate.offline.fem.body_mesh import own_mesh
from palpate.offline.fem.graded import Graded, Grading
from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.norms import relative, statistics
from palpate.offline.fem.problem import FullProblem, Load, TipPosition
from palpate.offline.reduce.layout import centred_points_and_rim
from palpate.offline.reduce.sampling import spacing_count
from palpate.offline.validate.compare import KnownAnswer, calibrate, reduced_guess
from palpate.offline.validate.queries import Place
from palpate.shared.arrays import Array
from palpate.shared.geometry.surface import Surface
from palpate.shared.model import ReducedModel
from palpate.shared.scene import Errors, Scene

GRADING = Grading(finest=0.25, even=0.4, growth=0.9, coarsest=1.4)
"""Of references: on the turbinate their own errors under a footprint are .2 to .6 % of displacement
and 5 to 6 % of stress, to which elements far away add as much as those near the contact."""

TIP_GRADING = Grading(finest=0.15, even=0.2, growth=1.0, coarsest=3.0, held=1.0)
"""The same under a tip, whose contact is a fifth of its radius across at a depth of a fiftieth.  On
``turbinate-mri`` edges of .5 radii where it is held take 124 000 instead of 57 000 degrees of
freedom and twice the time, for errors of 1 % more or less displacement and stress, 1.6 of force."""

APART, LEAST, MOST, RIM = 5.0, 9, 19, 3
"""Distance of the places looked at, in radii, their least number and the most; one in so many is on
the rim of the surface.  Under the tip errors differ more from place to place, so that it takes the
most: the largest of so many scores covers 95 of 100 others in the mean.  On a turbinate 42 of 50
answers elsewhere in range are within all estimates from 9 places, 47 from 15, and 49 from 19."""

LEVELS, DEPTHS = (0.3, 1.0), (0.15, 0.8)
"""Shares of the limit at which footprints and tips press there."""

SHALLOW = 0.05
"""Radii that a tip is deep at least: less deep, its contact is no larger than faces of the finer
mesh, which knows no better."""

LESS = (7 / 8, 3 / 4, 5 / 8, 1 / 2)
"""Shares at which footprints press where the finer mesh gives way at the limit, down to one that it
bears; if it bears none of them, it is left with the first of ``LEVELS``."""

CLOSE = 1e-4
"""Residual of solutions, relative to the load or the tip's force, which then errs by as little."""

UNDER_LOAD: Any = {
    "tolerance": CLOSE, "smallest_step": 1.0, "max_iterations": 12, "largest_shift": 0.0
}  # fmt: skip
UNDER_TIP: Any = {"tolerance": CLOSE, "smallest_step": 1 / 2, "max_iterations": 40}
"""Steps smaller, as fractions of a load, or with more iterations have failed, and a level without a
step is left out: its tissue has given way.  Steps that find it in balance take 4 to 7 iterations
under a load and 9 to 18, seldom 38, under a tip, each of some half a second on a fine mesh.  Under
a load their tangents are positive definite.  Of ten that fail on ``turbinate-mri`` the second to
the eighth is not: to shift it leads nowhere in 12 iterations, which take 30 to 40 seconds."""

GIVEN_WAY = 0.3
"""Error of displacement, of all or under the footprint, or of the tip's force, beyond which the
finer mesh has given way where the scene's own has not: that is no error of a size, and the limit
there is too high.  Training says how many there are.  Under the tip all of displacement counts by
what its error is more than at a smaller depth, since coarse meshes lack the dent at any."""

UNKNOWN = 0.01
"""What references err by themselves: errors below are taken for as much."""

DAMPING = 2.0
"""Of the fit, see ``compare.calibrate``: few answers are known."""

Levels = Sequence[tuple[float, Load | TipPosition, Array | None]]
"""What presses at one place, harder and harder: share of the limit, or mm; the step; if known the
reduced model's answer (n, 3) mm, near which the full one is."""


class Seen(NamedTuple):
    """What one model says of a load along the normal or a position of the tip."""

    displacement: Array  # (n, 3) mm, at nodes
    von_mises: Array  # (n,) kPa
    peaks: tuple[float, float]  # kPa, see ``StressField.peaks``
    felt: Array  # (3,) mN force of a tip, or mm that a footprint moves


class Pressed:
    """A full model pressed harder and harder; the tip is integrated over its faces if wanted."""

    def __init__(self, problem: FullProblem, integrated: bool = False) -> None:
        self._problem, self._integrated = problem, integrated
        self._last: tuple[float, Array] | None = None

    @property
    def displacement(self) -> Array:
        """Displacement (n, 3) mm of the last level, without the dent of a tip."""
        assert self._last is not None
        return self._last[1]

    def harder(self, level: float, step: Load | TipPosition, near: Array | None = None) -> Seen:
        """What it says at a level, sought ``near`` or from the last state, if lower, grown."""
        problem, before, start = self._problem, self._last, near
        if near is None and before is not None and before[0] < level:
            start = level / before[0] * before[1]
        contact, felt = None, None
        if isinstance(step, Load):  # where it is on every mesh, however far its surface goes
            nodal = problem.unit_load_at(step.position, -step.direction)
            forces = step.pressure * nodal[:, None] * step.direction
            found = problem.model.solve(forces, start=start, **UNDER_LOAD)
            contact, felt = problem.footprint(step), nodal @ found.displacement / nodal.sum()
        elif self._integrated:
            load = problem.sphere_at(step.position)
            found = problem.model.solve(load, start=start, **UNDER_TIP)
        else:
            found = problem.solve(step, start=start)
            contact = problem.footprint(step, found)
        self._last, u = (level, found.displacement), problem.displaced(found, contact)
        stress, peaks = problem.von_mises(u, contact=contact), problem.stress_field.peaks
        return Seen(u, stress, peaks(u, None, contact), found.force if felt is None else felt)


def compared(
    problem: FullProblem, scene: Scene, levels: Levels, how: Grading
) -> Iterator[tuple[float, Load | TipPosition, Seen, Seen]]:
    """What the full model says, and one on a mesh graded towards the place, at the former's nodes.

    The tip presses the latter as a sphere integrated over its faces.  It is sought from what the
    former says, which takes half as many iterations, and what the latter added to that at the level
    before: interpolated alone, a deep dent can turn small elements inside out.  Levels without
    equilibrium are left out.
    """
    fine, here = Graded(scene, levels[0][1].position, how), own_mesh(scene)
    own, exact = Pressed(problem), Pressed(fine.problem, integrated=True)
    start, added = None, np.zeros((len(fine.sites), 3))
    for level, step, answer in levels:
        try:
            found = own.harder(level, step, answer)
            if isinstance(step, TipPosition):
                start = here.at(fine.sites, own.displacement) + added
            there = exact.harder(level, step, start)
        except NoEquilibrium:
            continue
        if start is not None:
            added += exact.displacement - start
        u, stress = (fine.at(here.sites, field) for field in (there.displacement, there.von_mises))
        yield level, step, found, there._replace(displacement=u, von_mises=stress)


def places_of(scene: Scene, surface: Surface) -> int:
    """Number of places of a surface to look at."""
    return min(max(LEAST, spacing_count(surface, APART * scene.endoscope.radius)), MOST)


def places(model: ReducedModel, rng: np.random.Generator, tip: bool = False) -> list[Levels]:
    """Footprints pressed along the normal at places all over the surface, or tips at a few."""
    count = MOST if tip else places_of(model.scene, model.surface)
    points = centred_points_and_rim(model.surface, count, RIM, rng)
    found = [Place.at(model, point) for point in points]
    if tip:
        least = SHALLOW * model.scene.endoscope.radius
        inward = [
            [(at, place.touch(at)) for at in DEPTHS if at * place.depth >= least] for place in found
        ]
        return [answered(model, own) for own in inward if own]
    levels = (*LEVELS, *LESS)
    along = [[(at, place.press(-place.normal, at)) for at in levels] for place in found]
    return [answered(model, own) for own in along]


def answered(model: ReducedModel, steps: Sequence[tuple[float, Load | TipPosition]]) -> Levels:
    """Levels of one place with the reduced model's answers."""
    return [(level, step, reduced_guess(model, step)) for level, step in steps]


def mesh_errors(problem: FullProblem, levels: Levels) -> list[Array]:
    """Levels and errors of a scene's mesh at one place; a task for ``run.workers``.

    Relative L2 norms over its volume, of stress over ``counted_volumes``; the relative error of a
    tip's force, or of the mean displacement under a footprint; those of the largest stress and its
    99th percentile.  Last 1 within a radius of the rim of the surface, else 0.  The first level and
    the next that the finer mesh bears are looked at.
    """
    surface, away = problem.surface, problem.surface.rim_distance()[:, None]
    near = surface.locate(levels[0][1].position, away)[-1] < problem.scene.endoscope.radius
    found, volumes, counted = [], problem.nodal_volumes, problem.counted_volumes
    how = TIP_GRADING if isinstance(levels[0][1], TipPosition) else GRADING
    for level, _, own, exact in compared(problem, problem.scene, levels, how):
        errors = (
            relative(own.displacement, exact.displacement, volumes),
            relative(own.von_mises, exact.von_mises, counted),
            abs(float(np.linalg.norm(own.felt) / np.linalg.norm(exact.felt)) - 1.0),
            *np.abs(np.divide(own.peaks, exact.peaks) - 1.0),
        )
        found.append(np.array([level, *errors, near.item()]))
        if level > levels[0][0] and _known(found[-1], None).comparable:
            break
    return found


def borne(places: Sequence[Levels], found: Sequence[list[Array]], surface: Surface) -> Array:
    """Shares of the load range at the vertices (v,) that finer meshes bear: at the nearest place.

    Levels of rows found by ``mesh_errors`` under footprints become shares of what is left of it.
    """
    shares = np.ones(len(found))
    for k, rows in enumerate(found):
        held = (row[0] for row in rows if _known(row, None).comparable)
        shares[k] = max(held, default=1.0)  # a mesh so coarse tells nothing
        for row in rows:
            row[0] /= shares[k]
    points = [levels[0][1].position for levels in places]
    return shares[cKDTree(points).query(surface.vertices)[1]]


def fit(found: Sequence[list[Array]], tip: bool = False) -> tuple[Array, dict[str, Any]]:
    """Coefficients (3, 3) of the log of the mesh's errors: 1, share of the limit, near the rim.

    And what an artifact tells of these errors, of those of ``StressField.peaks`` as well.
    """
    known = [[_known(row, own[0] if tip else None) for row in own] for own in found]
    rows = np.array([row for own in found for row in own])
    there = np.array([answer.comparable for own in known for answer in own])
    told = {
        name: statistics(errors)
        for name, errors in zip((*Errors._fields, "peak", "p99"), rows[there, 1:-1].T, strict=True)
    }
    fitted, confidence = calibrate(known, DAMPING)
    given_way = int(np.sum(~there))
    counts = {"answers": len(rows), "given_way": given_way, "confidence": confidence}
    return fitted, counts | told


def _known(row: Array, first: Array | None) -> KnownAnswer:
    """An answer of ``mesh_errors``, comparable unless the finer mesh has given way.

    ``first`` is that to the first level under a tip there.
    """
    level, *errors, _, _, near_rim = row.tolist()
    moved = max(errors[0] - (0.0 if first is None else first[1]), errors[2])
    return KnownAnswer(
        np.maximum(errors, UNKNOWN),
        np.array([1.0, level, near_rim]),
        True,
        comparable=moved < GIVEN_WAY,
        near_rim=near_rim > 0.0,
    )
