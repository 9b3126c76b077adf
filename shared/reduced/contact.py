"""One round under the tip: equilibrium of local models at a place, and what the energy does there.

See ``reduced.touch`` for the search of which this is one step.
"""

import math

import numpy as np
from numba import njit

from palpate.shared.compiled import bind_compiled
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.footprint import LIMIT_FIELDS, means
from palpate.shared.mechanics.tip import EDGE_FIELD, bend, held, settle, squeeze, tangents_of
from palpate.shared.reduced.blend import MAX_ACTIVE
from palpate.shared.reduced.corrections import Secants, TouchedSecants, forget_secants
from palpate.shared.reduced.points import superpose
from palpate.shared.reduced.press import (
    MAX_ITERATIONS,
    ROUND_OFF,
    SMALLEST_TARGET,
    TOLERANCE,
    TOLERANCE_IN_TIME,
    anticipate,
    first_tangent,
)
from palpate.shared.reduced.problem import Problem, newton_method
from palpate.shared.reduced.terms import Pushed

PROBE = 0.05
"""Share of the tip's force whose answer a secant is drawn along."""

LEAST_FORCE = 1e-5
"""Force, over that which dents the tissue by about the radius, beside which none need be exact."""


@njit(cache=True, error_model="numpy", nogil=True)
def press_at_place(solver, x, sure):
    """Equilibrium of all active models under a tip at x that touches at the outcome's place.

    To be ``sure`` of the tangent, one secant more is drawn along the answer to the tip's force.
    """
    outcome, active, tip = solver.outcome, solver.active, solver.scratch.tip
    contact, radius = tip.contact, solver.tip.radius
    outcome.status[0] = outcome.energy[0] = outcome.penetration[0] = 0.0
    outcome.touched[0] = 0.0
    outcome.min_jacobian[0] = 1.0
    outcome.force[:] = 0.0
    tip.g[:] = 0.0
    tip.H[:] = 0.0
    tangents_of(outcome.upward, tip.tangents)
    sharpness = bend(outcome.limits[LIMIT_FIELDS:], tip.tangents, radius, tip.bent)
    contact.law[0], contact.law[1] = solver.tip.local_law(
        sharpness, outcome.limits[LIMIT_FIELDS + EDGE_FIELD]
    )
    contact.law[3] = held(contact.law[0], contact.law[5])
    contact.law[4] = radius
    for i in range(3):
        contact.away[i] = x[i] - outcome.foot[i]
        contact.law[4] -= contact.away[i] * contact.normal[i]
    for slot in range(MAX_ACTIVE):
        if active.weight[slot] > 0.0:
            k = active.number[slot]
            _feel(solver, k)
            _solve(solver, k, slot)
            if outcome.status[0] != newton.CONVERGED:
                return
            if contact.found[0] > 0.0:
                if sure:
                    _probe(solver, k, slot)
                _look(solver, k, slot)


@njit(cache=True, error_model="numpy", nogil=True)
def _feel(solver, k):
    """Write what a footprint at the outcome's place sees of model k, and its area."""
    models, outcome, tip = solver.models, solver.outcome, solver.scratch.tip
    first, last = models.node_from[k], models.node_from[k + 1]
    faces = models.faces.between(models.face_from[k], models.face_from[k + 1])
    nodal = tip.nodal[:, : last - first]
    outcome.area[0] = means(
        faces, outcome.foot, outcome.upward, tip.tangents, tip.bent, solver.tip.radius, nodal
    )
    contact, mean, steps = tip.contact, tip.contact.mean, tip.contact.steps
    mean[:] = 0.0
    steps[:] = 0.0
    r = mean.shape[1]
    for node in range(last - first):
        weight = nodal[0, node]
        if weight != 0.0:
            row, one, two = models.modes[first + node], nodal[1, node], nodal[2, node]
            for i in range(3):
                own, along, across = mean[i], steps[0, i], steps[1, i]
                for j in range(r):
                    mode = row[r * i + j]
                    own[j] += weight * mode
                    along[j] += one * mode
                    across[j] += two * mode
    for j in range(r):
        contact.along[j] = 0.0
        for i in range(3):
            contact.along[j] += contact.normal[i] * mean[i, j]


@njit(cache=True, error_model="numpy", nogil=True)
def local_problem(solver, k, slot):
    """Local model k under the tip that ``press_at_place`` has placed, by reference."""
    models, warm, scratch = solver.models, solver.warm, solver.scratch
    contact = scratch.tip.contact
    solver.past.begin_step(models.points.law.mu[k], k, slot)
    secants = Secants(warm.inverse[slot], warm.origin[slot], scratch.external, scratch.change)
    touched = TouchedSecants(
        bind_compiled(secants), contact.along, contact.found, scratch.tip.answer
    )
    pushed = Pushed(contact, scratch.load, scratch.tip.steady, scratch.external)
    return bind_compiled(
        Problem(
            bind_compiled(models.points.of(k)),
            solver.past,
            bind_compiled(pushed),
            bind_compiled(touched),
            scratch.work,
        )
    )


@njit(cache=True, error_model="numpy", nogil=True)
def _solve(solver, k, slot):
    """Equilibrium of model k at the place; its answer goes to memory's slot."""
    warm, scratch, outcome, tip = solver.warm, solver.scratch, solver.outcome, solver.scratch.tip
    q, state = warm.q[slot], scratch.start
    inverse, origin = warm.inverse[slot], warm.origin[slot]
    known = warm.number[slot] == k
    force = _expected_force(solver)
    _anticipate_tip(solver, k, force)
    problem, past = local_problem(solver, k, slot), solver.past
    size = past.external_force(scratch.load, tip.steady, origin)
    least = LEAST_FORCE * solver.tip.modulus * solver.tip.radius**2
    size = max(size, max(force, least) * math.sqrt(np.dot(tip.contact.along, tip.contact.along)))
    tolerance = TOLERANCE_IN_TIME if past.in_time else TOLERANCE
    target = max(solver.models.tolerance_factor * tolerance * size, SMALLEST_TARGET)
    status, iterations, energy, smallest = newton.STALLED, 0, 0.0, 0.0
    for attempt in range(0 if known else 1, 3):
        if attempt == 0:
            state[:] = q
        elif attempt == 1:
            state[:] = scratch.guess
            forget_secants(inverse, origin)
            first_tangent(solver.models.directions[k], solver.models.change[k], scratch, inverse)
        else:
            past.last_answer(slot, state)
            forget_secants(inverse, origin)
        status, more, energy, smallest = newton_method(
            problem, state, scratch.newton, target, np.inf, MAX_ITERATIONS[attempt], True, ROUND_OFF
        )
        iterations += more
        if status == newton.CONVERGED:
            break
    q[:] = state
    if status == newton.CONVERGED and past.in_time:  # errors are remembered
        problem.correct(scratch.newton[0], scratch.newton[1])
        q += scratch.newton[1]
    warm.guess[slot] = scratch.guess
    warm.number[slot] = k if status == newton.CONVERGED else -1
    outcome.status[0] = max(outcome.status[0], float(status))
    outcome.iterations[0] += iterations
    outcome.min_jacobian[0] = min(outcome.min_jacobian[0], smallest)
    outcome.energy[0] += solver.active.weight[slot] * energy


@njit(cache=True, error_model="numpy", nogil=True)
def _probe(solver, k, slot):
    """Draw a secant along the answer to the tip's force, from the state that has been found."""
    q, scratch, tip = solver.warm.q[slot], solver.scratch, solver.scratch.tip
    problem, residual, step = local_problem(solver, k, slot), scratch.newton[0], scratch.newton[1]
    found = tip.contact.found.copy()
    problem.correct(residual, step)  # learns from the state itself
    scratch.start[:] = q - PROBE * found[0] * tip.answer
    problem.potential(scratch.start, residual)
    problem.correct(residual, step)
    tip.contact.found[:] = found


@njit(cache=True, error_model="numpy", nogil=True)
def _expected_force(solver):
    """Force that the tip will have: the last, or that of a linear body and the law in series."""
    outcome, tip = solver.outcome, solver.scratch.tip
    last, law = solver.warm.tip.force, tip.contact.law
    if last[0] != 0.0 or last[1] != 0.0 or last[2] != 0.0:
        return math.sqrt(np.dot(last, last))
    compliance = 0.0
    for i in range(3):
        for j in range(3):
            # 3, 4, 5 are xy, xz, yz
            c = outcome.limits[1 + i] if i == j else outcome.limits[3 + i + j]
            compliance += outcome.upward[i] * c * outcome.upward[j]
    return squeeze(law[0], law[1] - compliance / max(outcome.area[0], 1e-12), law[4])[0]


@njit(cache=True, error_model="numpy", nogil=True)
def _anticipate_tip(solver, k, force):
    """Write the first guess of model k, and the dead load that takes off the cubature's defect."""
    outcome, load, along = solver.outcome, solver.scratch.load, solver.scratch.tip.contact.along
    for i in range(3):
        outcome.direction[i] = -solver.scratch.tip.contact.normal[i]
    for j in range(len(load)):
        load[j] = -force * along[j]
    anticipate(solver, k, force / max(outcome.area[0], 1e-12))
    for j in range(len(load)):
        load[j] += force * along[j]


@njit(cache=True, error_model="numpy", nogil=True)
def _look(solver, k, slot):
    """Add how the energy of model k changes with place and centre, by its weight."""
    models, outcome, tip = solver.models, solver.outcome, solver.scratch.tip
    contact, share, q, seen = tip.contact, solver.active.weight[slot], solver.warm.q[slot], tip.seen
    normal, r, gap = contact.normal, len(solver.warm.q[slot]), 0.0
    first, last = models.node_from[k], models.node_from[k + 1]
    for i in range(3):
        tip.towards[i] = contact.away[i] - np.dot(contact.mean[i], q)
        gap += tip.towards[i] ** 2
        seen[i] = contact.mean[i]
        for a in range(2):
            tip.slopes[a, i] = tip.tangents[a, i] + np.dot(contact.steps[a, i], q)
    gap = math.sqrt(gap)
    tip.towards /= gap
    for j in range(r):
        for a in range(2):
            seen[3 + a, j] = 0.0
            for i in range(3):
                seen[3 + a, j] += normal[i] * contact.steps[a, i, j]
    tip.curved[:] = -tip.bent
    for node in range(last - first):
        if tip.nodal[0, node] != 0.0:
            row, raised = models.modes[first + node], 0.0
            for i in range(3):
                moved = 0.0
                for j in range(r):
                    moved += row[r * i + j] * q[j]
                raised += normal[i] * moved
            tip.curved[0, 0] += tip.nodal[3, node] * raised
            tip.curved[0, 1] += tip.nodal[4, node] * raised
            tip.curved[1, 1] += tip.nodal[5, node] * raised
    tip.curved[1, 0] = tip.curved[0, 1]
    for s in range(len(seen)):
        superpose(solver.warm.inverse[slot], seen[s], tip.answered[s])
    law, found, edge = contact.law, contact.found, outcome.limits[LIMIT_FIELDS + EDGE_FIELD :]
    solver.tip.fading(edge[0], law, found[2], contact.fading)
    for a in range(2):
        tip.inwards[a] = np.dot(tip.tangents[a], edge[1:4])
    settle(
        np.dot(tip.answered, seen.T), found[0], found[1], gap, normal, tip.towards, tip.slopes,
        tip.curved, tip.inwards, contact.fading, tip.gradient, tip.hessian,
    )  # fmt: skip
    tip.g[:] += share * tip.gradient
    tip.H[:] += share * tip.hessian
    for i in range(3):
        tip.forces[slot, i] = contact.found[0] * tip.towards[i]
        outcome.force[i] += share * tip.forces[slot, i]
    outcome.penetration[0] = max(outcome.penetration[0], contact.found[2])
    outcome.touched[0] += 1.0
