"""The rigid tip on local models: at once, or at the end of a time step.

Theory.  See ``mechanics.tip`` for the energy that the tip adds to that of a local model, and
``reduced.problem`` for the latter.  At a place ``X`` of the surface and under a force along a
normal ``n`` the state is a minimum, sought like that under a load; the law's stiffness is a spring
beside the secants.  Place and normal are those where the energy is stationary: a few rounds of
Newton's method, each with gradient ``g`` and second derivatives ``H`` of the energy in place and
centre, the state in equilibrium.  Force on the tool and tangent are

    F = - g_c,    dF/dc = H_cX H_XX^-1 H_Xc - H_cc.

At the rim of the surface the place stays on it, as where a tip touches an edge.

A search starts where the last answer's place and force have followed the tip, or at the point of
the surface nearest to it.  Forces of neighbouring models are blended at one place; the tangent has
the derivatives of the weights, too.
"""

import math

import numpy as np
from numba import njit

from palpate.shared.compiled import bind_compiled
from palpate.shared.geometry.surface import UPRIGHT, locate
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.footprint import TIP_DEPTH
from palpate.shared.mechanics.tip import (
    LIFTED,
    LONGEST,
    TURNED,
    VANISHED,
    follow,
    meet_wall,
    next_place,
    pushed,
)
from palpate.shared.reduced.blend import MAX_ACTIVE, activate, weight_gradients
from palpate.shared.reduced.contact import press_at_place
from palpate.shared.reduced.features import estimate_errors, log_residual, near_rim

ELSEWHERE = 3
"""Status where the place has moved to local models whose past the step did not begin with."""

MOST_ROUNDS = 24
"""Places at which a state is sought; from the eighth on, steps to the next are halved."""

NEAR = 2e-3
"""Step to the next place, in radii of the tip, and turn of the normal that are not taken: the force
is corrected to first order."""

SHALLOW = 4e-3
"""Depth, in radii of the tip, up to which the place is that at rest: the triangles that say where
the surface is cut its curves by as much."""

RAMPS = 1, 8, 16, 32, 64
"""Steps of the way in that are tried, one after the other: a jump, then from where the tip does not
touch.  Of 20 000 positions in range on the turbinate of the MRI 4 have no answer without the last,
2 have none with it."""

LEAST_FACING = 0.1
"""Cosine between force and surface normal below which a place is none."""


@njit(cache=True, error_model="numpy", nogil=True)
def place(solver, x):
    """Find where the tip's centre ``x`` (3,) mm lies over the surface at rest.

    Writes the nearest point of the surface and its normal, the depth and its limit.
    """
    outcome, radius = solver.outcome, solver.tip.radius
    distance = locate(
        solver.surface, x, solver.scratch.surface, outcome.foot, outcome.upward, outcome.limits
    )
    outcome.limit[0] = outcome.limits[TIP_DEPTH]
    above = 0.0
    for i in range(3):
        above += (x[i] - outcome.foot[i]) * outcome.upward[i]
    beside = abs(above) < UPRIGHT * distance
    outcome.distance[0], outcome.beside[0] = distance, 1.0 if beside else 0.0
    outcome.depth[0] = radius - (distance if beside else math.copysign(distance, above))
    outcome.point[:] = outcome.foot
    outcome.normal[:] = outcome.upward


@njit(cache=True, error_model="numpy", nogil=True)
def begin(solver, x, last):
    """Choose where the search for a tip at ``x`` that ``place`` has placed begins, and its models.

    Off the tissue that is about ``last``, where it touched last: tissue with a past goes on without
    a load.
    """
    warm, tip, outcome = solver.warm.tip, solver.scratch.tip, solver.outcome
    normal, size = tip.contact.normal, 0.0
    away = 0.0
    for i in range(3):
        away += (x[i] - warm.centre[i]) ** 2
    known = warm.known[0] == 1.0 and away < (LONGEST * solver.tip.radius) ** 2
    if not known:
        warm.force[:] = 0.0
    for i in range(3):
        tip.place[i] = outcome.foot[i]
        normal[i] = outcome.upward[i]
        if outcome.depth[0] <= 0.0:
            tip.place[i] = last[i]
        elif known:
            tip.place[i] = warm.place[i]
            normal[i] = warm.force[i]
            for j in range(3):
                tip.place[i] += warm.follows[i, j] * (x[j] - warm.centre[j])
                normal[i] += warm.tangent[i, j] * (x[j] - warm.centre[j])
        size += normal[i] ** 2
    size = math.sqrt(size)
    if np.dot(normal, outcome.upward) < LEAST_FACING * size:  # contact is about to end
        normal[:] = outcome.upward
    else:
        normal /= size
    _go(solver)
    _choose(solver)


@njit(cache=True, error_model="numpy", nogil=True)
def _go(solver):
    """Go to the place wanted, if it is on the surface."""
    outcome, scratch = solver.outcome, solver.scratch
    locate(
        solver.surface, scratch.tip.place, scratch.surface, outcome.foot, outcome.upward,
        outcome.limits,
    )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True)
def _choose(solver):
    """Choose the models that answer at the outcome's place; False if a past of one is not known."""
    models, active = solver.models, solver.active
    activate(models.centres, models.blend, solver.outcome.foot, solver.warm.number, active)
    for slot in range(MAX_ACTIVE):
        own = active.number[slot]
        if solver.past.in_time and own >= 0 and own != solver.scratch.tip.begun[slot]:
            return False
    return True


@njit(cache=True, error_model="numpy", nogil=True)
def touch(solver, x):
    """Answer a tip at ``x`` (3,) mm whose search has begun; at once, estimate its errors.

    The solver's memory is the starting point on entry and holds the answers on return.  Its past
    then is at the end of the step; where it ends ``ELSEWHERE`` the step begins again with the
    models that are active then.
    """
    outcome, depth = solver.outcome, solver.outcome.depth[0]
    solver.scratch.tip.begun[:] = solver.active.number
    outcome.iterations[0] = 0.0
    for steps in RAMPS:
        _walk_in(solver, x, depth, steps)
        if outcome.status[0] in (newton.CONVERGED, ELSEWHERE) or depth <= 0.0:
            break
    if outcome.status[0] == newton.CONVERGED:
        _end_step(solver)
    # or ``transfer.estimate_history`` estimates
    if outcome.touched[0] > 0.0 and not solver.past.in_time:
        _estimate(solver)


@njit(cache=True, error_model="numpy", nogil=True, inline="always")
def _settle(solver, x):
    """Find place, normal, and state under a tip at x, from where the search has begun."""
    outcome, tip = solver.outcome, solver.scratch.tip
    cold = solver.warm.tip.known[0] == 0.0
    sure = not cold
    tip.wall[:] = 0.0
    largest = 0.0
    for made in range(MOST_ROUNDS):
        if made > 0 and not _choose(solver):
            outcome.status[0] = ELSEWHERE
            break
        press_at_place(solver, x, cold and sure)
        if outcome.status[0] != newton.CONVERGED:
            break
        force = math.sqrt(np.dot(outcome.force, outcome.force))
        largest = max(largest, force)
        if force <= VANISHED * largest:
            if made > 0 and not (solver.past.in_time and made > LIFTED):
                _go_back(solver)
                continue
            # right off the tissue, or above the dent that the past has left
            if outcome.depth[0] > 0.0 and not solver.past.in_time:
                outcome.status[0] = newton.EXHAUSTED
            break
        if outcome.depth[0] < SHALLOW * solver.tip.radius:
            break
        _step(solver, made)
        moved, turned = _move(solver), _turn(solver)
        if moved < NEAR * solver.tip.radius and turned < NEAR:
            if sure:
                break
            sure = True
        if made + 1 == MOST_ROUNDS or np.dot(tip.contact.normal, outcome.upward) < LEAST_FACING:
            outcome.status[0] = newton.EXHAUSTED
            break
    outcome.tangent[:] = 0.0
    outcome.barred[0] = 0.0
    if outcome.status[0] == newton.CONVERGED and outcome.touched[0] > 0.0:
        _react(solver)
    else:
        outcome.force[:] = 0.0
    _remember(solver, x)


@njit(cache=True, error_model="numpy", nogil=True, inline="always")
def _walk_in(solver, x, depth, steps):
    """Go the way in step by step, or in one jump from where the search has begun."""
    outcome, way, at = solver.outcome, solver.scratch.tip.way, solver.scratch.tip.at
    way[:] = 0.0
    if steps > 1:
        place(solver, x)
        way += depth * outcome.upward
        solver.warm.number[:] = -1
    for i in range(1, steps + 1):
        for j in range(3):
            at[j] = x[j] + (1.0 - i / steps) * way[j]
        if steps > 1:
            place(solver, at)
            begin(solver, at, outcome.foot)
            if not _choose(solver):
                outcome.status[0] = ELSEWHERE
                return
        _settle(solver, at)
        if outcome.status[0] != newton.CONVERGED:
            return


# --- from place to place -------------------------------------------------------------------------


@njit(cache=True, error_model="numpy", nogil=True)
def _step(solver, made):
    """Choose the next place by Newton's step."""
    outcome, tip, most = solver.outcome, solver.scratch.tip, LONGEST * solver.tip.radius
    for p in range(2):
        tip.barred[p] = np.dot(tip.tangents[p], tip.wall)
    least = TURNED * solver.tip.radius
    length = next_place(tip.g, tip.H, tip.barred, least, tip.moved)
    shorter = min(1.0, most / max(length, 1e-12)) * (0.5 if made > 6 else 1.0)
    tip.last[:] = outcome.foot
    tip.before[:] = tip.contact.normal
    tip.place[:] = outcome.foot
    for p in range(2):
        tip.step[p] = tip.moved[p]
        tip.wanted[p] = shorter * tip.step[p]
        for i in range(3):
            tip.place[i] += tip.wanted[p] * tip.tangents[p, i]


@njit(cache=True, error_model="numpy", nogil=True)
def _move(solver):
    """Go to the next place, as far as the surface goes; return how far, mm."""
    outcome, tip = solver.outcome, solver.scratch.tip
    _go(solver)
    for p in range(2):
        tip.moved[p] = 0.0
        for i in range(3):
            tip.moved[p] += tip.tangents[p, i] * (outcome.foot[i] - tip.last[i])
    meet_wall(tip.wanted, tip.moved, tip.barred)
    for i in range(3):
        tip.wall[i] = tip.tangents[0, i] * tip.barred[0] + tip.tangents[1, i] * tip.barred[1]
    return math.sqrt(tip.moved[0] ** 2 + tip.moved[1] ** 2)


@njit(cache=True, error_model="numpy", nogil=True)
def _go_back(solver):
    """Go half-way back to where there was contact."""
    tip, outcome = solver.scratch.tip, solver.outcome
    for i in range(3):
        tip.place[i] = 0.5 * (tip.last[i] + outcome.foot[i])
    tip.contact.normal[:] = tip.before
    _go(solver)
    outcome.status[0] = newton.EXHAUSTED  # until the next round


@njit(cache=True, error_model="numpy", nogil=True)
def _turn(solver):
    """Turn the normal to the force at the next place; return by how much."""
    outcome, tip = solver.outcome, solver.scratch.tip
    normal, turn, along, length = tip.contact.normal, 0.0, 0.0, 0.0
    for p in range(2):
        along += tip.moved[p] * tip.step[p]
        length += tip.step[p] ** 2
    share = min(max(along / max(length, 1e-300), 0.0), 1.0)
    # so short a step leads to where it is wanted
    share = share if length > (NEAR * solver.tip.radius) ** 2 else 1.0
    force = pushed(tip.g, tip.H, tip.step, share, outcome.force)
    for i in range(3):
        own = outcome.force[i] / max(force, 1e-300)
        turn += (own - normal[i]) ** 2
        normal[i] = own
        solver.warm.tip.force[i] = outcome.force[i]
    return math.sqrt(turn)


@njit(cache=True, error_model="numpy", nogil=True)
def _react(solver):
    """Write the tangent on the tool, and how the place follows the tip."""
    outcome, tip, models, active = (
        solver.outcome, solver.scratch.tip, solver.models, solver.active,
    )  # fmt: skip
    follows = solver.warm.tip.follows
    follow(tip.H, tip.barred, tip.turned, outcome.tangent)
    pressed = math.sqrt(np.dot(outcome.force, outcome.force))
    outcome.barred[0] = np.dot(tip.g[:2], tip.barred) / max(pressed, 1e-300)
    weight_gradients(models.centres, models.blend, outcome.foot, active)
    for i in range(3):
        for j in range(3):
            follows[i, j] = 0.0
            for p in range(2):
                follows[i, j] += tip.tangents[p, i] * tip.turned[p, j]
    for slot in range(MAX_ACTIVE):
        if active.weight[slot] > 0.0:
            for j in range(3):
                change = 0.0
                for i in range(3):
                    change += active.gradient[slot, i] * follows[i, j]
                for i in range(3):
                    outcome.tangent[i, j] += tip.forces[slot, i] * change


# --- what is kept --------------------------------------------------------------------------------


@njit(cache=True, error_model="numpy", nogil=True)
def _remember(solver, x):
    """Start the next search from this answer; write where the force acts on the tip."""
    tip, outcome = solver.warm.tip, solver.outcome
    force = math.sqrt(np.dot(outcome.force, outcome.force))
    tip.known[0] = 1.0 if force > 0.0 else 0.0
    tip.centre[:] = x
    tip.place[:] = outcome.foot
    tip.force[:] = outcome.force
    tip.tangent[:] = outcome.tangent
    if force > 0.0:
        for i in range(3):
            outcome.normal[i] = outcome.force[i] / force
            outcome.point[i] = x[i] - solver.tip.radius * outcome.normal[i]


@njit(cache=True, error_model="numpy", nogil=True)
def _end_step(solver):
    """Take the past to the end of its step."""
    active = solver.active
    for slot in range(MAX_ACTIVE):
        if active.weight[slot] > 0.0:
            points = bind_compiled(solver.models.points.of(active.number[slot]))
            solver.past.end_step(points, solver.scratch.work, slot, solver.warm.q[slot], True)


@njit(cache=True, error_model="numpy", nogil=True)
def _estimate(solver):
    """Estimated errors of an answer at once.

    The features: 1, the depth over its limit and its log, smallest det F, the normal (where on the
    body), the logs of force over depth (mN/mm), of the energy over that of a linear spring, and of
    the residual that a load of this force leaves in the full model; whether the contact is near the
    rim.
    """
    outcome, features = solver.outcome, solver.outcome.features
    pushed = math.sqrt(np.dot(outcome.force, outcome.force))
    depth = max(outcome.depth[0], 1e-6)
    share = depth / max(outcome.limit[0], 1e-6)
    features[0], features[1], features[2] = 1.0, share, math.log(share)
    features[3] = outcome.min_jacobian[0]
    features[4:7] = outcome.upward
    features[7] = math.log(max(pushed / depth, 1e-6))
    features[8] = math.log(max(2.0 * outcome.energy[0] / max(pushed * depth, 1e-9), 1e-3))
    load = pushed / max(outcome.area[0] * outcome.limits[0], 1e-9)
    features[9] = log_residual(solver, outcome.foot, outcome.direction, load)
    features[10] = near_rim(outcome.limits)
    count = solver.coefficients.shape[1]
    estimate_errors(solver.coefficients, features[:count], outcome.errors)
