"""Polynomials in a load, in a position of the tip, and in their places on a local model."""

import math

import numpy as np
from numba import njit

from palpate.shared.mechanics.footprint import LIMIT_FIELDS
from palpate.shared.mechanics.tip import CONTACT_FIELDS

RIM = LIMIT_FIELDS + CONTACT_FIELDS
"""Which of the values at a place, after load range and what a contact needs, is its distance from
the rim of the surface, in radii of the endoscope."""

CHANGING = 12
"""Directions in which the first tangent of a load's search is another than at rest."""

LOAD_FEATURES = (6 + 10) * 6
TANGENT_FEATURES = 1 + (3 + 6) * 3
CHANGES = CHANGING * (CHANGING + 1) // 2


@njit(cache=True, error_model="numpy", nogil=True)
def _along(frame, v):
    """Components of a vector along the rows of a frame: the normal and two tangents."""
    a = frame[0, 0] * v[0] + frame[0, 1] * v[1] + frame[0, 2] * v[2]
    b = frame[1, 0] * v[0] + frame[1, 1] * v[1] + frame[1, 2] * v[2]
    c = frame[2, 0] * v[0] + frame[2, 1] * v[1] + frame[2, 2] * v[2]
    return a, b, c


@njit(cache=True, error_model="numpy", nogil=True)
def _from_centre(frame, centre, x):
    """Position along the surface, mm from the centre."""
    _, s, t = _along(frame, (x[0] - centre[0], x[1] - centre[1], x[2] - centre[2]))
    return s, t


@njit(cache=True, error_model="numpy", nogil=True)
def load_features(frame, centre, x, load, out, of_tangent):
    """Polynomials in a load and its place on a local model.

    Parameters
    ----------
    frame : ndarray, shape (3, 3)
    centre, x : ndarray, shape (3,), mm
    load : ndarray, shape (3,)
        Pressure times direction over the model's pressure.
    out : ndarray, shape (LOAD_FEATURES,), out
        Monomials of degree 2 and 3 in the load times monomials of degree 0-2 in the position along
        the surface (mm from the centre), both in the model's frame.
    of_tangent : ndarray, shape (TANGENT_FEATURES,), out
        1, and degree 1 and 2 in the load times degree 0 and 1 in the position.
    """
    (s, t), (a, b, c) = _from_centre(frame, centre, x), _along(frame, load)
    of_tangent[0] = 1.0
    k, n = 0, 1
    for degree in range(1, 4):
        for i in range(degree + 1):
            for j in range(degree + 1 - i):
                monomial = b**i * c**j * a ** (degree - i - j)
                if degree < 3:
                    of_tangent[n] = monomial
                    of_tangent[n + 1] = monomial * s
                    of_tangent[n + 2] = monomial * t
                    n += 3
                if degree > 1:
                    out[k] = monomial
                    out[k + 1] = monomial * s
                    out[k + 2] = monomial * t
                    out[k + 3] = monomial * s * s
                    out[k + 4] = monomial * s * t
                    out[k + 5] = monomial * t * t
                    k += 6


RESIDUAL_FEATURES = 16

LEAST_LOAD = 1e-2
"""Share of the largest trained pressure below which residuals are taken for those there."""


@njit(cache=True, error_model="numpy", nogil=True)
def residual_features(frame, centre, x, direction, share, out):
    """What the residual of an answer in the full model depends on, (RESIDUAL_FEATURES,).

    Monomials up to degree 2 in the position on the local model (mm from the centre) and in the two
    tangential components of the unit direction, and the load's share of the largest trained
    pressure, as it is and its log.
    """
    (s, t), (_, b, c) = _from_centre(frame, centre, x), _along(frame, direction)
    share = min(max(share, LEAST_LOAD), 1.0)
    log = math.log(share)
    out[0], out[1], out[2], out[3], out[4], out[5] = 1.0, s, t, s * s, s * t, t * t
    out[6], out[7], out[8], out[9], out[10] = b, c, b * b, b * c, c * c
    out[11], out[12], out[13], out[14], out[15] = share, share**2, log, log * b, log * c


@njit(cache=True, error_model="numpy", nogil=True)
def log_residual(solver, x, direction, share):
    """Log of the residual in the full model that such answers leave, as trained."""
    models, active, features = solver.models, solver.active, solver.scratch.residual_features
    log = 0.0
    for slot in range(len(active.number)):
        k = active.number[slot]
        if k >= 0:
            centre = models.centres[:, k]
            residual_features(models.frames[k], centre, x, direction, share, features)
            log += active.weight[slot] * np.dot(models.residuals[k], features)
    return log


@njit(cache=True, error_model="numpy", nogil=True)
def near_rim(at):
    """1 where values (RIM + 1,) are those of a place within a radius of the rim, 0 elsewhere."""
    return 1.0 if at[RIM] < 1.0 else 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def estimate_errors(coefficients, features, errors):
    """Estimated errors: ``log error = c . features``."""
    for i in range(len(coefficients)):
        errors[i] = math.exp(np.dot(coefficients[i], features))


UNFITTED = np.empty((0, 3))
"""Coefficients of the mesh's errors that are not known."""


@njit(cache=True, error_model="numpy", nogil=True)
def total_errors(errors, fitted, share, rim, mesh, total):
    """Write the mesh's errors (3,) and those of mesh and reduction together, (3,).

    ``fitted`` (3, 3) are coefficients of their logs: 1, the share of the limit, near the rim; it
    has no rows where they are not known.
    """
    inside = min(max(share, 0.0), 1.0)
    for i in range(3):
        mesh[i] = 0.0
        if i < len(fitted):
            mesh[i] = math.exp(fitted[i, 0] + fitted[i, 1] * inside + fitted[i, 2] * rim)
        total[i] = math.hypot(errors[i], mesh[i]) if mesh[i] > 0.0 else errors[i]
