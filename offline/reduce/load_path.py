"""How far a growing load moves the tissue, and the load at which it moves as far as wanted.

The equilibrium path under ``p f`` starts along ``u_1 = K_0^-1 f`` and bends along its second and
third derivative at rest.  Galerkin's solution in these three vectors is within some percent of the
path as far as a scene goes, and costs a fraction of one full solution: it says where the full one
starts.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.model import FullModel, NoEquilibrium
from palpate.offline.reduce.ritz import energy_pod, path_vectors
from palpate.shared.mechanics import newton

Array = NDArray[np.float64]

NEAR = 0.1
"""Relative distance from the wanted displacement at which the pressure is interpolated."""

LEAST = 1e-3

TOLERANCE = 1e-3
MAX_ITERATIONS = 20


class LoadPath:
    """The full model in the first three derivatives of the path under ``p load``.

    Parameters
    ----------
    model : FullModel
    load : ndarray, shape (free dofs,), mN
        Of a unit pressure.
    """

    def __init__(self, model: FullModel, load: Array) -> None:
        self._model = model
        self._modes, _ = energy_pod(model, path_vectors(model, load), 3)
        self._unit = self._modes.T @ load
        self._load = np.zeros_like(self._unit)
        self._work = np.empty((4, len(self._unit)))
        self._tangent = np.eye(len(self._unit))
        self._q = np.zeros_like(self._unit)

    def solve(self, pressure: float, start: Array | None) -> Array:
        """Displacement (n, 3) mm at a pressure, from the last found unless ``start`` is None.

        Raises
        ------
        NoEquilibrium
        """
        self._load[:] = pressure * self._unit
        q = np.zeros_like(self._q) if start is None else self._q.copy()
        target = TOLERANCE * float(np.linalg.norm(self._load))
        status, *_ = newton.newton(self, q, self._work, target, 0.0, MAX_ITERATIONS, False)
        if status != newton.CONVERGED:
            raise NoEquilibrium("load: no equilibrium found along its path")
        self._q = q
        return self._full(q).reshape(-1, 3)

    def _full(self, q: Array) -> Array:
        displacement = np.zeros(3 * len(self._model.mesh.nodes))
        displacement[self._model.free] = self._modes @ q
        return displacement

    # what mechanics.newton asks for ------------------------------------------------------------

    def potential(self, q: Array, residual: Array) -> tuple[float, float]:
        """Total potential energy (mN mm), its gradient and the smallest det F."""
        force = np.empty(3 * len(self._model.mesh.nodes))
        energy, smallest = self._model.internal(self._full(q), force)
        residual[:] = self._modes.T @ force[self._model.free] - self._load
        return energy - float(self._load @ q), smallest

    def factorise(self, q: Array, shift: float) -> bool:
        """Tangent plus ``shift`` times the rest stiffness, if that is definite."""
        K = self._model.stiffness(self._full(q))
        self._tangent = self._modes.T @ (K @ self._modes) + shift * np.eye(len(q))
        return bool(np.linalg.eigvalsh(self._tangent)[0] > 0.0)

    def correct(self, residual: Array, step: Array) -> None:
        """Newton's step for a residual."""
        step[:] = np.linalg.solve(self._tangent, -residual)


def pressure_that_moves(
    solve: Callable[[float, Array | None], Array],
    wanted: float,
    pressure: float,
    exponent: float | None = None,
    start: Array | None = None,
) -> tuple[float, float, Array | None]:
    """Pressure at which the tissue moves by ``wanted`` mm, or beyond which it has no equilibrium.

    Parameters
    ----------
    solve : callable
        Displacement (n, 3) at a pressure, from a first guess; raises ``NoEquilibrium``.
    wanted : float, mm
        Largest nodal displacement.
    pressure : float, kPa
        First guess.
    exponent : float, optional
        Displacement as a power of the pressure near there, if known.
    start : ndarray, shape (n, 3), optional
        Displacement at the first guess, if known.

    Returns
    -------
    pressure, exponent : float
    displacement : ndarray, shape (n, 3), or None
        Near there.

    Raises
    ------
    NoEquilibrium
        If there is none at ``LEAST`` of the first guess either.
    """
    least = LEAST * pressure
    low, high, last = 0.0, np.inf, None
    state = below = None  # the last state, and that at the pressure ``low``
    while high > 1.03 * low:
        try:
            state = solve(pressure, start)
        except NoEquilibrium:
            if pressure < least:
                raise
            high = pressure
            pressure, start = (low + high) / 2, below
            continue
        moved = float(np.linalg.norm(state, axis=1).max())
        if moved < wanted:
            low, below = pressure, state
        else:
            high = pressure
        if last is not None:
            exponent = np.log(moved / last[1]) / np.log(pressure / last[0])
        power = float(np.clip(1.0 if exponent is None else exponent, 0.4, 6.0))
        enough = pressure * (wanted / moved) ** (1 / power)
        if exponent is not None and abs(moved / wanted - 1) < NEAR:
            return enough, power, state
        last = pressure, moved
        pressure = float(np.clip(enough, 0.3 * pressure, 2.5 * pressure))
        if not low < pressure < high:
            pressure = (low + high) / 2
        start = (pressure / last[0]) ** power * state
    return low, 1.0, below
