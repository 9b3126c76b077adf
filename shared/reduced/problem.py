"""One local model as a problem of equilibrium: tissue, its past, its load, its correction.

Theory.  The displacement of a local model is ``u = B q`` with ``r`` modes that are orthonormal in
the energy of the rest state, ``B^T K_0 B = I``.  Linear elasticity and linear visco-elasticity then
need no integration.  Only what the law adds to them is summed over few *cubature points* ``c`` of
positive weight ``w_c`` (Hernandez et al., Comput. Methods Appl. Mech. Engrg. 313 (2017) 687-722).
At the end of a time step the equilibrium minimises

    Pi(q) = q.q/2 - l q.Dq/2 - (f + D h).q + Phi(B q, x)
            + sum_c w_c [(W - W_0)(G_c q) + (psi - psi_0)(G_c q; B_c)]

``G``  gradients of the modes at the points (9, r), 1/mm
``W``  energy density of the law, ``W_0`` that of linear elasticity
``D``  deviatoric part of the rest stiffness in the modes; ``l = sum g_a new_a`` (``mechanics
       .viscosity``), ``h = sum g_a (decay_a z_a + old_a q_n)`` of the past answers' means ``z_a``
``psi``  what the past at a point, ``B_c``, adds to the energy; ``psi_0`` its linear part
``f``  dead load; ``Phi`` contact potential of the rigid tip at ``x``

Each line of it is one member of a ``Problem``, and each member has a type for every case: tissue
without a past (``Elastic``) or with one (``Viscous``), a ``Dead`` load or ``Contact``, and a
correction by the inverse tangent that ``Secants`` make up or by a factorised ``Tangent``.  The
compiler chooses the pieces by these types, so that a term that is absent costs nothing.  A further
past, load or correction is a named tuple and its functions in the table of the piece.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numba.extending import overload
from numpy.typing import NDArray

from palpate.shared.compiled import kind_of
from palpate.shared.mechanics import newton, tissue
from palpate.shared.reduced.corrections import correct, factorise
from palpate.shared.reduced.points import (
    Points,
    added_energy,
    nonlinear_stress,
    project,
    superpose,
)
from palpate.shared.reduced.terms import push, recall, soften

Array = NDArray[np.float64]
Field = NDArray[np.float32]


class Work(NamedTuple):
    """Working memory of one evaluation."""

    H: Field  # (9 c,) displacement gradient in tiles
    P: Field  # (9 c,) stress times weight, in tiles
    J: Array  # (c,) det F
    part: Array  # (c,) of the energy, see ``laws.first_piola``
    linear: Array  # (c,) kPa, energy density of linear elasticity
    stepped: Field  # (r,) state times steps
    latest: Array  # (r,) state of the last evaluation


class Problem(NamedTuple):
    """A local model under a load, for ``mechanics.newton.descend``."""

    points: Points
    past: Any  # Elastic or Viscous
    load: Any  # Dead or Contact
    correction: Any  # Secants or Tangent
    work: Work


@overload(newton.potential, jit_options={"error_model": "numpy"})
def _potential(system, u, residual):
    if kind_of(system) is not Problem:
        return None

    def potential(system, u, residual):
        points, past, work = system.points, system.past, system.work
        steps, stepped, latest = points.steps, work.stepped, work.latest
        for i in range(len(u)):
            stepped[i] = u[i] * steps[i]
            latest[i] = u[i]
        superpose(points.gradients, stepped, work.H)
        nonlinear_stress(work.H, points.weights, points.law, work.J, work.part, work.linear, work.P)
        smallest = work.J.min()
        if not smallest > 0.0:
            return tissue.INVERTED, smallest
        energy = added_energy(points.weights, points.law, work.J, work.part, work.linear)
        energy += recall(past, points, work)
        project(points.gradients, work.P, residual)
        for i in range(len(u)):
            residual[i] = residual[i] * steps[i] + u[i]
            energy += 0.5 * u[i] * u[i]
        energy += soften(past, u, residual)
        return energy + push(system.load, u, residual), smallest

    return potential


@overload(newton.factorise, jit_options={"error_model": "numpy"})
def _factorise(system, u, shift):
    if kind_of(system) is not Problem:
        return None
    return lambda system, u, shift: factorise(system.correction, system, u, shift)


@overload(newton.correct, jit_options={"error_model": "numpy"})
def _correct(system, residual, step):
    if kind_of(system) is not Problem:
        return None
    return lambda system, residual, step: correct(system.correction, system, residual, step)


descend = njit(newton.descend, error_model="numpy", nogil=True, cache=True)
