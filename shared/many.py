"""Many queries from rest on all cores, each answered as by itself, but for round-off.

What a thread does is compiled (``reduced.many``) and holds no lock; every thread has working memory
of its own.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from palpate.shared.answer import Answers
from palpate.shared.arrays import Array, Flags
from palpate.shared.compiled import room
from palpate.shared.mechanics import newton
from palpate.shared.query import ABSURD, load_beyond, refuse_rows, rows, stiffness, tip_beyond
from palpate.shared.reduced.features import UNFITTED
from palpate.shared.reduced.many import Found, press_many, touch_many

if TYPE_CHECKING:
    from palpate.shared.model import ReducedModel
    from palpate.shared.reduced.workspace import Workspace

PART = 200
"""Queries that a thread takes at once: some 20 ms."""


def solve(
    model: ReducedModel,
    positions: ArrayLike,
    pressures: ArrayLike,
    directions: ArrayLike | None,
    young: float | None,
    threads: int | None,
) -> Answers:
    """Answer pressed footprints.

    Parameters
    ----------
    positions : array_like, shape (n, 3), mm
    pressures : array_like, shape (n,), kPa
    directions : array_like, shape (n, 3), or None
        None for the inward normals.
    young : float or None
        Of all, kPa; see ``ReducedModel.press``.
    threads : int or None
        None for one on each core.

    Raises
    ------
    QueryError
        If a field is not finite, out of reach or makes no sense; it names the row, from 0.
    """
    at, endoscope = rows("positions", positions, 3), model.scene.endoscope
    pressed = rows("pressures", pressures, 1, len(at))[:, 0]
    ratio = stiffness(model.scene.tissue.young, young)
    most = ratio * ABSURD * model.pressure_max
    refuse_rows("pressures", (pressed < 0) | (pressed > most), f"must be 0 to {most:.3g} kPa")
    pressed = pressed / ratio
    towards = np.zeros_like(at)
    if directions is not None:
        towards = 0.5 * rows("directions", directions, 3, len(at))  # as in ``checked_load``
        length = np.array([math.hypot(*row) for row in towards.tolist()])
        refuse_rows("directions", length == 0.0, "must not be zero")
        towards = towards / length[:, None]

    def work(own: Workspace, found: Found, part: slice) -> None:
        mesh, loads = _fitted(model.estimators.mesh), (at[part], towards[part], pressed[part])
        press_many(own.solver, mesh, *loads, endoscope.radius, found)

    found = _in_threads(model, False, len(at), threads, work)
    reach = f"more than {endoscope.reach} mm from the accessible surface"
    refuse_rows("positions", found.distance > endoscope.reach, reach)
    refuse_rows("directions", ~(found.tilt < 90.0), "must point into the tissue")
    above = np.sum((at - found.point) * found.normal, axis=1)
    beyond = load_beyond(endoscope, above, found.distance, found.tilt, pressed, found.limit)
    answers = _answers(found, beyond, ratio)
    return answers._replace(limit=ratio * found.limit, error_force=np.zeros(len(at)))


def touch(
    model: ReducedModel, positions: ArrayLike, young: float | None, threads: int | None
) -> Answers:
    """Answer positions (n, 3) mm of the rigid tip; see ``solve``."""
    ratio = stiffness(model.scene.tissue.young, young)
    at, radius = rows("positions", positions, 3), model.body.tip.radius

    def work(own: Workspace, found: Found, part: slice) -> None:
        touch_many(own.solver, _fitted(model.estimators.mesh_tip), at[part], found)

    found = _in_threads(model, True, len(at), threads, work)
    below = "the tip's centre lies below the accessible surface"
    refuse_rows("positions", found.depth > radius, below)
    near = found.depth > 0.0
    beyond = tip_beyond(found.beside, found.barred, near, found.depth, found.limit)
    return _answers(found, beyond, ratio)


def _fitted(coefficients: Array | None) -> Array:
    return UNFITTED if coefficients is None else coefficients


def _in_threads(
    model: ReducedModel,
    tip: bool,
    count: int,
    threads: int | None,
    work: Callable[[Workspace, Found, slice], None],
) -> Found:
    """Let threads take parts of so many queries until all are done."""
    found, starts = room(Found, n=count), range(0, count, PART)
    left = iter(starts)

    def do(_: int) -> None:
        own = model.workspace(tip, in_time=False)
        for start in left:  # which one thread at a time is given
            part = slice(start, start + PART)
            work(own, Found(*(array[part] for array in found)), part)

    most = max(1, min(threads or os.cpu_count() or 1, len(starts)))
    with ThreadPoolExecutor(most) as pool:
        list(pool.map(do, range(most)))
    return found


def _answers(found: Found, beyond: Mapping[str, Flags], ratio: float) -> Answers:
    """Answers of what was found in tissue so many times as stiff.

    Errors of those beyond the range in a field are not known.
    """
    outside = np.any(list(beyond.values()), axis=0)
    converged = found.status == newton.CONVERGED
    found.errors[outside | ~converged] = np.inf
    return Answers(
        contact_point=found.point,
        normal=found.normal,
        distance=found.distance,
        force=ratio * found.force,
        converged=converged,
        iterations=found.iterations.astype(np.int64),
        in_range=~outside,
        error_displacement=found.errors[:, 0],
        error_von_mises=found.errors[:, 1],
        error_force=found.errors[:, 2],
        min_jacobian=found.min_jacobian,
        limit=found.limit,
        contact_displacement=found.displacement,
    )
