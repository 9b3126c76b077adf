"""How long one Newton step takes, beside FElupe's on the same mesh, law and state.

A step is all from a displacement to its correction: internal force, tangent, factorisation, solve.
FElupe gets its due: its own assembly with nothing of its bookkeeping round it (no copies of
fields, no plug-ins), and beside its default solver SciPy's with a better ordering and, where it is
installed, the one its documentation recommends for speed. Both codes run on one thread, in turns,
each step at another state than the last, so that no solver can answer from memory.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import splu, spsolve

from palpate.offline.fem.mesh import build_mesh
from palpate.offline.fem.model import FullModel
from palpate.offline.fem.surface import accessible_surface
from palpate.offline.scenes import find_scene
from palpate.shared.errors import PalpateError
from palpate.shared.geometry.quadrature import surface_quadrature
from palpate.shared.mechanics.footprint import footprint

Array = NDArray[np.float64]
Step = Callable[[Array], tuple[dict[str, float], Array]]

DIVISIONS = {"hex8": (23, 3, 20), "hex20": (13, 2, 13)}
"""Elements [along the section, through it, along y] that give the turbinate about 6048 DOFs."""

PRESSURE = 4.0  # kPa
POSITION = (10.2, 20.0, 9.0)  # mm


def compare(element: str = "hex8", repeats: int = 20) -> dict[str, Any]:
    """Time Newton steps of both codes in turns.

    Parameters
    ----------
    element : {"hex8", "hex20"}
    repeats : int
        Steps of each kind.

    Returns
    -------
    dict
        ``element``, ``unknowns``; the medians of ``palpate`` and of FElupe with each solver, in ms
        and split up; ``ratio``: FElupe with its default solver over palpate; ``ratio_best``: with
        its fastest solver.

    Raises
    ------
    PalpateError
        If FElupe is not installed.
    """
    try:
        import felupe as fem
    except ModuleNotFoundError as error:
        raise PalpateError("felupe is not installed: pip install 'palpate[test]'") from error
    scene = find_scene("turbinate")
    geometry = scene.geometry.model_copy(
        update={"element": element, "divisions": DIVISIONS[element]}
    )
    scene = scene.model_copy(update={"geometry": geometry})
    model = FullModel.of(scene, build_mesh(scene))
    load = _load(model, scene.endoscope.radius)
    # A bent state on the way to the whole load, as in the middle of a solve.
    halfway = model.solve(load / 2).displacement

    steps = {"palpate": _our_step(model, load)}
    for name, solver in _solvers().items():
        steps[f"felupe, {name}"] = _felupe_step(fem, model, load, solver)
    times: dict[str, list[dict[str, float]]] = {name: [] for name in steps}
    for round_ in range(repeats + 1):
        state = (1 - 1e-4 * round_) * halfway
        ours, *theirs = [
            _timed(step, state, times[name] if round_ else []) for name, step in steps.items()
        ]
        for correction in theirs:
            np.testing.assert_allclose(correction, ours, atol=1e-8 * np.abs(ours).max())
    medians = {
        name: {part: median(row[part] for row in rows) for part in rows[0]}
        for name, rows in times.items()
    }
    own, default, *others = (sum(parts.values()) for parts in medians.values())
    return {
        "element": element,
        "unknowns": len(model.free),
        "ms": medians,
        "ratio": default / own,
        "ratio_best": min(default, *others) / own,
    }


def _timed(step: Step, state: Array, into: list[dict[str, float]]) -> Array:
    """Take the step, keep its times and return its correction."""
    spent, correction = step(state)
    into.append(spent)
    return correction


def _load(model: FullModel, radius: float) -> Array:
    mesh = model.mesh
    x, normal, _ = accessible_surface(mesh).project(np.array(POSITION))
    nodal = np.empty(len(mesh.nodes))
    footprint(surface_quadrature(mesh.nodes, mesh.faces), x, normal, radius, nodal)
    return -PRESSURE * np.outer(nodal, normal)


def _our_step(model: FullModel, load: Array) -> Step:
    full_load = load.ravel()
    force = np.empty_like(full_load)

    def step(state: Array) -> tuple[dict[str, float], Array]:
        clock, u = _Clock(), state.ravel()
        model.internal(u, force)
        matrix = model.stiffness(u)
        clock.lap("assembly")
        model._solver.factorise(matrix.data)
        clock.lap("factorisation")
        correction = model._solver.solve((full_load - force)[model.free])
        clock.lap("solve")
        return clock.laps, correction

    return step


def _felupe_step(
    fem: Any, model: FullModel, load: Array, solver: Callable[[Any, Array], Array]
) -> Step:
    cell_type, region = {
        "hex8": ("hexahedron", fem.RegionHexahedron),
        "hex20": ("hexahedron20", fem.RegionQuadraticHexahedron),
    }[model.element]
    mesh = fem.Mesh(model.mesh.nodes, model.mesh.elements, cell_type)
    quadrature = fem.GaussLegendre(order=1, dim=3)
    field = fem.FieldContainer([fem.Field(region(mesh, quadrature=quadrature), dim=3)])
    solid = fem.SolidBody(_felupe_law(fem, model.mu[0], model.lam[0]), field)
    free, full_load = model.free, load.ravel()

    def step(state: Array) -> tuple[dict[str, float], Array]:
        field[0].values[:] = state
        clock = _Clock()
        force = solid.assemble.vector(field).toarray()[:, 0]
        matrix = solid.assemble.matrix()
        clock.lap("assembly")
        correction = solver(matrix[free, :][:, free], (full_load - force)[free])
        clock.lap("factorisation and solve")
        return clock.laps, correction

    return step


def _felupe_law(fem: Any, mu: float, lam: float) -> Any:
    """FEAP's Neo-Hookean law in the tensor algebra of FElupe; see ``mechanics.tissue``."""
    m = fem.math

    def gradient(x: list[Array]) -> list[Array]:
        F, state = x[0], x[-1]
        J = m.det(F)
        inverse = m.transpose(m.inv(F, J))
        return [mu * F + (lam / 2 * (J**2 - 1) - mu) * inverse, state]

    def hessian(x: list[Array]) -> list[Array]:
        F = x[0]
        J, eye = m.det(F), m.identity(F)
        inverse = m.transpose(m.inv(F, J))
        return [
            mu * m.cdya_ik(eye, eye)
            + (mu - lam / 2 * (J**2 - 1)) * m.cdya_il(inverse, inverse)
            + lam * J**2 * m.dya(inverse, inverse)
        ]

    return fem.Material(gradient, hessian)


def _solvers() -> dict[str, Callable[[Any, Array], Array]]:
    """FElupe's solvers by name, its default first."""
    solvers: dict[str, Callable[[Any, Array], Array]] = {
        "spsolve": lambda matrix, b: spsolve(matrix, b),
        "splu by minimum degree": lambda matrix, b: splu(
            matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}
        ).solve(b),
    }
    try:
        import pypardiso
    except ImportError:
        return solvers
    return solvers | {"pypardiso": pypardiso.spsolve}


class _Clock:
    """Splits the time of a step into laps, ms."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = 1e3 * (now - self._last)
        self._last = time.perf_counter()
