"""Newton steps of a local model: by secants or by its tangent; see ``reduced.problem``."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from palpate.shared.arrays import Array
from palpate.shared.compiled import methods
from palpate.shared.reduced.points import FAST, superpose

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


@methods()
class TouchedSecants(NamedTuple):
    """The same beside the tip's law, which is a spring along its normal."""

    secants: Secants
    along: Array  # (r,) mean displacement along the normal
    found: Array  # see ``terms.Contact``; its second number is the stiffness
    answer: Array  # (r,) scratch

    def prepare(self, problem, q, shift):
        """The secants are always those of the last steps."""
        return True

    def step(self, problem, residual, step):
        """Write ``step = - (tangent + spring)^-1 residual`` by Sherman and Morrison's formula."""
        self.secants.step(problem, residual, step)
        along, answer, stiffness = self.along, self.answer, self.found[1]
        superpose(self.secants.inverse, along, answer)
        moved = compliance = 0.0
        for i in range(len(step)):
            moved += along[i] * step[i]
            compliance += along[i] * answer[i]
        share = stiffness * moved / (1.0 + stiffness * compliance)
        for i in range(len(step)):
            step[i] -= share * answer[i]


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
