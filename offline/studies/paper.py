"""The figures of Radermacher & Reese anew: modal, Ritz and POD bases under one growing load.

Source: A. Radermacher, S. Reese, *A new strategy for model reduction in non-linear biomechanics*,
whose figures are 1a (error at a point P against the number of bases), 1b (ratio of CPU times) and
2c, 2d (relative errors on the turbinate in five POD bases).

The three methods, on the full quadrature of the mesh as in the paper:

- MOD: linear eigenmodes of least frequency;
- RITZ: load-dependent Ritz vectors of the one load (Wilson's sequence);
- POD: main directions of snapshots along the load's path, in the energy of the rest state.

Errors are taken at loads half-way between those of the snapshots.  Times are those of solves from
rest, full and reduced alternating, so that both meet the same speed of the machine.  What differs
from the paper:

- The cube: the paper does not give its size, mesh or load.  Here a dead pressure covers its whole
  top, which is free to move sideways, so that it would sway beyond ``pi^2 E / 48`` = 3.1 kPa (a
  clamped column); the load ends well before, at 13 % of its height.  P is the top's centre.
- The turbinate: our own section and mesh; the pressure is a round footprint's.  P lies under it.
- Elastic tissue follows a curve in one parameter, and a handful of POD bases hold it to within the
  reduced solver's tolerance; where fields are looked at, that is as small as can be.

Tissue that knows time is pressed, held, let go, and rests.  Full and reduced models take the same
time steps, each from its own past, and times are those of steps.  POD learns from one history and
is asked another: less pressure, and slower.  Errors are relative L2 norms over all moments, since
at the end there is nothing left to be relative to; the largest is that of a moment, over the
largest value in the history.  On the cube the relaxed tissue is softer and would sway under less:
the pressure is smaller by the share of the shear modulus that is lost.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from palpate.offline.fem.norms import relative
from palpate.offline.fem.problem import FullProblem
from palpate.offline.methods.full import Full
from palpate.offline.methods.galerkin import Galerkin
from palpate.offline.methods.method import Case, Method, Steps
from palpate.offline.methods.spaces import krylov, mass, modal, pod
from palpate.offline.pictures import require_pyvista
from palpate.offline.reduce.load_range import load_range
from palpate.offline.run.tables import write_csv
from palpate.offline.scenes import find_scene
from palpate.offline.studies import paper_pictures
from palpate.offline.studies.paper_claims import (
    FieldErrors,
    claims_of_figure_1,
    claims_of_figure_2,
)
from palpate.offline.studies.references import Fields
from palpate.offline.studies.relaxation import Phases, load_steps
from palpate.shared.geometry.quadrature import surface_quadrature

Array = NDArray[np.float64]

SNAPSHOTS = 20
ROUNDS = 3
"""How often every step is timed."""

SIZES = (1, 2, 3, 4, 5, 7, 10, 15, 20, 30)
"""Numbers of bases; POD ends where its snapshots have no more to give."""

CONTOUR_BASES = 5
"""Of the paper's figures 2c and 2d."""

CUBE_PRESSURE = 2.5  # kPa
MEDIAL = (10.0, 20.0, 11.0)
"""In the middle of the turbinate's medial side, mm."""

TRAINING: Phases = ((0.2, 10, 1.0), (2.0, 14, 1.0), (0.1, 5, 0.0), (2.0, 14, 0.0))
QUERY: Phases = ((0.3, 10, 0.9), (1.5, 14, 0.9), (0.15, 5, 0.0), (1.5, 14, 0.0))
"""Press, hold, release, rest: what POD is trained on, and what all methods answer, in time."""

HELD = 23
"""Step of both at whose end the load has been held."""

EXACT = 1e-6
"""Tolerance of the reduced solver where fields are looked at."""


@dataclass(frozen=True)
class Example:
    """A body under a load that grows.

    Attributes
    ----------
    load : ndarray, shape (n, 3), mN
        At its greatest.
    pressure : float, kPa
        The same.
    at : ndarray, shape (3,), mm
        Where the load's centre is.
    """

    problem: FullProblem
    load: Array
    pressure: float
    at: Array

    @property
    def name(self) -> str:
        """The scene's."""
        return self.problem.scene.name

    @property
    def point(self) -> int:
        """The node P, nearest to the load's centre."""
        return int(np.argmin(np.linalg.norm(self.problem.mesh.nodes - self.at, axis=1)))

    @property
    def in_time(self) -> bool:
        """Whether the tissue knows time."""
        return bool(self.problem.model.prony)

    def steps(self, levels: Sequence[tuple[float, float]]) -> Steps:
        """History of time steps (s) and shares of the load at their ends."""
        nodes = np.flatnonzero(self.load.any(axis=1))
        return [(Case((), nodes, share * self.load[nodes]), dt) for dt, share in levels]

    def training(self) -> Steps:
        """The history that POD learns from."""
        rising = [(0.0, i / SNAPSHOTS) for i in range(1, SNAPSHOTS + 1)]
        return self.steps(load_steps(TRAINING) if self.in_time else rising)

    def queries(self) -> list[Steps]:
        """The histories that methods are asked; of elastic tissue single loads, rising."""
        if self.in_time:
            return [self.steps(load_steps(QUERY))]
        return [self.steps([(0.0, (i - 0.5) / SNAPSHOTS)]) for i in range(1, SNAPSHOTS + 1)]


def cube(scene: str, report: Path) -> dict[str, Any]:
    """Figure 1: the cube of a scene under compression; see ``compare``."""
    problem = FullProblem(find_scene(scene))
    left = 1.0 - sum(share for share, _ in problem.model.prony)
    return compare(covered(problem, left * CUBE_PRESSURE), report)


def covered(problem: FullProblem, pressure: float) -> Example:
    """Pressure (kPa) all over the flat top of a block."""
    mesh = problem.mesh
    top = surface_quadrature(mesh.nodes, mesh.faces[mesh.accessible])
    areas = np.zeros(len(mesh.nodes))
    np.add.at(areas, top.nodes, top.areas[:, None] * top.shape)
    load = -pressure * areas[:, None] * top.normals[0]
    return Example(problem, load, pressure, top.points.mean(axis=0))


def turbinate(scene: str, report: Path) -> dict[str, Any]:
    """Figure 1 for the turbinate of a scene under a footprint, and of elastic tissue 2c and 2d."""
    found = find_scene(scene)
    contours = not found.tissue.prony
    if contours:
        require_pyvista()
    return compare(footprint(FullProblem(found), MEDIAL), report, contours=contours)


def footprint(problem: FullProblem, position: Sequence[float]) -> Example:
    """A footprint pressed straight in, up to the pressure that is trained for there."""
    at, *_ = problem.surface.project(np.array(position))
    areas, normal = problem.unit_load(at)
    pressure = float(load_range(problem, at)[0])
    return Example(problem, -pressure * areas[:, None] * normal, pressure, at)


def compare(
    example: Example, report: Path, sizes: Sequence[int] | None = None, contours: bool = False
) -> dict[str, Any]:
    """Errors and times of the three methods, and whether the paper's claims hold.

    Parameters
    ----------
    report : Path
        Folder to write ``paper_NAME.csv`` (a row per method and number of bases) and
        ``paper_NAME.png`` (figures 1a and 1b) to.
    sizes : sequence of int, optional
        Numbers of bases; ``SIZES`` if absent.
    contours : bool
        Whether to draw ``paper_NAME_contours.png`` (figures 2c and 2d) too.

    Returns
    -------
    dict
        ``load``; ``figure_1``: per method and number of bases what the table holds; ``claims``, see
        ``claims_of_figure_1`` and ``claims_of_figure_2``, in time of the moment when the load has
        been held; ``claims_with_fewer_bases``: the latter by number of bases, of elastic tissue.
    """
    training = snapshots(example)
    rows = measure(example, training, sizes or SIZES)
    fewest = CONTOUR_BASES if example.in_time else 1
    fields = {m: field_errors(example, training, m) for m in range(fewest, CONTOUR_BASES + 1)}
    moved = float(np.linalg.norm(training[:, example.point], axis=1).max())
    title = f"{example.name}, pressed with up to {example.pressure:.3g} kPa"
    title += f"{', held and let go' if example.in_time else ''}: P moves {moved:.1f} mm"
    write_csv(report / f"paper_{example.name}.csv", rows)
    paper_pictures.chart(report / f"paper_{example.name}.png", rows, title)
    if contours:
        path = report / f"paper_{example.name}_contours.png"
        errors = fields[CONTOUR_BASES].errors
        radius = example.problem.scene.endoscope.radius
        paper_pictures.contours(path, example.problem.mesh, errors, example.at, radius)
    claims = {size: claims_of_figure_2(own) for size, own in fields.items()}
    return {
        "load": {
            "pressure_kPa": example.pressure,
            "point_P_mm": example.problem.mesh.nodes[example.point].tolist(),
            "P_moves_mm": moved,
        },
        "figure_1": {f"{row['method']} {row['bases']}": row for row in rows},
        "claims": claims_of_figure_1(rows) | claims.pop(CONTOUR_BASES),
        "claims_with_fewer_bases": {str(size): own for size, own in claims.items()},
    }


def snapshots(example: Example) -> Array:
    """Full solutions (t, n, 3) mm of the history that POD learns from."""
    full = Full(example.problem)
    states = full.follow(tqdm(example.training(), desc="snapshots"))
    return np.array([full.displacement(state) for state in states])


def spaces(example: Example, training: Array, size: int) -> dict[str, Array]:
    """Bases of the three methods, (free dofs, <= size), nested."""
    model = example.problem.model
    load = example.load.reshape(-1, 1)[model.free]
    return {
        "MOD": modal(model, size),
        "RITZ": krylov(model, mass(model), load, size),
        "POD": pod(model, training.reshape(len(training), -1), size),
    }


def measure(example: Example, training: Array, sizes: Sequence[int]) -> list[dict[str, Any]]:
    """Rows of the table: a method and number of bases each."""
    problem = example.problem
    methods: dict[tuple[str, int], Method] = {("full", 0): Full(problem)}
    for name, basis in spaces(example, training, max(sizes)).items():
        for size in sizes:
            if size <= basis.shape[1]:
                own = basis[:, :size].copy()
                methods[name, size] = Galerkin(problem, own, in_time=example.in_time)
    full, *others = _in_turns(example, list(methods.values()))
    return [
        {"method": name, "bases": size} | _errors(example, found, full)
        for (name, size), found in zip(list(methods)[1:], others, strict=True)
    ]


@dataclass(frozen=True)
class Timed:
    """A method's fields in every history, median time (s) of a step, and steps without answer."""

    fields: list[Fields]
    seconds: float
    unconverged: int


def _in_turns(example: Example, methods: Sequence[Method]) -> list[Timed]:
    """Answers of the methods to all histories, one step after the other."""
    histories = example.queries()
    seconds: list[list[float]] = [[] for _ in methods]
    missed = [0] * len(methods)
    for method in methods:  # compiled code comes in from disk
        method.solve(histories[0][0][0])
    for _ in tqdm(range(ROUNDS), desc="full and reduced solves"):
        states: list[list[list[Any]]] = [[] for _ in methods]
        for history in histories:
            for method, own in zip(methods, states, strict=True):
                own.append([method.at_rest()])
            for case, dt in history:
                for i, method in enumerate(methods):
                    started = time.perf_counter()
                    answer = method.step(states[i][-1][-1], case, dt)
                    seconds[i].append(time.perf_counter() - started)
                    missed[i] += not answer.converged
                    states[i][-1].append(answer.state)
    return [
        Timed(
            [Fields.of(method, history[1:]) for history in own],
            float(np.median(times)),
            count // ROUNDS,
        )
        for method, own, times, count in zip(methods, states, seconds, missed, strict=True)
    ]


def _errors(example: Example, found: Timed, full: Timed) -> dict[str, Any]:
    """Columns of the table; means and maxima are over histories."""
    problem, P = example.problem, example.point
    pairs = list(zip(found.fields, full.fields, strict=True))
    points = [(own.displacements[:, P], exact.displacements[:, P]) for own, exact in pairs]
    worst = [
        np.linalg.norm(u - exact, axis=1).max() / np.linalg.norm(exact, axis=1).max()
        for u, exact in points
    ]
    whole = np.array([own.errors(problem, exact) for own, exact in pairs])
    return {
        "error_at_P_mean": float(np.mean([relative(*pair) for pair in points])),
        "error_at_P_max": float(np.max(worst)),
        "displacement_error_mean": float(whole[:, 0].mean()),
        "von_mises_error_mean": float(whole[:, 1].mean()),
        "full_ms": 1e3 * full.seconds,
        "reduced_ms": 1e3 * found.seconds,
        "cpu_ratio": full.seconds / found.seconds,
        "unconverged": found.unconverged,
    }


def field_errors(example: Example, training: Array, bases: int) -> FieldErrors:
    """Errors in POD bases: when the load has been held, or at the greatest load that is asked."""
    problem, in_time = example.problem, example.in_time
    basis = pod(problem.model, training.reshape(len(training), -1), bases)
    steps = example.queries()[-1][: HELD + 1]
    methods = Galerkin(problem, basis, in_time=in_time, accurate=EXACT), Full(problem)
    fields = [Fields.of(method, method.follow(steps)[-1:]) for method in methods]
    return FieldErrors.of(problem, *fields)
