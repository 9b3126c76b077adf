"""The reduced model under the rigid tip: what ``ReducedModel.touch`` runs.

Theory.  Each local model holds the displacement in a space of few modes, orthonormal in the energy
of the rest state, and minimises

    min_q  q . q / 2 + sum_c w_c (W - W_0)(G_c q) + Phi(V q, x)

with the cubature of ``reduced.press`` and the contact potential ``Phi`` of ``mechanics.sphere``, at
the nodes of the surface near the model.  Nothing else is known of the load: the tip's centre ``x``
is the query.  Force and tangent of an equilibrium are

    F = -dPhi/dx,      dF/dx = B^T K^-1 B - d2Phi/dx2,      B = -d2Phi/dq dx,

K the tangent there.  K^-1 B dx is also where the search for the next equilibrium starts.  A model
that joins in takes over the answer of a neighbour, projected in the energy of the rest state.

Local models are blended by the distance of the tip's centre from where it lies when a tip presses
the middle of the model, half as deep as may be.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numba.extending import overload
from numpy.typing import NDArray

from palpate.shared.compiled import bind, bind_compiled
from palpate.shared.errors import QueryError
from palpate.shared.geometry.surface import UPRIGHT, SurfaceIndex, locate
from palpate.shared.mechanics import newton, tissue
from palpate.shared.mechanics.sphere import (
    CONVEX,
    HARDNESS,
    STIFFNESS,
    Tip,
    TipSurface,
    Touching,
    reaction,
    room_for,
    touch,
)
from palpate.shared.reduced.history import Local
from palpate.shared.reduced.press import (
    FAST,
    LANES,
    MAX_ACTIVE,
    RESIDUAL_FEATURES,
    ROUND_OFF,
    STATE,
    TILE,
    activate,
    added_energy,
    back_substitute,
    cholesky,
    increments,
    is_system,
    linearise,
    lower_products,
    nonlinear_stress,
    project,
    residual_features,
    superpose,
)

Array = NDArray[np.float64]
Field = NDArray[np.float32]
Ints = NDArray[np.int64]

TOLERANCE = 0.001
"""Residual before the last correction relative to the response, both in the energy norm of the
rest state.  Newton's method squares it (to 1e-6, say), which need not be evaluated; but the tangent
on the tool is that before the correction: in hard contact 1 % of it is a matter of micrometres."""

LEAST_SHARE = 0.1
"""Weight of a model below which its residual may not be larger still: that counts by weight."""

LAG = 0.01
"""Change of the response, relative to it, up to which the tissue's part of the tangent serves
again.  The contact's never does: it is far stiffer and changes as fast as the tip moves."""

SLIGHT = 0.05
"""Depth in radii of the tip below which an answer need not be nearer to equilibrium, in that norm,
than one so deep: where contact begins Newton's method is slow, and the force next to nothing."""

MAX_ITERATIONS = 40

SKIN = 0.02
"""Distance from the surface, in radii of the tip, at which contact is looked for: the triangles
that say where the surface is cut its curves."""

MOST_SADDLES, NUDGE = 3, 0.02
"""Saddles that one search leaves at most, and by how much of the response."""

RAMP = 8
"""Steps of the way in when an equilibrium cannot be found in one jump."""


@dataclass(frozen=True)
class LocalTips:
    """What training finds out about p patches under the tip, from regions of M modes each.

    Attributes
    ----------
    modes : ndarray, shape (p, M, m), float32
        Of each patch, in the basis of its region.
    point_from : ndarray, shape (p + 1,), int64
        Cubature points of patch k are rows ``point_from[k] : point_from[k + 1]``.
    points : ndarray, shape (c,), int32
        Quadrature point, counted element by element.
    weights : ndarray, shape (c,), mm^3
    guess : ndarray, shape (p, TIP_FEATURES, m), float32
        Answer as a polynomial in place and depth.
    pairs : ndarray, shape (n, 2), int32
        Patches next to one another, the smaller number first.
    overlaps : ndarray, shape (n, m, m), float32
        Products of their modes in the energy of the rest state.
    residuals : ndarray, shape (p, RESIDUAL_FEATURES)
        Log of the residual that answers leave in the full model, relative to them in the energy
        norm at rest, by ``reduced.press.residual_features``: the direction is the inward normal,
        the load the depth.
    """

    modes: Field
    point_from: Ints
    points: NDArray[np.int32]
    weights: Array
    guess: Field
    pairs: NDArray[np.int32]
    overlaps: Field
    residuals: Array


class Points(NamedTuple):
    """Cubature points of all models, filled up with points of no weight."""

    gradients: Field  # (p, m, 9 c) 1/mm, in tiles
    weights: Array  # (p, c) mm^3
    mu: Array  # (p, c) kPa
    lam: Array  # (p, c) kPa


class TipModels(NamedTuple):
    """Local models of the tip; ``*_from[k] : *_from[k + 1]`` are the rows of model k."""

    centres: Array  # (3, p) mm, of a tip at the middle of the model, half as deep as may be
    frames: Array  # (p, 3, 3) rows: outward normal and two tangents
    blend: float  # mm
    points: Points
    tangent_points: Points  # the same, or fewer for a tangent that need not be exact
    guess: Field  # (p, TIP_FEATURES, m) of the answer
    tip: Tip
    surface: TipSurface
    node_from: Ints  # (p + 1,)
    nodes: NDArray[np.int32]  # (s,) of the surface, near the model
    modes: Field  # (s, 3, m) mm
    face_from: Ints  # (p + 1,)
    faces: NDArray[np.int32]  # (t,) of the surface, near the model
    corners: NDArray[np.int32]  # (t, k) their nodes, counted from the model's first
    neighbour_from: Ints  # (p + 1,)
    neighbours: NDArray[np.int32]  # (o,) models whose answers can be taken over
    overlaps: Field  # (o, m, m) from their modes to the model's
    residuals: Array  # (p, RESIDUAL_FEATURES) log of the residual, see ``LocalTips``


TIP_DEGREE = 3
"""Of the first guess in the depth."""

TIP_FEATURES = 6 * TIP_DEGREE


@njit(cache=True, error_model="numpy", nogil=True)
def tip_features(frame, centre, x, depth, out):
    """Polynomials in the depth (degree 1-3) and the place along the surface (0-2), mm."""
    s = t = 0.0
    for i in range(3):
        s += frame[1, i] * (x[i] - centre[i])
        t += frame[2, i] * (x[i] - centre[i])
    power = 1.0
    for degree in range(TIP_DEGREE):
        power *= depth
        k = 6 * degree
        out[k], out[k + 1], out[k + 2] = power, power * s, power * t
        out[k + 3], out[k + 4], out[k + 5] = power * s * s, power * s * t, power * t * t


class TipMemory(NamedTuple):
    """The models of the last equilibrium, to start the next from; patch < 0 is an empty slot."""

    patch: Ints  # (MAX_ACTIVE,)
    q: Array  # (MAX_ACTIVE, m)
    bulk: Array  # (MAX_ACTIVE, m, m) part of the tangent
    formed: Array  # (MAX_ACTIVE, m) state at which that was formed
    factor: Array  # (MAX_ACTIVE, m, m) of the tangent at the answer
    coupling: Array  # (MAX_ACTIVE, 3, m) B there
    position: Array  # (3,) mm


class TipScratch(NamedTuple):
    """Working memory."""

    H: Field
    P: Field
    J: Array
    trace: Array
    linear: Array
    state: Field
    increments: Field  # (m, 9 c)
    latest: Array  # (m,)
    tangent: Array  # (m, m)
    newton: Array  # (4, m)
    position: Array  # (3,) mm
    factor: Array  # (MAX_ACTIVE, m, m)
    coupling: Array  # (MAX_ACTIVE, 3, m)
    moved: Array  # (n, 3) mm, of the surface's nodes; only those near are written
    own: Array  # (3 k f, m) modes at the nodes of touching faces
    folded: Array  # (3 k f, m) the faces' stiffnesses times these
    square: Array  # (3 k, 3 k) a face's stiffness
    product: Array  # (m, m)
    touching: Touching
    distance: Array  # (p,)
    fade: Array  # (MAX_ACTIVE, 3) 1/mm, gradients of the weights
    features: Array  # (TIP_FEATURES,)
    residual_features: Array  # (RESIDUAL_FEATURES,)
    inward: Array  # (3,)
    ground: Array  # (clusters + 3,)


TIP_ERROR_FEATURES = 10


class TipOutcome(NamedTuple):
    """What a query writes."""

    patch: Ints  # (MAX_ACTIVE,) models that answer, see ``reduced.activate``
    q: Array  # (MAX_ACTIVE, m) their answers
    weight: Array  # (MAX_ACTIVE,)
    foot: Array  # (3,) mm, on the surface, nearest to the tip's centre
    upward: Array  # (3,) outward normal there
    force: Array  # (3,) mN
    tangent: Array  # (3, 3) mN/mm
    point: Array  # (3,) mm, see ``Touch.contact_point``
    normal: Array  # (3,) from there to the tip's centre
    forces: Array  # (MAX_ACTIVE, 3) of the models
    tangents: Array  # (MAX_ACTIVE, 3, 3)
    limit: Array  # (1,) mm, largest trained depth there
    features: Array  # (TIP_ERROR_FEATURES,) of the error estimate
    errors: Array  # (3,) estimated: displacement, von Mises stress, force
    scalars: Array  # (SCALARS,)


(STATUS, ITERATIONS, SMALLEST_J, ENERGY, PENETRATION, TOUCHED, DEPTH, DISTANCE, BESIDE) = range(9)
SCALARS = 9


class TipSolver(NamedTuple):
    """All that a query reads of the models, and all that it writes."""

    models: TipModels
    ground: SurfaceIndex
    coefficients: Array  # (3, TIP_ERROR_FEATURES) of the error estimate
    memory: TipMemory
    scratch: TipScratch
    outcome: TipOutcome


class TipSystem(NamedTuple):
    """A local model under the tip, for ``mechanics.newton.descend``."""

    gradients: Field
    weights: Array
    mu: Array
    lam: Array
    tangent_gradients: Field
    tangent_weights: Array
    tangent_mu: Array
    tangent_lam: Array
    H: Field
    P: Field
    J: Array
    trace: Array
    linear: Array
    state: Field
    increments: Field
    bulk: Array  # (m, m) part of the tangent
    formed: Array  # (m,) state at which that was formed
    latest: Array  # (m,) state that ``touching`` is of
    tangent: Array
    factor: Array
    tip: Tip
    surface: TipSurface
    nodes: NDArray[np.int32]
    modes: Field
    faces: NDArray[np.int32]
    corners: NDArray[np.int32]
    x: Array
    step: Array  # (m,) scratch
    moved: Array
    own: Array
    folded: Array
    square: Array
    product: Array
    touching: Touching


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def _move(nodes, modes, q, moved):
    """Displacement of the nodes, into the rows of ``moved`` that are theirs."""
    for a in range(len(nodes)):
        for i in range(3):
            row, total = modes[a, i], 0.0
            for j in range(len(q)):
                total += row[j] * q[j]
            moved[nodes[a], i] = total


@njit(cache=True, error_model="numpy", nogil=True)
def form_contact(system, q, wanted):
    """What the tip does to the state q: (faces touched, energy, largest penetration)."""
    moved = system.moved
    _move(system.nodes, system.modes, q, moved)
    return touch(system.tip, system.surface, system.faces, system.x, moved, system.touching, wanted)


@njit(cache=True, error_model="numpy", nogil=True)
def stress_points(system, u):
    """Stress beyond linear elasticity at the points; what energy that is, and smallest det F."""
    superpose(system.gradients, u, system.H)
    J, trace, linear = system.J, system.trace, system.linear
    weights, mu, lam = system.weights, system.mu, system.lam
    nonlinear_stress(system.H, weights, mu, lam, J, trace, linear, system.P)
    smallest = J.min()
    return (added_energy(weights, mu, lam, J, trace, linear) if smallest > 0.0 else 0.0), smallest


@njit(cache=True, error_model="numpy", nogil=True)
def balance(system, u, residual):
    """Residual of the stress at the points, linear elasticity and contact; energy of these two."""
    project(system.gradients, system.P, residual)
    count, energy, _ = form_contact(system, u, STIFFNESS)
    system.latest[:] = u
    for j in range(len(u)):
        residual[j] += u[j]
        energy += 0.5 * u[j] * u[j]
    for c in range(count):
        own, force = system.corners[system.touching.face[c]], system.touching.force[c]
        for k in range(len(own)):
            for i in range(3):
                row, f = system.modes[own[k], i], force[k, i]
                for j in range(len(u)):
                    residual[j] -= f * row[j]
    return energy


@overload(newton.potential, jit_options={"error_model": "numpy"})
def _potential(system, u, residual):
    if not is_system(TipSystem, system):
        return None

    def potential(system, u, residual):
        energy, smallest = stress_points(system, u)
        if not smallest > 0.0:
            return tissue.INVERTED, smallest
        return energy + balance(system, u, residual), smallest

    return potential


@overload(newton.factorise, jit_options={"error_model": "numpy"})
def _factorise(system, u, shift):
    if not is_system(TipSystem, system):
        return None

    def factorise(system, u, shift):
        known = far(u, system.formed) <= LAG * LAG
        if shift > 0.0:
            form_contact(system, u, CONVEX)
            system.latest[:] = np.inf
        elif far(u, system.latest) > 0.0:
            form_contact(system, u, STIFFNESS)
            system.latest[:] = u
        while True:
            if not known:
                _form_bulk(system, u)
            system.tangent[:] = system.bulk
            add_contact(system)
            if cholesky(system.tangent, shift, system.factor):
                return True
            if not known:
                return False
            known = False

    return factorise


@njit(cache=True, error_model="numpy", nogil=True)
def far(u, other):
    """Squared distance of a state from another, relative to its size."""
    size = distance = 0.0
    for j in range(len(u)):
        size += u[j] * u[j]
        distance += (u[j] - other[j]) ** 2
    return distance / max(size, 1e-12)


@njit(cache=True, error_model="numpy", nogil=True)
def _form_bulk(system, u):
    """The part of the tissue in the tangent at u, lower triangle."""
    gradients, bulk = system.tangent_gradients, system.bulk
    H = system.H[: gradients.shape[1]]
    superpose(gradients, u, H)
    linearise(H, system.tangent_weights, system.tangent_mu, system.tangent_lam, system.state)
    increments(system.state, gradients, system.increments)
    lower_products(gradients, system.increments, bulk)
    for j in range(len(u)):
        bulk[j, j] += 1.0
    system.formed[:] = u


@njit(cache=True, error_model="numpy", nogil=True)
def add_contact(system):
    """Add the stiffness of all touching faces to the tangent; ``react`` uses what is left here.

    It exceeds the tissue's by many orders of magnitude, so single precision would not do.
    """
    touching, own, folded, square = system.touching, system.own, system.folded, system.square
    nodes = system.corners.shape[1]
    rows = 3 * nodes
    count = touching.touched[0]
    for c in range(count):
        _place_face(system, c, square, own[rows * c : rows * (c + 1)])
        np.dot(square, own[rows * c : rows * (c + 1)], folded[rows * c : rows * (c + 1)])
    if count > 0:
        np.dot(own[: rows * count].T, folded[: rows * count], system.product)
        system.tangent[:] += system.product


@njit(cache=True, error_model="numpy", nogil=True)
def _place_face(system, c, square, own):
    """A touching face's stiffness (3 k, 3 k), and modes (3 k, m) at its nodes."""
    K, corners = system.touching.stiffness[c], system.corners[system.touching.face[c]]
    nodes = len(corners)
    for i in range(3):
        for a in range(nodes):
            row, target = system.modes[corners[a], i], own[nodes * i + a]
            for n in range(len(row)):
                target[n] = row[n]
            for j in range(3):
                low, high = min(i, j), max(i, j)
                for b in range(nodes):
                    square[nodes * i + a, nodes * j + b] = K[low, high, a, b]


@overload(newton.correct, jit_options={"error_model": "numpy"})
def _correct(system, residual, step):
    if not is_system(TipSystem, system):
        return None

    def correct(system, residual, step):
        for j in range(len(step)):
            step[j] = -residual[j]
        back_substitute(system.factor, step)

    return correct


descend = njit(newton.descend, error_model="numpy", nogil=True, cache=True)


@njit(cache=True, error_model="numpy", nogil=True)
def _response(tip, depth):
    """About a tenth of the least response to a tip so deep, in the energy norm."""
    return 0.1 * depth * tip.radius * math.sqrt(tip.stiffness / HARDNESS)


@njit(cache=True, error_model="numpy", nogil=True)
def settle(system, tip, q, work, depth, tolerance, most):
    """Equilibrium near q, in place: (status, iterations, energy, smallest det F).

    The tolerance is relative to the response, which is not known before; the depth says what it may
    be.
    """
    energy, smallest = newton.potential(system, q, work[0])
    status, iterations = newton.CONVERGED, 0
    least = _response(tip, SLIGHT * tip.radius)
    size = max(math.sqrt(np.dot(q, q)), _response(tip, depth), least)
    while True:
        status, more, energy, smallest = descend(
            system, q, work, energy, smallest, tolerance * size, 0.0, most, False, ROUND_OFF
        )
        iterations += more
        found = math.sqrt(np.dot(q, q))
        if status != newton.CONVERGED or size <= 2.0 * found or size <= least:
            return status, iterations, energy, smallest
        size = max(found, least)


@njit(cache=True, error_model="numpy", nogil=True)
def settle_stably(system, tip, q, work, depth, tolerance, most, tangent):
    """As ``settle``, but never in a saddle, and with the tangent at q factorised.

    ``tangent`` is where the system forms it.  Where tissue snaps, equilibria end in saddles; from
    one the search goes on the way down.
    """
    status, iterations, energy, smallest = settle(system, tip, q, work, depth, tolerance, most)
    saddles = 0
    while status == newton.CONVERGED and not newton.factorise(system, q, 0.0):
        saddles += 1
        if saddles > MOST_SADDLES or iterations >= most:
            return newton.STALLED, iterations, energy, smallest
        _leave_saddle(system, q, work, tangent)
        status, more, energy, smallest = settle(system, tip, q, work, depth, tolerance, most)
        iterations += more
    return status, iterations, energy, smallest


@njit(cache=True, error_model="numpy", nogil=True)
def _leave_saddle(system, q, work, tangent):
    """Move q, a saddle, along the eigenvector of the least eigenvalue of the tangent."""
    K = np.tril(tangent)
    K += np.tril(tangent, -1).T
    down = NUDGE * math.sqrt(np.dot(q, q)) * np.linalg.eigh(K)[1][:, 0]
    ahead, _ = newton.potential(system, q + down, work[3])
    back, _ = newton.potential(system, q - down, work[3])
    q += down if ahead < back else -down


@njit(cache=True, error_model="numpy", nogil=True)
def tip_system(models, k, slot, memory, scratch):
    """Local model k under the tip at ``scratch.position``, by reference."""
    nodes = slice(models.node_from[k], models.node_from[k + 1])
    faces = slice(models.face_from[k], models.face_from[k + 1])
    return bind_compiled(
        TipSystem(
            models.points.gradients[k],
            models.points.weights[k],
            models.points.mu[k],
            models.points.lam[k],
            models.tangent_points.gradients[k],
            models.tangent_points.weights[k],
            models.tangent_points.mu[k],
            models.tangent_points.lam[k],
            scratch.H,
            scratch.P,
            scratch.J,
            scratch.trace,
            scratch.linear,
            scratch.state,
            scratch.increments,
            memory.bulk[slot],
            memory.formed[slot],
            scratch.latest,
            scratch.tangent,
            scratch.factor[slot],
            models.tip,
            models.surface,
            models.nodes[nodes],
            models.modes[nodes],
            models.faces[faces],
            models.corners[faces],
            scratch.position,
            scratch.newton[1],
            scratch.moved,
            scratch.own,
            scratch.folded,
            scratch.square,
            scratch.product,
            scratch.touching,
        )
    )


@njit(cache=True, error_model="numpy", nogil=True)
def first_guess(models, k, x, depth, features, q):
    """First guess of model k with the tip at x so deep, by what was trained, into q (m,)."""
    tip_features(models.frames[k], models.centres[:, k], x, max(depth, 0.0), features)
    q[:] = 0.0
    for f in range(TIP_FEATURES):
        row = models.guess[k, f]
        for j in range(len(q)):
            q[j] += features[f] * row[j]


@njit(cache=True, error_model="numpy", nogil=True)
def _predict(memory, slot, x, q):
    """Follow the last answer's derivatives to the position x."""
    q[:] = 0.0
    for i in range(3):
        q += (x[i] - memory.position[i]) * memory.coupling[slot, i]
    back_substitute(memory.factor[slot], q)
    q += memory.q[slot]


@njit(cache=True, error_model="numpy", nogil=True)
def _take_over(models, k, x, memory, scratch, q):
    """Project the answer of the nearest neighbour that has one, as it is at x; False without."""
    source, at, least = -1, -1, np.inf
    for i in range(models.neighbour_from[k], models.neighbour_from[k + 1]):
        n = models.neighbours[i]
        for slot in range(MAX_ACTIVE):
            if memory.patch[slot] == n and scratch.distance[n] < least:
                source, at, least = slot, i, scratch.distance[n]
    if source < 0:
        return False
    followed = scratch.newton[0]
    _predict(memory, source, x, followed)
    for i in range(len(q)):
        row, total = models.overlaps[at, i], 0.0
        for j in range(len(q)):
            total += row[j] * followed[j]
        q[i] = total
    return True


@njit(cache=True, error_model="numpy", nogil=True)
def settle_on_the_way(system, tip, q, work, depth, normal, tangent):
    """As ``settle_stably``, from rest along the way in, for where a jump fails."""
    at = system.x
    away = depth * normal
    at += away
    q[:] = 0.0
    status, iterations, energy, smallest = newton.CONVERGED, 0, 0.0, 1.0
    for _ in range(RAMP):
        if status == newton.CONVERGED:
            at -= away / RAMP
            status, more, energy, smallest = settle_stably(
                system, tip, q, work, depth, TOLERANCE, MAX_ITERATIONS, tangent
            )
            iterations += more
    return status, iterations, energy, smallest


@njit(cache=True, error_model="numpy", nogil=True)
def _solve(models, k, slot, x, normal, depth, most, memory, scratch, outcome):
    """Equilibrium of model k, its force and tangent, into the outcome's slot."""
    q = outcome.q[slot]
    if memory.patch[slot] == k:
        _predict(memory, slot, x, q)
    else:
        memory.formed[slot] = np.inf
        if not _take_over(models, k, x, memory, scratch, q):
            first_guess(models, k, x, depth, scratch.features, q)
    scratch.position[:] = x
    scratch.latest[:] = np.inf
    system = tip_system(models, k, slot, memory, scratch)
    tolerance = TOLERANCE / max(outcome.weight[slot], LEAST_SHARE)
    status, iterations, energy, smallest = settle_stably(
        system, models.tip, q, scratch.newton, depth, tolerance, most, scratch.tangent
    )
    if status != newton.CONVERGED and depth > 0.0 and most == MAX_ITERATIONS:
        status, more, energy, smallest = settle_on_the_way(
            system, models.tip, q, scratch.newton, depth, normal, scratch.tangent
        )
        iterations += more
    if status == newton.CONVERGED:
        coupling, force = scratch.coupling[slot], outcome.forces[slot]
        react(system, coupling, force, outcome.tangents[slot])
        residual, step = scratch.newton[0], scratch.newton[1]
        newton.correct(system, residual, step)
        energy += 0.5 * np.dot(residual, step)
        q += step
        for i in range(3):
            force[i] += np.dot(coupling[i], step)
    else:
        outcome.forces[slot] = 0.0
        outcome.tangents[slot] = 0.0
    outcome.patch[slot] = k if status == newton.CONVERGED else -2 - k
    scalars, touching = outcome.scalars, scratch.touching
    scalars[STATUS] = max(scalars[STATUS], float(status))
    scalars[ITERATIONS] = max(scalars[ITERATIONS], float(iterations))
    scalars[SMALLEST_J] = min(scalars[SMALLEST_J], smallest)
    scalars[ENERGY] += outcome.weight[slot] * energy
    scalars[PENETRATION] = max(scalars[PENETRATION], touching.deepest[0])
    scalars[TOUCHED] += touching.touched[0]


@njit(cache=True, error_model="numpy", nogil=True)
def _remember(memory, scratch, outcome, x):
    """Start the next search from these answers; from those before where one is no equilibrium."""
    found = outcome.scalars[STATUS] == newton.CONVERGED
    for slot in range(MAX_ACTIVE):
        if outcome.weight[slot] > 0.0:
            if found:
                memory.q[slot] = outcome.q[slot]
                memory.factor[slot] = scratch.factor[slot]
                memory.coupling[slot] = scratch.coupling[slot]
            elif outcome.patch[slot] != memory.patch[slot]:
                memory.formed[slot] = np.inf  # of another model, or far off
    if found:
        memory.patch[:] = outcome.patch
        memory.position[:] = x


@njit(cache=True, error_model="numpy", nogil=True)
def react(system, coupling, force, tangent):
    """Force, its derivative and B of an equilibrium whose tangent has just been factorised."""
    touching, folded = system.touching, system.folded
    count, nodes = touching.touched[0], system.corners.shape[1]
    reaction(touching, count, force)
    coupling[:] = 0.0
    # a tip that moves by dx does what nodes do that all move by -dx
    for c in range(count):
        for i in range(3):
            target = coupling[i]
            for a in range(nodes):
                row = folded[nodes * (3 * c + i) + a]
                for n in range(len(row)):
                    target[n] += row[n]
    step = system.step
    for i in range(3):
        step[:] = coupling[i]
        back_substitute(system.factor, step)
        for j in range(3):
            tangent[j, i] = np.dot(coupling[j], step) - touching.own[j, i]


@njit(cache=True, error_model="numpy", nogil=True)
def weight_gradients(models, outcome, x, scratch):
    """Gradients of the weights in the tip's position, into ``scratch.fade``."""
    fade, centres, weight = scratch.fade, models.centres, outcome.weight
    fade[:] = 0.0
    nearest = 0
    for k in range(len(scratch.distance)):
        if scratch.distance[k] < scratch.distance[nearest]:
            nearest = k
    least = math.sqrt(scratch.distance[nearest])
    whole = 0.0
    for slot in range(MAX_ACTIVE):
        if weight[slot] > 0.0:
            k = outcome.patch[slot]
            k = k if k >= 0 else -2 - k
            own = math.sqrt(scratch.distance[k])
            excess = (own - least) / models.blend
            whole += (1.0 - excess) ** 2 * (1.0 + 2.0 * excess)
            for i in range(3):
                away = (x[i] - centres[i, k]) / max(own, 1e-12)
                away -= (x[i] - centres[i, nearest]) / max(least, 1e-12)
                fade[slot, i] = -6.0 * excess * (1.0 - excess) * away / models.blend
    for i in range(3):
        total = fade[:, i].sum()
        for slot in range(MAX_ACTIVE):
            fade[slot, i] = (fade[slot, i] - weight[slot] * total) / whole


@njit(cache=True, error_model="numpy", nogil=True)
def query(solver, x, most):
    """Answer the tip's centre ``x`` (3,) mm into the solver's outcome.

    At ``most`` so many iterations are made in a patch; only with ``MAX_ITERATIONS`` is the way in
    tried too where a jump fails.  A centre that is beyond the tip's radius from the surface, or
    below it, is not solved: the depth in the outcome tells.
    """
    models, memory, scratch, outcome = (
        solver.models, solver.memory, solver.scratch, solver.outcome,
    )  # fmt: skip
    scalars, foot, upward = outcome.scalars, outcome.foot, outcome.upward
    scalars[:] = 0.0
    scalars[SMALLEST_J] = 1.0
    outcome.force[:] = 0.0
    outcome.tangent[:] = 0.0
    outcome.weight[:] = 0.0
    outcome.errors[:] = 0.0
    outcome.features[:] = 0.0
    distance = locate(solver.ground, x, scratch.ground, foot, upward, outcome.limit)
    outcome.point[:] = foot
    outcome.normal[:] = upward
    above = 0.0
    for i in range(3):
        above += (x[i] - foot[i]) * upward[i]
    radius = models.tip.radius
    beside = abs(above) < UPRIGHT * distance
    depth = radius - (distance if beside else math.copysign(distance, above))
    scalars[DEPTH], scalars[DISTANCE], scalars[BESIDE] = depth, distance, 1.0 if beside else 0.0
    if depth > radius or depth < -SKIN * radius:
        return
    outcome.patch[:] = memory.patch
    activate(models, x, outcome, scratch.distance, outcome.weight)
    weight_gradients(models, outcome, x, scratch)
    for slot in range(MAX_ACTIVE):
        if outcome.weight[slot] > 0.0:
            k = outcome.patch[slot]
            k = k if k >= 0 else -2 - k
            _solve(models, k, slot, x, upward, depth, most, memory, scratch, outcome)
            share = outcome.weight[slot]
            for i in range(3):
                outcome.force[i] += share * outcome.forces[slot, i]
                for j in range(3):
                    outcome.tangent[i, j] += (
                        share * outcome.tangents[slot, i, j]
                        + outcome.forces[slot, i] * scratch.fade[slot, j]
                    )
    _remember(memory, scratch, outcome, x)
    if scalars[TOUCHED] > 0.0:
        _conclude(solver, x)


@njit(cache=True, error_model="numpy", nogil=True)
def _conclude(solver, x):
    """Where the force acts, and the estimated errors: ``log error = c . features``.

    The features: 1, the depth over its limit and its log, smallest det F, the normal (where on the
    body), and the logs of force over depth (mN/mm), of the energy over that of a linear spring, and
    of the residual that such answers leave in the full model.
    """
    outcome = solver.outcome
    scalars, features, force = outcome.scalars, outcome.features, outcome.force
    pushed = math.sqrt(np.dot(force, force))
    if pushed > 0.0:
        for i in range(3):
            outcome.normal[i] = force[i] / pushed
            outcome.point[i] = x[i] - solver.models.tip.radius * outcome.normal[i]
    depth = max(scalars[DEPTH], 1e-6)
    share = depth / max(outcome.limit[0], 1e-6)
    features[0], features[1], features[2] = 1.0, share, math.log(share)
    features[3] = scalars[SMALLEST_J]
    features[4:7] = outcome.upward
    features[7] = math.log(max(pushed / depth, 1e-6))
    features[8] = math.log(max(2.0 * scalars[ENERGY] / max(pushed * depth, 1e-9), 1e-3))
    features[9] = _residual(solver.models, x, share, solver.scratch, outcome)
    for i in range(3):
        outcome.errors[i] = math.exp(np.dot(solver.coefficients[i], features))


@njit(cache=True, error_model="numpy", nogil=True)
def _residual(models, x, share, scratch, outcome):
    """Log of the residual in the full model at a share of the largest depth, as trained."""
    log, inward, features = 0.0, scratch.inward, scratch.residual_features
    for i in range(3):
        inward[i] = -outcome.upward[i]
    for slot in range(MAX_ACTIVE):
        if outcome.weight[slot] > 0.0:
            k = outcome.patch[slot] if outcome.patch[slot] >= 0 else -2 - outcome.patch[slot]
            frame, centre = models.frames[k], models.centres[:, k]
            residual_features(frame, centre, x, inward, share, features)
            log += outcome.weight[slot] * np.dot(models.residuals[k], features)
    return log


_WEIGHT = slice(0, MAX_ACTIVE)
_FORCE, _POINT, _NORMAL = (slice(_WEIGHT.stop + 3 * i, _WEIGHT.stop + 3 * i + 3) for i in range(3))
_TANGENT = slice(_NORMAL.stop, _NORMAL.stop + 9)
_FEATURES = slice(_TANGENT.stop, _TANGENT.stop + TIP_ERROR_FEATURES)
_ERRORS = slice(_FEATURES.stop, _FEATURES.stop + 3)
_LIMIT = slice(_ERRORS.stop, _ERRORS.stop + 1)
_SCALARS = slice(_LIMIT.stop, _LIMIT.stop + SCALARS)
"""Where the parts of an outcome lie in a state's record."""


class TipState:
    """Working memory and last answer of one caller under the tip.

    Parameters
    ----------
    models : TipModels
    ground : SurfaceIndex
        Accessible surface with the largest depth (v, 1) mm at its vertices.
    coefficients : ndarray, shape (3, TIP_ERROR_FEATURES)
        Of the error estimate: displacement, von Mises stress, force.
    """

    def __init__(self, models: TipModels, ground: SurfaceIndex, coefficients: Array) -> None:
        self.radius = models.tip.radius
        count, m, entries = models.points.gradients.shape
        tangent_entries = models.tangent_points.gradients.shape[2]
        points = LANES * (entries // TILE)
        faces, rows = int(np.diff(models.face_from).max()), 3 * models.corners.shape[1]
        self.memory = TipMemory(
            patch=np.full(MAX_ACTIVE, -1, np.int64),
            q=np.zeros((MAX_ACTIVE, m)),
            bulk=np.zeros((MAX_ACTIVE, m, m)),
            formed=np.zeros((MAX_ACTIVE, m)),
            factor=np.zeros((MAX_ACTIVE, m, m)),
            coupling=np.zeros((MAX_ACTIVE, 3, m)),
            position=np.zeros(3),
        )
        self.scratch = scratch = TipScratch(
            H=np.zeros(entries, np.float32),
            P=np.zeros(entries, np.float32),
            J=np.zeros(points),
            trace=np.zeros(points),
            linear=np.zeros(points),
            state=np.zeros(STATE * LANES * (tangent_entries // TILE), np.float32),
            increments=np.zeros((m, tangent_entries), np.float32),
            latest=np.zeros(m),
            tangent=np.zeros((m, m)),
            newton=np.zeros((4, m)),
            position=np.zeros(3),
            factor=np.zeros((MAX_ACTIVE, m, m)),
            coupling=np.zeros((MAX_ACTIVE, 3, m)),
            moved=np.zeros(models.surface.nodes.shape),
            own=np.zeros((rows * faces, m)),
            folded=np.zeros((rows * faces, m)),
            square=np.zeros((rows, rows)),
            product=np.zeros((m, m)),
            touching=room_for(models.surface, faces),
            distance=np.zeros(count),
            fade=np.zeros((MAX_ACTIVE, 3)),
            features=np.zeros(TIP_FEATURES),
            residual_features=np.zeros(RESIDUAL_FEATURES),
            inward=np.zeros(3),
            ground=np.zeros(len(ground.radii) + 3),
        )
        # one array, so that an answer is kept by one copy
        self.record = record = np.zeros(_SCALARS.stop)
        self.outcome = outcome = TipOutcome(
            patch=np.full(MAX_ACTIVE, -1, np.int64),
            q=np.zeros((MAX_ACTIVE, m)),
            weight=record[_WEIGHT],
            foot=np.zeros(3),
            upward=np.zeros(3),
            force=record[_FORCE],
            tangent=record[_TANGENT].reshape(3, 3),
            point=record[_POINT],
            normal=record[_NORMAL],
            forces=np.zeros((MAX_ACTIVE, 3)),
            tangents=np.zeros((MAX_ACTIVE, 3, 3)),
            limit=record[_LIMIT],
            features=record[_FEATURES],
            errors=record[_ERRORS],
            scalars=record[_SCALARS],
        )
        solver = TipSolver(
            models, ground, np.ascontiguousarray(coefficients), self.memory, scratch, outcome
        )
        self.bound = bind(solver)

    def forget(self) -> None:
        """Make the next answer independent of those before."""
        self.memory.patch[:] = -1

    def go_on(self) -> None:
        """Start the next search where the last one ended, which found no equilibrium."""
        memory, outcome = self.memory, self.outcome
        numbers = np.where(outcome.patch >= 0, outcome.patch, -2 - outcome.patch)
        memory.patch[:] = np.where(outcome.weight > 0.0, numbers, -1)
        memory.q[:] = outcome.q
        memory.formed[:] = np.inf
        memory.factor[:] = np.eye(memory.q.shape[1])
        memory.coupling[:] = 0.0  # the answer to another position is unknown


class Touch(NamedTuple):
    """Answer to a position of the tip.

    Attributes
    ----------
    position : ndarray, shape (3,), mm
        Centre of the tip.
    contact : bool
        Whether it touches the tissue.
    force : ndarray, shape (3,), mN
        On the tool.
    tangent : ndarray, shape (3, 3), mN/mm
        Derivative of the force in the position.
    contact_point : ndarray, shape (3,), mm
        Where the force acts on the tip; without contact, the surface point nearest to it.
    normal : ndarray, shape (3,)
        Unit vector from there to the tip's centre; without contact, the surface's normal.
    depth : float, mm
        How far the tip overlaps the undeformed surface; negative away from it.
    depth_limit : float, mm
        Largest trained depth there.
    penetration : float, mm
        How far at most the tip overlaps the deformed surface.
    energy : float, mN mm
        Stored in tissue and contact; of tissue that remembers, the potential of its last step.
    converged : bool
    iterations : int
    in_range : bool
        Whether the position is of the kind the model was trained and validated for.
    out_of_range : tuple of str
        ``depth``, or ``position`` where the tip is beside the surface.
    error_displacement, error_von_mises, error_force : float
        Estimated relative errors against the full model, calibrated to cover 95 % of cases.
    min_jacobian : float
        Smallest det F among the cubature points.
    features : ndarray, shape (TIP_ERROR_FEATURES,)
        What the error estimate is made of.
    patches : tuple of (int, float, ndarray)
        Active patches: number, weight, answer (m,) in the patch's modes under
        the tip; see ``ReducedModel.displacement``.
    solve_seconds : float
    time : float, s
        Since rest, of tissue that remembers.
    active : tuple of (int, float, Local)
        Of such tissue, the active patches with all that they remember.
    """

    position: Array
    contact: bool
    force: Array
    tangent: Array
    contact_point: Array
    normal: Array
    depth: float
    depth_limit: float
    penetration: float
    energy: float
    converged: bool
    iterations: int
    in_range: bool
    out_of_range: tuple[str, ...]
    error_displacement: float
    error_von_mises: float
    error_force: float
    min_jacobian: float
    features: Array
    patches: tuple[tuple[int, float, Array], ...]
    solve_seconds: float
    time: float = 0.0
    active: tuple[tuple[int, float, Local], ...] = ()


def answer(state: TipState, position: Array, started: float, most: int = MAX_ITERATIONS) -> Touch:
    """Answer a finite position of the tip; ``started`` is when the clock began to run, s.

    For ``most`` see ``query``.

    Raises
    ------
    QueryError
        If the tip's centre lies below the surface.
    """
    query(state.bound, position, most)
    record, outcome, radius = state.record.copy(), state.outcome, state.radius
    weights, scalars = record[_WEIGHT].tolist(), record[_SCALARS].tolist()
    errors, limit = record[_ERRORS].tolist(), record[_LIMIT].item()
    depth = scalars[DEPTH]
    if depth > radius:
        raise QueryError(
            "position",
            f"the tip's centre lies {depth - radius:.2f} mm below the accessible surface",
        )
    contact = scalars[TOUCHED] > 0
    out_of_range: tuple[str, ...] = ()
    if contact and scalars[BESIDE]:
        out_of_range += ("position",)
    if depth > limit * (1 + 1e-9):
        out_of_range += ("depth",)
    patches = []
    if contact:
        for slot, weight in enumerate(weights):
            if weight > 0:
                k = int(outcome.patch[slot])
                patches.append((k if k >= 0 else -2 - k, weight, outcome.q[slot].copy()))
    return Touch(
        position=position,
        contact=contact,
        force=record[_FORCE],
        tangent=record[_TANGENT].reshape(3, 3),
        contact_point=record[_POINT],
        normal=record[_NORMAL],
        depth=depth,
        depth_limit=limit,
        penetration=scalars[PENETRATION],
        energy=scalars[ENERGY],
        converged=scalars[STATUS] == newton.CONVERGED,
        iterations=int(scalars[ITERATIONS]),
        in_range=not out_of_range,
        out_of_range=out_of_range,
        error_displacement=errors[0],
        error_von_mises=errors[1],
        error_force=errors[2],
        min_jacobian=scalars[SMALLEST_J],
        features=record[_FEATURES],
        patches=tuple(patches),
        solve_seconds=time.perf_counter() - started,
    )
