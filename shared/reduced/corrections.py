"""Newton steps of a local model: by secants or by its tangent; see ``reduced.problem``."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from palpate.shared.compiled import by_type
from palpate.shared.reduced.points import (
    FAST,
    Points,
    add_past_increments,
    back_substitute,
    cholesky,
    contract,
    increments,
    linearise,
    lower_products,
    multiply,
    superpose,
)
from palpate.shared.reduced.terms import (
    Elastic,
    Viscous,
    distance,
    has_moved,
    note_past,
    soften_tangent,
    stiffen,
)

Array = NDArray[np.float64]
Field = NDArray[np.float32]

LEAST_CURVATURE = 1e-2
"""Cosine between a step and the change of force it causes, below which it is not a secant."""


class Secants(NamedTuple):
    """An inverse tangent made up of the changes that the steps so far have shown."""

    inverse: Array  # (r, r)
    origin: Array  # (2, r) state and force of the tissue that the next secant starts from
    external: Array  # (r,) load and past: the force of the tissue less the residual
    change: Array  # (r,) scratch


class Tangent(NamedTuple):
    """A tangent whose tissue part serves again while answer and past move little."""

    points: Points  # of the tangent: those of the residual, or fewer where it need not be exact
    state: Field  # what ``points.increments`` needs
    units: Field  # (9, 9 c) in tiles, gradients with one component
    moduli: Field  # (9, 9 c) in tiles, kPa
    products: Field  # (r, 9 c)
    bulk: Array  # (r, r) tissue's part without the linear part of the past
    formed: Array  # (2 r + 1,) state, past and loss at which that was formed
    lag: float  # change of answer and past, relative to the answer, that it serves for
    whole: Array  # (r, r) lower triangle
    factor: Array  # (r, r) lower Cholesky factor


def factorise(correction, problem, q, shift):
    """Make the correction ready at a state; False if the tangent is not positive definite."""


def _factorise_secants(correction, problem, q, shift):
    return True  # the secants are always those of the last steps


def _factorise_tangent(correction, problem, q, shift):
    past, r = problem.past, len(q)
    size = max(np.dot(q, q), 1e-12)
    formed = correction.formed[:r]
    known = distance(q, formed) <= correction.lag**2 and not has_moved(
        past, correction.formed[r:], size, correction.lag
    )
    while True:
        if not known:
            _form_bulk(correction, problem, q)
        soften_tangent(past, correction.bulk, correction.whole)
        stiffen(problem.load, q, shift, correction.whole)
        if cholesky(correction.whole, shift, correction.factor):
            return True
        if distance(q, formed) == 0.0:  # formed at this very state
            return False
        known = False


@njit(cache=True, error_model="numpy", nogil=True)
def _form_bulk(correction, problem, q):
    """Form the tissue's part of the tangent at q, lower triangle."""
    points, work, bulk = correction.points, problem.work, correction.bulk
    H = work.H[: points.gradients.shape[1]]
    for i in range(len(q)):
        work.stepped[i] = q[i] * points.steps[i]
    superpose(points.gradients, work.stepped, H)
    linearise(H, points.weights, points.law, correction.state)
    form_products(problem.past, correction, points, H)
    lower_products(points.gradients, correction.products, bulk)
    for j in range(len(q)):
        bulk[j, j] += 1.0
        correction.formed[j] = q[j]
    note_past(problem.past, correction.formed[len(q) :])


def form_products(past, correction, points, H):
    """Write the tangent at the points times the gradients of the modes, (r, 9 c)."""


def _form_products_at_once(past, correction, points, H):
    increments(points.law, correction.state, points.gradients, correction.products)


def _form_products_in_time(past, correction, points, H):
    # In training a tangent may have fewer points than the residual, of which no past is known:
    # it then has the linear part of the past only.
    if len(past.B) * 9 != len(H) * 6:
        increments(points.law, correction.state, points.gradients, correction.products)
        return
    # there are more modes than components of a gradient, so the moduli of the points come first
    increments(points.law, correction.state, correction.units, correction.moduli)
    add_past_increments(
        H, past.B, points.weights, points.law.mu, past.loss[0], correction.units, past.state,
        correction.moduli,
    )  # fmt: skip
    contract(correction.moduli, points.gradients, correction.products)


by_type(form_products, {Elastic: _form_products_at_once, Viscous: _form_products_in_time})


def correct(correction, problem, residual, step):
    """Write ``step = - tangent^-1 residual``."""


def _correct_by_secants(correction, problem, residual, step):
    _learn_secant(correction, problem.work.latest, residual)
    multiply(correction.inverse, residual, step)
    for i in range(len(step)):
        step[i] = -step[i]


def _correct_by_tangent(correction, problem, residual, step):
    for j in range(len(step)):
        step[j] = -residual[j]
    back_substitute(correction.factor, step)


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def _learn_secant(correction, state, residual):
    """Update the inverse tangent with the secant to a new state (BFGS), which is the next origin.

    Nocedal & Wright, Numerical Optimization, eq. 6.17.  The origin may stem from another query, for
    the tissue's force does not know the load.  From an origin of NaN no secant is drawn.
    """
    inverse, external, product = correction.inverse, correction.external, correction.change
    step, change = correction.origin[0], correction.origin[1]
    curvature = length = force = 0.0
    for i in range(len(step)):
        step[i] = state[i] - step[i]
        change[i] = residual[i] + external[i] - change[i]
        curvature += step[i] * change[i]
        length += step[i] * step[i]
        force += change[i] * change[i]
    if curvature > LEAST_CURVATURE * math.sqrt(length * force):
        scale = 1.0 / curvature
        multiply(inverse, change, product)
        whole = 0.0
        for i in range(len(step)):
            whole += product[i] * change[i]
        whole = (1.0 + whole * scale) * scale
        for i in range(len(step)):
            row, a, b = inverse[i], whole * step[i] - scale * product[i], scale * step[i]
            for j in range(len(step)):
                row[j] += a * step[j] - b * product[j]
    for i in range(len(step)):
        step[i] = state[i]
        change[i] = residual[i] + external[i]


@njit(cache=True, error_model="numpy", nogil=True)
def forget_secants(inverse, origin):
    """Start with the inverse of the rest stiffness; the next state is the first origin."""
    origin[:] = np.nan
    inverse[:] = 0.0
    for i in range(len(inverse)):
        inverse[i, i] = 1.0


by_type(factorise, {Secants: _factorise_secants, Tangent: _factorise_tangent})
by_type(correct, {Secants: _correct_by_secants, Tangent: _correct_by_tangent})
