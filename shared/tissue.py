"""Constitutive laws of soft tissue at a material point, compiled.

A law is three functions side by side: the stored energy with the first Piola-Kirchhoff stress,
and the tangent.  A 3x3 tensor is a flat array of nine numbers in row-major order,
``F[3 * i + J] = dx_i / dX_J``; the tangent is 9x9 in the same order.  The full and the reduced
model call these very functions.

FEAP's compressible Neo-Hookean law (Taylor, FEAP Theory Manual, finite elasticity)::

    W = mu/2 (tr C - 3 - 2 ln J) + lambda/4 (J^2 - 1 - 2 ln J)
    P = mu (F - F^-T) + lambda/2 (J^2 - 1) F^-T
    A = dP/dF = mu I + (mu - lambda/2 (J^2 - 1)) F^-T (x) F^-1 + lambda J^2 F^-T (.) F^-T

where ``(F^-T (x) F^-1)_iJkL = F^-1_Li... `` reads ``Finv[J, k] * Finv[L, i]``.
"""

import math

from numba import njit

INVERTED = math.inf
"""Energy returned where det F <= 0: a barrier every line search respects."""


def lame(young: float, poisson: float) -> tuple[float, float]:
    """Lamé parameters ``(mu, lambda)`` in the unit of ``young`` (kPa)."""
    mu = young / (2.0 * (1.0 + poisson))
    return mu, young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))


@njit(cache=True, error_model="numpy", inline="always")
def inverse_and_jacobian(F, Finv):
    """Write F^-1 to ``Finv`` (both flat, shape (9,)) and return ``J = det F``."""
    c0 = F[4] * F[8] - F[5] * F[7]
    c1 = F[5] * F[6] - F[3] * F[8]
    c2 = F[3] * F[7] - F[4] * F[6]
    J = F[0] * c0 + F[1] * c1 + F[2] * c2
    inv = 1.0 / J
    Finv[0] = c0 * inv
    Finv[1] = (F[2] * F[7] - F[1] * F[8]) * inv
    Finv[2] = (F[1] * F[5] - F[2] * F[4]) * inv
    Finv[3] = c1 * inv
    Finv[4] = (F[0] * F[8] - F[2] * F[6]) * inv
    Finv[5] = (F[2] * F[3] - F[0] * F[5]) * inv
    Finv[6] = c2 * inv
    Finv[7] = (F[1] * F[6] - F[0] * F[7]) * inv
    Finv[8] = (F[0] * F[4] - F[1] * F[3]) * inv
    return J


@njit(cache=True, error_model="numpy")
def stress(F, mu, lam, Finv, P):
    """First Piola-Kirchhoff stress and stored energy of the Neo-Hookean law.

    Parameters
    ----------
    F : ndarray, shape (9,), dimensionless
        Deformation gradient, row-major.
    mu, lam : float, kPa
        Lamé parameters.
    Finv, P : ndarray, shape (9,), out
        Inverse deformation gradient and stress P (kPa).  Untouched meaning when J <= 0.

    Returns
    -------
    W, J : float
        Energy density (kPa = mN mm / mm^3; ``INVERTED`` if J <= 0) and det F.
    """
    J = inverse_and_jacobian(F, Finv)
    if not J > 0.0:
        return INVERTED, J
    log_J = math.log(J)
    volumetric = 0.5 * lam * (J * J - 1.0) - mu
    trace = -3.0
    for i in range(3):
        for j in range(3):
            P[3 * i + j] = mu * F[3 * i + j] + volumetric * Finv[3 * j + i]
            trace += F[3 * i + j] * F[3 * i + j]
    W = 0.5 * mu * (trace - 2.0 * log_J) + 0.25 * lam * (J * J - 1.0 - 2.0 * log_J)
    return W, J


@njit(cache=True, error_model="numpy")
def tangent(F, mu, lam, Finv, A):
    """Material tangent ``A = dP/dF`` of the Neo-Hookean law.

    Parameters
    ----------
    F : ndarray, shape (9,), dimensionless
    mu, lam : float, kPa
    Finv : ndarray, shape (9,), out
    A : ndarray, shape (9, 9), out, kPa
        Symmetric, row and column in the order of ``F``.

    Returns
    -------
    J : float
        det F.
    """
    J = inverse_and_jacobian(F, Finv)
    geometric = mu - 0.5 * lam * (J * J - 1.0)
    bulk = lam * J * J
    for i in range(3):
        for j in range(3):
            a = 3 * i + j
            for k in range(3):
                for n in range(3):
                    A[a, 3 * k + n] = (
                        geometric * Finv[3 * j + k] * Finv[3 * n + i]
                        + bulk * Finv[3 * j + i] * Finv[3 * n + k]
                    )
            A[a, a] += mu
    return J


@njit(cache=True, error_model="numpy")
def von_mises(F, P, J):
    """Von Mises equivalent of the Cauchy stress ``sigma = P F^T / J`` (kPa)."""
    s00 = (P[0] * F[0] + P[1] * F[1] + P[2] * F[2]) / J
    s11 = (P[3] * F[3] + P[4] * F[4] + P[5] * F[5]) / J
    s22 = (P[6] * F[6] + P[7] * F[7] + P[8] * F[8]) / J
    s01 = (P[0] * F[3] + P[1] * F[4] + P[2] * F[5]) / J
    s02 = (P[0] * F[6] + P[1] * F[7] + P[2] * F[8]) / J
    s12 = (P[3] * F[6] + P[4] * F[7] + P[5] * F[8]) / J
    normal = (s00 - s11) ** 2 + (s11 - s22) ** 2 + (s22 - s00) ** 2
    return math.sqrt(0.5 * normal + 3.0 * (s01 * s01 + s02 * s02 + s12 * s12))


@njit(cache=True, error_model="numpy")
def second_derivative(H, mu, lam, P2):
    """Second derivative of P at rest along ``F = I + s H``: ``P2 = D^2 P(I)[H, H]`` (kPa).

    H, P2 flat, shape (9,).  From the series of F^-1 and J^2 in s.
    """
    a = H[0] + H[4] + H[8]
    trace = 0.0  # tr H^2
    for i in range(3):
        for j in range(3):
            trace += H[3 * i + j] * H[3 * j + i]
    square = 2.0 * a * a - trace  # second coefficient of J^2
    for i in range(3):
        for j in range(3):
            hh = 0.0  # (H H)_ji
            for k in range(3):
                hh += H[3 * j + k] * H[3 * k + i]
            P2[3 * i + j] = -2.0 * mu * hh - 2.0 * lam * a * H[3 * j + i]
        P2[4 * i] += lam * square


@njit(cache=True, error_model="numpy")
def third_derivative(H, H2, mu, lam, P3):
    """Third derivative (kPa) of P at rest along ``F = I + s H + s^2 H2 / 2``.

    ``P3 = D^3 P(I)[H, H, H] + 3 D^2 P(I)[H, H2]``, all flat, shape (9,).
    """
    a = H[0] + H[4] + H[8]
    b = H2[0] + H2[4] + H2[8]
    trace, cross, cube = 0.0, 0.0, 0.0  # tr H^2, tr(H H2), tr H^3
    for i in range(3):
        for j in range(3):
            square = 0.0  # (H H)_ij
            for k in range(3):
                square += H[3 * i + k] * H[3 * k + j]
            P3[3 * j + i] = square
            trace += square if i == j else 0.0
            cube += square * H[3 * j + i]
            cross += H[3 * i + j] * H2[3 * j + i]
    log2, log3 = 0.5 * (b - trace), cube / 3.0 - 0.5 * cross
    b1 = 2.0 * a
    b2 = 2.0 * log2 + 2.0 * a * a
    b3 = 2.0 * log3 + 4.0 * a * log2 + 4.0 / 3.0 * a * a * a
    s = (P3[0], P3[1], P3[2], P3[3], P3[4], P3[5], P3[6], P3[7], P3[8])  # (H H)^T
    for i in range(3):
        for j in range(3):
            x2 = s[3 * i + j] - 0.5 * H2[3 * j + i]  # coefficients of F^-T
            x3 = 0.0
            for k in range(3):
                x3 -= s[3 * k + j] * H[3 * k + i]
                x3 += 0.5 * (H[3 * j + k] * H2[3 * k + i] + H2[3 * j + k] * H[3 * k + i])
            P3[3 * i + j] = 6.0 * (0.5 * lam * (b1 * x2 - b2 * H[3 * j + i]) - mu * x3)
        P3[4 * i] += 3.0 * lam * b3
