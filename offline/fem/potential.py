"""The total potential energy of a body under loads, as ``mechanics.newton`` minimises it.

The unknowns are the displacements of the free degrees of freedom, or their coordinates in a basis.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import csr_matrix

from palpate.offline.fem.linear_solver import NotPositiveDefinite
from palpate.offline.fem.terms import Term, TipLoad
from palpate.shared.arrays import Array

if TYPE_CHECKING:
    from palpate.offline.fem.model import FullModel


class Potential:
    """Elastic tissue and further terms.

    Only one potential of a full model can be minimised at a time: they share its linear solver.
    What is clamped is held where ``held`` (3 nodes,) mm has it, else at rest.
    """

    def __init__(self, model: FullModel, terms: Sequence[Term], held: Array | None = None) -> None:
        self.free = model.free
        self.keeps = False  # see ``keep``
        self.terms = terms
        self._model = model
        self._displacement = np.zeros(3 * len(model.mesh.nodes)) if held is None else held.copy()
        self._force = np.zeros_like(self._displacement)
        self._data = np.empty(model.pattern.nnz)
        self._springs: list[tuple[Array, Array]] = []  # see ``solve``

    def stiffness(self, u: Array, convex: bool = False) -> csr_matrix:
        """Tangent (mN/mm) at ``u`` (free dofs,) mm, which the next call overwrites.

        For ``convex`` see ``DeadLoad.add_stiffness``.
        """
        self._displacement[self.free] = u
        self._data[:] = 0.0
        self._model.add_stiffness(self._displacement, self._data)
        for term in self.terms:
            term.add_stiffness(self._displacement, self._data, convex)
        return self._model.matrix(self._data)

    def solve(self, loads: Array) -> Array:
        """Linear responses (free dofs, k) mm to loads (free dofs, k) mN, by the factorisation.

        A tip's spring beside the factorised matrix comes by Sherman and Morrison's formula.
        """
        found = self._model.solver.solve(loads)
        for direction, response in self._springs:
            found -= np.multiply.outer(response, direction @ found)
        return found

    def compliance(self, u: Array, seen: Array) -> Array:
        """``seen^T K^-1 seen`` (k, k) of the tissue's tangent alone; seen (free dofs, k).

        The tangent is that at u, or if ``keeps`` the last factorised one.
        """
        if not self.keeps:
            self.factorise(u, 0.0)
        return np.asarray(seen.T @ self._model.solver.solve(seen))

    def potential(self, u: Array, residual: Array) -> tuple[float, float]:
        """Energy (mN mm), its gradient (mN) and the smallest det F."""
        self._displacement[self.free] = u
        energy, smallest = self._model.internal(self._displacement, self._force)
        if smallest > 0.0:
            for term in self.terms:
                energy += term.add_force(self._displacement, self._force)
        np.take(self._force, self.free, out=residual)
        return energy, smallest

    def factorise(self, u: Array, shift: float) -> bool:
        """Factorise the tangent plus ``shift`` times the rest stiffness, if that is definite."""
        matrix = self.stiffness(u, convex=shift > 0)
        if shift:
            matrix.data += shift * self._model.rest_stiffness.data
        try:
            self._model.solver.factorise(matrix.data)
        except NotPositiveDefinite:
            return False
        self._press_on_springs()
        return True

    def keep(self, u: Array) -> None:
        """Begin at ``u`` with the tangent that the model has factorised last."""
        self.keeps = True
        self._displacement[self.free] = u
        self._press_on_springs()

    def _press_on_springs(self) -> None:
        """Find what the springs of tips do to the factorised matrix."""
        self._springs = []
        for term in self.terms:
            if isinstance(term, TipLoad):
                direction, stiffness = term.spring(self._displacement)
                direction = direction[self.free]
                response = self._model.solver.solve(direction)
                response *= stiffness / (1.0 + stiffness * (direction @ response))
                self._springs.append((direction, response))

    def correct(self, residual: Array, step: Array) -> None:
        """Newton's step for a residual, by the last factorisation."""
        np.negative(self.solve(residual), out=step)


class Projected(Potential):
    """The same in the span of a basis (free dofs, m) mm, orthonormal in the energy at rest."""

    def __init__(self, model: FullModel, terms: Sequence[Term], basis: Array) -> None:
        super().__init__(model, terms)
        self._basis = basis
        self._residual = np.empty(len(basis))

    def potential(self, q: Array, residual: Array) -> tuple[float, float]:
        """Energy (mN mm), its gradient in the coordinates ``q`` (m,) and the smallest det F."""
        energy, smallest = super().potential(self._basis @ q, self._residual)
        np.matmul(self._basis.T, self._residual, out=residual)
        return energy, smallest

    def factorise(self, q: Array, shift: float) -> bool:
        """See ``Potential``."""
        K = self.stiffness(self._basis @ q, convex=shift > 0)
        tangent = self._basis.T @ (K @ self._basis) + shift * np.eye(len(q))
        try:
            self._factor = cho_factor(tangent)
        except LinAlgError:
            return False
        return True

    def solve(self, loads: Array) -> Array:
        """Coordinates (m, k) of responses to loads (m, k), by the factorisation."""
        return np.asarray(cho_solve(self._factor, loads))
