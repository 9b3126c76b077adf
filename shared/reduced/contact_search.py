"""Search for the equilibrium of a local model in contact with the tip.

Contact is too stiff for secants: Newton's method factorises the tangent.  A search never ends in a
saddle, and where one jump fails it goes the way in, step by step.
"""

import math

import numpy as np
from numba import njit

from palpate.shared.mechanics import newton
from palpate.shared.mechanics.sphere import HARDNESS
from palpate.shared.reduced.problem import newton_method

TOLERANCE = 0.001
"""Residual before the last correction relative to the response, both in the energy norm of the
rest state.  The last correction reduces it to about its square; it is applied but not evaluated.
The tangent on the tool is that before it: in hard contact 1 % of it is a matter of micrometres."""

SLIGHT = 0.05
"""Depth in radii of the tip below which an answer need not be nearer to equilibrium, in that norm,
than one so deep: where contact begins Newton's method is slow, and the force next to nothing."""

MAX_ITERATIONS = 40

ROUND_OFF = 1e-6
"""Relative error of the energy: gradients are summed in single precision."""

MOST_SADDLES, NUDGE = 3, 0.02
"""Saddles that one search leaves at most, and by how much of the response."""

RAMP = 8
"""Steps of the way in when an equilibrium cannot be found in one jump."""


@njit(cache=True, error_model="numpy", nogil=True)
def _response(tip, depth):
    """About a tenth of the least response to a tip so deep, in the energy norm."""
    return 0.1 * depth * tip.radius * math.sqrt(tip.stiffness / HARDNESS)


@njit(cache=True, error_model="numpy", nogil=True)
def solve_contact(problem, q, work, depth, tolerance, most):
    """Equilibrium near q, in place: (status, iterations, energy, smallest det F).

    The tolerance is relative to the response, which is not known before; the depth says what it may
    be.
    """
    tip, iterations = problem.load.tip, 0
    least = _response(tip, SLIGHT * tip.radius)
    size = max(math.sqrt(np.dot(q, q)), _response(tip, depth), least)
    while True:
        status, more, energy, smallest = newton_method(
            problem, q, work, tolerance * size, 0.0, most, False, ROUND_OFF
        )
        iterations += more
        found = math.sqrt(np.dot(q, q))
        if status != newton.CONVERGED or size <= 2.0 * found or size <= least:
            return status, iterations, energy, smallest
        size = max(found, least)


@njit(cache=True, error_model="numpy", nogil=True)
def to_minimum(problem, q, work, depth, tolerance, most):
    """As ``solve_contact``, but never in a saddle, and with the tangent at q factorised.

    Where tissue snaps, equilibria end in saddles; from one the search goes on the way down.
    """
    status, iterations, energy, smallest = solve_contact(problem, q, work, depth, tolerance, most)
    saddles = 0
    while status == newton.CONVERGED and not problem.factorise(q, 0.0):
        saddles += 1
        if saddles > MOST_SADDLES or iterations >= most:
            return newton.STALLED, iterations, energy, smallest
        _leave_saddle(problem, q, work)
        status, more, energy, smallest = solve_contact(problem, q, work, depth, tolerance, most)
        iterations += more
    return status, iterations, energy, smallest


@njit(cache=True, error_model="numpy", nogil=True)
def _leave_saddle(problem, q, work):
    """Move q, a saddle, along the eigenvector of the least eigenvalue of the tangent."""
    tangent = problem.correction.work.whole
    K = np.tril(tangent) + np.tril(tangent, -1).T
    down = NUDGE * math.sqrt(np.dot(q, q)) * np.linalg.eigh(K)[1][:, 0]
    ahead, _ = problem.potential(q + down, work[3])
    back, _ = problem.potential(q - down, work[3])
    q += down if ahead < back else -down


@njit(cache=True, error_model="numpy", nogil=True)
def along_the_way_in(problem, q, work, depth, normal, most):
    """As ``to_minimum``, from rest in steps along the way in, for where a jump fails."""
    at = problem.load.x
    away = depth * normal
    at += away
    q[:] = 0.0
    problem.correction.formed[:] = np.inf
    status, iterations, energy, smallest = newton.CONVERGED, 0, 0.0, 1.0
    for _ in range(RAMP):
        if status == newton.CONVERGED:
            at -= away / RAMP
            status, more, energy, smallest = to_minimum(problem, q, work, depth, TOLERANCE, most)
            iterations += more
    return status, iterations, energy, smallest
