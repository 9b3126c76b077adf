"""An answer: what a pressed or touched tissue does, and how far to trust it."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.shared.reduced.transfer import Local, Past

Array = NDArray[np.float64]


class Answer(NamedTuple):
    """Answer to one load or one position of the tip, at once or at the end of a time step.

    By itself it says that nothing is known.

    Attributes
    ----------
    contact_point : ndarray, shape (3,), mm
        Queried position moved to the surface; of a tip in contact, where the force acts on it.
    normal : ndarray, shape (3,)
        Outward unit normal there; of a tip in contact, the direction of its force.
    distance : float, mm
        Of the queried position from the surface.
    force : ndarray, shape (3,), mN
        On the tool.
    converged : bool
        If not, forces are zero under the tip and ``past`` has not gone on.
    iterations : int
        Most of one local model.
    in_range : bool
        Whether the query is of the kind the model was trained and validated for.
    out_of_range : tuple of str
        The fields that are not.
    error_displacement, error_von_mises, error_force : float
        Estimated relative errors against the full model on the same mesh, calibrated to cover 95 %
        of cases; infinite beyond the range or without equilibrium.  The force of a load is given.
        Over a history, of the largest until now, relative to the largest until now.
    min_jacobian : float
        Smallest det F among the cubature points.
    pressure_limit, depth_limit : float, kPa and mm
        Largest trained pressure, in the direction of the load or of the normal, and largest trained
        depth of the tip, 0 in a scene without one.
    features : ndarray
        What the error estimate is made of.
    parts : tuple of (int, float, ndarray)
        Local models that answer: number, weight, state (r,) in their modes.
    solve_seconds : float
    direction : ndarray, shape (3,)
        Of a load.
    tilt : float, degrees
        Of that from the inward normal.
    pressure, radius : float, kPa and mm
        Of a load, at the footprint's centre.
    departure : float
        Of the answer from the linear response, relative to that, in the energy norm.
    residual : float
        That such answers leave in the full model, relative to them in the energy norm at rest.
    contact_displacement : ndarray, shape (3,), mm
        Mean under the footprint, weighted with its pressure.
    tip : bool
        Whether the tip was asked for, not a load.
    position : ndarray, shape (3,), mm
        Centre of the tip.
    contact : bool
        Whether something presses.
    tangent : ndarray, shape (3, 3), mN/mm
        Derivative of the tip's force in its position.
    depth : float, mm
        How far the tip overlaps the undeformed surface; negative away from it.
    penetration : float, mm
        How far at most the tip overlaps the deformed surface.
    energy : float, mN mm
        Stored in tissue and contact; with a past, the potential of the step.
    time : float, s
        Since rest, of tissue with a past.
    past : Past or None
        To go on from; the one before if this answer did not converge.
    active : tuple of (int, float, Local)
        Of tissue with a past: local models that answer with what they remember.
    """

    contact_point: Array = np.zeros(3)
    normal: Array = np.zeros(3)
    distance: float = 0.0
    force: Array = np.zeros(3)
    converged: bool = False
    iterations: int = 0
    in_range: bool = False
    out_of_range: tuple[str, ...] = ()
    error_displacement: float = math.inf
    error_von_mises: float = math.inf
    error_force: float = math.inf
    min_jacobian: float = 1.0
    pressure_limit: float = 0.0
    depth_limit: float = 0.0
    features: Array = np.zeros(0)
    parts: tuple[tuple[int, float, Array], ...] = ()
    solve_seconds: float = 0.0
    direction: Array = np.zeros(3)
    tilt: float = 0.0
    pressure: float = 0.0
    radius: float = 0.0
    departure: float = 0.0
    residual: float = 0.0
    contact_displacement: Array = np.zeros(3)
    tip: bool = False
    position: Array = np.zeros(3)
    contact: bool = False
    tangent: Array = np.zeros((3, 3))
    depth: float = 0.0
    penetration: float = 0.0
    energy: float = 0.0
    time: float = 0.0
    past: Past | None = None
    active: tuple[tuple[int, float, Local], ...] = ()


def describe(answer: Answer) -> dict[str, Any]:
    """Write the answer to a load without its fields, JSON-able, as all of the software has it."""
    return {
        "contact": {
            "position": answer.contact_point.tolist(),
            "normal": answer.normal.tolist(),
            "distance": answer.distance,
            "direction": answer.direction.tolist(),
            "pressure": answer.pressure,
            "radius": answer.radius,
            "pressure_limit": answer.pressure_limit,
            "depth_limit": answer.depth_limit or None,
        },
        "force": answer.force.tolist(),
        "contact_displacement": answer.contact_displacement.tolist(),
        "trust": {
            "converged": answer.converged,
            "iterations": answer.iterations,
            "in_range": answer.in_range,
            "out_of_range": answer.out_of_range,
            "error_estimate": {
                "displacement": finite(answer.error_displacement),
                "von_mises": finite(answer.error_von_mises),
            },
            "min_jacobian": answer.min_jacobian,
        },
    } | ({} if answer.past is None else {"time": answer.time})


def finite(value: float) -> float | None:
    """Return the number, or None, which is null in JSON, where it is infinite."""
    return value if math.isfinite(value) else None
