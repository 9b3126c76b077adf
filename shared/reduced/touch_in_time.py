"""The rigid tip on tissue that remembers, compiled: what ``reduced.tip_history`` runs.

Theory.  A step finds the equilibrium of a local model of ``reduced.touch`` with its past, which is
kept and carried from model to model as that of ``reduced.press_in_time``: linear visco-elasticity
by the deviatoric stiffness ``D`` of the modes, what the law adds to it at the cubature points.

    min_q  Pi(q, x) - sum_a g_a q . D (decay_a z_a + old_a q_n + new_a q/2) + sum_c w_c (...)

with ``Pi`` the potential of the elastic tissue under the tip, ``z_a`` the means of the answers over
the past and ``q_n`` the last answer.  Force and tangent of a step follow as those of ``Pi``: the
tangent is the derivative in the position at the end of the step, the past being what it is.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numba.extending import overload
from numpy.typing import NDArray

from palpate.shared.compiled import bind_compiled
from palpate.shared.geometry.surface import UPRIGHT, locate
from palpate.shared.mechanics import newton, tissue
from palpate.shared.mechanics.sphere import CONVEX, STIFFNESS
from palpate.shared.reduced.press import (
    FAST,
    LANES,
    TILE,
    activate,
    back_substitute,
    cholesky,
    increments,
    is_system,
    linearise,
    lower_products,
    multiply,
    superpose,
)
from palpate.shared.reduced.press_in_time import (
    KNOTS,
    SYMMETRIC,
    add_knot,
    add_past_stress,
    advance_points,
    cut,
    drive_points,
    inverse_cube_root,
    predict_points,
    recall,
)
from palpate.shared.reduced.touch import (
    BESIDE,
    DEPTH,
    DISTANCE,
    ENERGY,
    ITERATIONS,
    LEAST_SHARE,
    MAX_ITERATIONS,
    PENETRATION,
    SKIN,
    SMALLEST_J,
    STATUS,
    TOLERANCE,
    TOUCHED,
    TipSystem,
    add_contact,
    balance,
    far,
    first_guess,
    form_contact,
    react,
    settle_on_the_way,
    settle_stably,
    stress_points,
    tip_system,
    weight_gradients,
)

Array = NDArray[np.float64]
Field = NDArray[np.float32]

LAG = 0.03
"""As ``reduced.touch.LAG``, of the answer and of its past: both change at every step, and forming
the tangent takes as long as all the rest.  Iterations stay as few; the price is the tangent on the
tool."""

NOTHING, SHAPE, EVERYTHING = 0, 1, 2
"""What a memory knows of the last answer: that it was rest, its shape, its derivatives too."""

STATE = 26
"""Components of what ``_add_past_increments`` needs of a point."""


class TipMemory(NamedTuple):
    """What one local model remembers: views of a record, as ``reduced_history.Memory``.

    See ``reduced.touch.TipMemory`` for what is of the last answer.
    """

    wide: Array  # (m,) last answer
    known: Array  # (1,)
    bulk: Array  # (1, m, m) part of the tangent, and
    formed: Array  # (1, m) state and
    formed_past: Array  # (m + 1,) past and loss at which that was formed
    factor: Array  # (1, m, m)
    coupling: Array  # (1, 3, m)
    position: Array  # (3,) mm
    mean: Array  # (terms, m)
    points: Field  # (terms + 1, 6 c)
    linear: Field  # (terms + 1, 6 c)
    knots: Array  # (KNOTS, m)
    share: Array  # (KNOTS, terms)


@njit(cache=True, error_model="numpy", nogil=True)
def opened(record, terms, modes, points):
    """Memory in a record (n,) of ``new_record``, which starts with the last answer."""
    answers, at = cut(record, 0, 2, modes)
    bulk, at = cut(record, at, modes, modes)
    factor, at = cut(record, at, modes, modes)
    coupling, at = cut(record, at, 3, modes)
    mean, at = cut(record, at, terms, modes)
    knots, at = cut(record, at, KNOTS, modes)
    share, at = cut(record, at, KNOTS, terms)
    past, at = cut(record, at, 1, modes + 1)
    position, at = cut(record, at, 1, 3)
    known, at = cut(record, at, 1, 1)
    histories = record[at:].view(np.float32).reshape(2, terms + 1, SYMMETRIC * points)
    return TipMemory(
        answers[0], known[0], bulk.reshape(1, modes, modes), answers[1:], past[0],
        factor.reshape(1, modes, modes), coupling.reshape(1, 3, modes), position[0], mean,
        histories[0], histories[1], knots, share,
    )  # fmt: skip


def new_record(terms: int, modes: int, points: int) -> Array:
    """Record of a local model that nothing has happened to."""
    size = modes * (2 * modes + terms + KNOTS + 6) + KNOTS * terms + 5
    record = np.zeros(size + (terms + 1) * SYMMETRIC * points)
    memory = opened(record, terms, modes, points)
    memory.share[-1] = 1.0
    memory.formed[:] = np.inf
    return record


class TipScratch(NamedTuple):
    """Working memory of a step, beyond that of ``reduced.touch``."""

    H: Field  # (9 c,)
    B: Field  # (6 c,) in tiles, what the past drives the points to
    S: Field  # (6 c,) in tiles, kPa, the linear part of it
    state: Field  # (STATE LANES,)
    units: Field  # (9, 9 c) in tiles, gradients with one component
    moduli: Field  # (9, 9 c) in tiles
    steps: Field  # (m,) ones
    stepped: Field  # (m,)
    past: Array  # (m + 1,) mean of the answers over the past, and the loss of the step
    exerted: Array  # (m,)
    softer: Array  # (m,)
    q: Array  # (m,)


def new_scratch(modes: int, points: int) -> TipScratch:
    """Of models with so many modes and points."""
    return TipScratch(
        H=np.zeros(9 * points, np.float32),
        B=np.zeros(SYMMETRIC * points, np.float32),
        S=np.zeros(SYMMETRIC * points, np.float32),
        state=np.zeros(STATE * LANES, np.float32),
        units=np.tile(np.repeat(np.eye(9, dtype=np.float32), LANES, axis=1), points // LANES),
        moduli=np.zeros((9, 9 * points), np.float32),
        steps=np.ones(modes, np.float32),
        stepped=np.zeros(modes, np.float32),
        past=np.zeros(modes + 1),
        exerted=np.zeros(modes),
        softer=np.zeros(modes),
        q=np.zeros(modes),
    )


class PastTipSystem(NamedTuple):
    """A local model under the tip and its past, for ``mechanics.newton.descend``."""

    tip: TipSystem  # bound; of the elastic tissue
    x: Array  # its position
    deviatoric: Field  # (m, m) D
    past: Array  # (m + 1,)
    formed_past: Array  # (m + 1,)
    exerted: Array  # (m,) by the past
    loss: float  # sum of g new
    B: Field
    S: Field
    state: Field
    units: Field
    moduli: Field
    softer: Array


@overload(newton.potential, jit_options={"error_model": "numpy"})
def _potential(system, u, residual):
    if not is_system(PastTipSystem, system):
        return None

    def potential(system, u, residual):
        tip = system.tip
        energy, smallest = stress_points(tip, u)
        if not smallest > 0.0:
            return tissue.INVERTED, smallest
        # trace has served; its room is that of the energies
        add_past_stress(
            tip.H, tip.weights, tip.mu, tip.J, system.B, system.S, system.loss, tip.trace, tip.P
        )
        energy += np.dot(tip.weights, tip.trace) + balance(tip, u, residual)
        loss, softer, exerted = system.loss, system.softer, system.exerted
        multiply(system.deviatoric, u, softer)
        for j in range(len(u)):
            lost = loss * softer[j]
            residual[j] -= lost + exerted[j]
            energy -= (0.5 * lost + exerted[j]) * u[j]
        return energy, smallest

    return potential


@overload(newton.factorise, jit_options={"error_model": "numpy"})
def _factorise(system, u, shift):
    if not is_system(PastTipSystem, system):
        return None

    def factorise(system, u, shift):
        tip = system.tip
        known = _still_known(system, u)
        if shift > 0.0:
            form_contact(tip, u, CONVEX)
            tip.latest[:] = np.inf
        elif far(u, tip.latest) > 0.0:
            form_contact(tip, u, STIFFNESS)
            tip.latest[:] = u
        while True:
            if not known:
                _form_bulk(system, u)
            _soften(tip.bulk, system.loss, system.deviatoric, tip.tangent)
            add_contact(tip)
            if cholesky(tip.tangent, shift, tip.factor):
                return True
            if not known:
                return False
            known = False

    return factorise


@overload(newton.correct, jit_options={"error_model": "numpy"})
def _correct(system, residual, step):
    if not is_system(PastTipSystem, system):
        return None
    return lambda system, residual, step: newton.correct(system.tip, residual, step)


@njit(cache=True, error_model="numpy", nogil=True)
def _still_known(system, u):
    """Whether the tissue's part of the tangent still serves: neither answer nor past have moved."""
    size = moved = 0.0
    past, formed = system.past, system.formed_past
    last = len(u)
    for j in range(last):
        size += u[j] * u[j]
        moved += (past[j] - formed[j]) ** 2
    near = moved <= LAG * LAG * size and abs(past[last] - formed[last]) <= LAG
    return near and far(u, system.tip.formed) <= LAG * LAG


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def _soften(bulk, loss, D, tangent):
    """``tangent = bulk - loss D``."""
    for i in range(len(bulk)):
        b, d, t = bulk[i], D[i], tangent[i]
        for j in range(len(b)):
            t[j] = b[j] - loss * d[j]


@njit(cache=True, error_model="numpy", nogil=True)
def _form_bulk(system, u):
    """The part of the tissue in the tangent at u but for the linear part of its past.

    A tangent with a cubature of its own, in training, knows the linear part only.
    """
    tip = system.tip
    gradients, bulk = tip.tangent_gradients, tip.bulk
    H = tip.H[: gradients.shape[1]]
    superpose(gradients, u, H)
    linearise(H, tip.tangent_weights, tip.tangent_mu, tip.tangent_lam, tip.state)
    if gradients.shape[1] == tip.gradients.shape[1]:
        # there are more modes than components of a gradient
        units, moduli = system.units, system.moduli
        increments(tip.state, units, moduli)
        _add_past_increments(
            H, system.B, tip.weights, tip.mu, system.loss, units, system.state, moduli
        )
        _contract(moduli, gradients, tip.increments)
    else:
        increments(tip.state, gradients, tip.increments)
    lower_products(gradients, tip.increments, bulk)
    for j in range(len(u)):
        bulk[j, j] += 1.0
    tip.formed[:] = u
    system.formed_past[:] = system.past


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def _contract(moduli, gradients, out):
    """``out = moduli : gradients``, (m, 9 c) in tiles; row i of ``moduli`` is of component i."""
    n = LANES
    for tile in range(gradients.shape[1] // TILE):
        at = TILE * tile
        m0, m1, m2 = moduli[0, at : at + TILE], moduli[1, at : at + TILE], moduli[2, at : at + TILE]
        m3, m4, m5 = moduli[3, at : at + TILE], moduli[4, at : at + TILE], moduli[5, at : at + TILE]
        m6, m7, m8 = moduli[6, at : at + TILE], moduli[7, at : at + TILE], moduli[8, at : at + TILE]
        for mode in range(len(gradients)):
            h, d = gradients[mode, at : at + TILE], out[mode, at : at + TILE]
            for c in range(LANES):
                h0, h1, h2 = h[c], h[n + c], h[2 * n + c]
                h3, h4, h5 = h[3 * n + c], h[4 * n + c], h[5 * n + c]
                h6, h7, h8 = h[6 * n + c], h[7 * n + c], h[8 * n + c]
                for i in range(9):
                    k = n * i + c
                    d[k] = (
                        h0 * m0[k] + h1 * m1[k] + h2 * m2[k]
                        + h3 * m3[k] + h4 * m4[k] + h5 * m5[k]
                        + h6 * m6[k] + h7 * m7[k] + h8 * m8[k]
                    )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def _add_past_increments(H, B, weights, mu, loss, gradients, state, out):
    """Add the tangent of ``add_past_stress`` times the gradient of every mode: (m, 9 c) in tiles.

    With ``G = F^-T``, ``t = C : B`` and gradients h, at every point

        mu J^-2/3 (h B - 2/3 (G:h) F B - 2/3 (FB:h) G + t/3 (2/3 (G:h) G + G h^T G))
        + 2 mu loss dev sym h.
    """
    n = LANES
    for tile in range(len(weights) // LANES):
        h = H[TILE * tile : TILE * (tile + 1)]
        b = B[SYMMETRIC * n * tile : SYMMETRIC * n * (tile + 1)]
        w, m = weights[n * tile : n * (tile + 1)], mu[n * tile : n * (tile + 1)]
        _past_state(h, b, w, m, loss, state)
        s = state
        for mode in range(len(gradients)):
            g = gradients[mode, TILE * tile : TILE * (tile + 1)]
            d = out[mode, TILE * tile : TILE * (tile + 1)]
            for c in range(LANES):
                h0, h1, h2 = g[c], g[n + c], g[2 * n + c]
                h3, h4, h5 = g[3 * n + c], g[4 * n + c], g[5 * n + c]
                h6, h7, h8 = g[6 * n + c], g[7 * n + c], g[8 * n + c]
                g0, g1, g2 = s[c], s[n + c], s[2 * n + c]
                g3, g4, g5 = s[3 * n + c], s[4 * n + c], s[5 * n + c]
                g6, g7, g8 = s[6 * n + c], s[7 * n + c], s[8 * n + c]
                f0, f1, f2 = s[9 * n + c], s[10 * n + c], s[11 * n + c]
                f3, f4, f5 = s[12 * n + c], s[13 * n + c], s[14 * n + c]
                f6, f7, f8 = s[15 * n + c], s[16 * n + c], s[17 * n + c]
                b0, b1, b2 = s[18 * n + c], s[19 * n + c], s[20 * n + c]
                b3, b4, b5 = s[21 * n + c], s[22 * n + c], s[23 * n + c]
                third, soft = s[24 * n + c], s[25 * n + c]
                wider = g0 * h0 + g1 * h1 + g2 * h2 + g3 * h3 + g4 * h4 + g5 * h5
                wider += g6 * h6 + g7 * h7 + g8 * h8
                along = f0 * h0 + f1 * h1 + f2 * h2 + f3 * h3 + f4 * h4 + f5 * h5
                along += f6 * h6 + f7 * h7 + f8 * h8
                wider *= np.float32(2.0 / 3.0)
                x = third * wider - np.float32(2.0 / 3.0) * along  # of G
                # h^T G by rows
                k0, k1, k2 = (
                    h0 * g0 + h3 * g3 + h6 * g6,
                    h0 * g1 + h3 * g4 + h6 * g7,
                    h0 * g2 + h3 * g5 + h6 * g8,
                )
                k3, k4, k5 = (
                    h1 * g0 + h4 * g3 + h7 * g6,
                    h1 * g1 + h4 * g4 + h7 * g7,
                    h1 * g2 + h4 * g5 + h7 * g8,
                )
                k6, k7, k8 = (
                    h2 * g0 + h5 * g3 + h8 * g6,
                    h2 * g1 + h5 * g4 + h8 * g7,
                    h2 * g2 + h5 * g5 + h8 * g8,
                )
                mean = (h0 + h4 + h8) / np.float32(3.0)
                l0, l4, l8 = (
                    np.float32(2.0) * soft * (h0 - mean),
                    np.float32(2.0) * soft * (h4 - mean),
                    np.float32(2.0) * soft * (h8 - mean),
                )
                l1, l2, l5 = soft * (h1 + h3), soft * (h2 + h6), soft * (h5 + h7)
                d[c] += (
                    l0
                    + h0 * b0
                    + h1 * b5
                    + h2 * b4
                    - wider * f0
                    + x * g0
                    + third * (g0 * k0 + g1 * k3 + g2 * k6)
                )
                d[n + c] += (
                    l1
                    + h0 * b5
                    + h1 * b1
                    + h2 * b3
                    - wider * f1
                    + x * g1
                    + third * (g0 * k1 + g1 * k4 + g2 * k7)
                )
                d[2 * n + c] += (
                    l2
                    + h0 * b4
                    + h1 * b3
                    + h2 * b2
                    - wider * f2
                    + x * g2
                    + third * (g0 * k2 + g1 * k5 + g2 * k8)
                )
                d[3 * n + c] += (
                    l1
                    + h3 * b0
                    + h4 * b5
                    + h5 * b4
                    - wider * f3
                    + x * g3
                    + third * (g3 * k0 + g4 * k3 + g5 * k6)
                )
                d[4 * n + c] += (
                    l4
                    + h3 * b5
                    + h4 * b1
                    + h5 * b3
                    - wider * f4
                    + x * g4
                    + third * (g3 * k1 + g4 * k4 + g5 * k7)
                )
                d[5 * n + c] += (
                    l5
                    + h3 * b4
                    + h4 * b3
                    + h5 * b2
                    - wider * f5
                    + x * g5
                    + third * (g3 * k2 + g4 * k5 + g5 * k8)
                )
                d[6 * n + c] += (
                    l2
                    + h6 * b0
                    + h7 * b5
                    + h8 * b4
                    - wider * f6
                    + x * g6
                    + third * (g6 * k0 + g7 * k3 + g8 * k6)
                )
                d[7 * n + c] += (
                    l5
                    + h6 * b5
                    + h7 * b1
                    + h8 * b3
                    - wider * f7
                    + x * g7
                    + third * (g6 * k1 + g7 * k4 + g8 * k7)
                )
                d[8 * n + c] += l8 + h6 * b4 + h7 * b3 + h8 * b2 - wider * f8 + x * g8 + third * (
                    g6 * k2 + g7 * k5 + g8 * k8)  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def _past_state(h, b, w, m, loss, s):
    """What ``_add_past_increments`` needs of a tile: G, FB and B with the modulus, t/3, softness.

    ``w`` and ``m`` are weights and shear moduli of its points.
    """
    n = LANES
    for c in range(LANES):
        f0, f1, f2 = 1.0 + h[c], float(h[n + c]), float(h[2 * n + c])
        f3, f4, f5 = float(h[3 * n + c]), 1.0 + h[4 * n + c], float(h[5 * n + c])
        f6, f7, f8 = float(h[6 * n + c]), float(h[7 * n + c]), 1.0 + h[8 * n + c]
        c0, c1, c2 = f4 * f8 - f5 * f7, f5 * f6 - f3 * f8, f3 * f7 - f4 * f6
        c3, c4, c5 = f2 * f7 - f1 * f8, f0 * f8 - f2 * f6, f1 * f6 - f0 * f7
        c6, c7, c8 = f1 * f5 - f2 * f4, f2 * f3 - f0 * f5, f0 * f4 - f1 * f3
        J = f0 * c0 + f1 * c1 + f2 * c2  # c = J F^-T
        root = inverse_cube_root(J)
        scale = w[c] * m[c] * root * root
        b0, b1, b2 = scale * b[c], scale * b[n + c], scale * b[2 * n + c]
        b3, b4, b5 = scale * b[3 * n + c], scale * b[4 * n + c], scale * b[5 * n + c]
        p0, p1, p2 = (
            f0 * b0 + f1 * b5 + f2 * b4,
            f0 * b5 + f1 * b1 + f2 * b3,
            f0 * b4 + f1 * b3 + f2 * b2,
        )
        p3, p4, p5 = (
            f3 * b0 + f4 * b5 + f5 * b4,
            f3 * b5 + f4 * b1 + f5 * b3,
            f3 * b4 + f4 * b3 + f5 * b2,
        )
        p6, p7, p8 = (
            f6 * b0 + f7 * b5 + f8 * b4,
            f6 * b5 + f7 * b1 + f8 * b3,
            f6 * b4 + f7 * b3 + f8 * b2,
        )
        contraction = f0 * p0 + f1 * p1 + f2 * p2 + f3 * p3 + f4 * p4 + f5 * p5
        contraction += f6 * p6 + f7 * p7 + f8 * p8
        s[c], s[n + c], s[2 * n + c] = c0 / J, c1 / J, c2 / J
        s[3 * n + c], s[4 * n + c], s[5 * n + c] = c3 / J, c4 / J, c5 / J
        s[6 * n + c], s[7 * n + c], s[8 * n + c] = c6 / J, c7 / J, c8 / J
        s[9 * n + c], s[10 * n + c], s[11 * n + c] = p0, p1, p2
        s[12 * n + c], s[13 * n + c], s[14 * n + c] = p3, p4, p5
        s[15 * n + c], s[16 * n + c], s[17 * n + c] = p6, p7, p8
        s[18 * n + c], s[19 * n + c], s[20 * n + c] = b0, b1, b2
        s[21 * n + c], s[22 * n + c], s[23 * n + c] = b3, b4, b5
        s[24 * n + c], s[25 * n + c] = contraction / 3.0, loss * w[c] * m[c]


# --- a step --------------------------------------------------------------------------------------


@njit(cache=True, error_model="numpy", nogil=True)
def place_tip(solver, x, at):
    """Where the tip's centre ``x`` (3,) mm lies, and the local models that answer.

    As ``reduced.touch.query`` without an answer.  Models are chosen about ``at`` (3,) mm: ``x``, or
    where the tip touched last.  Writes foot, normal, limit, weights and which models (``-2 - k``)
    into the outcome.
    """
    scratch, outcome = solver.scratch, solver.outcome
    outcome.scalars[:] = 0.0
    outcome.scalars[SMALLEST_J] = 1.0
    outcome.force[:] = 0.0
    outcome.tangent[:] = 0.0
    distance = locate(solver.ground, x, scratch.ground, outcome.foot, outcome.upward, outcome.limit)
    outcome.point[:] = outcome.foot
    outcome.normal[:] = outcome.upward
    above = 0.0
    for i in range(3):
        above += (x[i] - outcome.foot[i]) * outcome.upward[i]
    beside = abs(above) < UPRIGHT * distance
    depth = solver.models.tip.radius - (distance if beside else math.copysign(distance, above))
    scalars = outcome.scalars
    scalars[DEPTH], scalars[DISTANCE], scalars[BESIDE] = depth, distance, 1.0 if beside else 0.0
    if not depth > -SKIN * solver.models.tip.radius:
        x = at
    outcome.patch[:] = -1
    activate(solver.models, x, outcome, scratch.distance, outcome.weight)
    weight_gradients(solver.models, outcome, x, scratch)


@njit(cache=True, error_model="numpy", nogil=True)
def step_tip(solver, slot, x, deviatoric, time, most, start, record, own):
    """Equilibrium of the local model in a slot with the tip at ``x`` at the end of a time step.

    Parameters
    ----------
    solver : reduced.touch.TipSolver
        Placed; its outcome gets the model's share of force, tangent and what else adds up.
    slot : int
    x : ndarray, shape (3,), mm
    deviatoric : ndarray, shape (m, m)
    time : Weights
        Of the step.
    most : int
        Iterations; the way in is tried only with ``MAX_ITERATIONS``, as in ``reduced.touch.query``.
    start : ndarray, shape (m,) or (0,)
        Where to begin the search, if not at the last answer.
    record : ndarray, shape (n,)
        Of the model, see ``opened``; goes to the end of the step if that has an answer.
    own : TipScratch

    Returns
    -------
    status : int
        Without an answer ``own.q`` is where the search ended.
    """
    models, scratch, outcome = solver.models, solver.scratch, solver.outcome
    k = -2 - outcome.patch[slot]
    scalars, normal = outcome.scalars, outcome.upward
    depth = scalars[DEPTH]
    memory = opened(record, len(time.share), len(deviatoric), models.points.weights.shape[1])
    loss = _remember(models.points.mu[k], deviatoric, time, memory, own)
    q, at = own.q, scratch.position
    q[:] = memory.wide
    if len(start) > 0:
        q[:] = start
    elif memory.known[0] == EVERYTHING:
        _follow(memory, x, q, scratch.newton[1])
    elif memory.known[0] == NOTHING and depth > 0.0:
        first_guess(models, k, x, depth, scratch.features, q)
    at[:] = x
    scratch.latest[:] = np.inf
    system = bind_compiled(
        PastTipSystem(
            tip_system(models, k, 0, memory, scratch),
            at, deviatoric, own.past, memory.formed_past, own.exerted, loss, own.B, own.S,
            own.state, own.units, own.moduli, own.softer,
        )
    )  # fmt: skip
    tip, pressed = models.tip, max(depth, 0.0)
    tolerance = TOLERANCE / max(outcome.weight[slot], LEAST_SHARE)
    status, iterations, energy, smallest = settle_stably(
        system, tip, q, scratch.newton, pressed, tolerance, most, scratch.tangent
    )
    if status != newton.CONVERGED and depth > 0.0 and most == MAX_ITERATIONS:
        memory.formed[:] = np.inf
        status, more, energy, smallest = settle_on_the_way(
            system, tip, q, scratch.newton, depth, normal, scratch.tangent
        )
        iterations += more
    scalars[STATUS] = max(scalars[STATUS], float(status))
    scalars[ITERATIONS] = max(scalars[ITERATIONS], float(iterations))
    scalars[SMALLEST_J] = min(scalars[SMALLEST_J], smallest)
    if status != newton.CONVERGED:
        return status
    coupling, force, residual, step = (
        memory.coupling[0], outcome.forces[slot], scratch.newton[0], scratch.newton[1],
    )  # fmt: skip
    react(system.tip, coupling, force, outcome.tangents[slot])
    newton.correct(system, residual, step)
    energy += 0.5 * np.dot(residual, step)
    q += step
    for i in range(3):
        force[i] += np.dot(coupling[i], step)
    share = outcome.weight[slot]
    memory.factor[0] = scratch.factor[0]
    memory.position[:] = x
    scalars[ENERGY] += share * energy
    scalars[PENETRATION] = max(scalars[PENETRATION], scratch.touching.deepest[0])
    scalars[TOUCHED] += scratch.touching.touched[0]
    for i in range(3):
        outcome.force[i] += share * force[i]
        for j in range(3):
            outcome.tangent[i, j] += (
                share * outcome.tangents[slot, i, j] + force[i] * scratch.fade[slot, j]
            )
    _advance(models.points.gradients[k], time, memory, own)
    return status


@njit(cache=True, error_model="numpy", nogil=True)
def _follow(memory, x, q, step):
    """Move the last answer by its derivatives to the position x."""
    step[:] = 0.0
    for i in range(3):
        step += (x[i] - memory.position[i]) * memory.coupling[0, i]
    back_substitute(memory.factor[0], step)
    q += step


@njit(cache=True, error_model="numpy", nogil=True)
def _remember(mu, deviatoric, time, memory, own):
    """What is known of the end of a step before it is solved, into ``own``; returns the loss."""
    m, past, mean, wide = len(memory.wide), own.past, memory.mean, memory.wide
    past[:] = 0.0
    for a in range(len(mean)):
        g = time.share[a]
        past[m] += g * time.new[a]
        for i in range(m):
            past[i] += g * (time.decay[a] * mean[a, i] + time.old[a] * wide[i])
    loss = predict_points(memory.points, memory.linear, time, mu, own.B, own.S)
    multiply(deviatoric, past[:m], own.exerted)
    return loss


@njit(cache=True, error_model="numpy", nogil=True)
def _advance(gradients, time, memory, own):
    """Go to the end of a step that ``own.q`` is the answer of."""
    q, wide, mean = own.q, memory.wide, memory.mean
    superpose(gradients, q, own.H)
    drive_points(own.H, own.B, own.S)
    advance_points(own.B, time, memory.points)
    advance_points(own.S, time, memory.linear)
    for a in range(len(mean)):
        for i in range(len(q)):
            mean[a, i] = time.decay[a] * mean[a, i] + time.old[a] * wide[i] + time.new[a] * q[i]
    wide[:] = q
    memory.known[0] = EVERYTHING
    add_knot(memory, time)


@njit(cache=True, error_model="numpy", nogil=True)
def conclude(solver, x):
    """Where the force acts on a tip at ``x``; returns its size."""
    outcome = solver.outcome
    force = outcome.force
    pushed = math.sqrt(np.dot(force, force))
    if pushed > 0.0:
        for i in range(3):
            outcome.normal[i] = force[i] / pushed
            outcome.point[i] = x[i] - solver.models.tip.radius * outcome.normal[i]
    return pushed


@njit(cache=True, error_model="numpy", nogil=True)
def recall_tip_points(solver, k, memory, own):
    """As ``reduced_history.recall_points`` of a local model under the tip."""
    recall(solver.models.points.gradients[k], own.steps, memory, own)
