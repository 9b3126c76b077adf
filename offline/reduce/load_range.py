"""The range of loads: the pressure at which the tissue moves as far as the scene allows.

The equilibrium path under ``p f`` starts along ``u_1 = K_0^-1 f`` and bends along its second and
third derivative at rest.  Galerkin's solution in these three vectors is within some percent of the
path as far as a scene goes, and costs a fraction of one full solution: it says where the full one
starts.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.mesh import local_thickness
from palpate.offline.fem.model import FullModel, NoEquilibrium
from palpate.offline.fem.potential import Projected
from palpate.offline.fem.problem import FullProblem
from palpate.offline.fem.terms import DeadLoad
from palpate.offline.reduce.ritz import energy_pod, ritz_vectors
from palpate.shared.mechanics import newton

Array = NDArray[np.float64]

NEAR = 0.1
"""Relative distance from the wanted displacement at which the pressure is interpolated."""

LEAST = 1e-3

TOLERANCE = 1e-3
MAX_ITERATIONS = 20

DEEPEST = 0.8
"""Largest depth of the tip, in radii: its centre must stay outside the undeformed body."""

SHALLOWEST = 0.02
"""Millimetres that the range of depths has at least."""


class LoadPath:
    """The full model in the first three derivatives of the path under ``p load`` (free dofs,)."""

    def __init__(self, model: FullModel, load: Array) -> None:
        self._model = model
        self._load = model.filled(load)
        self._basis, _ = energy_pod(model, ritz_vectors(model, load[:, None]), 3)
        self._q = np.zeros(self._basis.shape[1])

    def solve(self, pressure: float, start: Array | None) -> Array:
        """Displacement (n, 3) mm at a pressure, from the last found unless ``start`` is None."""
        load = pressure * self._load
        path = Projected(self._model, [DeadLoad(load)], self._basis)
        q = np.zeros_like(self._q) if start is None else self._q.copy()
        target = TOLERANCE * float(np.linalg.norm(self._basis.T @ load[self._model.free]))
        status, *_ = newton.newton(
            path, q, np.empty((4, len(q))), target, 0.0, MAX_ITERATIONS, False
        )
        if status != newton.CONVERGED:
            raise NoEquilibrium("load: no equilibrium found along its path")
        self._q = q
        return self._model.filled(self._basis @ q).reshape(-1, 3)


def pressure_that_moves(
    solve: Callable[[float, Array | None], Array],
    wanted: float,
    pressure: float,
    exponent: float | None = None,
    start: Array | None = None,
) -> tuple[float, float, Array | None]:
    """Pressure at which a node moves by ``wanted`` mm, or beyond which there is no equilibrium.

    ``solve`` finds the displacement (n, 3) at a pressure from a first guess or raises
    ``NoEquilibrium``, as this does if there is none at ``LEAST`` of the first guess either. Taken
    and returned: a pressure (kPa), the power of it by which the displacement grows near there, and
    a displacement there.
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


def load_range(problem: FullProblem, position: Array) -> Array:
    """Load range (LIMIT_FIELDS,) at a surface point; see ``mechanics.footprint.pressure_limit``.

    The limit along the normal is where the tissue moves by the scene's indentation, or beyond
    which it has no equilibrium; the depth of the tip is how far the footprint has sunk then.
    """
    model = problem.model.relaxed  # for as long as it takes
    nodal, normal = problem.unit_load(position)
    unit = np.einsum("n,ij->nij", nodal, np.eye(3)).reshape(-1, 3)[model.free]
    linear = model.solve_linear(unit)
    C = unit.T @ linear / nodal.sum()
    thickness = local_thickness(problem.mesh, position[None], normal[None])[0]
    wanted = problem.scene.load.max_indentation * thickness
    pressure = wanted / np.linalg.norm((linear @ normal).reshape(-1, 3), axis=1).max()
    path = LoadPath(model, -unit @ normal)
    # no load steps in the full model: where a jump fails, the pressure between is asked for
    near = pressure_that_moves(path.solve, wanted, pressure)

    def full(pressure: float, start: Array | None) -> Array:
        force = -pressure * nodal[:, None] * normal
        return model.solve(force, start=start, smallest_step=1.0).displacement

    limit, _, moved = pressure_that_moves(full, wanted, *near)
    depth = 0.0 if moved is None else -float(nodal @ moved @ normal) / nodal.sum()
    depth = min(max(depth, SHALLOWEST), DEEPEST * problem.scene.endoscope.radius)
    return np.array([limit, *np.diag(C), C[0, 1], C[0, 2], C[1, 2], depth])
