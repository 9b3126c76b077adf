"""Young's modulus of tissue from forces measured on a tip that touched it.

At a given Poisson's ratio forces go with the modulus, so it is that of the training times the slope
of the measured forces over the answered ones: least squares, ``r = sum f.F / sum f.f``.  Its
variance is that of White's estimator in the form HC3, which holds for noise of any size at every
place (MacKinnon & White, J. Econometrics 29 (1985) 305-325):

    var r = sum (f.e / (1 - h))^2 / (sum f.f)^2,    e = F - r f,    h = f.f / sum f.f.
"""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student

from palpate.offline.table import PLACE, read_table
from palpate.shared.arrays import Array, Flags
from palpate.shared.errors import PalpateError, QueryError
from palpate.shared.model import ReducedModel
from palpate.shared.reduced.transfer import REST

FORCE, TIME = ("force_x", "force_y", "force_z"), "time"

CONFIDENCE = 0.95
"""That the modulus lies in the interval, if the model is right."""

FEWEST = 3
"""Measured forces that an interval is made of."""


def identify(artifact: Path, recording: Path) -> dict[str, Any]:
    """Young's modulus (kPa) that forces measured on the rigid tip tell, JSON-able.

    The first line of the recording names its columns: ``x,y,z``, the tip's centre in mm, and
    ``force_x,force_y,force_z``, mN on the tool; with tissue that remembers ``time`` in s, too.
    Other columns are left aside, and so are rows without contact or beyond the trained range.

    Raises
    ------
    PalpateError
        If a file cannot be used, a row makes no sense, or too few rows have a force.
    """
    atlas = ReducedModel.load(artifact)
    names, rows = read_table(recording)
    wanted = PLACE + FORCE + ((TIME,) if atlas.scene.tissue.prony else ())
    missing = [name for name in wanted if name not in names]
    if missing:
        raise PalpateError(f"{recording}: its first line lacks {', '.join(missing)}")
    columns = dict(zip(names, rows.T, strict=True))
    measured = np.column_stack([columns[name] for name in FORCE])
    at = np.column_stack([columns[name] for name in PLACE])
    try:
        answered, errors, known = _answered(atlas, at, columns.get(TIME))
    except QueryError as error:
        raise PalpateError(f"{recording}: {error}") from error
    used = known & (np.linalg.norm(answered, axis=1) > 0.0) & np.isfinite(measured).all(axis=1)
    if used.sum() < FEWEST:
        raise PalpateError(
            f"{recording}: {used.sum()} rows are in contact and within the trained range, at least "
            f"{FEWEST} are needed"
        )
    ratio, half = slope(answered[used], measured[used])
    young = atlas.scene.tissue.young
    return {
        "scene": atlas.name,
        "young": ratio * young,
        "interval": [(ratio - half) * young, (ratio + half) * young],
        "confidence": CONFIDENCE,
        "rows": len(rows),
        "used": int(used.sum()),
        "error_force": float(np.median(errors[used])),
    }


def slope(answered: Array, measured: Array) -> tuple[float, float]:
    """Slope of measured over answered forces (n, 3), and half of its confidence interval."""
    own = np.sum(answered**2, axis=1)
    ratio = float(np.sum(answered * measured) / own.sum())
    left = np.sum(answered * (measured - ratio * answered), axis=1) / (1.0 - own / own.sum())
    error = np.sqrt(np.sum(left**2)) / own.sum()
    return ratio, float(student.ppf(0.5 + CONFIDENCE / 2.0, len(own) - 1) * error)


def _answered(atlas: ReducedModel, at: Array, times: Array | None) -> tuple[Array, Array, Flags]:
    """Forces (n, 3) mN of the trained tissue, their estimated errors, and which are known."""
    if times is None or not atlas.scene.tissue.prony:
        found = atlas.touch_many(at)
        return found.force, found.error_force, found.converged & found.in_range
    answers, past, warm = [], REST, atlas.new_warm()
    for x, dt in zip(at, np.diff(times, prepend=times[:1]), strict=True):
        answers.append(atlas.touch(x, past=past, dt=dt, warm=warm))
        past = answers[-1].past or past
    return (
        np.array([answer.force for answer in answers]),
        np.array([answer.error_force for answer in answers]),
        np.array([answer.converged and answer.in_range for answer in answers]),
    )
