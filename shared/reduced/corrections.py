"""Newton steps of a local model: by secants or by its tangent; see ``reduced.problem``."""

import math
from typing import Annotated, NamedTuple

import numpy as np
from numba import njit

from palpate.shared.arrays import Array, Field
from palpate.shared.compiled import methods
from palpate.shared.reduced.points import (
    FAST,
    Points,
    back_substitute,
    cholesky,
    distance,
    linearise,
    lower_products,
    superpose,
)

LEAST_CURVATURE = 1e-2
"""Cosine between a step and the change of force it causes, below which it is not a secant."""


@methods()
class Secants(NamedTuple):
    """An inverse tangent made up of the changes that the steps so far have shown."""

    inverse: Array  # (r, r)
    origin: Array  # (2, r) state and force of the tissue that the next secant starts from
    external: Array  # (r,) load and past: the force of the tissue less the residual
    change: Array  # (r,) scratch

    def prepare(self, problem, q, shift):
        """The secants are always those of the last steps."""
        return True

    def step(self, problem, residual, step):
        """Write ``step = - inverse residual``, with a new secant."""
        _learn_secant(self, problem.work.latest, residual)
        superpose(self.inverse, residual, step)
        for i in range(len(step)):
            step[i] = -step[i]


class TangentWork(NamedTuple):
    """Working memory of a tangent with so many points."""

    state: Annotated[Field, "state tangent_points"]  # what ``points.increments`` needs
    units: Annotated[Field, "9, 9 tangent_points"]  # in tiles, gradients with one component
    moduli: Annotated[Field, "9, 9 tangent_points"]  # in tiles, kPa
    products: Annotated[Field, "r, 9 tangent_points"]  # with the modes, in tiles
    whole: Annotated[Array, "r, r"]  # lower triangle


@methods()
class Tangent(NamedTuple):
    """A tangent whose tissue part serves again while answer and past move little."""

    points: Points  # of the tangent: those of the residual, or fewer where it need not be exact
    bulk: Array  # (r, r) tissue's part without the linear part of the past
    formed: Array  # (3, r) state, past and loss at which that was formed
    lag: float  # change of answer and past, relative to the answer, that it serves for
    factor: Array  # (r, r) lower Cholesky factor
    work: TangentWork

    def prepare(self, problem, q, shift):
        """Factorise the tangent at q, shifted; False if it is not positive definite."""
        past, formed, size = problem.past, self.formed, max(np.dot(q, q), 1e-12)
        known = distance(q, formed[0]) <= self.lag**2
        known = known and not past.has_moved(formed[1:], size, self.lag)
        while True:
            if not known:
                _form_bulk(self, problem, q)
            past.soften_tangent(self.bulk, self.work.whole)
            problem.load.stiffen(q, shift, self.work.whole)
            if cholesky(self.work.whole, shift, self.factor):
                return True
            if distance(q, formed[0]) == 0.0:  # formed at this very state
                return False
            known = False

    def step(self, problem, residual, step):
        """Write ``step = - tangent^-1 residual``."""
        for j in range(len(step)):
            step[j] = -residual[j]
        back_substitute(self.factor, step)


@njit(cache=True, error_model="numpy", nogil=True)
def _form_bulk(correction, problem, q):
    """Form the tissue's part of the tangent at q, lower triangle."""
    points, work, own = correction.points, problem.work, correction.work
    H = work.H[: points.gradients.shape[1]]
    points.strain(q, work.stepped, H)
    linearise(H, points.weights, points.law, own.state)
    problem.past.form_products(points, H, own)
    lower_products(points.gradients, own.products, correction.bulk)
    for j in range(len(q)):
        correction.bulk[j, j] += 1.0
    correction.formed[0] = q
    problem.past.note(correction.formed[1:])


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
        superpose(inverse, change, product)
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
