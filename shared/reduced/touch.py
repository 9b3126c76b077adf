"""The rigid tip on local models: at once, or at the end of a time step.

Theory.  See ``reduced.problem`` for the potential: the load is the contact potential ``Phi`` of
``mechanics.sphere`` at the nodes of the surface near the local model.  Nothing else is known of the
load: the tip's centre ``x`` is the query.  Force on the tool and tangent of an equilibrium are

    F = - dPhi/dx,   dF/dx = B^T K^-1 B - d2Phi/dx2,   B = d2Phi/(dq dx),  K = d2Pi/dq2,

the past being what it is.  Contact is too stiff for secants, so the tangent is factorised.

A search starts from the last answer and its derivative ``K^-1 B`` in the tip's position, from a
neighbour's answer projected on the model's modes in the energy of the rest state, from what the
tissue remembers, or from a polynomial in place and depth.  Forces of neighbouring models are
blended; the tangent has the derivatives of the weights, too.
"""

import math
from typing import Annotated, NamedTuple

import numpy as np
from numba import njit

from palpate.shared.arrays import Array, Field, Ints, Numbers
from palpate.shared.compiled import bind_compiled
from palpate.shared.geometry.surface import UPRIGHT, locate
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.footprint import TIP_DEPTH
from palpate.shared.mechanics.sphere import Tip, TipSurface
from palpate.shared.reduced.blend import MAX_ACTIVE, activate, weight_gradients
from palpate.shared.reduced.contact_search import (
    MAX_ITERATIONS,
    TOLERANCE,
    along_the_way_in,
    to_minimum,
)
from palpate.shared.reduced.corrections import Tangent, TangentWork
from palpate.shared.reduced.features import (
    TIP_FEATURES,
    estimate_errors,
    log_residual,
    tip_features,
)
from palpate.shared.reduced.points import Points, project
from palpate.shared.reduced.problem import Problem, Work
from palpate.shared.reduced.terms import Contact, ContactWork, reaction

LEAST_SHARE = 0.1
"""Weight of a model below which its residual may not be larger still: that counts by weight."""

LAG_AT_ONCE, LAG_IN_TIME = 0.01, 0.03
"""Change of answer and past, relative to the answer, up to which the tissue's part of the tangent
serves again.  In time both change at every step, and forming the tangent takes as long as all the
rest.  The contact's part never serves again: it is far stiffer and changes as fast as the tip
moves."""

SKIN = 0.02
"""Distance from the surface, in radii of the tip, at which contact is looked for: the triangles
that say where the surface is cut its curves."""


class TouchModels(NamedTuple):
    """Local models of the tip; ``*_from[k] : *_from[k + 1]`` are the rows of model k."""

    centres: Array  # (3, p) mm, of a tip at the middle of the model, half as deep as may be
    frames: Array  # (p, 3, 3) rows: outward normal and two tangents
    blend: float  # mm
    points: Points
    tangent_points: Points  # the same, or fewer for a tangent that need not be exact
    guess: Field  # (p, TIP_FEATURES, r) of the answer
    tip: Tip
    surface: TipSurface
    node_from: Ints  # (p + 1,)
    nodes: Numbers  # (s,) of the surface, near the model
    modes: Field  # (s, 3, r) mm
    face_from: Ints  # (p + 1,)
    faces: Numbers  # (t,) of the surface, near the model
    corners: Numbers  # (t, k) their nodes, counted from the model's first
    neighbour_from: Ints  # (p + 1,)
    neighbours: Numbers  # (o,) models whose answers can be projected
    transfer: Field  # (o, r, r) from their modes to the model's
    residuals: Array  # (p, RESIDUAL_FEATURES) log of the residual; the load is the depth


class TouchWarm(NamedTuple):
    """The models of the last equilibrium, to start the next from."""

    number: Annotated[Ints, "slots"]  # -1 for an empty slot
    q: Annotated[Array, "slots, r"]
    slope: Annotated[Array, "slots, 3, r"]  # 1/mm, K^-1 B there
    position: Annotated[Array, "3"]  # mm
    bulk: Annotated[Array, "slots, r, r"]  # see ``corrections.Tangent``
    formed: Annotated[Array, "slots, 3, r"]


class TouchScratch(NamedTuple):
    """Working memory of a query."""

    work: Work
    newton: Annotated[Array, "4, r"]
    x: Annotated[Array, "3"]  # mm
    q: Annotated[Array, "slots, r"]  # answers, or where searches have ended
    slope: Annotated[Array, "slots, 3, r"]
    factor: Annotated[Array, "r, r"]  # of the last model's tangent
    coupling: Annotated[Array, "3, r"]  # its B
    forces: Annotated[Array, "slots, 3"]  # mN, of the models
    tangents: Annotated[Array, "slots, 3, 3"]  # mN/mm
    tangent: TangentWork
    contact: ContactWork
    features: Annotated[Array, "features"]  # of the position
    residual_features: Annotated[Array, "residual_features"]
    inward: Annotated[Array, "3"]
    surface: Annotated[Array, "clusters"]  # see ``geometry.surface.locate``


@njit(cache=True, error_model="numpy", nogil=True)
def place(solver, x, last):
    """Find where the tip's centre ``x`` (3,) mm lies, and the local models that answer.

    Off the tissue, models are chosen about ``last``, where it touched last: tissue with a past goes
    on without a load.  Writes the nearest point of the surface and its normal, the depth and its
    limit.
    """
    models, outcome, tip = solver.models, solver.outcome, solver.models.tip
    distance = locate(
        solver.surface, x, solver.scratch.surface, outcome.foot, outcome.upward, outcome.limits
    )
    outcome.limit[0] = outcome.limits[TIP_DEPTH]
    above = 0.0
    for i in range(3):
        above += (x[i] - outcome.foot[i]) * outcome.upward[i]
    beside = abs(above) < UPRIGHT * distance
    outcome.distance[0], outcome.beside[0] = distance, 1.0 if beside else 0.0
    outcome.depth[0] = tip.radius - (distance if beside else math.copysign(distance, above))
    at = x if outcome.depth[0] > -SKIN * tip.radius else last
    activate(models.centres, models.blend, at, solver.warm.number, solver.active)
    weight_gradients(models.centres, models.blend, at, solver.active)


@njit(cache=True, error_model="numpy", nogil=True)
def touch(solver, x, most):
    """Answer a tip at ``x`` (3,) mm that ``place`` has placed; at once, estimate its errors.

    Parameters
    ----------
    solver : Bound of Solver
        Its memory is the starting point on entry and holds the answers on return if all models have
        one.  Its past then is at the end of the step.
    x : ndarray, shape (3,), mm
    most : int
        Iterations in one local model; only with ``MAX_ITERATIONS`` is the way in tried, too, where
        a jump fails.
    """
    outcome, scratch, active = solver.outcome, solver.scratch, solver.active
    outcome.status[0] = outcome.iterations[0] = outcome.energy[0] = 0.0
    outcome.penetration[0] = outcome.touched[0] = 0.0
    outcome.min_jacobian[0] = 1.0
    outcome.force[:] = 0.0
    outcome.tangent[:] = 0.0
    for slot in range(MAX_ACTIVE):
        if active.weight[slot] > 0.0:
            _solve(solver, active.number[slot], slot, x, most)
    if outcome.status[0] == newton.CONVERGED:
        for slot in range(MAX_ACTIVE):
            if active.weight[slot] > 0.0:
                share, force = active.weight[slot], scratch.forces[slot]
                for i in range(3):
                    outcome.force[i] += share * force[i]
                    for j in range(3):
                        outcome.tangent[i, j] += (
                            share * scratch.tangents[slot, i, j]
                            + force[i] * active.gradient[slot, j]
                        )
    _remember(solver, x)
    _act(solver, x)
    # or ``transfer.estimate_history`` estimates
    if outcome.touched[0] > 0.0 and not solver.past.in_time:
        _estimate(solver, x)


@njit(cache=True, error_model="numpy", nogil=True)
def _solve(solver, k, slot, x, most):
    """Equilibrium of model k, its force and tangent, into the slot."""
    scratch, outcome = solver.scratch, solver.outcome
    q, depth = scratch.q[slot], outcome.depth[0]
    _start(solver, k, slot, x, q)
    scratch.x[:] = x
    scratch.contact.latest[:] = np.inf
    problem = local_problem(solver, k, slot)
    tolerance = TOLERANCE / max(solver.active.weight[slot], LEAST_SHARE)
    status, iterations, energy, smallest = to_minimum(
        problem, q, scratch.newton, max(depth, 0.0), tolerance, most
    )
    if status != newton.CONVERGED and depth > 0.0 and most == MAX_ITERATIONS:
        status, more, energy, smallest = along_the_way_in(
            problem, q, scratch.newton, depth, outcome.upward, most
        )
        iterations += more
    outcome.status[0] = max(outcome.status[0], float(status))
    outcome.iterations[0] = max(outcome.iterations[0], float(iterations))
    outcome.min_jacobian[0] = min(outcome.min_jacobian[0], smallest)
    if status != newton.CONVERGED:
        return
    coupling, force = scratch.coupling, scratch.forces[slot]
    residual, step = scratch.newton[0], scratch.newton[1]
    reaction(
        problem.load, scratch.factor, coupling, scratch.slope[slot], force, scratch.tangents[slot]
    )
    problem.correct(residual, step)
    energy += 0.5 * np.dot(residual, step)
    q += step
    for i in range(3):
        force[i] += np.dot(coupling[i], step)
    touching = scratch.contact.touching
    outcome.energy[0] += solver.active.weight[slot] * energy
    outcome.penetration[0] = max(outcome.penetration[0], touching.deepest[0])
    outcome.touched[0] += touching.touched[0]


@njit(cache=True, error_model="numpy", nogil=True)
def local_problem(solver, k, slot):
    """Local model k under the tip at ``scratch.x``, by reference."""
    models, warm, scratch = solver.models, solver.warm, solver.scratch
    nodes = slice(models.node_from[k], models.node_from[k + 1])
    faces = slice(models.face_from[k], models.face_from[k + 1])
    solver.past.begin_step(models.points.law.mu[k], k, slot)
    contact = Contact(
        models.tip, models.surface, scratch.x, models.nodes[nodes], models.modes[nodes],
        models.faces[faces], models.corners[faces], scratch.contact,
    )  # fmt: skip
    lag = LAG_IN_TIME if solver.past.in_time else LAG_AT_ONCE
    tangent = Tangent(
        bind_compiled(models.tangent_points.of(k)), warm.bulk[slot], warm.formed[slot], lag,
        scratch.factor, scratch.tangent,
    )  # fmt: skip
    return bind_compiled(
        Problem(
            bind_compiled(models.points.of(k)),
            solver.past,
            bind_compiled(contact),
            bind_compiled(tangent),
            scratch.work,
        )
    )


# --- where a search starts -----------------------------------------------------------------------


@njit(cache=True, error_model="numpy", nogil=True)
def _start(solver, k, slot, x, q):
    """Write where the search of model k starts, (r,)."""
    warm, depth = solver.warm, max(solver.outcome.depth[0], 0.0)
    if warm.number[slot] == k:
        _follow(warm, slot, x, q)
        return
    warm.formed[slot] = np.inf
    if _from_neighbour(solver, k, x, q):
        return
    solver.past.last_answer(slot, q)
    if not np.any(q):
        first_guess(solver.models, k, x, depth, solver.scratch.features, q)


@njit(cache=True, error_model="numpy", nogil=True)
def _follow(warm, slot, x, q):
    """Follow the derivatives of the last answer to the position x."""
    q[:] = warm.q[slot]
    for i in range(3):
        q += (x[i] - warm.position[i]) * warm.slope[slot, i]


@njit(cache=True, error_model="numpy", nogil=True)
def _from_neighbour(solver, k, x, q):
    """Project the answer of the nearest neighbour that has one, as it is at x; False without."""
    models, warm, distance = solver.models, solver.warm, solver.active.distance
    source, at, least = -1, -1, np.inf
    for i in range(models.neighbour_from[k], models.neighbour_from[k + 1]):
        n = models.neighbours[i]
        for slot in range(MAX_ACTIVE):
            if warm.number[slot] == n and distance[n] < least:
                source, at, least = slot, i, distance[n]
    if source < 0:
        return False
    followed = solver.scratch.work.stepped
    _follow(warm, source, x, q)
    followed[:] = q
    project(models.transfer[at], followed, q)
    return True


@njit(cache=True, error_model="numpy", nogil=True)
def first_guess(models, k, x, depth, features, q):
    """Write the trained first guess of model k with the tip at x so deep, (r,)."""
    tip_features(models.frames[k], models.centres[:, k], x, depth, features)
    q[:] = 0.0
    for f in range(TIP_FEATURES):
        row = models.guess[k, f]
        for j in range(len(q)):
            q[j] += features[f] * row[j]


# --- what is kept --------------------------------------------------------------------------------


@njit(cache=True, error_model="numpy", nogil=True)
def _remember(solver, x):
    """Start the next search from these answers; from those before where one is no equilibrium."""
    warm, scratch, active = solver.warm, solver.scratch, solver.active
    found = solver.outcome.status[0] == newton.CONVERGED
    for slot in range(MAX_ACTIVE):
        if active.weight[slot] > 0.0:
            k = active.number[slot]
            if found:
                warm.q[slot] = scratch.q[slot]
                warm.slope[slot] = scratch.slope[slot]
                points = solver.models.points.of(k)
                solver.past.end_step(points, scratch.work, slot, scratch.q[slot], True)
            elif k != warm.number[slot]:
                warm.formed[slot] = np.inf  # of another model, or far off
    if found:
        warm.number[:] = active.number
        warm.position[:] = x


@njit(cache=True, error_model="numpy", nogil=True)
def _act(solver, x):
    """Write where the force acts on the tip; without one, the surface point nearest to it."""
    outcome = solver.outcome
    outcome.point[:] = outcome.foot
    outcome.normal[:] = outcome.upward
    pushed = math.sqrt(np.dot(outcome.force, outcome.force))
    if pushed > 0.0:
        for i in range(3):
            outcome.normal[i] = outcome.force[i] / pushed
            outcome.point[i] = x[i] - solver.models.tip.radius * outcome.normal[i]


@njit(cache=True, error_model="numpy", nogil=True)
def _estimate(solver, x):
    """Estimated errors of an answer at once.

    The features: 1, the depth over its limit and its log, smallest det F, the normal (where on the
    body), and the logs of force over depth (mN/mm), of the energy over that of a linear spring, and
    of the residual that such answers leave in the full model.
    """
    outcome, features, inward = solver.outcome, solver.outcome.features, solver.scratch.inward
    pushed = math.sqrt(np.dot(outcome.force, outcome.force))
    depth = max(outcome.depth[0], 1e-6)
    share = depth / max(outcome.limit[0], 1e-6)
    inward[:] = -outcome.upward
    features[0], features[1], features[2] = 1.0, share, math.log(share)
    features[3] = outcome.min_jacobian[0]
    features[4:7] = outcome.upward
    features[7] = math.log(max(pushed / depth, 1e-6))
    features[8] = math.log(max(2.0 * outcome.energy[0] / max(pushed * depth, 1e-9), 1e-3))
    features[9] = log_residual(solver, x, inward, share)
    count = solver.coefficients.shape[1]
    estimate_errors(solver.coefficients, features[:count], outcome.errors)
