"""A dead pressure on local models: at once, or at the end of a time step.

Theory.  See ``reduced.problem`` for the potential.  Its minimum is sought with the inverse tangent
that secants make up (BFGS): the rest stiffness is the identity, so few of them are needed.

A search starts where it is likely to end.  A local model that answered last in its slot is *warm*:
its answer differs from its first guess much as this one will; in time, where the force of the past
is followed by the inverse tangent, the start misses the answer much as the last one did.  A *cold*
model starts from the guess, with an inverse tangent that differs from the identity in few
directions; both are polynomials in the load and its place.  Where neither leads to an equilibrium
the search starts from the last answer that the tissue remembers, which is rest for elastic tissue:
a guess can lie beyond a fold of the load path.

What the points miss of the internal force in equilibrium, the *defect* of the cubature, is a smooth
function of the load.  It is fitted by polynomials on each local model and taken off ``f``: the
state in which the points are in equilibrium with the rest is that of the Galerkin model.

Between the centres the answers of the nearest local models are blended (``reduced.blend``).  No
array of mesh size is touched to solve a query.
"""

import math
from typing import Annotated, NamedTuple

import numpy as np
from numba import njit

from palpate.shared.arrays import Array, Field, Ints
from palpate.shared.compiled import bind_compiled
from palpate.shared.geometry.surface import locate
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.footprint import SurfaceQuadrature, footprint, pressure_limit
from palpate.shared.reduced.blend import MAX_ACTIVE, activate
from palpate.shared.reduced.corrections import Secants, forget_secants
from palpate.shared.reduced.features import estimate_errors, load_features, log_residual, near_rim
from palpate.shared.reduced.points import FAST, Points, back_substitute, cholesky, superpose
from palpate.shared.reduced.problem import Problem, Work, newton_method
from palpate.shared.reduced.terms import Dead, TipScratch, TipWarm

TOLERANCE, TOLERANCE_IN_TIME = 1.5e-3, 2e-3
"""Residual at equilibrium relative to load and past: in the energy norm of the rest state both are
displacements, so this is the solver's share of the error.  In time the answer then is corrected
once more, since errors are remembered: a quarter of that is left.  Where a scene's tolerance is
looser than the usual, so is this: ``PressModels.tolerance_factor``."""

SMALLEST_TARGET = 3e-7
"""Residual in the energy norm, (mN mm)^(1/2), that counts as equilibrium under any load.  After a
load is removed within one instant, load and past vanish and a relative criterion cannot be met."""

MAX_ITERATIONS = 10, 60, 400
"""Of a search from the last answer, from the first guess and from what the tissue remembers."""

ROUND_OFF = 1e-5
"""Relative error of the energy: where the tissue gives way it is a difference of large numbers, and
gradients are summed in single precision."""


class PressModels(NamedTuple):
    """All local models; ``*_from[k] : *_from[k + 1]`` are the rows of model k."""

    centres: Array  # (3, p) mm
    frames: Array  # (p, 3, 3) rows: outward normal and two tangents at the centre
    pressures: Array  # (p,) kPa, scale of the load there
    points: Points
    node_from: Ints  # (p + 1,)
    modes: Field  # (s, 3 r) modes, axis by axis, at the nodes that a footprint can load
    face_from: Ints  # (p + 1,)
    faces: SurfaceQuadrature  # nodes counted from the model's first
    defect: Field  # (p, LOAD_FEATURES, r) mN, force that the points miss
    guess: Field  # (p, LOAD_FEATURES, r) equilibrium less the linear response
    directions: Field  # (p, CHANGING, r) orthonormal, in which the tangent changes
    change: Field  # (p, TANGENT_FEATURES, CHANGES) tangent there less that at rest, lower triangle
    residuals: Array  # (p, RESIDUAL_FEATURES) log of the residual, by ``residual_features``
    blend: float  # mm, excess distance over the nearest centre at which a model fades out
    tolerance_factor: float  # times the solver's tolerance
    max_tilt: float  # degrees, largest of training


class PressWarm(NamedTuple):
    """Last answers in each slot, to start the next of the same local model from."""

    number: Annotated[Ints, "slots"]  # -1 for an empty slot
    q: Annotated[Array, "slots, r"]
    guess: Annotated[Array, "slots, r"]  # its first guess
    missed: Annotated[Array, "slots, r"]  # the answer less where it was expected
    past: Annotated[Array, "slots, r"]  # force of the past in it, on linear tissue
    inverse: Annotated[Array, "slots, r, r"]  # see ``corrections.Secants``
    origin: Annotated[Array, "slots, 2, r"]
    tip: TipWarm


class PressScratch(NamedTuple):
    """Working memory of a query."""

    work: Work
    newton: Annotated[Array, "4, r"]
    start: Annotated[Array, "r"]
    load: Annotated[Array, "r"]
    guess: Annotated[Array, "r"]
    external: Annotated[Array, "r"]
    change: Annotated[Array, "r"]
    unit_loads: Annotated[Field, "3 r"]  # of a unit pressure along each axis
    fitted: Annotated[Field, "r"]
    scaled_load: Annotated[Array, "3"]
    features: Annotated[Array, "features"]  # of the load
    tangent_features: Annotated[Array, "tangent_features"]
    fitted_change: Annotated[Field, "changes"]
    tangent: Annotated[Array, "changing, changing"]
    factor: Annotated[Array, "changing, changing"]
    turned: Annotated[Field, "changing, r"]
    residual_features: Annotated[Array, "residual_features"]
    nodal: Annotated[Array, "nodes"]  # most of a model
    surface: Annotated[Array, "clusters"]  # see ``geometry.surface.locate``
    tip: TipScratch


@njit(cache=True, error_model="numpy", nogil=True)
def place(solver, position, direction):
    """Find the contact point nearest to ``position`` and the local models that answer there.

    Writes the point, its normal and load range, the unit direction, its tilt, the largest trained
    pressure, and the distance of the position.  ``direction`` (3,) may have any length; zero stands
    for the inward normal.
    """
    outcome = solver.outcome
    x, normal, towards = outcome.foot, outcome.upward, outcome.direction
    distance = locate(solver.surface, position, solver.scratch.surface, x, normal, outcome.limits)
    length = math.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
    cosine = 0.0
    for i in range(3):
        towards[i] = direction[i] / length if length > 0.0 else -normal[i]
        cosine -= towards[i] * normal[i]
    outcome.distance[0] = distance
    outcome.tilt[0] = math.degrees(math.acos(min(1.0, max(-1.0, cosine))))
    outcome.limit[0] = pressure_limit(outcome.limits, normal, towards)
    activate(solver.models.centres, solver.models.blend, x, solver.warm.number, solver.active)


@njit(cache=True, error_model="numpy", nogil=True)
def press(solver, pressure, radius):
    """Press where ``place`` has found, from the answers that the solver's memory holds.

    Of an answer at once it estimates the errors, too.

    Parameters
    ----------
    solver : Bound of Solver
        Its memory is the starting point on entry and holds the answers on return; its past goes to
        the end of the step.  The numbers of the outcome are the worst of the active models.
    pressure, radius : float
        kPa and mm.
    """
    models, outcome, active, q = solver.models, solver.outcome, solver.active, solver.warm.q
    unit = solver.scratch.unit_loads
    outcome.status[0] = outcome.iterations[0] = outcome.energy[0] = outcome.departure[0] = 0.0
    outcome.min_jacobian[0] = np.inf
    outcome.displacement[:] = 0.0
    for slot in range(MAX_ACTIVE):
        share = active.weight[slot]
        if share == 0.0:
            continue
        k = active.number[slot]
        area = _load(models, k, outcome, pressure, radius, solver.scratch)
        outcome.area[0] = area
        anticipate(solver, k, pressure)
        _solve(solver, k, slot)
        r = q.shape[1]
        for i in range(3):
            moved = 0.0
            for j in range(r):
                moved += unit[r * i + j] * q[slot, j]
            outcome.displacement[i] += share * moved / max(area, 1e-12)
    for i in range(3):
        outcome.force[i] = -pressure * outcome.area[0] * outcome.direction[i]
    if not solver.past.in_time:  # or ``transfer.estimate_history`` does
        _estimate(solver, pressure)


@njit(cache=True, error_model="numpy", nogil=True)
def _load(models, k, outcome, pressure, radius, scratch):
    """Write the load of model k into ``scratch.load`` (r,); return force over pressure, mm^2."""
    first, last = models.node_from[k], models.node_from[k + 1]
    a, b = models.face_from[k], models.face_from[k + 1]
    nodal = scratch.nodal[: last - first]
    area = footprint(models.faces.between(a, b), outcome.foot, outcome.upward, radius, nodal)
    unit, load, direction = scratch.unit_loads, scratch.load, outcome.direction
    unit[:] = np.float32(0.0)
    for node in range(last - first):
        if nodal[node] != 0.0:
            weight, row = np.float32(nodal[node]), models.modes[first + node]
            for j in range(len(unit)):
                unit[j] += weight * row[j]
    r = len(load)
    for j in range(r):
        load[j] = pressure * (
            direction[0] * unit[j] + direction[1] * unit[r + j] + direction[2] * unit[2 * r + j]
        )
    return area


@njit(cache=True, error_model="numpy", nogil=True)
def anticipate(solver, k, pressure):
    """Take the cubature's defect off ``scratch.load`` of model k and write its first guess.

    Beyond the range of pressures what is fitted stays what it is at its end.
    """
    models, outcome, scratch = solver.models, solver.outcome, solver.scratch
    largest = pressure_limit(outcome.limits, outcome.upward, outcome.direction)
    inside = min(pressure, largest) / models.pressures[k]
    for i in range(3):
        scratch.scaled_load[i] = outcome.direction[i] * inside
    frame, centre = models.frames[k], models.centres[:, k]
    load, guess, fitted, features = scratch.load, scratch.guess, scratch.fitted, scratch.features
    load_features(
        frame, centre, outcome.foot, scratch.scaled_load, features, scratch.tangent_features
    )
    if not solver.past.in_time:  # the defect is known of equilibria at once only
        superpose(models.defect[k], features, fitted)
        load -= fitted
    superpose(models.guess[k], features, fitted)
    for i in range(len(load)):
        guess[i] = load[i] + fitted[i]


@njit(cache=True, error_model="numpy", nogil=True)
def local_problem(solver, k, slot):
    """Local model k under ``scratch.load``, by reference."""
    models, warm, scratch = solver.models, solver.warm, solver.scratch
    solver.past.begin_step(models.points.law.mu[k], k, slot)
    secants = Secants(warm.inverse[slot], warm.origin[slot], scratch.external, scratch.change)
    return bind_compiled(
        Problem(
            bind_compiled(models.points.of(k)),
            solver.past,
            bind_compiled(Dead(scratch.load)),
            bind_compiled(secants),
            scratch.work,
        )
    )


@njit(cache=True, error_model="numpy", nogil=True, inline="always")
def _solve(solver, k, slot):
    """Equilibrium of model k under ``scratch.load``; its answer goes to memory's slot."""
    models, warm, scratch, outcome = solver.models, solver.warm, solver.scratch, solver.outcome
    q, load, guess, start = warm.q[slot], scratch.load, scratch.guess, scratch.start
    inverse, origin, missed = warm.inverse[slot], warm.origin[slot], warm.missed[slot]
    problem, past = local_problem(solver, k, slot), solver.past
    size = past.external_force(load, scratch.external, origin)
    tolerance = TOLERANCE_IN_TIME if past.in_time else TOLERANCE
    target = max(models.tolerance_factor * tolerance * size, SMALLEST_TARGET)
    known = warm.number[slot] == k
    status, iterations, smallest = newton.STALLED, 0, 0.0
    for attempt in range(0 if known else 1, 3):
        if attempt == 0:
            for i in range(len(q)):
                start[i] = guess[i] + q[i] - warm.guess[slot, i]
            past.follow(inverse, q, warm.past[slot], missed, scratch.change, start)
        elif attempt == 1:
            start[:] = guess
            forget_secants(inverse, origin)
            first_tangent(models.directions[k], models.change[k], scratch, inverse)
            warm.past[slot] = missed[:] = 0.0
            past.follow(inverse, guess, warm.past[slot], missed, scratch.change, start)
        else:
            past.last_answer(slot, start)
            forget_secants(inverse, origin)
        status, more, _, smallest = newton_method(
            problem, start, scratch.newton, target, np.inf, MAX_ITERATIONS[attempt], True, ROUND_OFF
        )
        iterations += more
        if status == newton.CONVERGED:
            break
    found = status == newton.CONVERGED
    q[:] = start
    warm.guess[slot] = guess
    warm.number[slot] = k if found else -1
    if found and past.in_time:
        problem.correct(scratch.newton[0], scratch.newton[1])
        q += scratch.newton[1]
        past.end_step(problem.points, scratch.work, slot, q, False)
    past.note_answer(q, attempt == 0, warm.past[slot], missed)
    length = departure = 0.0
    for i in range(len(q)):
        length += q[i] ** 2
        departure += (q[i] - load[i]) ** 2
    departure = math.sqrt(departure) / max(math.sqrt(np.dot(load, load)), 1e-9)
    outcome.status[0] = max(outcome.status[0], float(status))
    outcome.iterations[0] = max(outcome.iterations[0], float(iterations))
    outcome.min_jacobian[0] = min(outcome.min_jacobian[0], smallest)
    outcome.energy[0] = max(outcome.energy[0], math.sqrt(length))
    outcome.departure[0] = max(outcome.departure[0], departure)


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def first_tangent(directions, table, scratch, inverse):
    """Add to the inverse (r, r) of the tangent at rest what the load changes in few directions.

    With ``V`` these directions and ``K`` the tangent in them, that is ``V^T (K^-1 - I) V``; a ``K``
    that is not positive definite is shifted towards the rest stiffness until it is.
    """
    K, L, turned, change = scratch.tangent, scratch.factor, scratch.turned, scratch.fitted_change
    superpose(table, scratch.tangent_features, change)
    at = 0
    for i in range(len(K)):
        for j in range(i + 1):
            K[i, j] = K[j, i] = change[at]
            at += 1
        K[i, i] += 1.0
    shift = 0.0
    while not cholesky(K, shift, L):
        shift = max(0.1, 4.0 * shift)
        if shift > newton.LARGEST_SHIFT:
            return
    turned[:] = directions
    back_substitute(L, turned)
    turned -= directions
    inverse += np.dot(directions.T, turned)


@njit(cache=True, error_model="numpy", nogil=True)
def _estimate(solver, pressure):
    """Estimated errors of an answer at once.

    The features: 1, tilt over the largest, smallest det F, the normal (where on the body), and the
    logs of the pressure over its limit, of the departure from the linear response, of the residual
    that such answers leave in the full model, of the contact's displacement over pressure (mm/kPa)
    and of the displacement in the energy norm; whether the contact is near the rim.
    """
    outcome, features = solver.outcome, solver.outcome.features
    load = pressure / outcome.limit[0]
    residual = log_residual(solver, outcome.foot, outcome.direction, load)
    compliance = math.sqrt(np.dot(outcome.displacement, outcome.displacement)) / max(pressure, 1e-6)
    outcome.residual[0] = math.exp(residual)
    features[0] = 1.0
    features[1] = outcome.tilt[0] / max(solver.models.max_tilt, 1.0)
    features[2] = outcome.min_jacobian[0]
    features[3:6] = outcome.upward
    features[6] = math.log(max(load, 1e-6))
    features[7] = math.log(max(outcome.departure[0], 1e-6))
    features[8], features[9] = residual, math.log(max(compliance, 1e-6))
    features[10] = math.log(max(outcome.energy[0], 1e-6))
    features[11] = near_rim(outcome.limits)
    estimate_errors(solver.coefficients, features, outcome.errors)
