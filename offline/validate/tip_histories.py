"""The reduced against the full model over histories of the rigid tip it has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.offline.run.workshop import Workshop
from palpate.offline.validate.histories import NONE_FOLLOWED, Hand, Press, random_course
from palpate.offline.validate.loads import unseen, verdict
from palpate.offline.validate.moments import (
    KnownMoment,
    covered_moments,
    errors_so_far,
    known_moments,
)
from palpate.offline.validate.norms import relative, statistics
from palpate.offline.validate.tip import OTHER_EQUILIBRIUM, QUANTITIES
from palpate.shared.answer import Answer
from palpate.shared.errors import QueryError
from palpate.shared.geometry.surface import Surface
from palpate.shared.local_models import Estimator
from palpate.shared.mechanics.footprint import TIP_DEPTH
from palpate.shared.model import ReducedModel
from palpate.shared.reduced.transfer import REST
from palpate.shared.scene import Scene

Array = NDArray[np.float64]

OFF = 0.05
"""Millimetres between the surface at rest and a tip that does not press."""


class Course(NamedTuple):
    """Positions of the tip at the ends of time steps."""

    positions: Array  # (t, 3) mm
    times: list[float]  # (t,) s, lengths of the steps


class _TipHand(Hand):
    """A rigid tip instead of a footprint: a press says where its centre is."""

    def _press(self, dt: float) -> Press:
        depth = self._level * self._limits[TIP_DEPTH] if self._level > 0.0 else -OFF
        centre = self._x + (self._endoscope.radius - depth) * self._normal
        return Press(dt, centre, -self._normal, 0.0)


def random_courses(
    surface: Surface, limits: Array, scene: Scene, count: int, rng: np.random.Generator
) -> list[Course]:
    """Ramps, holds, releases, taps and slides; one course in eight begins on the rim."""
    courses = []
    for number in range(count):
        hand = _TipHand(surface, limits, scene, rng, rim=number % 8 == 0)
        presses = random_course(hand)
        courses.append(Course(np.array([p.position for p in presses]), [p.dt for p in presses]))
    return courses


def play_course(atlas: ReducedModel, course: Course) -> list[Answer]:
    """Answers of the reduced model."""
    past, warm, answers = REST, atlas.new_warm(), []
    for position, dt in zip(*course, strict=True):
        answer = atlas.touch(position, past=past, dt=dt, warm=warm)
        assert answer.past is not None
        past = answer.past
        answers.append(answer)
    return answers


@dataclass
class CourseComparison:
    """One history answered by both models.

    Attributes
    ----------
    steps : int
    seconds : float
    travel : float, mm
        Of the tip.
    displacement, von_mises, force : float
        Relative L2 errors over all nodes (outside the clamped layer) and all moments.
    worst_displacement, worst_von_mises, worst_force : float
        Largest error of a moment, over the largest norm until then.
    apart : int
        Moments at which the models rest in different equilibria, as where tissue has slipped off
        the tip in one and is about to in the other.
    together_displacement, together_von_mises, together_force : float
        Errors over all other moments.
    unconverged : int
    moments : list of KnownMoment
    """

    steps: int
    seconds: float
    travel: float
    displacement: float
    von_mises: float
    force: float
    worst_displacement: float
    worst_von_mises: float
    worst_force: float
    apart: int
    together_displacement: float
    together_von_mises: float
    together_force: float
    unconverged: int
    moments: list[KnownMoment] = field(repr=False)

    @property
    def typical(self) -> bool:
        """Whether both models rest in the same equilibria."""
        return self.displacement <= OTHER_EQUILIBRIUM

    def estimate(self, estimator: Estimator) -> None:
        """Fill in the estimated errors of its moments."""
        for moment in self.moments:
            moment.estimate(estimator)


def compare_course(
    workshop: Workshop, atlas: ReducedModel, course: Course, full: Sequence[NDArray[Any]]
) -> CourseComparison:
    """Answer a history with the reduced model and compare with full solutions (t, ...)."""
    answers = play_course(atlas, course)
    kept = workshop.beyond_clamped_layer
    u = np.array([atlas.displacement(answer) for answer in answers], float)
    s = np.array([atlas.von_mises(answer) for answer in answers], float)[:, kept]
    f = np.array([answer.force for answer in answers])
    pairs = list(zip((u, s, f), (full[0], full[1][:, kept], full[2]), strict=True))
    errors = errors_so_far(pairs)
    overall = [relative(a, b.astype(float)) for a, b in pairs]
    together = ~_apart(u, full[0])
    rest = [relative(a[together], b[together].astype(float)) for a, b in pairs]
    worst = errors.max(axis=1).tolist()
    return CourseComparison(
        steps=len(answers),
        seconds=float(sum(course.times)),
        travel=float(np.linalg.norm(np.diff(course.positions, axis=0), axis=1).sum()),
        displacement=overall[0],
        von_mises=overall[1],
        force=overall[2],
        worst_displacement=worst[0],
        worst_von_mises=worst[1],
        worst_force=worst[2],
        apart=int(np.sum(~together)),
        together_displacement=rest[0],
        together_von_mises=rest[1],
        together_force=rest[2],
        unconverged=sum(not answer.converged for answer in answers),
        moments=known_moments(errors, answers),
    )


def _apart(u: Array, exact: NDArray[Any]) -> NDArray[np.bool_]:
    """Moments (t,) at which displacements (t, n, 3) are those of different equilibria."""
    away, size = (np.linalg.norm(x.reshape(len(x), -1), axis=1) for x in (u - exact, exact))
    return np.asarray(away > OTHER_EQUILIBRIUM * np.maximum.accumulate(size))


def validate_courses(
    artifact: Path, count: int, seed: int, csv: Path | None = None
) -> dict[str, Any]:
    """Compare an artifact with its full model over new random histories of the rigid tip.

    Parameters
    ----------
    artifact : Path
    count : int
        Histories, over the whole surface and range of depths; one in eight begins on the rim.
    seed : int
    csv : Path, optional
        Where to write one row per history.

    Returns
    -------
    dict
        As ``summarise_courses``, and ``without_equilibrium``: histories that the full model could
        not follow, and which count in nothing else.
    """
    atlas, workshop, rng = unseen(artifact, seed)
    if atlas.models.viscous_tips is None:
        raise QueryError("histories", f"scene {atlas.name!r} has no tip that knows of time")
    courses = random_courses(atlas.surface, atlas.limits, atlas.scene, count, rng)

    def judge(i: int, found: Sequence[NDArray[Any]] | None) -> CourseComparison | None:
        return None if found is None else compare_course(workshop, atlas, courses[i], found)

    tasks = [(Workshop.follow_tip, *course) for course in courses]
    return verdict(artifact, tasks, judge, summarise_courses, NONE_FOLLOWED, csv)


def summarise_courses(rows: Sequence[CourseComparison]) -> dict[str, Any]:
    """Statistics over histories, those left out that the models spend in different equilibria.

    ``covered``: the share of all converged moments that are within their three estimates.
    ``apart``: in how many histories the models part for a while, and for how many moments in all;
    ``together_...``: errors over all other moments of all histories.
    """
    typical = [row for row in rows if row.typical]
    names = [*QUANTITIES, *(f"worst_{name}" for name in QUANTITIES)]
    together = [f"together_{name}" for name in QUANTITIES]
    return {
        "histories": len(rows),
        "steps": sum(row.steps for row in rows),
        "unconverged": sum(row.unconverged for row in rows),
        "other_equilibrium": len(rows) - len(typical),
        **covered_moments(rows, QUANTITIES),
        "apart": {
            "histories": sum(row.apart > 0 for row in rows),
            "moments": sum(row.apart for row in rows),
        },
        **{name: statistics([getattr(row, name) for row in typical]) for name in names},
        **{name: statistics([getattr(row, name) for row in rows]) for name in together},
    }
