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
``f``  dead load; ``Phi`` energy of the law of the rigid tip at ``x``

Each line of it is one member of a ``Problem``, and each member has a type for every case: tissue
without a past (``Elastic``) or with one (``Remembering``), a ``Dead`` load or the tip as well
(``Pushed``), and a correction by the inverse tangent that ``Secants`` make up, beside the law's
spring in ``TouchedSecants``.  A further past, load or correction is a named tuple with the same
methods.
"""

from typing import Annotated, Any, NamedTuple

from numba import njit

from palpate.shared.arrays import Array, Field
from palpate.shared.compiled import methods
from palpate.shared.mechanics import newton, tissue
from palpate.shared.reduced.points import Points, added_energy, nonlinear_stress, project


class Work(NamedTuple):
    """Working memory of one evaluation."""

    H: Annotated[Field, "9 c"]  # displacement gradient in tiles
    P: Annotated[Field, "9 c"]  # stress times weight, in tiles
    J: Annotated[Array, "c"]  # det F
    part: Annotated[Array, "c"]  # of the energy, see ``tissue.Law.first_piola``
    linear: Annotated[Array, "c"]  # kPa, energy density of linear elasticity
    stepped: Annotated[Field, "r"]  # state times steps
    latest: Annotated[Array, "r"]  # state of the last evaluation


@methods()
class Problem(NamedTuple):
    """A local model under a load, for ``mechanics.newton``."""

    points: Points
    past: Any  # past.Elastic or past.Remembering
    load: Any  # Dead or Pushed
    correction: Any  # Secants or TouchedSecants
    work: Work

    def potential(self, u, residual):
        """See ``mechanics.newton``."""
        points, work = self.points, self.work
        work.latest[:] = u
        points.strain(u, work.stepped, work.H)
        nonlinear_stress(work.H, points.weights, points.law, work.J, work.part, work.linear, work.P)
        smallest = work.J.min()
        if not smallest > 0.0:
            return tissue.INVERTED, smallest
        energy = added_energy(points.weights, points.law, work.J, work.part, work.linear)
        energy += self.past.recall(points, work)
        project(points.gradients, work.P, residual)
        for i in range(len(u)):
            residual[i] = residual[i] * points.steps[i] + u[i]
            energy += 0.5 * u[i] * u[i]
        energy += self.past.soften(u, residual)
        return energy + self.load.push(u, residual), smallest

    def factorise(self, u, shift):
        """See ``mechanics.newton``."""
        return self.correction.prepare(self, u, shift)

    def correct(self, residual, step):
        """See ``mechanics.newton``."""
        self.correction.step(self, residual, step)


newton_method = njit(newton.newton, error_model="numpy", nogil=True, cache=True)
