"""What a compiled query reads and writes."""

from typing import Annotated, Any, NamedTuple

from palpate.shared.arrays import Array
from palpate.shared.geometry.surface import SurfaceIndex
from palpate.shared.mechanics.tip import Tip
from palpate.shared.reduced.blend import Active
from palpate.shared.reduced.press import PressModels, PressScratch, PressWarm

Number = Annotated[Array, "1"]
Vector = Annotated[Array, "3"]

PRESS_FEATURES, TOUCH_FEATURES, HISTORY_FEATURES = 12, 11, 9
"""Features of the error estimates of loads, of the tip, and of histories of both; the last of the
first two is ``features.near_rim``."""


class Outcome(NamedTuple):
    """Outcome of the last query, which writes what is of its kind; a number is an array of one."""

    status: Number  # worst of the local models, see ``mechanics.newton``
    iterations: Number  # most of one local model
    min_jacobian: Number  # smallest det F among the points
    energy: Number  # of a load: largest norm of a state; under the tip: mN mm
    distance: Number  # mm, of the position from the surface
    beside: Number  # 1 where it lies beside the surface rather than above or below
    tilt: Number  # degrees, of a load's direction from the inward normal
    limit: Number  # kPa or mm, largest trained pressure or depth
    depth: Number  # mm, of the tip in the undeformed surface
    area: Number  # mm^2, force over pressure of a footprint
    departure: Number  # from the linear response, relative to it
    residual: Number  # of an answer at once: relative residual of such in the full model
    penetration: Number  # mm, of the tip in the smoothed deformed surface
    barred: Number  # force with which the rim holds the tip's place back, over the tip's force
    touched: Number  # number of local models that the tip touches
    foot: Vector  # mm, on the surface, nearest to the position
    upward: Vector  # outward normal there
    direction: Vector  # of a load
    force: Vector  # mN
    displacement: Vector  # mm, mean under a footprint
    point: Vector  # mm, where the tip's force acts
    normal: Vector  # from there outwards
    errors: Vector  # estimated: displacement, von Mises stress, force
    tangent: Annotated[Array, "3, 3"]  # mN/mm
    features: Annotated[Array, "features"]  # of the error estimate, with room for the most
    limits: Annotated[Array, "limits"]  # values there, see ``Solver.surface``


class Solver(NamedTuple):
    """All that a query reads, and all that it writes; made by ``reduced.workspace``."""

    models: PressModels
    tip: Tip
    surface: SurfaceIndex  # values at its vertices: load range, curvature, distance from the rim
    coefficients: Array  # (2 or 3, features) of the error estimate: displacement, von Mises, force
    past: Any  # Elastic or Remembering
    active: Active
    warm: PressWarm
    scratch: PressScratch
    outcome: Outcome
