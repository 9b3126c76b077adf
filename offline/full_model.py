"""The full finite element model: finite strain, total Lagrangian, quasi-static.

It gives ``shared.equilibrium`` its potential, tangent and correction on the free degrees of freedom
(dof = 3 node + axis, clamped nodes left out) and answers loads on its surface.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from offline import assembly
from offline.linear_solver import NotPositiveDefinite, sparse_solver
from offline.mesh import Mesh
from shared import equilibrium
from shared.errors import PalpateError
from shared.quadrature import volume_quadrature
from shared.scene import ElementName, Scene
from shared.tissue import lame

Array = NDArray[np.float64]

TOLERANCE = 1e-9
"""Residual of an equilibrium relative to the load, both in the Euclidean norm of nodal forces."""

MAX_ITERATIONS = 40
REUSE = 0.05
"""A factorisation costs ten corrections here, so a tangent serves while it gains a digit."""


class NoEquilibrium(PalpateError):
    """A load under which no equilibrium was found, even in small steps."""


@dataclass(frozen=True)
class Equilibrium:
    """A converged state of the full model."""

    displacement: Array  # (nodes, 3) mm
    iterations: int
    load_steps: int
    min_jacobian: float


@dataclass
class FullModel:
    """Full model of one mesh and tissue.

    Parameters
    ----------
    mesh : Mesh
    element : {"hex8", "hex8-mean-dilatation", "hex8-fbar", "hex20"}
    young, poisson : float
        kPa and 1.
    """

    mesh: Mesh
    element: ElementName
    young: float
    poisson: float
    _load: Array = field(init=False, repr=False)

    @classmethod
    def of(cls, scene: Scene, mesh: Mesh) -> FullModel:
        """Full model of a scene on its mesh."""
        return cls(mesh, scene.geometry.element, scene.tissue.young, scene.tissue.poisson)

    def __post_init__(self) -> None:
        mesh = self.mesh
        self.free = np.flatnonzero(np.repeat(~mesh.clamped, 3))
        self.gradients, self.weights = volume_quadrature(mesh.nodes, mesh.elements, 2)
        self.connectivity = np.ascontiguousarray(mesh.elements, dtype=np.int32)
        mu, lam = lame(self.young, self.poisson)
        self.mu = np.full(len(mesh.elements), mu)
        self.lam = np.full(len(mesh.elements), lam)
        self._theta = self._theta_points()
        self._slots, self.pattern = self._sparsity()
        self._load = np.zeros(len(self.free))
        self._full = np.zeros(3 * len(mesh.nodes))
        self._force = np.zeros_like(self._full)
        self._data = np.zeros(self.pattern.nnz)
        self._work = np.zeros((4, len(self.free)))
        self._solver = sparse_solver(self.pattern)
        self._at_rest = False

    def _theta_points(self) -> tuple[Array, Array] | None:
        """Gradients and weights of the points whose J make up an element's dilatation."""
        if self.element == "hex8-mean-dilatation":
            return self.gradients, self.weights / self.weights.sum(axis=1, keepdims=True)
        if self.element == "hex8-fbar":
            weights = self.weights / self.weights.sum(axis=1, keepdims=True)
            mean = np.einsum("eq,eqai->eai", weights, self.gradients)
            return np.ascontiguousarray(mean[:, None]), np.ones((len(mean), 1))
        return None

    def _sparsity(self) -> tuple[NDArray[np.int32], csr_matrix]:
        """CSR pattern of the free dofs and the slot in it of every element matrix entry."""
        number = np.full(3 * len(self.mesh.nodes), -1, dtype=np.int64)
        number[self.free] = np.arange(len(self.free))
        dofs = number[
            (3 * self.mesh.elements[:, :, None] + np.arange(3)).reshape(len(self.mesh.elements), -1)
        ]
        rows = np.repeat(dofs, dofs.shape[1], axis=1).ravel()
        cols = np.tile(dofs, (1, dofs.shape[1])).ravel()
        used = (rows >= 0) & (cols >= 0)
        keys, inverse = np.unique(rows[used] * len(self.free) + cols[used], return_inverse=True)
        slots = np.full(len(rows), -1, dtype=np.int32)
        slots[used] = inverse
        n = len(self.free)
        indptr = np.searchsorted(keys // n, np.arange(n + 1)).astype(np.int32)
        pattern = csr_matrix((np.zeros(len(keys)), (keys % n).astype(np.int32), indptr), (n, n))
        return slots.reshape(len(dofs), dofs.shape[1], -1), pattern

    def internal(self, displacement: Array, force: Array) -> tuple[float, float]:
        """Write the internal force (3 nodes,) mN of a displacement (3 nodes,) mm.

        Returns
        -------
        energy, smallest : float
            Stored energy (mN mm) and smallest det F.
        """
        force[:] = 0.0
        args = (self.connectivity, self.gradients, self.weights)
        if self._theta is None:
            return assembly.standard_residual(*args, self.mu, self.lam, displacement, force)
        return assembly.dilatation_residual(
            *args, *self._theta, self.mu, self.lam, displacement, force
        )

    def internal_free(self, u: Array) -> Array:
        """Internal force (free dofs,) mN of a displacement (free dofs,) mm.

        Raises
        ------
        PalpateError
            If the displacement inverts an element.
        """
        self._full[self.free] = u
        _, smallest = self.internal(self._full, self._force)
        if not smallest > 0:
            raise PalpateError("displacement: it inverts an element")
        return self._force[self.free]

    def solve_linear(self, loads: Array) -> Array:
        """Linear response (free dofs, k) mm to loads (free dofs, k) mN: rest stiffness."""
        if not self._at_rest:
            self.factorise(np.zeros(len(self.free)), 0.0)
            self._at_rest = True
        return self._solver.solve(loads)

    def stiffness(self, displacement: Array) -> csr_matrix:
        """Tangent stiffness (mN/mm) of the free dofs; the next call overwrites the matrix."""
        self._data[:] = 0.0
        args = (self.connectivity, self.gradients, self.weights)
        rest = (self.mu, self.lam, displacement, self._slots, self._data)
        if self._theta is None:
            assembly.standard_tangent(*args, *rest)
        else:
            assembly.dilatation_tangent(*args, *self._theta, *rest)
        return csr_matrix((self._data, self.pattern.indices, self.pattern.indptr), copy=False)

    @cached_property
    def rest_stiffness(self) -> csr_matrix:
        """Stiffness (mN/mm) of the free dofs at rest."""
        return self.stiffness(np.zeros_like(self._full)).copy()

    # what shared.equilibrium asks for ------------------------------------------------------------

    def potential(self, u: Array, residual: Array) -> tuple[float, float]:
        """Total potential energy (mN mm), its gradient (mN) and the smallest det F."""
        self._full[self.free] = u
        energy, smallest = self.internal(self._full, self._force)
        np.subtract(self._force[self.free], self._load, out=residual)
        return energy - float(self._load @ u), smallest

    def factorise(self, u: Array, shift: float) -> bool:
        """Factorise the tangent plus ``shift`` times the rest stiffness, if that is definite."""
        self._full[self.free] = u
        matrix = self.stiffness(self._full)
        data = matrix.data + shift * self.rest_stiffness.data if shift else matrix.data
        self._at_rest = False
        try:
            self._solver.factorise(data)
        except NotPositiveDefinite:
            return False
        return True

    def correct(self, residual: Array, step: Array) -> None:
        """Newton's step for a residual, by the last factorisation."""
        np.negative(self._solver.solve(residual), out=step)

    # ---------------------------------------------------------------------------------------------

    def solve(
        self,
        load: Array,
        start: Array | None = None,
        reuse: float = REUSE,
        smallest_step: float = 1 / 64,
    ) -> Equilibrium:
        """Equilibrium under a dead load, in one jump if that converges, else in load steps.

        Parameters
        ----------
        load : ndarray, shape (nodes, 3), mN
        start : ndarray, shape (nodes, 3), mm, optional
            First guess; rest if absent.
        reuse : float
            See ``shared.equilibrium.newton``.
        smallest_step : float
            Fraction of the load below which a step is given up.

        Raises
        ------
        NoEquilibrium
        """
        full_load = load.reshape(-1)[self.free]
        u = np.zeros(len(self.free)) if start is None else start.reshape(-1)[self.free].copy()
        converged, reached, step = u.copy() if start is None else np.zeros_like(u), 0.0, 1.0
        target = max(TOLERANCE * float(np.linalg.norm(full_load)), 1e-12)
        total = steps = 0
        while reached < 1.0:
            fraction = min(1.0, reached + step)
            np.multiply(full_load, fraction, out=self._load)
            status, iterations, _, smallest = equilibrium.newton(
                self, u, self._work, target, reuse, MAX_ITERATIONS, False
            )
            total += iterations
            steps += 1
            if status == equilibrium.CONVERGED:
                converged[:], reached, step = u, fraction, 2.0 * step
                continue
            step *= 0.5
            if step < smallest_step:
                raise NoEquilibrium(
                    f"load: no equilibrium found beyond {100 * reached:.0f} % of it; "
                    "lower the pressure"
                )
            u[:] = converged
        displacement = np.zeros(3 * len(self.mesh.nodes))
        displacement[self.free] = u
        return Equilibrium(displacement.reshape(-1, 3), total, steps, smallest)
