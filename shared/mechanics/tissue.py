"""Constitutive laws of soft tissue at a material point, compiled.

A law gives the stored energy with the first Piola-Kirchhoff stress, and the tangent: as functions
of arrays for the full model, point by point, and of scalars for the reduced one, many points at a
time.  A 3x3 tensor is a flat array of nine numbers in row-major order,
``F[3 * i + J] = dx_i / dX_J``; the tangent is 9x9 in the same order.

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


@njit(cache=True, error_model="numpy", forceinline=True)
def first_piola(f0, f1, f2, f3, f4, f5, f6, f7, f8, mu, lam):
    """The law in scalars, for loops over many points to become vector code.

    Parameters
    ----------
    f0 ... f8 : float, dimensionless
        Deformation gradient.
    mu, lam : float, kPa

    Returns
    -------
    J, trace : float
        det F and tr(F^T F), of which ``energy`` is made.
    p0 ... p8 : float, kPa
        First Piola-Kirchhoff stress; without meaning where J <= 0.
    """
    c0, c1, c2 = f4 * f8 - f5 * f7, f5 * f6 - f3 * f8, f3 * f7 - f4 * f6
    c3, c4, c5 = f2 * f7 - f1 * f8, f0 * f8 - f2 * f6, f1 * f6 - f0 * f7
    c6, c7, c8 = f1 * f5 - f2 * f4, f2 * f3 - f0 * f5, f0 * f4 - f1 * f3
    J = f0 * c0 + f1 * c1 + f2 * c2  # c = J F^-T
    s = (0.5 * lam * (J * J - 1.0) - mu) / J
    trace = f0 * f0 + f1 * f1 + f2 * f2 + f3 * f3 + f4 * f4 + f5 * f5 + f6 * f6 + f7 * f7 + f8 * f8
    return (
        J, trace,
        mu * f0 + s * c0, mu * f1 + s * c1, mu * f2 + s * c2,
        mu * f3 + s * c3, mu * f4 + s * c4, mu * f5 + s * c5,
        mu * f6 + s * c6, mu * f7 + s * c7, mu * f8 + s * c8,
    )  # fmt: skip


@njit(cache=True, error_model="numpy", forceinline=True)
def energy(J, trace, mu, lam):
    """Energy density (kPa = mN mm / mm^3) at ``J > 0`` and ``tr(F^T F)``."""
    log_J = math.log(J)
    return 0.5 * mu * (trace - 3.0 - 2.0 * log_J) + 0.25 * lam * (J * J - 1.0 - 2.0 * log_J)


@njit(cache=True, error_model="numpy")
def stress(F, mu, lam, P):
    """First Piola-Kirchhoff stress and stored energy of the Neo-Hookean law.

    Parameters
    ----------
    F : ndarray, shape (9,), dimensionless
        Deformation gradient, row-major.
    mu, lam : float, kPa
        Lamé parameters.
    P : ndarray, shape (9,), out, kPa
        Without meaning when J <= 0.

    Returns
    -------
    W, J : float
        Energy density (kPa; ``INVERTED`` if J <= 0) and det F.
    """
    J, trace, P[0], P[1], P[2], P[3], P[4], P[5], P[6], P[7], P[8] = first_piola(
        F[0], F[1], F[2], F[3], F[4], F[5], F[6], F[7], F[8], mu, lam
    )
    if not J > 0.0:
        return INVERTED, J
    return energy(J, trace, mu, lam), J


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


@njit(cache=True, error_model="numpy", forceinline=True)
def rest_stress(h0, h1, h2, h3, h4, h5, h6, h7, h8, mu, lam):
    """Linear elasticity at rest: energy (kPa) and stress ``A(I) : H`` (nine floats, kPa)."""
    trace = h0 + h4 + h8
    s1, s2, s5 = h1 + h3, h2 + h6, h5 + h7
    pressure = lam * trace
    W = (h0 * h0 + h4 * h4 + h8 * h8) * mu + (
        pressure * trace + mu * (s1 * s1 + s2 * s2 + s5 * s5)
    ) / 2
    two = mu + mu
    return (
        W,
        two * h0 + pressure, mu * s1, mu * s2,
        mu * s1, two * h4 + pressure, mu * s5,
        mu * s2, mu * s5, two * h8 + pressure,
    )  # fmt: skip


@njit(cache=True, error_model="numpy", forceinline=True)
def linearise(f0, f1, f2, f3, f4, f5, f6, f7, f8, mu, lam):
    """What ``increment`` needs of a state: ``F^-T`` (t0 ... t8) and the moduli of its two terms.

    Returns
    -------
    t0 ... t8 : float, dimensionless
    geometric, bulk : float, kPa
    """
    c0, c1, c2 = f4 * f8 - f5 * f7, f5 * f6 - f3 * f8, f3 * f7 - f4 * f6
    J = f0 * c0 + f1 * c1 + f2 * c2
    i = 1.0 / J
    return (
        c0 * i, c1 * i, c2 * i,
        (f2 * f7 - f1 * f8) * i, (f0 * f8 - f2 * f6) * i, (f1 * f6 - f0 * f7) * i,
        (f1 * f5 - f2 * f4) * i, (f2 * f3 - f0 * f5) * i, (f0 * f4 - f1 * f3) * i,
        mu - 0.5 * lam * (J * J - 1.0), lam * J * J,
    )  # fmt: skip


@njit(cache=True, error_model="numpy", forceinline=True)
def increment(
    t0, t1, t2, t3, t4, t5, t6, t7, t8, geometric, bulk, mu, h0, h1, h2, h3, h4, h5, h6, h7, h8
):
    """Tangent times a gradient, ``A : H`` (kPa, nine floats), without the tangent.

    ``A : H = mu H + geometric T H^T T + bulk (T : H) T`` with ``T = F^-T``, in the precision of the
    arguments; see ``linearise``.
    """
    # X = T H^T
    x00, x01, x02 = (
        t0 * h0 + t1 * h1 + t2 * h2,
        t0 * h3 + t1 * h4 + t2 * h5,
        t0 * h6 + t1 * h7 + t2 * h8,
    )
    x10, x11, x12 = (
        t3 * h0 + t4 * h1 + t5 * h2,
        t3 * h3 + t4 * h4 + t5 * h5,
        t3 * h6 + t4 * h7 + t5 * h8,
    )
    x20, x21, x22 = (
        t6 * h0 + t7 * h1 + t8 * h2,
        t6 * h3 + t7 * h4 + t8 * h5,
        t6 * h6 + t7 * h7 + t8 * h8,
    )
    b = bulk * (x00 + x11 + x22)
    x00, x01, x02 = geometric * x00 + b, geometric * x01, geometric * x02
    x10, x11, x12 = geometric * x10, geometric * x11 + b, geometric * x12
    x20, x21, x22 = geometric * x20, geometric * x21, geometric * x22 + b
    return (
        mu * h0 + x00 * t0 + x01 * t3 + x02 * t6,
        mu * h1 + x00 * t1 + x01 * t4 + x02 * t7,
        mu * h2 + x00 * t2 + x01 * t5 + x02 * t8,
        mu * h3 + x10 * t0 + x11 * t3 + x12 * t6,
        mu * h4 + x10 * t1 + x11 * t4 + x12 * t7,
        mu * h5 + x10 * t2 + x11 * t5 + x12 * t8,
        mu * h6 + x20 * t0 + x21 * t3 + x22 * t6,
        mu * h7 + x20 * t1 + x21 * t4 + x22 * t7,
        mu * h8 + x20 * t2 + x21 * t5 + x22 * t8,
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def von_mises(f0, f1, f2, f3, f4, f5, f6, f7, f8, mu, lam):
    """Von Mises equivalent (kPa) of the Cauchy stress ``P F^T / J``; see ``first_piola``."""
    J, _, p0, p1, p2, p3, p4, p5, p6, p7, p8 = first_piola(
        f0, f1, f2, f3, f4, f5, f6, f7, f8, mu, lam
    )
    return equivalent(f0, f1, f2, f3, f4, f5, f6, f7, f8, p0, p1, p2, p3, p4, p5, p6, p7, p8, J)


@njit(cache=True, error_model="numpy", forceinline=True)
def equivalent(f0, f1, f2, f3, f4, f5, f6, f7, f8, p0, p1, p2, p3, p4, p5, p6, p7, p8, J):
    """Von Mises equivalent of the Cauchy stress ``P F^T / J``, in the unit of ``P``."""
    s00, s11 = p0 * f0 + p1 * f1 + p2 * f2, p3 * f3 + p4 * f4 + p5 * f5
    s22, s01 = p6 * f6 + p7 * f7 + p8 * f8, p0 * f3 + p1 * f4 + p2 * f5
    s02, s12 = p0 * f6 + p1 * f7 + p2 * f8, p3 * f6 + p4 * f7 + p5 * f8
    a, b, c = s00 - s11, s11 - s22, s22 - s00
    normal = a * a + b * b + c * c
    return math.sqrt(0.5 * normal + 3.0 * (s01 * s01 + s02 * s02 + s12 * s12)) / abs(J)
