"""Galerkin models in time: a basis for the whole body and every quadrature point.

A step is that of the artifact's local models, ``reduced.press_in_time.step_patch``, with other
modes and points; what the tissue remembers is kept at every quadrature point.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.model import History
from palpate.offline.methods.galerkin import TOLERANCE, Cubature, GalerkinModel, reduce_load
from palpate.offline.methods.method import Case
from palpate.offline.reduce.viscous import deviatoric_stiffness
from palpate.offline.run.workshop import Workshop
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.viscosity import COMPONENTS, step_weights
from palpate.shared.reduced.press import LANES
from palpate.shared.reduced.press_in_time import (
    SYMMETRIC,
    Memory,
    new_record,
    new_scratch,
    opened,
    step_patch,
)

Array = NDArray[np.float64]
Field = NDArray[np.float32]


class _OneModel(NamedTuple):
    """The body, as ``step_patch`` takes local models: one, with float32 gradients."""

    gradients: Field  # (1, r, 9 c) 1/mm, in tiles
    steps: Field  # (1, r)
    weights: Array  # (1, c) mm^3
    mu: Array  # (1, c) kPa
    lam: Array  # (1, c) kPa


class GalerkinInTime:
    """The full model in time in the span of modes; see ``offline.methods.in_time.InTime``.

    Parameters
    ----------
    family, label : str
    workshop : Workshop
    basis : ndarray, shape (free dofs, m), mm
        Orthonormal in the energy at rest.
    accurate : float
        Residual at equilibrium relative to load and past; single precision ends at about 1e-6.
    """

    def __init__(
        self,
        family: str,
        label: str,
        workshop: Workshop,
        basis: Array,
        accurate: float = TOLERANCE,
    ) -> None:
        model, m = workshop.model, basis.shape[1]
        self.family, self.label, self.unknowns = family, label, m
        self._workshop, self._accurate = workshop, accurate
        reduced = GalerkinModel(model, m, Cubature.full(model))
        reduced.adopt(basis)
        system, self._modes = reduced.content.system, reduced.content.modes
        rows, points = len(system.gradients), len(system.weights)
        self._body = _OneModel(
            system.gradients[None],
            np.ones((1, rows), np.float32),
            system.weights[None],
            system.mu[None],
            system.lam[None],
        )
        self._deviatoric = np.zeros((rows, rows), np.float32)
        self._deviatoric[:m, :m] = basis.T @ (deviatoric_stiffness(model) @ basis)
        self._load = np.zeros(rows)
        self._sizes = len(workshop.model.prony), rows, points
        self._scratch = new_scratch(rows, points)

    def at_rest(self) -> Array:
        """See ``InTime``."""
        return new_record(*self._sizes)

    def step(self, past: Array, case: Case, dt: float) -> tuple[bool, Array]:
        """See ``InTime``."""
        weights = step_weights(self._workshop.model.prony, dt)
        after = past.copy()
        reduce_load(self._modes, case.nodes, case.forces, self._load)
        status, _, _ = step_patch(
            self._body, 0, self._deviatoric, weights, self._load, self.opened(after), self._scratch,
            self._accurate,
        )  # fmt: skip
        converged = status == newton.CONVERGED
        return converged, after if converged else past

    def trusted(self, past: Array) -> bool:
        """See ``InTime``."""
        return True

    def displacement(self, past: Array) -> Array:
        """See ``InTime``."""
        return (self._modes @ self.opened(past).wide).reshape(-1, 3)

    def von_mises(self, past: Array) -> Array:
        """See ``InTime``."""
        return self._workshop.von_mises_after(self.history(past))

    def opened(self, past: Array) -> Memory:
        """What the past is to ``step_patch``."""
        memory: Memory = opened(past, *self._sizes)
        return memory

    def history(self, past: Array) -> History:
        """The past as the full model remembers it, but for the means that only energies need."""
        elements, own = self._workshop.model.weights.shape
        histories = self.opened(past).points
        terms = len(histories)
        tiles = histories.reshape(terms, -1, SYMMETRIC, LANES).transpose(1, 3, 0, 2)
        points = np.zeros((elements * own, terms, COMPONENTS))
        points[:, :, :SYMMETRIC] = tiles.reshape(-1, terms, SYMMETRIC)[: elements * own]
        return History(self.displacement(past), points.reshape(elements, own, terms, COMPONENTS))
