"""Empirical cubatures of a reduced model: quadrature points and their weights.

- by point (ECM: Hernandez, Caicedo & Ferrer 2017): few points of positive weight;
- by element (ECSW: Farhat, Avery, Chapman & Cortial 2014): few elements, whose points all get the
  element's weight.

Both reproduce, over training states, what the tissue law adds to the force of linear elasticity.
The states are equilibria of the reduced model *and* random departures from them.  In equilibrium
the internal force equals the load, whatever the tissue does: points fitted to equilibria alone
reproduce the load but not the tangent, and with it the next Newton step.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.offline.methods.galerkin import Cubature, Galerkin, stress_points
from palpate.offline.methods.method import Case
from palpate.offline.reduce.cubature import compress, nonnegative
from palpate.shared.reduced.points import LANES

Array = NDArray[np.float64]

OFF_EQUILIBRIUM = 0.1
"""Size of a departure from equilibrium, relative to each mode's part in the state."""

LOOKS = 16
"""Random combinations of the modes' forces in one state, which are fitted instead of the forces."""

EQUATIONS = 2  # equations kept for every cubature point, or element, allowed


@dataclass(frozen=True)
class PointForces:
    """Contribution of every quadrature point to the sums that a cubature has to reproduce."""

    contributions: NDArray[np.float32]  # (points, sums)
    weights: Array  # (points,) mm^3
    per_element: int

    def by_point(self, most: int, rng: np.random.Generator) -> Cubature:
        """Cubature of at most ``most`` points, each with a weight of its own."""
        chosen, factors = _fit(self.contributions, most, rng)
        return Cubature(chosen, factors * self.weights[chosen])

    def by_element(self, most: int, rng: np.random.Generator) -> Cubature:
        """Cubature of at most ``most`` elements: all their points, one factor each."""
        sums = self.contributions.reshape(-1, self.per_element, self.contributions.shape[1])
        elements, factors = _fit(sums.sum(axis=1), most, rng)
        points = (self.per_element * elements[:, None] + np.arange(self.per_element)).ravel()
        return Cubature(points, np.repeat(factors, self.per_element) * self.weights[points])


def point_forces(reduced: Galerkin, cases: Iterable[Case], rng: np.random.Generator) -> PointForces:
    """Forces at every point of a model with the full cubature, in and off equilibria of cases.

    They are weighted with the square root of the compliance at equilibrium, relative to the
    answer: an error of their sum is then a relative error of displacement in the energy norm.
    Cases without an equilibrium are skipped.
    """
    columns = []
    for case in cases:
        answer = reduced.solve(case)
        if not answer.converged:
            continue
        q = answer.state
        L = np.linalg.cholesky(reduced.tangent(q))
        departure = OFF_EQUILIBRIUM * np.abs(q) * rng.standard_normal(len(q))
        for state in (q, q + departure):
            looks = np.linalg.solve(L.T, rng.standard_normal((len(q), LOOKS)))
            looks /= np.sqrt(LOOKS) * np.linalg.norm(q)
            if stress_points(reduced.content, state) > 0.0:
                columns.append(_contributions(reduced, looks))
    weights = reduced.problem.model.weights
    contributions = np.hstack(columns)[: weights.size]
    return PointForces(contributions, weights.ravel(), weights.shape[1])


def _contributions(reduced: Galerkin, looks: Array) -> NDArray[np.float32]:
    """Nonlinear forces (c, k) of the points' stress along ``looks`` (m, k)."""
    content = reduced.content
    work = (looks.T.astype(np.float32) @ content.points.gradients) * content.work.P
    tiles = work.reshape(len(work), -1, 9, LANES).sum(axis=2)
    return np.ascontiguousarray(tiles.reshape(len(work), -1).T)


def _fit(
    contributions: NDArray[np.float32], most: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], Array]:
    """Few rows, and the positive factors with which they reproduce the sums of all rows."""
    size = min(EQUATIONS * most, *contributions.shape)
    return nonnegative(*compress(contributions, size, rng), most)
