"""What a compiled query reads and writes; its outcome is one array, kept by one copy."""

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from palpate.shared.arrays import Array
from palpate.shared.geometry.surface import SurfaceIndex
from palpate.shared.mechanics.footprint import LIMIT_FIELDS
from palpate.shared.reduced.blend import Active

Number = Any

PRESS_FEATURES, TOUCH_FEATURES, HISTORY_FEATURES = 11, 10, 9
"""Features of the error estimates of loads, of the tip, and of histories of both."""


class Outcome(NamedTuple):
    """Views of the array, in which a number is an array of one; or a copy with plain numbers."""

    status: Number  # worst of the local models, see ``mechanics.newton``
    iterations: Number  # most of one local model
    min_jacobian: Number  # smallest det F among the points
    energy: Number  # of a load: largest norm of a state; under the tip: mN mm
    distance: Number  # mm, of the position from the surface
    beside: Number  # 1 where it lies beside the surface rather than above or below
    tilt: Number  # degrees, of a load's direction from the inward normal
    limit: Number  # kPa or mm, largest trained pressure or depth
    depth: Number  # mm, of the tip in the undeformed surface
    area: Number  # mm^2, force over pressure
    departure: Number  # from the linear response, relative to it
    residual: Number  # relative residual of such answers in the full model
    penetration: Number  # mm, of the tip in the deformed surface
    touched: Number  # number of faces
    foot: Array  # (3,) mm, on the surface, nearest to the position
    upward: Array  # (3,) outward normal there
    direction: Array  # (3,) of a load
    force: Array  # (3,) mN
    displacement: Array  # (3,) mm, mean under a footprint
    point: Array  # (3,) mm, where the tip's force acts
    normal: Array  # (3,) from there outwards
    errors: Array  # (3,) estimated: displacement, von Mises stress, force
    tangent: Array  # (3, 3) mN/mm
    features: Array  # (PRESS_FEATURES,) of the error estimate
    limits: Array  # (LIMIT_FIELDS,) load range there, see ``mechanics.footprint``


NUMBERS = Outcome._fields.index("foot")
"""Of fields that are one number."""

_SIZES = {"tangent": 9, "features": PRESS_FEATURES, "limits": LIMIT_FIELDS}
_ENDS = np.cumsum([NUMBERS, *(_SIZES.get(name, 3) for name in Outcome._fields[NUMBERS:])]).tolist()
ARRAYS = [slice(start, stop) for start, stop in pairwise(_ENDS)]
"""Where the others lie in the array."""


def new_outcome() -> tuple[Array, Outcome]:
    """Return the array and its views."""
    record = np.zeros(_ENDS[-1])
    numbers = [record[i : i + 1] for i in range(NUMBERS)]
    views = Outcome(*numbers, *(record[place] for place in ARRAYS))
    return record, views._replace(tangent=views.tangent.reshape(3, 3))


class Solver(NamedTuple):
    """All that a query reads, and all that it writes; made by ``reduced.workspace``."""

    models: Any  # PressModels or TouchModels
    surface: SurfaceIndex  # values at its vertices: the load range
    coefficients: Array  # (2 or 3, features) of the error estimate: displacement, von Mises, force
    past: Any  # Elastic or Remembering
    active: Active
    warm: Any  # PressWarm or TouchWarm
    scratch: Any  # PressScratch or TouchScratch
    outcome: Outcome
