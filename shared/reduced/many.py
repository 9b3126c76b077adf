"""Many queries from rest, one after the other in compiled code: what one thread has to do."""

from typing import Annotated, NamedTuple

from numba import njit

from palpate.shared.arrays import Array
from palpate.shared.mechanics import newton
from palpate.shared.reduced import press, touch
from palpate.shared.reduced.features import near_rim, total_errors


class Found(NamedTuple):
    """What is found of n loads or positions of the tip; see ``Outcome``."""

    status: Annotated[Array, "n"]
    iterations: Annotated[Array, "n"]
    min_jacobian: Annotated[Array, "n"]
    distance: Annotated[Array, "n"]  # mm
    tilt: Annotated[Array, "n"]  # degrees, of a load
    beside: Annotated[Array, "n"]
    barred: Annotated[Array, "n"]
    depth: Annotated[Array, "n"]  # mm, of the tip
    limit: Annotated[Array, "n"]  # kPa or mm
    point: Annotated[Array, "n, 3"]  # mm
    normal: Annotated[Array, "n, 3"]
    force: Annotated[Array, "n, 3"]  # mN
    displacement: Annotated[Array, "n, 3"]  # mm, under a load
    errors: Annotated[Array, "n, 3"]  # of mesh and reduction
    mesh: Annotated[Array, "n, 3"]  # of the mesh alone


@njit(cache=True, error_model="numpy", nogil=True)
def press_many(solver, mesh, positions, directions, pressures, radius, found):
    """Press at positions (n, 3) mm, each from rest; ``mesh`` are coefficients of its errors."""
    outcome = solver.outcome
    for i in range(len(positions)):
        solver.warm.number[:] = -1
        press.place(solver, positions[i], directions[i])
        press.press(solver, pressures[i], radius)
        found.point[i] = outcome.foot
        found.normal[i] = outcome.upward
        found.displacement[i] = outcome.displacement
        found.tilt[i] = outcome.tilt[0]
        _note(outcome, mesh, pressures[i], i, found)


@njit(cache=True, error_model="numpy", nogil=True)
def touch_many(solver, mesh, positions, found):
    """Touch with a tip at positions (n, 3) mm, each from rest; below the surface none is sought."""
    outcome = solver.outcome
    for i in range(len(positions)):
        solver.warm.number[:] = -1
        solver.warm.tip.known[0] = 0.0
        touch.place(solver, positions[i])
        found.depth[i], found.beside[i] = outcome.depth[0], outcome.beside[0]
        if found.depth[i] > solver.tip.radius:
            found.status[i] = newton.STALLED
            continue
        touch.begin(solver, positions[i], outcome.foot)
        if found.depth[i] <= 0.0:
            solver.active.number[:] = -1
            solver.active.weight[:] = 0.0
        outcome.errors[:] = 0.0
        touch.touch(solver, positions[i])
        found.point[i] = outcome.point
        found.normal[i] = outcome.normal
        found.barred[i] = outcome.barred[0]
        _note(outcome, mesh, found.depth[i], i, found)
        if outcome.touched[0] == 0.0:
            found.errors[i] = 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def _note(outcome, mesh, level, i, found):
    """Write what loads and the tip have in common."""
    found.status[i], found.iterations[i] = outcome.status[0], outcome.iterations[0]
    found.min_jacobian[i], found.distance[i] = outcome.min_jacobian[0], outcome.distance[0]
    found.limit[i] = outcome.limit[0]
    found.force[i] = outcome.force
    share, rim = level / outcome.limit[0], near_rim(outcome.limits)
    total_errors(outcome.errors, mesh, share, rim, found.mesh[i], found.errors[i])
