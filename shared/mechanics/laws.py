"""Constitutive laws: one file and one line of ``AnyTissue`` for each.

A law is stored energy ``W(F)`` (kPa = mN mm / mm^3), the first Piola-Kirchhoff stress ``P = dW/dF``
and its derivative ``A = dP/dF``; F is the deformation gradient, ``J = det F``.  Its file has a
named tuple of its parameters, first the Lamé parameters at rest, with the methods of
``mechanics.tissue.Law`` in tensors of ``mechanics.tensors``; and its table in a scene, a kind of
``Tissue``.

So every law is written once: the full model calls it point by point, the reduced one in loops over
many points that become vector code.
"""

import numpy as np
from numba import njit

from palpate.shared.arrays import Ints, Numbers
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


def law_of(tissue: AnyTissue, regions: Numbers) -> Law:
    """Parameters (n,) of a tissue at points in regions (n,): 0 is none of them, n the n-th."""
    kind = tissue.parameters
    values = [
        (*lame(own.young, own.poisson), *(getattr(own, name) for name in kind._fields[2:]))
        for own in (tissue, *tissue.region)
    ]
    law: Law = kind(*np.array(values)[regions].T.copy())
    return law


def law_at_points(law: Law, parts: Ints) -> Law:
    """Parameters (e, q) of what of a law (e,) counts at the points of elements: parts (q,)."""
    values = (np.stack(part, axis=1)[:, parts] for part in zip(*law.parts(), strict=True))
    found: Law = type(law)(*map(np.ascontiguousarray, values))
    return found


@njit(cache=True, error_model="numpy")
def tangent(law, F, A):
    """Write ``A = dP/dF`` (9, 9) kPa, which is symmetric."""
    state = law.linearise(F)
    for k in range(9):
        store(law.increment(state, unit(k)), A[k], 0, 1)


@njit(cache=True, error_model="numpy", forceinline=True)
def von_mises(law, F):
    """Von Mises equivalent (kPa) of the Cauchy stress at a deformation gradient."""
    J, _, P = law.first_piola(F)
    return equivalent(F, P, J)
