"""Visco-hyperelastic tissue: what the past does to the stress at a material point, compiled.

Theory.  Finite linear visco-elasticity (Simo, Comput. Methods Appl. Mech. Engrg. 60 (1987) 153-173;
Holzapfel & Simo, Int. J. Solids Struct. 33 (1996) 3019-3034; Simo & Hughes, Computational
Inelasticity, ch. 10).  At once the tissue answers with its elastic law ``W``.
With time it loses the share ``g_a`` (time constant ``tau_a``) of the isochoric stress of the
modified Neo-Hookean law with the same shear modulus, ``W_iso = mu/2 (tr Cbar - 3)``,
``Cbar = J^-2/3 C``; nothing else relaxes, so the volumetric response and what is left for ever,
``W - sum g W_iso``, are elastic.  In second Piola-Kirchhoff stress, ``DEV[A] = A - (C:A)/3 C^-1``::

    S = dW/dE - J^-2/3 sum g_a DEV[ S0(t) - int_-inf^t exp(-(t-s)/tau_a) dS0(s) ],   S0 = mu DEV[I]

``S0 = mu (I - m)`` with ``m = (tr C / 3) C^-1``, whose DEV vanishes at its own time, so this is

    S = dW/dE + mu J^-2/3 DEV[B],   B = sum g_a (H_a - I),   tau_a dH_a/dt = m - H_a:

the past is in the tensors ``H_a``, which tend to ``m`` as the stress relaxes.  With the means
``c_a`` of ``c = tr Cbar / 3``, kept alike, the free energy is

    Psi = W + mu/2 sum g_a (Cbar : H_a - 3 c_a - tr Cbar + 3),

and ``D = sum mu g_a (Cbar : H_a - 3 c_a) / (2 tau_a)`` is dissipated.  It is never negative,
whatever the history: ``H_a`` is a mean of tensors ``c(s) Cbar(s)^-1`` with ``c_a`` the mean of
``c(s)``, and ``Cbar : Cbar(s)^-1 >= 3``, both being of determinant one.

In a step the integral is exact for ``m`` linear in time, hence for a constant deformation, and of
second order in the step for others::

    H_a(t + dt) = decay H_a(t) + old m(t) + new m(t + dt),
    decay = exp(-dt/tau_a),   new = 1 - (1 - decay) tau_a/dt,   old = 1 - decay - new.

``m`` at the end of the step has no part in the stress there.  So ``B`` is known before the step is
solved, and ``Psi`` with that ``B`` is an incremental potential: stress and symmetric tangent are
its derivatives, and an energy line search works as for elastic tissue.

A *history* is an array (terms + 1, 7): of every term ``H - I`` and ``c_a - 1``, in the last row
``m - I`` and ``c - 1`` at the last time.  Rest is zero.  A symmetric tensor is kept as 00, 11, 22,
12, 02, 01; other tensors as in ``mechanics.tissue``.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from palpate.shared.mechanics.tissue import equivalent, first_piola, inverse_and_jacobian

Array = NDArray[np.float64]

COMPONENTS = 7
"""Of one term of a history: a symmetric tensor and a scalar."""


class Weights(NamedTuple):
    """What a time step does to each term of a Prony series; arrays of shape (terms,)."""

    share: Array  # g
    decay: Array
    old: Array
    new: Array


def step_weights(prony: Sequence[tuple[float, float]], dt: float) -> Weights:
    """Weights of a time step ``dt`` (s), which may be infinite, for terms ``(g, tau in s)``.

    Raises
    ------
    ValueError
        If ``dt`` is negative or not a number.
    """
    if not dt >= 0.0:
        raise ValueError(f"dt: must be >= 0 s, not {dt}")
    terms = []
    for share, tau in prony:
        x = dt / tau
        lost = -math.expm1(-x)  # 1 - decay
        mean = lost / x if x > 1e-4 else 1.0 - x / 2 + x * x / 6
        terms.append((share, 1.0 - lost, lost - (1.0 - mean), 1.0 - mean))
    return Weights(*np.array(terms, dtype=float).reshape(-1, 4).T.copy())


@njit(cache=True, error_model="numpy")
def driving(F, Finv, m):
    """What the history tends to: ``m - I`` and ``c - 1`` of a deformation gradient.

    Parameters
    ----------
    F : ndarray, shape (9,)
    Finv : ndarray, shape (9,), out
    m : ndarray, shape (7,), out
    """
    J = inverse_and_jacobian(F, Finv)
    third = 0.0
    for i in range(9):
        third += F[i] * F[i] / 3.0
    for a in range(6):
        i, j = _pair(a)
        product = 0.0  # C^-1 = F^-1 F^-T
        for k in range(3):
            product += Finv[3 * i + k] * Finv[3 * j + k]
        m[a] = third * product
    for a in range(3):
        m[a] -= 1.0
    m[6] = J ** (-2.0 / 3.0) * third - 1.0


@njit(cache=True, error_model="numpy", inline="always")
def _pair(a):
    """Row and column of component ``a`` of a symmetric tensor."""
    if a < 3:
        return a, a
    return (1 if a == 3 else 0), (2 if a < 5 else 1)


@njit(cache=True, error_model="numpy")
def predict(history, weights, B):
    """What of ``B`` is known before a step is solved, (7,): the tensor, and its mean of ``c``.

    history (terms + 1, 7), weights ``Weights`` of the step.
    """
    terms = len(history) - 1
    B[:] = 0.0
    for a in range(terms):
        g = weights.share[a]
        for i in range(COMPONENTS):
            B[i] += g * (weights.decay[a] * history[a, i] + weights.old[a] * history[terms, i])
        for i in (0, 1, 2, 6):
            B[i] -= g * weights.new[a]


@njit(cache=True, error_model="numpy")
def advance(history, m, weights):
    """Go to the end of a step, where ``driving`` is ``m``, in place."""
    terms = len(history) - 1
    for i in range(COMPONENTS):
        for a in range(terms):
            history[a, i] = (
                weights.decay[a] * history[a, i]
                + weights.old[a] * history[terms, i]
                + weights.new[a] * m[i]
            )
        history[terms, i] = m[i]


@njit(cache=True, error_model="numpy", forceinline=True)
def driven(f0, f1, f2, f3, f4, f5, f6, f7, f8):
    """``m - I`` of a deformation gradient in scalars, for loops over many points."""
    c0, c1, c2 = f4 * f8 - f5 * f7, f5 * f6 - f3 * f8, f3 * f7 - f4 * f6
    c3, c4, c5 = f2 * f7 - f1 * f8, f0 * f8 - f2 * f6, f1 * f6 - f0 * f7
    c6, c7, c8 = f1 * f5 - f2 * f4, f2 * f3 - f0 * f5, f0 * f4 - f1 * f3
    J = f0 * c0 + f1 * c1 + f2 * c2  # c = J F^-T
    trace = f0 * f0 + f1 * f1 + f2 * f2 + f3 * f3 + f4 * f4 + f5 * f5 + f6 * f6 + f7 * f7 + f8 * f8
    s = trace / (3.0 * J * J)
    return (
        s * (c0 * c0 + c3 * c3 + c6 * c6) - 1.0,
        s * (c1 * c1 + c4 * c4 + c7 * c7) - 1.0,
        s * (c2 * c2 + c5 * c5 + c8 * c8) - 1.0,
        s * (c1 * c2 + c4 * c5 + c7 * c8),
        s * (c0 * c2 + c3 * c5 + c6 * c8),
        s * (c0 * c1 + c3 * c4 + c6 * c7),
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def overstress(f0, f1, f2, f3, f4, f5, f6, f7, f8, b0, b1, b2, b3, b4, b5, J, scale):
    """``scale (F B - (C:B)/3 F^-T)`` in scalars, for loops over many points.

    Parameters
    ----------
    f0 ... f8 : float
        Deformation gradient.
    b0 ... b5 : float
        ``B``.
    J, scale : float
        det F, and ``mu J^-2/3`` in kPa.

    Returns
    -------
    contraction : float
        ``C : B``.
    p0 ... p8 : float, kPa
        What the past adds to the first Piola-Kirchhoff stress.
    """
    n0, n1, n2 = (
        f0 * b0 + f1 * b5 + f2 * b4,
        f0 * b5 + f1 * b1 + f2 * b3,
        f0 * b4 + f1 * b3 + f2 * b2,
    )
    n3, n4, n5 = (
        f3 * b0 + f4 * b5 + f5 * b4,
        f3 * b5 + f4 * b1 + f5 * b3,
        f3 * b4 + f4 * b3 + f5 * b2,
    )
    n6, n7, n8 = (
        f6 * b0 + f7 * b5 + f8 * b4,
        f6 * b5 + f7 * b1 + f8 * b3,
        f6 * b4 + f7 * b3 + f8 * b2,
    )
    contraction = (
        f0 * n0 + f1 * n1 + f2 * n2 + f3 * n3 + f4 * n4 + f5 * n5 + f6 * n6 + f7 * n7 + f8 * n8
    )
    s = contraction / (3.0 * J)
    return (
        contraction,
        scale * (n0 - s * (f4 * f8 - f5 * f7)),
        scale * (n1 - s * (f5 * f6 - f3 * f8)),
        scale * (n2 - s * (f3 * f7 - f4 * f6)),
        scale * (n3 - s * (f2 * f7 - f1 * f8)),
        scale * (n4 - s * (f0 * f8 - f2 * f6)),
        scale * (n5 - s * (f1 * f6 - f0 * f7)),
        scale * (n6 - s * (f1 * f5 - f2 * f4)),
        scale * (n7 - s * (f2 * f3 - f0 * f5)),
        scale * (n8 - s * (f0 * f4 - f1 * f3)),
    )


@njit(cache=True, error_model="numpy")
def add_stress(F, B, mu, J, P):
    """Add what the past does to the stress ``P`` (9,) kPa; return what it adds to the energy (kPa).

    Without ``-3/2 mu B[6]``, a constant of the step beside which small energies would drown.
    F (9,) with det F = ``J > 0``; B (7,) from ``predict``; ``mu`` kPa.
    """
    scale = mu * J ** (-2.0 / 3.0)
    contraction, p0, p1, p2, p3, p4, p5, p6, p7, p8 = overstress(
        F[0], F[1], F[2], F[3], F[4], F[5], F[6], F[7], F[8],
        B[0], B[1], B[2], B[3], B[4], B[5], J, scale,
    )  # fmt: skip
    P[0] += p0
    P[1] += p1
    P[2] += p2
    P[3] += p3
    P[4] += p4
    P[5] += p5
    P[6] += p6
    P[7] += p7
    P[8] += p8
    return 0.5 * scale * contraction


@njit(cache=True, error_model="numpy")
def add_tangent(F, B, mu, Finv, FB, A):
    """Add what the past does to the tangent ``A`` (9, 9) kPa, symmetric.

    F (9,); B (7,) from ``predict``; ``mu`` kPa; Finv, FB (9,) are scratch.
    """
    J = inverse_and_jacobian(F, Finv)
    contraction = 0.0
    for i in range(3):
        f, g, h = F[3 * i], F[3 * i + 1], F[3 * i + 2]
        FB[3 * i] = f * B[0] + g * B[5] + h * B[4]
        FB[3 * i + 1] = f * B[5] + g * B[1] + h * B[3]
        FB[3 * i + 2] = f * B[4] + g * B[3] + h * B[2]
        contraction += f * FB[3 * i] + g * FB[3 * i + 1] + h * FB[3 * i + 2]
    scale = mu * J ** (-2.0 / 3.0)
    third = contraction / 3.0
    for i in range(3):
        for j in range(3):
            a = 3 * i + j
            for k in range(3):
                for n in range(3):
                    b = 3 * k + n
                    Ta, Tb = Finv[3 * j + i], Finv[3 * n + k]
                    A[a, b] += scale * (
                        third * (2.0 / 3.0 * Ta * Tb + Finv[3 * j + k] * Finv[3 * n + i])
                        - 2.0 / 3.0 * (FB[a] * Tb + Ta * FB[b])
                    )
            for n in range(3):
                A[a, 3 * i + n] += scale * B[_component(j, n)]


@njit(cache=True, error_model="numpy", inline="always")
def _component(i, j):
    """Where a symmetric tensor keeps row ``i`` and column ``j``."""
    return i if i == j else 6 - i - j


@njit(cache=True, error_model="numpy")
def dissipation(F, history, weights, tau, mu):
    """Dissipated power (kPa/s) at the last time of a history, whose deformation gradient is F."""
    J = F[0] * (F[4] * F[8] - F[5] * F[7])
    J += F[1] * (F[5] * F[6] - F[3] * F[8]) + F[2] * (F[3] * F[7] - F[4] * F[6])
    trace = 0.0
    for i in range(9):
        trace += F[i] * F[i]
    power = 0.0
    for a in range(len(tau)):
        h = history[a]
        contraction = trace
        for i in range(3):
            for j in range(3):
                product = F[i] * F[j] + F[3 + i] * F[3 + j] + F[6 + i] * F[6 + j]
                contraction += product * h[_component(i, j)]
        excess = J ** (-2.0 / 3.0) * contraction - 3.0 * (1.0 + h[6])
        power += 0.5 * mu * weights.share[a] * excess / tau[a]
    return power


@njit(cache=True, error_model="numpy", forceinline=True)
def von_mises(f0, f1, f2, f3, f4, f5, f6, f7, f8, b0, b1, b2, b3, b4, b5, mu, lam):
    """Von Mises equivalent (kPa) of the Cauchy stress with its past; see ``overstress``."""
    J, _, p0, p1, p2, p3, p4, p5, p6, p7, p8 = first_piola(
        f0, f1, f2, f3, f4, f5, f6, f7, f8, mu, lam
    )
    _, q0, q1, q2, q3, q4, q5, q6, q7, q8 = overstress(
        f0, f1, f2, f3, f4, f5, f6, f7, f8, b0, b1, b2, b3, b4, b5, J, mu * abs(J) ** (-2.0 / 3.0)
    )
    return equivalent(
        f0, f1, f2, f3, f4, f5, f6, f7, f8,
        p0 + q0, p1 + q1, p2 + q2, p3 + q3, p4 + q4, p5 + q5, p6 + q6, p7 + q7, p8 + q8, J,
    )  # fmt: skip
