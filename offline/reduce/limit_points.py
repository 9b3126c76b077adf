"""Where tissue gives way within its load range: the range ends before that.

Near a fold of the load path a small error of the force is a large one of the displacement, and
between the folds of the full and of the reduced model the two lie on different branches: the one
kind of answer that is converged, in range and wrong.  The reduced model is quick enough to be
pressed everywhere, in all directions and a little beyond the range, and shows where its own path
turns; the full model's does so close by.

Under the rigid tip a free edge can lie on either side of it, and slips off to the other as the tip
slides on.  There one position has several answers, and which is the right one hangs on the way that
the tip came: reduced and full model need not part from the same one at the same step.  The reduced
model is asked everywhere whether its answers depend on the way.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.offline.fem.problem import FullProblem
from palpate.offline.reduce.sampling import cone, random_points_and_rim, tangents
from palpate.shared.answer import Answer
from palpate.shared.errors import QueryError
from palpate.shared.local_models import Estimators, LocalModels
from palpate.shared.mechanics.footprint import TIP_DEPTH, pressure_limit
from palpate.shared.model import ReducedModel

Array = NDArray[np.float64]

PATHS_PER_PATCH = 16

SHARES = np.linspace(0.6, 1.1, 11)
"""Of the limit at which each path is solved."""

SUDDEN = 1.0
"""Growth of the exponent of displacement over pressure from one step to the next: softening tissue
has up to .6, a jump by 5 % of the displacement 1."""

MARGIN = 1.1
"""Limit at which the reduced model gives way over the one it gets: the full one may do so before
that."""

REACH = 2.0
"""Distance (mm) from where tissue gives way up to which the limit is lowered."""

CLOSER = 24
"""More paths near each that gives way."""

CONTACTS_PER_PATCH, CONTACTS_CLOSER = 2, 4
"""Contacts of the tip, and more of them near each whose answer depends on the way."""

DEPTH_SHARES = np.linspace(1.0, 0.1, 7)
"""Of the depth limit that are tried, until one has the same answer by all ways."""

WAYS, FAR, STRIDE = 4, 1.5, 0.5
"""Ways that the tip comes sliding, their length and steps (mm)."""

SAME = 0.1
"""Difference of answers, relative to them, that is not one of equilibria."""

SLIP_REACH = 1.0
"""As ``REACH``, of a tip: half its radius."""


Rows = list[tuple[Any, ...]]
Ask = Callable[[str, Callable[..., float], Rows], Iterable[float]]
"""Values of a function of the reduced model at places, its further arguments; under a title."""


def lowered_limits(model: ReducedModel, ask: Ask, rng: np.random.Generator) -> Array:
    """Load range (v, LIMIT_FIELDS) whose pressures are lowered where tissue gives way."""

    def rows(points: Iterable[Array]) -> Rows:
        found: Rows = []
        for i, point in enumerate(points):
            x, normal, _, fields = model.surface.locate(point, model.limits)
            tilt = model.scene.endoscope.max_tilt
            direction = cone(normal, tilt, 1, rng, border=i % 2 == 0)[0]
            found.append((x, direction, pressure_limit(fields, normal, direction)))
        return found

    ask_there = partial(ask, "giving way", limit_load_share)
    return _lowered(model, 0, rows, ask_there, (PATHS_PER_PATCH, CLOSER), REACH, rng)


def lowered_depths(model: ReducedModel, ask: Ask, rng: np.random.Generator) -> Array:
    """The same, depths of the tip lowered to where an answer does not depend on the way."""

    def rows(points: Iterable[Array]) -> Rows:
        return [(model.surface.project(x)[0], rng.uniform(0.0, 2.0 * np.pi)) for x in points]

    ask_there = partial(ask, "slipping off", path_independent_share)
    counts = CONTACTS_PER_PATCH, CONTACTS_CLOSER
    return _lowered(model, TIP_DEPTH, rows, ask_there, counts, SLIP_REACH, rng)


def _lowered(
    model: ReducedModel,
    field: int,
    rows: Callable[[Iterable[Array]], Rows],
    ask_there: Callable[[Rows], Iterable[float]],
    counts: tuple[int, int],
    reach: float,
    rng: np.random.Generator,
) -> Array:
    """Load range with a field lowered to the shares of it that the reduced model bears.

    ``counts`` are points for each local model, and more of them near each that does not bear all.
    """
    surface, (first, closer) = model.surface, counts
    vertices = cKDTree(surface.vertices)

    def lacking(points: Iterable[Array]) -> list[tuple[Array, float]]:
        asked = rows(points)
        shares = zip(asked, ask_there(asked), strict=True)
        return [(x, share) for (x, *_), share in shares if share < 1.0]

    found = lacking(random_points_and_rim(surface, first * len(model.models.centres), rng))
    near = [rng.choice(vertices.query_ball_point(x, reach), closer) for x, _ in found]
    if near:
        found += lacking(surface.vertices[np.concatenate(near)])
    share = np.ones(len(surface.vertices))
    for x, bearable in found:
        lowered = vertices.query_ball_point(x, reach)
        share[lowered] = np.minimum(share[lowered], bearable)
    limits = model.limits.copy()
    limits[:, field] *= share
    return limits


def untested(problem: FullProblem, models: LocalModels, limits: Array) -> ReducedModel:
    """Reduced model of local models and a load range, without error estimates."""
    scene = problem.scene
    return ReducedModel(
        scene.name, scene, {}, problem.body, problem.surface, limits, models, Estimators()
    )


@lru_cache(maxsize=1)
def _pickled(problem: FullProblem, path: Path) -> ReducedModel:
    return untested(problem, *pickle.loads(path.read_bytes()))


def ask(
    problem: FullProblem, path: Path, function: Callable[..., float], rows: Rows
) -> list[float]:
    """Values of a function of a reduced model and of further arguments; for ``run.workers``.

    ``path`` is a pickle of the local models and their load range.
    """
    return [function(_pickled(problem, path), *row) for row in rows]


def limit_load_share(model: ReducedModel, x: Array, direction: Array, limit: float) -> float:
    """Share of a pressure (kPa) up to which tissue yields gradually, with ``MARGIN``; at most 1."""
    moved = np.full(len(SHARES), np.nan)  # where it does not converge an answer says so itself
    for i, share in enumerate(SHARES):
        answer = model.press(x, share * limit, direction)
        if answer.converged:
            moved[i] = sum(weight * np.linalg.norm(q) for _, weight, q in answer.parts)
    exponents = np.diff(np.log(moved)) / np.diff(np.log(SHARES))
    sudden = np.flatnonzero(np.diff(exponents) > SUDDEN)
    return float(SHARES[sudden[0] + 1]) / MARGIN if len(sudden) else 1.0


def path_independent_share(model: ReducedModel, x: Array, turn: float = 0.0) -> float:
    """Share of the depth limit at a contact up to which the tip's way there does not matter.

    ``turn`` is the angle (rad) of the ways about the normal.
    """
    for share in DEPTH_SHARES:
        if not _depends_on_way(model, x, share, turn):
            return float(share) if share == 1.0 else float(share) / MARGIN
    return float(DEPTH_SHARES[-1]) / MARGIN


def _depends_on_way(model: ReducedModel, x: Array, share: float, turn: float) -> bool:
    """Whether a tip that comes sliding finds another equilibrium than one pressed in."""
    pressed = model.touch(_over(model, x, share))
    state = model.new_warm()
    for angle in turn + 2.0 * np.pi * np.arange(WAYS) / WAYS:
        state.forget()
        slid = None
        for place in reversed(_way(model, x, angle)):
            try:
                slid = model.touch(_over(model, place, share), warm=state)
            except QueryError:  # in a fold the tip's centre can be below the other side
                continue
        if slid is not None and _apart(pressed, slid):
            return True
    return False


def _over(model: ReducedModel, x: Array, share: float) -> Array:
    """Centre of a tip pressed in at a point of the surface by a share of the depth limit."""
    x, normal, _, fields = model.surface.locate(x, model.limits)
    return x + (model.scene.endoscope.radius - share * fields[TIP_DEPTH]) * normal


def _way(model: ReducedModel, x: Array, angle: float) -> list[Array]:
    """Points of the surface from one point on, as far as it goes."""
    places, normal = [x], model.surface.project(x)[1]
    heading = np.array([np.cos(angle), np.sin(angle)]) @ np.array(tangents(normal))
    for _ in range(round(FAR / STRIDE)):
        on, normal = model.surface.project(places[-1] + STRIDE * heading)[:2]
        heading = heading - heading @ normal * normal
        size = float(np.linalg.norm(heading))
        if size < 1e-6 or np.linalg.norm(on - places[-1]) < 0.3 * STRIDE:
            break
        heading /= size
        places.append(on)
    return places


def _apart(one: Answer, other: Answer) -> bool:
    """Whether answers to the same position are different equilibria, as far as they are known."""
    if not (one.converged and other.converged):
        return False
    known = {k: q for k, _, q in other.parts}
    both = [(weight, q, known[k]) for k, weight, q in one.parts if k in known]
    away = sum(weight * np.linalg.norm(p - q) for weight, p, q in both)
    return bool(away > SAME * sum(weight * np.linalg.norm(p) for weight, p, _ in both))
