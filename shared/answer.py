"""An answer without its fields, as every JSON of the software has it."""

from __future__ import annotations

from typing import Any

from palpate.shared.model import Solution
from palpate.shared.reduced.history import Moment


def describe(scene: str, solution: Solution) -> dict[str, Any]:
    """Write the part of an answer that does not grow with the mesh, JSON-able."""
    return {
        "scene": scene,
        "contact": _contact(solution),
        "force": solution.force.tolist(),
        "contact_displacement": solution.contact_displacement.tolist(),
        "trust": _trust(solution),
    }


def describe_moment(moment: Moment) -> dict[str, Any]:
    """Write the answer at the end of a time step, JSON-able."""
    return {
        "time": moment.time,
        "contact": _contact(moment),
        "force": moment.force.tolist(),
        "contact_displacement": moment.contact_displacement.tolist(),
        "trust": _trust(moment),
    }


def _contact(solution: Solution | Moment) -> dict[str, Any]:
    return {
        "position": solution.contact_point.tolist(),
        "normal": solution.normal.tolist(),
        "distance": solution.distance,
        "direction": solution.direction.tolist(),
        "pressure": solution.pressure,
        "radius": solution.radius,
        "pressure_limit": solution.pressure_limit,
    }


def _trust(solution: Solution | Moment) -> dict[str, Any]:
    return {
        "converged": solution.converged,
        "iterations": solution.iterations,
        "in_range": solution.in_range,
        "out_of_range": solution.out_of_range,
        "error_estimate": {
            "displacement": solution.error_displacement,
            "von_mises": solution.error_von_mises,
        },
        "min_jacobian": solution.min_jacobian,
    }
