"""An answer: what a pressed or touched tissue does, and how far to trust it."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from palpate.shared.arrays import Array, Field, Flags, Ints
from palpate.shared.near_field import Contact
from palpate.shared.reduced.transfer import Local, Past


class Answer(NamedTuple):
    """Answer to one load or one position of the tip, at once or at the end of a time step.

    By itself it says that nothing is known.  Errors are relative, those of mesh and reduction
    together, and calibrated to cover 95 % of cases; infinite beyond the range or without
    equilibrium.  Over a history they are the largest until now, relative to the largest until now.
    """

    contact_point: Array = np.zeros(3)  # mm, on the surface; of a tip, where its force acts on it
    normal: Array = np.zeros(3)  # outward there; of a tip in contact, direction of its force
    distance: float = 0.0  # mm, of the queried position from the surface
    force: Array = np.zeros(3)  # mN, on the tool
    converged: bool = False  # if not, a tip has no force and ``past`` has not gone on
    iterations: int = 0  # most of one local model
    in_range: bool = False  # whether the model was trained and validated for such a query
    out_of_range: tuple[str, ...] = ()  # the fields that are not
    error_displacement: float = math.inf  # estimated
    error_von_mises: float = math.inf  # estimated
    error_force: float = math.inf  # estimated; that of a load is given
    error_reduction: Array = np.full(3, math.inf)  # of these, beside the same mesh's full model
    error_mesh: Array = np.zeros(3)  # of these, of that beside a finer mesh's; 0 if not known
    min_jacobian: float = 1.0  # smallest det F among the cubature points
    pressure_limit: float = 0.0  # kPa, largest trained, in the direction of the load or the normal
    depth_limit: float = 0.0  # mm, largest trained of the tip; 0 in a scene without one
    features: Array = np.zeros(0)  # what the error estimate is made of
    parts: tuple[tuple[int, float, Array], ...] = ()  # local models: number, weight, state (r,)
    solve_seconds: float = 0.0
    direction: Array = np.zeros(3)  # of a load
    tilt: float = 0.0  # degrees, of that from the inward normal
    pressure: float = 0.0  # kPa, of a load, at the footprint's centre
    radius: float = 0.0  # mm, of the footprint
    departure: float = 0.0  # from the linear response, relative to that, in the energy norm
    residual: float = 0.0  # at once: of such answers in the full model, relative, in energy norm
    contact_displacement: Array = np.zeros(3)  # mm, mean under the footprint's pressure
    tip: bool = False  # whether the tip was asked for, not a load
    position: Array = np.zeros(3)  # mm, centre of the tip
    contact: bool = False  # whether something presses
    tangent: Array = np.zeros((3, 3))  # mN/mm, derivative of the tip's force in its position
    depth: float = 0.0  # mm, of the tip in the undeformed surface; negative away from it
    penetration: float = 0.0  # mm, of the tip in the deformed surface as a footprint sees it
    energy: float = 0.0  # mN mm, in tissue and contact; with a past, the potential of the step
    footprint: Contact | None = None  # that presses, of a tip the one of its force
    time: float = 0.0  # s, since rest, of tissue with a past
    past: Past | None = None  # to go on from; the one before if this answer did not converge
    active: tuple[tuple[int, float, Local], ...] = ()  # with a past: local models and theirs
    stiffness: float = 1.0  # Young's modulus over that of the training

    def stiffened(self, ratio: float) -> "Answer":
        """Answer of tissue so many times as stiff as the training's, which moves as far.

        Forces and stresses go with Young's modulus at a given Poisson's ratio; what the fields and
        the next step are made of, ``parts``, ``footprint`` and ``past``, is the training's.
        """
        return self._replace(
            force=ratio * self.force,
            tangent=ratio * self.tangent,
            energy=ratio * self.energy,
            pressure=ratio * self.pressure,
            pressure_limit=ratio * self.pressure_limit,
            stiffness=ratio,
        )


class Answers(NamedTuple):
    """Answers to n loads or positions of the tip, each from rest; see ``Answer``."""

    contact_point: Array  # (n, 3) mm
    normal: Array  # (n, 3)
    distance: Array  # (n,) mm
    force: Array  # (n, 3) mN, on the tool
    converged: Flags  # (n,)
    iterations: Ints  # (n,)
    in_range: Flags  # (n,)
    error_displacement: Array  # (n,) estimated; infinite beyond the range or without equilibrium
    error_von_mises: Array  # (n,)
    error_force: Array  # (n,)
    min_jacobian: Array  # (n,)
    limit: Array  # (n,) kPa, largest trained pressure, or mm, largest depth of the tip
    contact_displacement: Array  # (n, 3) mm, mean under the footprint of a load


def describe(answer: Answer) -> dict[str, Any]:
    """Write an answer without its fields, JSON-able, as all of the software has it."""
    errors = {
        "displacement": finite(answer.error_displacement),
        "von_mises": finite(answer.error_von_mises),
    }
    contact: dict[str, Any] = {
        "position": answer.contact_point.tolist(),
        "normal": answer.normal.tolist(),
        "distance": answer.distance,
    }
    if answer.tip:
        errors["force"] = finite(answer.error_force)
        contact |= {"centre": answer.position.tolist(), "depth": answer.depth}
        contact |= {"depth_limit": answer.depth_limit, "touches": answer.contact}
        felt: dict[str, Any] = {"tangent": answer.tangent.tolist()}
    else:
        contact |= {
            "direction": answer.direction.tolist(),
            "pressure": answer.pressure,
            "radius": answer.radius,
            "pressure_limit": answer.pressure_limit,
            "depth_limit": answer.depth_limit or None,
        }
        felt = {"contact_displacement": answer.contact_displacement.tolist()}
    return {
        "contact": contact,
        "force": answer.force.tolist(),
        **felt,
        "trust": {
            "converged": answer.converged,
            "iterations": answer.iterations,
            "in_range": answer.in_range,
            "out_of_range": answer.out_of_range,
            "error_estimate": errors,
            "min_jacobian": answer.min_jacobian,
        },
    } | ({} if answer.past is None else {"time": answer.time})


def peak(
    displacement: Field | Array, stresses: Sequence[tuple[float, float]], regions: Sequence[str]
) -> dict[str, Any]:
    """Largest displacement (mm) of nodes (n, 3), and stresses by region (kPa), JSON-able.

    See ``StressField.peaks_by_region``; those of ``regions`` by name, if there are any.
    """
    names = "von_mises", "von_mises_p99"
    rest, *others = (dict(zip(names, own, strict=True)) for own in stresses)
    moved = float(np.linalg.norm(displacement, axis=1).max())
    found: dict[str, Any] = {"displacement": moved} | rest
    return found | ({"regions": dict(zip(regions, others, strict=True))} if regions else {})


def finite(value: float) -> float | None:
    """Return the number, or None, which is null in JSON, where it is infinite."""
    return value if math.isfinite(value) else None
