"""What a query must be to be answered, and what it must be to be within the trained range."""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from palpate.shared.arrays import Array, Flags
from palpate.shared.errors import QueryError
from palpate.shared.geometry.surface import UPRIGHT, Surface
from palpate.shared.reduced.outcome import Outcome
from palpate.shared.scene import Endoscope

BESIDE = 0.1
"""Millimetres beyond the rim of the surface at which the answer is not to the question any more."""

BARRED = 0.1
"""Share of the tip's force with which the rim may hold back its place: with more, it presses what
lies beyond the accessible surface.  Spheres integrated there have forces 25 % larger at a share of
0.4, and within 6 % up to 0.15."""

ABSURD = 10.0
"""Multiple of the largest trained pressure beyond which a load is not answered."""

INWARD = np.zeros(3)
"""Direction that stands for the inward normal."""


MOST_YOUNG = 1e6
"""Largest Young's modulus of a query, kPa; the smallest is its inverse."""


def stiffness(trained: float, young: float | None) -> float:
    """Young's modulus of a query over that of the training, both kPa; None is the latter.

    Raises
    ------
    QueryError
        If it is not that of any tissue.
    """
    if young is None:
        return 1.0
    if not 1.0 / MOST_YOUNG <= young <= MOST_YOUNG:
        allowed = f"[{1 / MOST_YOUNG:g}, {MOST_YOUNG:g}] kPa"
        raise QueryError("young", f"must be in {allowed}, not {young}")
    return young / trained


def checked_load(
    endoscope: Endoscope,
    pressure_max: float,
    position: ArrayLike,
    pressure: float,
    direction: ArrayLike | None,
    radius: float | None,
) -> tuple[Array, Array, float]:
    """Position, unit direction (zero for the inward normal) and radius of a well-formed load.

    Raises
    ------
    QueryError
        If not; ``pressure_max`` (kPa) is the largest trained pressure.
    """
    if not (math.isfinite(pressure) and pressure >= 0):
        raise QueryError("pressure", f"must be a finite number >= 0 kPa, not {pressure}")
    if pressure > ABSURD * pressure_max:
        raise QueryError(
            "pressure",
            f"must be at most {ABSURD:g} times the {pressure_max:.3g} kPa of the "
            f"training, not {pressure:g}",
        )
    at = vector("position", position)
    if radius is None:
        radius = endoscope.radius
    elif not endoscope.radius / 2 <= radius <= endoscope.radius:
        allowed = f"[{endoscope.radius / 2}, {endoscope.radius}] mm"
        raise QueryError("radius", f"must be in {allowed}, not {radius}")
    if direction is None:
        return at, INWARD, float(radius)
    towards = 0.5 * vector("direction", direction)  # else the length of the largest is infinite
    length = math.hypot(*towards.tolist())
    if length == 0.0:
        raise QueryError("direction", "must not be the zero vector")
    return at, towards / length, float(radius)


def check_place(endoscope: Endoscope, surface: Surface, found: Outcome) -> None:
    """Raise ``QueryError`` if a load that is placed is out of reach or does not press."""
    distance, reach = found.distance.item(), endoscope.reach
    if distance > reach:
        near = ", ".join(f"{x:.2f}" for x in found.foot)
        low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
        box = ", ".join(f"{a:.1f} to {b:.1f}" for a, b in zip(low, high, strict=True))
        raise QueryError(
            "position",
            f"{distance:.2f} mm from the accessible surface, at most {reach} mm allowed; nearest "
            f"is ({near}), and it lies within ({box}) mm",
        )
    if not found.tilt.item() < 90.0:
        raise QueryError("direction", "must point into the tissue")


def out_of_range(
    endoscope: Endoscope, at: Array, found: Outcome, pressure: float, radius: float
) -> tuple[str, ...]:
    """Fields of a load that are not of the kind the model was trained for."""
    above = np.dot(at - found.foot, found.upward)
    numbers = (found.distance.item(), found.tilt.item(), pressure, found.limit.item())
    beyond = load_beyond(endoscope, above, *numbers) | {"radius": radius != endoscope.radius}
    return tuple(field for field, outside in beyond.items() if outside)


def load_beyond(
    endoscope: Endoscope, above: Any, distance: Any, tilt: Any, pressure: Any, limit: Any
) -> dict[str, Any]:
    """Whether the fields of a load, or of loads (n,), are beyond the trained range.

    ``above`` and ``distance`` (mm) are those of the position from the surface.
    """
    # rather beyond the rim than above or below
    beside = (distance > BESIDE) & (np.abs(above) < UPRIGHT * distance)
    return {
        "position": beside,
        "pressure": over(pressure, limit),
        "direction": tilt > endoscope.max_tilt + 1e-6,
    }


def tip_beyond(beside: Any, barred: Any, near: Any, depth: Any, limit: Any) -> dict[str, Any]:
    """The same of a position of the tip, or of positions (n,), see ``Outcome``.

    Where the tip is not ``near`` the tissue it is beside nothing.
    """
    aside = ((beside > 0.0) | (barred > BARRED)) & near
    return {"position": aside, "depth": over(depth, limit)}


def over(level: Any, limit: Any) -> Any:
    """Whether a pressure or a depth is more than its limit, and not by round-off."""
    return level > limit * (1 + 1e-9)


def vector(field: str, value: ArrayLike) -> Array:
    """Read three finite numbers.

    Raises
    ------
    QueryError
        That names the field.
    """
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise QueryError(field, "must be three numbers") from error
    if numbers.shape != (3,) or not all(map(math.isfinite, numbers.tolist())):
        raise QueryError(field, "must be three finite numbers")
    return numbers


def rows(field: str, values: ArrayLike, columns: int, count: int | None = None) -> Array:
    """Read rows (n, columns) of finite numbers, as many as wanted if that is given.

    Raises
    ------
    QueryError
        That names the field, and the row from 0.
    """
    try:
        numbers = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise QueryError(field, "must be numbers") from error
    if columns == 1 and numbers.ndim == 1:
        numbers = numbers[:, None]
    if numbers.ndim != 2 or numbers.shape[1] != columns or count not in (None, len(numbers)):
        wanted = f"{'n' if count is None else count} x {columns}"
        raise QueryError(field, f"must be {wanted} numbers, not {numbers.shape}")
    refuse_rows(field, np.asarray(~np.isfinite(numbers).all(axis=1)), "must be finite")
    return np.ascontiguousarray(numbers)


def refuse_rows(field: str, wrong: Flags, message: str) -> None:
    """Raise ``QueryError`` for the first of rows (n,) that are wrong, if there is one."""
    if wrong.any():
        raise QueryError(f"{field}.{int(np.argmax(wrong))}", message)
