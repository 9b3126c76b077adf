"""Static equilibrium by Newton's method with an energy line search, for any size of model.

A model takes part by three methods.  ``potential(u, residual)`` writes the residual (internal minus
external force) at ``u`` and returns the total potential energy, whose gradient that is, and the
smallest det F.  ``factorise(u, shift)`` factorises the tangent at ``u`` plus ``shift`` times the
rest stiffness; False if it is not positive definite.  ``correct(residual, step)`` writes ``step = -
(factorised tangent)^-1 residual``.  For the full model this source runs as Python, for the reduced
one it is compiled.

Equilibria are sought as minima: where the tangent is not positive definite it is shifted by a
multiple of the rest stiffness until it is, from a quarter of the last one on (Nocedal & Wright,
Numerical Optimization, algorithm 3.3), and every step must lower the potential (ch. 3).
"""

import math

import numpy as np

CONVERGED, STALLED, EXHAUSTED = 0, 1, 2

SUFFICIENT_DECREASE = 1e-4
SMALLEST_STEP = 1e-6
SMALLEST_SHIFT, LARGEST_SHIFT = 0.01, 1e4


def newton(
    system, u, work, target, reuse, max_iterations, factorised, round_off=1e-9, noise=0.0,
    largest_shift=LARGEST_SHIFT,
):  # fmt: skip
    """Find the equilibrium of ``system`` near ``u``, in place.

    Parameters
    ----------
    system
        With the methods above.
    u : ndarray, shape (n,)
        Start on entry, equilibrium on return.
    work : ndarray, shape (4, n)
        Scratch: residual, step, trial state, trial residual.
    target : float
        Residual norm at which the state counts as equilibrium (units of the residual).
    reuse : float
        A factorised tangent serves again while it contracts the residual at least by this factor;
        0 gives Newton's method proper, quadratic to the end.
    max_iterations : int
    factorised : bool
        Whether ``system`` still holds the factorised tangent of a state near ``u``.
    round_off : float
        Relative error with which the system knows its energy; where strains are small, it is a
        difference of large numbers.
    noise : float
        Absolute error of the energy, which does not vanish with the load.
    largest_shift : float
        Of the tangent, beyond which the search has failed; 0 ends it at the first tangent that is
        not positive definite.

    Returns
    -------
    status : int
        ``CONVERGED``, ``STALLED`` (no descent found, no tangent positive definite, or ``u`` inverts
        an element on entry) or ``EXHAUSTED`` (iterations used up).
    iterations : int
        Corrections made.
    energy : float
        Potential at ``u``; ``work[0]`` holds the residual there.
    smallest : float
        Smallest det F at ``u``.
    """
    residual, step, trial, trial_residual = work[0], work[1], work[2], work[3]
    energy, smallest = system.potential(u, residual)
    if not smallest > 0:  # beyond an inverted element there is neither residual nor tangent
        return STALLED, 0, energy, smallest
    norm = math.sqrt(np.dot(residual, residual))
    stale = not factorised
    iterations, shift = 0, 0.0
    while not norm <= target:
        if iterations == max_iterations:
            return EXHAUSTED, iterations, energy, smallest
        if stale:
            shift = 0.25 * shift if shift > SMALLEST_SHIFT else 0.0
            while not system.factorise(u, shift):
                shift = max(SMALLEST_SHIFT, 4.0 * shift)
                if shift > largest_shift:
                    return STALLED, iterations, energy, smallest
        system.correct(residual, step)
        slope = np.dot(residual, step)
        length = 1.0
        while True:
            np.multiply(step, length, trial)
            np.add(trial, u, trial)
            trial_energy, trial_smallest = system.potential(trial, trial_residual)
            allowed = SUFFICIENT_DECREASE * length * slope + round_off * abs(energy) + noise
            if trial_energy - energy <= allowed:
                break
            length *= 0.5
            if length < SMALLEST_STEP:
                break
        iterations += 1
        if length < SMALLEST_STEP:
            if stale:
                return STALLED, iterations, energy, smallest
            stale = True
            continue
        u[:] = trial
        residual[:] = trial_residual
        energy, smallest = trial_energy, trial_smallest
        previous = norm
        norm = math.sqrt(np.dot(residual, residual))
        stale = length < 1.0 or norm > reuse * previous
    return CONVERGED, iterations, energy, smallest
