"""The reduced model in time: history at the cubature points of the local models in use.

Theory.  See ``mechanics.viscosity`` for the law and ``reduced.press`` for local models.  A step
finds the equilibrium in the wide space ``u = B c`` of a local model.  Like linear elasticity,
linear visco-elasticity needs no cubature: with ``D = B^T K_dev B``, ``K_dev`` the deviatoric part
of the rest stiffness, and the means ``z_a`` of the answers over the past, its potential is

    c.c/2 - sum_a g_a c . D (decay_a z_a + old_a c_n + new_a c/2) - f . c.

Only what the law adds to that is summed over the cubature points, each of which keeps its history
(``mechanics.viscosity``; a local model has the same points for the elastic part).

When another local model takes over, the history follows.  Its displacements are projected on the
new wide space in the energy of the rest state.  They are few: *knots* of the path of answers, each
with its weight in the mean of every term.  A step adds a knot; where there are too many, two
neighbours become their mean, those that the sum of squared distances misses least (Ward, J. Am.
Stat. Assoc. 58 (1963) 236-244).  The new points' histories are the weighted sums of what the knots
drive them to, with the linear part corrected to the exact means.  What the new space cannot hold,
such as a dent that the tool has left far behind, *remains*: it recovers by linear visco-elasticity
in the space it was made in (``Remains``), beside the answer of the new one, and costs nothing until
fields are asked for.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numba.extending import overload
from numpy.typing import NDArray

from palpate.shared.mechanics import newton, tissue, viscosity
from palpate.shared.reduced.press import (
    DISTANCE,
    LANES,
    LIMIT,
    ROUND_OFF,
    TILE,
    TILT,
    activate,
    added_energy,
    aim,
    correct_by_secants,
    descend,
    forget_secants,
    is_system,
    load_patch,
    multiply,
    nonlinear_stress,
    project,
    superpose,
)

Array = NDArray[np.float64]
Field = NDArray[np.float32]

FAST = {"contract", "reassoc", "nsz"}

KNOTS = 8
"""Of the path of answers; the last is the last answer."""

SYMMETRIC = 6
"""Components of a symmetric tensor, in the order of ``mechanics.viscosity``."""

ACCURATE = 1e-3
"""Residual at equilibrium relative to load and past, as ``reduced.press.TOLERANCE``."""

AT_REST = 3e-7
"""Residual in the energy norm, (mN mm)^(1/2), that counts as equilibrium under any load: where all
is lifted before time passes nothing is left to be relative to, and energies drown in round-off."""

MOST_ITERATIONS = 40
MOST_ITERATIONS_ANEW = 200


class Memory(NamedTuple):
    """What one local model remembers: views of a record, which is copied and passed as one."""

    wide: Array  # (r,) last answer
    pull: Array  # (r,) of load and past on linear tissue, at the last answer
    mean: Array  # (terms, r) of the answers over the past
    points: Field  # (terms + 1, 6 c) histories of the cubature points, in tiles
    linear: Field  # (terms + 1, 6 c) minus their linear part: of 2 dev sym H
    knots: Array  # (KNOTS, r)
    share: Array  # (KNOTS, terms) weight of a knot in each mean; sums to 1
    secants: Array  # (r, r) inverse tangent, see reduced.press.WideSystem


@njit(cache=True, error_model="numpy", nogil=True)
def cut(record, start, rows, columns):
    """Part of a record (n,) as (rows, columns), and where it ends."""
    stop = start + rows * columns
    return record[start:stop].reshape(rows, columns), stop


@njit(cache=True, error_model="numpy", nogil=True)
def opened(record, terms, modes, points):
    """Memory in a record (n,) of ``new_record``, which starts with the last answer."""
    answers, at = cut(record, 0, 2, modes)
    mean, at = cut(record, at, terms, modes)
    knots, at = cut(record, at, KNOTS, modes)
    share, at = cut(record, at, KNOTS, terms)
    secants, at = cut(record, at, modes, modes)
    histories = record[at:].view(np.float32).reshape(2, terms + 1, SYMMETRIC * points)
    return Memory(
        answers[0], answers[1], mean, histories[0], histories[1], knots, share, secants
    )  # fmt: skip


def new_record(terms: int, modes: int, points: int) -> Array:
    """Record of a local model that nothing has happened to."""
    size = modes * (2 + terms + KNOTS + modes) + KNOTS * terms
    record = np.zeros(size + (terms + 1) * SYMMETRIC * points)
    memory = opened(record, terms, modes, points)
    memory.share[-1] = 1.0
    memory.secants[:] = np.eye(modes)
    return record


class Scratch(NamedTuple):
    """Working memory of a step."""

    H: Field  # (9 c,)
    P: Field  # (9 c,)
    J: Array  # (c,)
    trace: Array  # (c,)
    linear: Array  # (c,)
    B: Field  # (6 c,) in tiles, what the past drives the points to
    S: Field  # (6 c,) in tiles, kPa, the linear part of it
    stepped: Field  # (r,)
    origin: Array  # (2, r)
    latest: Array  # (r,)
    change: Array  # (r,)
    load: Array  # (r,)
    past: Array  # (r,)
    newton: Array  # (4, r)
    start: Array  # (r,)


def new_scratch(modes: int, points: int) -> Scratch:
    """Of models with so many modes and points."""
    return Scratch(
        H=np.zeros(9 * points, np.float32),
        P=np.zeros(9 * points, np.float32),
        J=np.zeros(points),
        trace=np.zeros(points),
        linear=np.zeros(points),
        B=np.zeros(SYMMETRIC * points, np.float32),
        S=np.zeros(SYMMETRIC * points, np.float32),
        stepped=np.zeros(modes, np.float32),
        origin=np.zeros((2, modes)),
        latest=np.zeros(modes),
        change=np.zeros(modes),
        load=np.zeros(modes),
        past=np.zeros(modes),
        newton=np.zeros((4, modes)),
        start=np.zeros(modes),
    )


# --- the law at many points ----------------------------------------------------------------------


@njit(cache=True, error_model="numpy", forceinline=True)
def inverse_cube_root(J):
    """``J^(-1/3)`` to double precision for J from 0.2 to 5 by Newton's method: vector code."""
    y = 3.0 / (2.0 + J)
    for _ in range(5):
        y *= (4.0 - J * y * y * y) / 3.0
    return y


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def predict_points(history, linear, weights, mu, B, S):
    """What is known of the end of a step before it is solved.

    Parameters
    ----------
    history, linear : ndarray, shape (terms + 1, 6 c)
        See ``Memory``.
    weights : Weights
    mu : ndarray, shape (c,), kPa
    B, S : ndarray, shape (6 c,), out
        ``B`` of ``mechanics.viscosity``, and minus the stress (kPa) that it leads to if linear.
    """
    terms = len(history) - 1
    loss = 0.0
    for a in range(terms):
        loss += weights.share[a] * weights.new[a]
    _recall_mean(history, weights, B)
    _recall_mean(linear, weights, S)
    for tile in range(len(mu) // LANES):
        b = B[SYMMETRIC * LANES * tile : SYMMETRIC * LANES * (tile + 1)]
        s = S[SYMMETRIC * LANES * tile : SYMMETRIC * LANES * (tile + 1)]
        m = mu[LANES * tile : LANES * (tile + 1)]
        for c in range(3 * LANES):
            b[c] -= np.float32(loss)
        for i in range(SYMMETRIC):
            for c in range(LANES):
                s[LANES * i + c] *= m[c]
    return loss


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def _recall_mean(history, weights, out):
    """``sum g (decay z + old last)`` of a history (terms + 1, n)."""
    terms = len(history) - 1
    last = history[terms]
    out[:] = np.float32(0.0)
    for a in range(terms):
        row = history[a]
        kept = np.float32(weights.share[a] * weights.decay[a])
        old = np.float32(weights.share[a] * weights.old[a])
        for i in range(len(out)):
            out[i] += kept * row[i] + old * last[i]


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def add_past_stress(H, weights, mu, J, B, S, loss, energy, P):
    """Add what the past does beyond linear visco-elasticity, times weight, to the stress ``P``.

    ``energy`` (c,) is overwritten with its energy density (kPa), but for a constant.
    """
    for tile in range(len(weights) // LANES):
        h, p = H[TILE * tile : TILE * (tile + 1)], P[TILE * tile : TILE * (tile + 1)]
        b = B[SYMMETRIC * LANES * tile : SYMMETRIC * LANES * (tile + 1)]
        s = S[SYMMETRIC * LANES * tile : SYMMETRIC * LANES * (tile + 1)]
        at = LANES * tile
        w, m, j, e = (
            weights[at : at + LANES], mu[at : at + LANES], J[at : at + LANES],
            energy[at : at + LANES],
        )  # fmt: skip
        for c in range(LANES):
            h0, h1, h2 = float(h[c]), float(h[LANES + c]), float(h[2 * LANES + c])
            h3, h4, h5 = float(h[3 * LANES + c]), float(h[4 * LANES + c]), float(h[5 * LANES + c])
            h6, h7, h8 = float(h[6 * LANES + c]), float(h[7 * LANES + c]), float(h[8 * LANES + c])
            b0, b1, b2 = float(b[c]), float(b[LANES + c]), float(b[2 * LANES + c])
            b3, b4, b5 = float(b[3 * LANES + c]), float(b[4 * LANES + c]), float(b[5 * LANES + c])
            root = inverse_cube_root(j[c])
            scale = m[c] * root * root
            contraction, q0, q1, q2, q3, q4, q5, q6, q7, q8 = viscosity.overstress(
                1.0 + h0, h1, h2, h3, 1.0 + h4, h5, h6, h7, 1.0 + h8,
                b0, b1, b2, b3, b4, b5, j[c], scale,
            )  # fmt: skip
            # linear: -(S + 2 mu loss dev sym H)
            soft = loss * m[c]
            third = (h0 + h4 + h8) / 3.0
            l0, l1, l2 = (
                2.0 * soft * (h0 - third),
                2.0 * soft * (h4 - third),
                2.0 * soft * (h8 - third),
            )
            l3, l4, l5 = soft * (h5 + h7), soft * (h2 + h6), soft * (h1 + h3)
            s0, s1, s2 = float(s[c]), float(s[LANES + c]), float(s[2 * LANES + c])
            s3, s4, s5 = float(s[3 * LANES + c]), float(s[4 * LANES + c]), float(s[5 * LANES + c])
            e[c] = (
                0.5 * (scale * contraction - m[c] * (b0 + b1 + b2))
                + (s0 + 0.5 * l0) * h0 + (s1 + 0.5 * l1) * h4 + (s2 + 0.5 * l2) * h8
                + (s3 + 0.5 * l3) * (h5 + h7) + (s4 + 0.5 * l4) * (h2 + h6)
                + (s5 + 0.5 * l5) * (h1 + h3)
            )  # fmt: skip
            t0, t1, t2, t3, t4, t5 = s0 + l0, s1 + l1, s2 + l2, s3 + l3, s4 + l4, s5 + l5
            p[c] += w[c] * (q0 + t0)
            p[LANES + c] += w[c] * (q1 + t5)
            p[2 * LANES + c] += w[c] * (q2 + t4)
            p[3 * LANES + c] += w[c] * (q3 + t5)
            p[4 * LANES + c] += w[c] * (q4 + t1)
            p[5 * LANES + c] += w[c] * (q5 + t3)
            p[6 * LANES + c] += w[c] * (q6 + t4)
            p[7 * LANES + c] += w[c] * (q7 + t3)
            p[8 * LANES + c] += w[c] * (q8 + t2)


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def drive_points(H, m, linear):
    """``m - I`` of ``mechanics.viscosity`` (6 c,) in tiles, of displacement gradients (9 c,).

    ``linear`` (6 c,) is ``2 dev sym H``, minus its linear part.
    """
    for tile in range(len(H) // TILE):
        h = H[TILE * tile : TILE * (tile + 1)]
        d = m[SYMMETRIC * LANES * tile : SYMMETRIC * LANES * (tile + 1)]
        e = linear[SYMMETRIC * LANES * tile : SYMMETRIC * LANES * (tile + 1)]
        for c in range(LANES):
            m0, m1, m2, m3, m4, m5 = viscosity.driven(
                1.0 + h[c], float(h[LANES + c]), float(h[2 * LANES + c]),
                float(h[3 * LANES + c]), 1.0 + h[4 * LANES + c], float(h[5 * LANES + c]),
                float(h[6 * LANES + c]), float(h[7 * LANES + c]), 1.0 + h[8 * LANES + c],
            )  # fmt: skip
            d[c], d[LANES + c], d[2 * LANES + c] = m0, m1, m2
            d[3 * LANES + c], d[4 * LANES + c], d[5 * LANES + c] = m3, m4, m5
            third = (h[c] + h[4 * LANES + c] + h[8 * LANES + c]) / np.float32(3.0)
            e[c] = np.float32(2.0) * (h[c] - third)
            e[LANES + c] = np.float32(2.0) * (h[4 * LANES + c] - third)
            e[2 * LANES + c] = np.float32(2.0) * (h[8 * LANES + c] - third)
            e[3 * LANES + c] = h[5 * LANES + c] + h[7 * LANES + c]
            e[4 * LANES + c] = h[2 * LANES + c] + h[6 * LANES + c]
            e[5 * LANES + c] = h[LANES + c] + h[3 * LANES + c]


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def advance_points(m, weights, history):
    """Go to the end of a step, where the points are driven to ``m`` (6 c,); history in place."""
    terms = len(history) - 1
    last = history[terms]
    for a in range(terms):
        row = history[a]
        decay, old, new = (
            np.float32(weights.decay[a]), np.float32(weights.old[a]), np.float32(weights.new[a]),
        )  # fmt: skip
        for i in range(len(row)):
            row[i] = decay * row[i] + old * last[i] + new * m[i]
    for i in range(len(last)):
        last[i] = m[i]


# --- a step of one local model as a system for mechanics.newton --------------------------------


class PastSystem(NamedTuple):
    """A patch under a load and its past, in all its wide modes; see ``WideSystem``."""

    gradients: NDArray[np.int16]  # (r, 9 c) in tiles
    steps: Field  # (r,) 1/mm
    weights: Array  # (c,) mm^3
    mu: Array  # (c,) kPa
    lam: Array  # (c,) kPa
    deviatoric: Field  # (r, r) D
    load: Array  # (r,) with what the past exerts
    loss: float  # sum of g new
    B: Field  # (6 c,)
    S: Field  # (6 c,)
    H: Field  # (9 c,)
    P: Field  # (9 c,)
    J: Array  # (c,)
    trace: Array  # (c,)
    linear: Array  # (c,)
    stepped: Field  # (r,)
    secants: Array  # (r, r)
    origin: Array  # (2, r)
    latest: Array  # (r,)
    change: Array  # (r,)


@overload(newton.potential, jit_options={"error_model": "numpy"})
def _potential(system, u, residual):
    if not is_system(PastSystem, system):
        return None

    def potential(system, u, residual):
        steps, stepped = system.steps, system.stepped
        for i in range(len(u)):
            stepped[i] = u[i] * steps[i]
        superpose(system.gradients, stepped, system.H)
        J, trace, linear = system.J, system.trace, system.linear
        weights, mu, lam = system.weights, system.mu, system.lam
        nonlinear_stress(system.H, weights, mu, lam, J, trace, linear, system.P)
        smallest = J.min()
        if not smallest > 0.0:
            return tissue.INVERTED, smallest
        energy = added_energy(weights, mu, lam, J, trace, linear)
        # trace has served; its room is that of the energies
        add_past_stress(system.H, weights, mu, J, system.B, system.S, system.loss, trace, system.P)
        energy += np.dot(weights, trace)
        project(system.gradients, system.P, residual)
        softer = system.change  # its room; the secants need it later
        multiply(system.deviatoric, u, softer)
        for i in range(len(u)):
            system.latest[i] = u[i]
            stiff = u[i] - system.loss * softer[i]
            residual[i] = residual[i] * steps[i] + stiff - system.load[i]
            energy += (0.5 * stiff - system.load[i]) * u[i]
        return energy, smallest

    return potential


@overload(newton.factorise, jit_options={"error_model": "numpy"})
def _factorise(system, u, shift):
    if not is_system(PastSystem, system):
        return None
    # the secants are always those of the last steps
    return lambda system, u, shift: True


@overload(newton.correct, jit_options={"error_model": "numpy"})
def _correct(system, residual, step):
    if not is_system(PastSystem, system):
        return None
    return lambda system, residual, step: correct_by_secants(system, residual, step)


@njit(cache=True, error_model="numpy", nogil=True)
def step_patch(patches, k, deviatoric, time, load, memory, scratch, accurate=ACCURATE):
    """Equilibrium of local model k under a load at the end of a time step.

    Parameters
    ----------
    patches : Patches
    deviatoric : ndarray, shape (r, r)
    time : Weights
        Of the step.
    load : ndarray, shape (r,)
    memory : Memory
        Goes to the end of the step if that has an answer, else it stays as it is.
    scratch : Scratch
    accurate : float
        Residual at equilibrium relative to load and past.

    Returns
    -------
    status, iterations : int
        As ``mechanics.newton.newton``.
    smallest : float
        Smallest det F.
    """
    gradients, steps, weights = patches.gradients[k], patches.steps[k], patches.weights[k]
    mu, lam = patches.mu[k], patches.lam[k]
    wide, mean, pull, terms = memory.wide, memory.mean, memory.pull, len(memory.mean)
    past, exerted, pressed = scratch.past, scratch.change, scratch.load
    past[:] = 0.0
    for a in range(terms):
        g = time.share[a]
        for i in range(len(past)):
            past[i] += g * (time.decay[a] * mean[a, i] + time.old[a] * wide[i])
    loss = predict_points(memory.points, memory.linear, time, mu, scratch.B, scratch.S)
    size = 0.0
    multiply(deviatoric, past, exerted)
    for i in range(len(past)):
        pressed[i] = load[i] + exerted[i]
        size += max(load[i] ** 2, exerted[i] ** 2)
    target = max(accurate * math.sqrt(size), AT_REST)
    system = PastSystem(
        gradients, steps, weights, mu, lam, deviatoric, pressed, loss, scratch.B, scratch.S,
        scratch.H, scratch.P, scratch.J, scratch.trace, scratch.linear, scratch.stepped,
        memory.secants, scratch.origin, scratch.latest, scratch.change,
    )  # fmt: skip
    start, work = scratch.start, scratch.newton
    pulled, change = work[0], scratch.change  # their room
    multiply(deviatoric, wide, change)
    for i in range(len(wide)):
        pulled[i] = pressed[i] + loss * change[i] - pull[i]
    status, iterations, smallest = newton.STALLED, 0, 0.0
    multiply(memory.secants, pulled, start)  # what is not linear does not change
    for attempt in range(2):
        most = MOST_ITERATIONS if attempt == 0 else MOST_ITERATIONS_ANEW
        scratch.origin[:] = np.nan
        if attempt == 1:
            forget_secants(memory.secants, scratch.origin)
            start[:] = 0.0
        start += wide
        energy, smallest = newton.potential(system, start, work[0])
        status, more, energy, smallest = descend(
            system, start, work, energy, smallest, target, np.inf, most, True, ROUND_OFF
        )
        iterations += more
        if status == newton.CONVERGED:
            break
    if status != newton.CONVERGED:
        forget_secants(memory.secants, scratch.origin)
        return status, iterations, smallest
    # the last evaluation was of the answer
    drive_points(scratch.H, scratch.B, scratch.S)
    advance_points(scratch.B, time, memory.points)
    advance_points(scratch.S, time, memory.linear)
    for a in range(terms):
        for i in range(len(start)):
            mean[a, i] = time.decay[a] * mean[a, i] + time.old[a] * wide[i] + time.new[a] * start[i]
    wide[:] = start
    for i in range(len(wide)):  # the last evaluation has left ``D u``
        pull[i] = pressed[i] + loss * change[i]
    add_knot(memory, time)
    return status, iterations, smallest


# --- the path of answers -------------------------------------------------------------------------


@njit(cache=True, error_model="numpy", nogil=True)
def add_knot(memory, time):
    """Append the last answer to the knots; two of the others become one."""
    knots, share = memory.knots, memory.share
    last = len(knots) - 1
    for a in range(share.shape[1]):
        for j in range(last + 1):
            share[j, a] *= time.decay[a]
        share[last, a] += time.old[a]
    best, least = 0, np.inf
    for j in range(last):
        x, y = 0.0, 0.0
        for a in range(share.shape[1]):
            x += time.share[a] * share[j, a]
            y += time.share[a] * share[j + 1, a]
        distance = 0.0
        for i in range(knots.shape[1]):
            distance += (knots[j, i] - knots[j + 1, i]) ** 2
        cost = x * y / (x + y) * distance if x * y > 0.0 else 0.0
        if cost < least:
            best, least, ratio = j, cost, (y / (x + y) if x + y > 0.0 else 1.0)
    for i in range(knots.shape[1]):
        knots[best, i] += ratio * (knots[best + 1, i] - knots[best, i])
    for a in range(share.shape[1]):
        share[best, a] += share[best + 1, a]
    for j in range(best + 1, last):
        knots[j] = knots[j + 1]
        share[j] = share[j + 1]
    knots[last] = memory.wide
    for a in range(share.shape[1]):
        share[last, a] = time.new[a]


@njit(cache=True, error_model="numpy", nogil=True)
def recall_points(solver, k, memory, scratch):
    """Give the points of local model k the history that the knots and the means tell."""
    recall(solver.patches.gradients[k], solver.patches.steps[k], memory, scratch)


@njit(cache=True, error_model="numpy", nogil=True)
def recall(gradients, steps, memory, scratch):
    """``recall_points`` of a local model with gradients (r, 9 c) in units of ``steps`` (r,)."""
    points, linear, mean = memory.points, memory.linear, memory.mean
    knots, share = memory.knots, memory.share
    stepped, driven, straight = scratch.stepped, scratch.B, scratch.S
    terms, last = len(mean), len(knots) - 1
    points[:] = np.float32(0.0)
    linear[:] = np.float32(0.0)
    for j in range(last + 1):
        for i in range(len(steps)):
            stepped[i] = knots[j, i] * steps[i]
        superpose(gradients, stepped, scratch.H)
        drive_points(scratch.H, driven, straight)
        for a in range(terms):
            points[a] += np.float32(share[j, a]) * driven
            linear[a] += np.float32(share[j, a]) * straight
    points[terms] = driven
    linear[terms] = straight
    for a in range(terms):
        for i in range(len(steps)):
            stepped[i] = mean[a, i] * steps[i]
        superpose(gradients, stepped, scratch.H)
        drive_points(scratch.H, driven, straight)
        points[a] -= straight - linear[a]
        linear[a] = straight


# --- the atlas -----------------------------------------------------------------------------------


@njit(cache=True, error_model="numpy", nogil=True)
def place(terms, solver, position, direction):
    """Contact point nearest to ``position``, its load range, and the patches that answer there.

    As ``reduced.press.query`` without an answer: writes point, normal, direction, range, weights
    and three of the scalars of the outcome, and which patches (``-2 - k``) into the memory.
    """
    outcome = solver.outcome
    scalars = outcome.scalars
    scalars[DISTANCE], scalars[TILT], scalars[LIMIT] = aim(terms, solver, position, direction)
    solver.memory.patch[:] = -1
    activate(solver.patches, outcome.point, solver.memory, solver.scratch.distance, outcome.weight)


@njit(cache=True, error_model="numpy", nogil=True)
def step_at(solver, k, pressure, radius, deviatoric, time, record, scratch, share, moved):
    """Press local model k where ``place`` has found; its record goes to the end of the step.

    Of the contact's displacement its share is added to ``moved`` (3,). Returns status, iterations,
    smallest det F and force over pressure (mm^2).
    """
    outcome, own = solver.outcome, solver.scratch
    area = load_patch(
        solver.patches, k, outcome.point, outcome.normal, outcome.direction, pressure, radius, own
    )
    memory = opened(record, len(time.share), len(deviatoric), solver.patches.weights.shape[1])
    status, iterations, smallest = step_patch(
        solver.patches, k, deviatoric, time, own.wide_load, memory, scratch
    )
    wide, unit = memory.wide, own.unit_loads
    if area > 0.0:
        for i in range(3):
            total = 0.0
            for j in range(len(wide)):
                total += unit[len(wide) * i + j] * wide[j]
            moved[i] += share * total / area
    return status, iterations, smallest, area
