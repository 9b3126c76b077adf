"""Constitutive law of soft tissue at a material point, compiled.

The law is written once, in tensors that are tuples of numbers (``mechanics.tensors``): the full
model calls it point by point, the reduced one in loops over many points that become vector code.

FEAP's compressible Neo-Hookean law (Taylor, FEAP Theory Manual, finite elasticity)::

    W = mu/2 (tr C - 3 - 2 ln J) + lambda/4 (J^2 - 1 - 2 ln J)
    P = mu (F - F^-T) + lambda/2 (J^2 - 1) F^-T
    A : H = mu H + (mu - lambda/2 (J^2 - 1)) F^-T H^T F^-T + lambda J^2 (F^-T : H) F^-T

with ``A = dP/dF``; mu, lambda and all that is derived from them are in kPa.
"""

import math

from numba import njit

from palpate.shared.mechanics.tensors import (
    add_dot,
    add_identity,
    cofactor,
    combine,
    ddot,
    det,
    dot,
    scale,
    store,
    trace,
    transposed,
    unit,
)

INVERTED = math.inf
"""Energy returned where det F <= 0: a barrier every line search respects."""


def lame(young: float, poisson: float) -> tuple[float, float]:
    """Lamé parameters ``(mu, lambda)`` in the unit of ``young`` (kPa)."""
    mu = young / (2.0 * (1.0 + poisson))
    return mu, young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))


@njit(cache=True, error_model="numpy", forceinline=True)
def first_piola(F, mu, lam):
    """Stress of a deformation gradient.

    Returns
    -------
    J, square : float
        det F and F : F, of which ``energy`` is made.
    P : tuple of 9 floats, kPa
        First Piola-Kirchhoff stress; without meaning where J <= 0.
    """
    C = cofactor(F)  # J F^-T
    J = det(F, C)
    s = (0.5 * lam * (J * J - 1.0) - mu) / J
    return J, ddot(F, F), combine(mu, F, s, C)


@njit(cache=True, error_model="numpy", forceinline=True)
def energy(J, square, mu, lam):
    """Energy density (kPa = mN mm / mm^3) at ``J > 0`` and ``square = F : F``."""
    log_J = math.log(J)
    return 0.5 * mu * (square - 3.0 - 2.0 * log_J) + 0.25 * lam * (J * J - 1.0 - 2.0 * log_J)


@njit(cache=True, error_model="numpy", forceinline=True)
def linearise(F, mu, lam):
    """What ``increment`` needs of a state: ``F^-T`` and the moduli (kPa) of its last two terms."""
    C = cofactor(F)
    J = det(F, C)
    return scale(1.0 / J, C), mu - 0.5 * lam * (J * J - 1.0), lam * J * J


@njit(cache=True, error_model="numpy", forceinline=True)
def increment(T, geometric, bulk, mu, H):
    """``A : H = mu H + geometric T H^T T + bulk (T : H) T`` (kPa); see ``linearise``."""
    X = dot(T, transposed(H))
    X = add_identity(scale(geometric, X), bulk * trace(X))
    return add_dot(scale(mu, H), X, T)


@njit(cache=True, error_model="numpy")
def tangent(F, mu, lam, A):
    """Write ``A = dP/dF`` (9, 9) kPa, which is symmetric."""
    T, geometric, bulk = linearise(F, mu, lam)
    for k in range(9):
        store(increment(T, geometric, bulk, mu, unit(k)), A[k], 0, 1)


@njit(cache=True, error_model="numpy", forceinline=True)
def rest_stress(H, mu, lam):
    """Linear elasticity at rest: energy density (kPa) and stress ``A(I) : H`` (kPa)."""
    pressure = lam * trace(H)
    s1, s2, s5 = H[1] + H[3], H[2] + H[6], H[5] + H[7]
    W = (H[0] * H[0] + H[4] * H[4] + H[8] * H[8]) * mu + (
        pressure * trace(H) + mu * (s1 * s1 + s2 * s2 + s5 * s5)
    ) / 2
    two = mu + mu
    return W, (
        two * H[0] + pressure, mu * s1, mu * s2,
        mu * s1, two * H[4] + pressure, mu * s5,
        mu * s2, mu * s5, two * H[8] + pressure,
    )  # fmt: skip


@njit(cache=True, error_model="numpy", forceinline=True)
def von_mises(F, mu, lam):
    """Von Mises equivalent (kPa) of the Cauchy stress of a deformation gradient."""
    J, _, P = first_piola(F, mu, lam)
    return equivalent(F, P, J)


@njit(cache=True, error_model="numpy", forceinline=True)
def equivalent(F, P, J):
    """Von Mises equivalent of the Cauchy stress ``P F^T / J``, in the unit of ``P``."""
    S = dot(P, transposed(F))
    a, b, c = S[0] - S[4], S[4] - S[8], S[8] - S[0]
    normal = a * a + b * b + c * c
    return math.sqrt(0.5 * normal + 3.0 * (S[1] * S[1] + S[2] * S[2] + S[5] * S[5])) / abs(J)
