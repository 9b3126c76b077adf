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

A *history* is an array (terms + 1, n): of every term ``H - I``, in the last row ``m - I`` at the
last time, of many points one after the other or component by component.  Rest is zero.  Tensors are
those of ``mechanics.tensors``; those of a history are packed.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from palpate.shared.arrays import Array
from palpate.shared.mechanics.tensors import (
    FAST,
    add,
    cofactor,
    constant,
    ddot,
    det,
    dot,
    gram,
    inline,
    isochoric,
    load,
    scale,
    store,
    subtract,
    transposed,
    unit,
)
from palpate.shared.mechanics.tissue import equivalent


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


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def predict(history, weights, out):
    """What of ``B`` is known before a step is solved, but for the multiple of ``I`` in it.

    Parameters
    ----------
    history : ndarray, shape (terms + 1, n)
    weights : Weights
        Of the step.
    out : ndarray, shape (n,), out
        ``sum g (decay (H - I) + old (m - I))``; ``B`` is that less ``loss I``.

    Returns
    -------
    loss : float
        ``sum g new``.
    """
    terms = len(history) - 1
    last = history[terms]
    loss = 0.0
    out[:] = constant(0.0, last[0])
    for a in range(terms):
        row = history[a]
        loss += weights.share[a] * weights.new[a]
        kept = constant(weights.share[a] * weights.decay[a], last[0])
        old = constant(weights.share[a] * weights.old[a], last[0])
        for i in range(len(out)):
            out[i] += kept * row[i] + old * last[i]
    return loss


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def advance(m, weights, history):
    """Go to the end of a step, where ``m - I`` is ``m`` (n,); history (terms + 1, n) in place."""
    terms = len(history) - 1
    last = history[terms]
    for a in range(terms):
        row = history[a]
        decay = constant(weights.decay[a], last[0])
        old, new = constant(weights.old[a], last[0]), constant(weights.new[a], last[0])
        for i in range(len(row)):
            row[i] = decay * row[i] + old * last[i] + new * m[i]
    for i in range(len(last)):
        last[i] = m[i]


@njit(cache=True, error_model="numpy", forceinline=True)
def driven(F):
    """``m - I`` of a deformation gradient, packed."""
    C = cofactor(F)  # J F^-T
    J = det(F, C)
    s = ddot(F, F) / (3.0 * J * J)
    a, b, c, d, e, f = gram(C)
    return s * a - 1.0, s * b - 1.0, s * c - 1.0, s * d, s * e, s * f


@njit(cache=True, error_model="numpy", forceinline=True)
def overstress(F, B, J, modulus):
    """What the past adds to the stress: ``modulus (F B - (C:B)/3 F^-T)``.

    Parameters
    ----------
    F, B : tuple of 9 floats
    J, modulus : float
        det F > 0, and ``mu J^-2/3`` in kPa.

    Returns
    -------
    contraction : float
        ``C : B``.  ``modulus/2 C:B`` is what the past adds to the energy density, but for a
        constant of the step beside which small energies would drown.
    P : tuple of 9 floats, kPa
    """
    N = dot(F, B)
    contraction = ddot(F, N)
    s = contraction / (3.0 * J)
    return contraction, scale(modulus, subtract(N, scale(s, cofactor(F))))


@njit(cache=True, error_model="numpy", forceinline=True)
def linearise(F, B, modulus):
    """What ``increment`` needs of a state: ``G = F^-T``, and ``F B``, ``B``, ``C:B/3`` (kPa)."""
    C = cofactor(F)
    B = scale(modulus, B)
    FB = dot(F, B)
    return scale(1.0 / det(F, C), C), FB, B, ddot(F, FB) / 3.0


@inline
def increment(G, FB, B, third, H):
    """What the past adds to ``A : H`` (kPa), of the state that ``linearise`` has described.

    ``H B - 2/3 (G:H) F B - 2/3 (FB:H) G + C:B/3 (2/3 (G:H) G + G H^T G)``
    """
    share = constant(2.0 / 3.0, third)
    wider = share * ddot(G, H)
    D = subtract(dot(H, B), scale(wider, FB))
    D = add(D, scale(third * wider - share * ddot(FB, H), G))
    return add(D, scale(third, dot(G, dot(transposed(H), G))))


@njit(cache=True, error_model="numpy")
def add_tangent(F, B, mu, A):
    """Add what the past does to the tangent ``A`` (9, 9) kPa, which stays symmetric."""
    modulus = mu * isochoric(det(F, cofactor(F)))
    G, FB, B, third = linearise(F, B, modulus)
    for k in range(9):
        row = A[k]
        store(add(load(row, 0, 1), increment(G, FB, B, third, unit(k))), row, 0, 1)


@njit(cache=True, error_model="numpy", forceinline=True)
def von_mises(law, F, B):
    """Von Mises equivalent (kPa) of the Cauchy stress with its past; see ``overstress``."""
    J, _, P = law.first_piola(F)
    _, Q = overstress(F, B, J, law.mu * isochoric(abs(J)))
    return equivalent(F, add(P, Q), J)
