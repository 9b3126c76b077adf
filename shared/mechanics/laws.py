"""Constitutive laws: one file and one line of ``AnyTissue`` for each.

A law is stored energy ``W(F)`` (kPa = mN mm / mm^3), the first Piola-Kirchhoff stress ``P = dW/dF``
and its derivative ``A = dP/dF``; F is the deformation gradient, ``J = det F``.  Its file has a
named tuple of its parameters, first the Lamé parameters at rest, whose methods are the functions
below, in tensors of ``mechanics.tensors``; and its table in a scene, a kind of ``Tissue``.

So every law is written once: the full model calls it point by point, the reduced one in loops over
many points that become vector code.  The compiler takes the functions by the tuple's type.
"""

from typing import Any, get_args

import numpy as np
from numba import njit

from palpate.shared.compiled import by_type
from palpate.shared.mechanics.demiray import DemirayTissue
from palpate.shared.mechanics.mooney_rivlin import MooneyRivlinTissue
from palpate.shared.mechanics.neo_hookean import NeoHookeanTissue
from palpate.shared.mechanics.tensors import store, unit
from palpate.shared.mechanics.tissue import Law, equivalent, lame

AnyTissue = (
    NeoHookeanTissue
    | MooneyRivlinTissue
    | DemirayTissue
)  # fmt: skip

LAWS: list[Any] = [tissue.parameters for tissue in get_args(AnyTissue)]


def law_of(tissue: AnyTissue, count: int) -> Law:
    """Parameters of so many points of a tissue."""
    kind = tissue.parameters
    constants = (getattr(tissue, name) for name in kind._fields[2:])
    values = *lame(tissue.young, tissue.poisson), *constants
    law: Law = kind(*(np.full(count, value) for value in values))
    return law


def at(law, i):
    """Parameters at one point, or at those of a slice."""


def first_piola(law, F):
    """Stress at a deformation gradient.

    Returns
    -------
    J : float
        det F.
    part : float
        What ``energy`` needs besides J.
    P : tuple of 9 floats, kPa
        First Piola-Kirchhoff stress; without meaning where J <= 0.
    """


def energy(law, J, part):
    """Energy density (kPa) at ``J > 0``; see ``first_piola``."""


def linearise(law, F):
    """What ``increment`` needs of a state: a tensor and nine moduli (kPa), first mu and lam."""


def increment(law, state, H):
    """``A : H`` (kPa), linear in the moduli of the state."""


for piece in (at, first_piola, energy, linearise, increment):
    by_type(piece, {law: getattr(law, piece.__name__) for law in LAWS}, forceinline=True)


@njit(cache=True, error_model="numpy")
def tangent(law, F, A):
    """Write ``A = dP/dF`` (9, 9) kPa, which is symmetric."""
    state = linearise(law, F)
    for k in range(9):
        store(increment(law, state, unit(k)), A[k], 0, 1)


@njit(cache=True, error_model="numpy", forceinline=True)
def von_mises(law, F):
    """Von Mises equivalent (kPa) of the Cauchy stress at a deformation gradient."""
    J, _, P = first_piola(law, F)
    return equivalent(F, P, J)
