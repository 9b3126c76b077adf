"""The figures of Radermacher & Reese anew: modal, Ritz and POD bases under one growing load.

Source: A. Radermacher, S. Reese, *A new strategy for model reduction in non-linear biomechanics*,
whose figures are 1a (error at a point P against the number of bases), 1b (ratio of CPU times) and
2c, 2d (relative errors on the turbinate in five POD bases).

The three methods, on the full quadrature of the mesh as in the paper:

- MOD: linear eigenmodes of least frequency;
- RITZ: load-dependent Ritz vectors of the one load (Wilson's sequence);
- POD: main directions of snapshots along the load's path, in the energy of the rest state.

Errors are taken at loads half-way between the snapshots' own.  Times are those of solves from rest,
full and reduced in turns, so that they share the weather.  What differs from the paper:

- The cube: the paper does not give its size, mesh or load.  Here a dead pressure covers its whole
  top, which is free to move sideways, so that it would sway beyond ``pi^2 E / 48`` = 3.1 kPa (a
  clamped column); the load ends well before, at 13 % of its height.  P is the top's centre.
- The turbinate: our own section and mesh; the pressure is a round footprint's.  P lies under it.
- Tissue is elastic without time: the path is a curve in one parameter, and a handful of POD bases
  hold it to within the reduced solver's tolerance.  For tissue with time see ``paper_in_time``.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr
from tqdm import tqdm

from palpate.offline.methods.full import Full
from palpate.offline.methods.galerkin import Cubature, Galerkin
from palpate.offline.methods.method import Answer, Case
from palpate.offline.methods.spaces import krylov, mass, modal, pod
from palpate.offline.run.workshop import Workshop
from palpate.offline.scenes import find_scene
from palpate.offline.studies import paper_pictures
from palpate.offline.validate.norms import relative
from palpate.shared.geometry.quadrature import surface_quadrature

Array = NDArray[np.float64]

SNAPSHOTS = 20
ROUNDS = 3
"""How often every load is solved for the clock."""

SIZES = (1, 2, 3, 4, 5, 7, 10, 15, 20, 30)
"""Numbers of bases; POD ends where its snapshots have no more to give."""

CONTOUR_BASES = 5
"""Of the paper's figures 2c and 2d."""

ACCURACIES = (0.01, 0.001)
"""Errors at P at which the methods' times are compared."""

MARGIN = 1.25
"""Factor by which ratios of CPU times must differ to be told apart on a busy machine."""

POLISH = 4
"""Newton steps from the answer of the reduced solver: enough for round-off."""

CUBE_PRESSURE = 2.5  # kPa
MEDIAL = (10.0, 20.0, 11.0)
"""In the middle of the turbinate's medial side, mm."""


@dataclass(frozen=True)
class Example:
    """A body under a load that grows.

    Attributes
    ----------
    name : str
    workshop : Workshop
    load : ndarray, shape (n, 3), mN
        At its greatest.
    pressure : float, kPa
        The same.
    at : ndarray, shape (3,), mm
        Where the load's centre is.
    point : int
        The node P, nearest to that.
    """

    name: str
    workshop: Workshop
    load: Array
    pressure: float
    at: Array
    point: int

    @classmethod
    def pressed(
        cls, workshop: Workshop, areas: Array, normal: Array, pressure: float, at: Array
    ) -> Example:
        """Pressure on nodal areas (n,) mm^2 about ``at``, against a normal."""
        nodes = workshop.mesh.nodes
        point = int(np.argmin(np.linalg.norm(nodes - at, axis=1)))
        load = -pressure * areas[:, None] * normal
        return cls(workshop.scene.name, workshop, load, pressure, at, point)

    def case(self, factor: float) -> Case:
        """A share of the load, for a method to answer."""
        nodes = np.flatnonzero(self.load.any(axis=1))
        return Case((), nodes, factor * self.load[nodes])


@dataclass(frozen=True)
class Trial:
    """What a method of one size makes of k loads."""

    method: str
    bases: int
    displacements: Array  # (k, n, 3) mm
    seconds: float  # median
    unconverged: int


def cube(report: Path) -> dict[str, Any]:
    """Figure 1: the cube under compression; see ``compare``."""
    workshop = Workshop(find_scene("cube"))
    return compare(covered(workshop, CUBE_PRESSURE), report)


def covered(workshop: Workshop, pressure: float) -> Example:
    """Pressure (kPa) all over the flat top of a block."""
    mesh = workshop.mesh
    top = surface_quadrature(mesh.nodes, mesh.faces[mesh.accessible])
    areas = np.zeros(len(mesh.nodes))
    np.add.at(areas, top.nodes, top.areas[:, None] * top.shape)
    return Example.pressed(workshop, areas, top.normals[0], pressure, top.points.mean(axis=0))


def turbinate(report: Path) -> dict[str, Any]:
    """Figure 1 for the turbinate under a footprint, and figures 2c and 2d; see ``compare``."""
    paper_pictures.require_pyvista()
    example = footprint(Workshop(find_scene("turbinate")), MEDIAL)
    return compare(example, report, contours=True)


def footprint(workshop: Workshop, position: Sequence[float]) -> Example:
    """A footprint pressed straight in, up to the pressure that is trained for there."""
    at, *_ = workshop.surface.project(np.array(position))
    areas, normal = workshop.unit_load(at)
    return Example.pressed(workshop, areas, normal, float(workshop.load_range(at)[0]), at)


# --- figure 1 ------------------------------------------------------------------------------------


def compare(
    example: Example, report: Path, sizes: Sequence[int] = SIZES, contours: bool = False
) -> dict[str, Any]:
    """Errors and times of the three methods, and what becomes of the paper's claims.

    Parameters
    ----------
    example : Example
    report : Path
        Folder to write ``paper_NAME.csv`` (a row per method and number of bases) and
        ``paper_NAME.png`` (figures 1a and 1b) to.
    sizes : sequence of int
        Numbers of bases.
    contours : bool
        Whether to draw ``paper_NAME_contours.png`` (figures 2c and 2d) too.

    Returns
    -------
    dict
        ``load``; ``figure_1``: per method and number of bases what the table holds; ``claims``, see
        ``claims_of_figure_1`` and ``claims_of_figure_2``; ``claims_with_fewer_bases``: the latter
        by number of bases.
    """
    known = snapshots(example)
    rows = measure(example, known, sizes)
    fields = {size: field_errors(example, known, size) for size in range(1, CONTOUR_BASES + 1)}
    moved = float(np.linalg.norm(known[-1, example.point]))
    title = f"{example.name}, pressed with up to {example.pressure:.1f} kPa: P moves {moved:.1f} mm"
    figure = publish_figure_1(example, rows, moved, title, report)
    if contours:
        path = report / f"paper_{example.name}_contours.png"
        errors = fields[CONTOUR_BASES].contours
        radius = example.workshop.scene.endoscope.radius
        paper_pictures.contours(path, example.workshop.mesh, errors, example.at, radius)
    return figure | {
        "claims": claims_of_figure_1(rows) | claims_of_figure_2(fields[CONTOUR_BASES]),
        "claims_with_fewer_bases": {
            str(size): claims_of_figure_2(fields[size]) for size in range(1, CONTOUR_BASES)
        },
    }


def publish_figure_1(
    example: Example, rows: list[dict[str, Any]], moved: float, title: str, report: Path
) -> dict[str, Any]:
    """Write table and chart, and say what was pressed how far (mm) and found."""
    report.mkdir(parents=True, exist_ok=True)
    _write(report / f"paper_{example.name}.csv", rows)
    paper_pictures.chart(report / f"paper_{example.name}.png", rows, title)
    return {
        "load": {
            "pressure_kPa": example.pressure,
            "point_P_mm": example.workshop.mesh.nodes[example.point].tolist(),
            "P_moves_mm": moved,
        },
        "figure_1": {f"{row['method']} {row['bases']}": row for row in rows},
    }


def factors() -> tuple[Array, Array]:
    """Shares of the load: those of the snapshots, and those half-way between, to be judged at."""
    steps = np.arange(1, SNAPSHOTS + 1)
    return steps / SNAPSHOTS, (steps - 0.5) / SNAPSHOTS


def snapshots(example: Example) -> Array:
    """Full solutions along the load's path, (SNAPSHOTS, n, 3) mm, each from the last."""
    found: list[Array] = []
    for factor in tqdm(factors()[0], desc="snapshots"):
        start = found[-1] if found else None
        state = example.workshop.model.solve(factor * example.load, start)
        found.append(state.displacement)
    return np.array(found)


def spaces(example: Example, known: Array, size: int) -> dict[str, Array]:
    """Bases of the three methods, (free dofs, <= size), nested."""
    model = example.workshop.model
    load = example.load.reshape(-1, 1)[model.free]
    return {
        "MOD": modal(model, size),
        "RITZ": krylov(model, mass(model), load, size),
        "POD": pod(model, known.reshape(len(known), -1), size),
    }


def measure(example: Example, known: Array, sizes: Sequence[int]) -> list[dict[str, Any]]:
    """Rows of the table: a method and number of bases each."""
    model = example.workshop.model
    everything = Cubature.full(model)
    methods: dict[tuple[str, int], Full | Galerkin] = {("full", len(model.free)): Full(model)}
    for name, basis in spaces(example, known, max(sizes)).items():
        for size in sizes:
            if size <= basis.shape[1]:
                modes = np.ascontiguousarray(basis[:, :size])
                methods[name, size] = Galerkin(name, str(size), model, modes, everything)
    full, *trials = _in_turns(example, methods)
    return [_row(example, trial, full) for trial in trials]


def _in_turns(example: Example, methods: dict[tuple[str, int], Full | Galerkin]) -> list[Trial]:
    """Every method's answers to the loads that are judged at, one load after the other."""
    first = example.case(factors()[1][0])
    answers: dict[tuple[str, int], dict[float, Answer]] = {key: {} for key in methods}
    seconds: dict[tuple[str, int], list[float]] = {key: [] for key in methods}
    for method in methods.values():
        method.solve(first)  # compiled code comes in from disk
    for factor in tqdm(np.tile(factors()[1], ROUNDS), desc="full and reduced solves"):
        case = example.case(factor)
        for key, method in methods.items():
            started = time.perf_counter()
            answers[key][factor] = method.solve(case)
            seconds[key].append(time.perf_counter() - started)
    return [
        Trial(
            *key,
            np.array([method.displacement(answer) for answer in answers[key].values()]),
            float(np.median(seconds[key])),
            sum(not answer.converged for answer in answers[key].values()),
        )
        for key, method in methods.items()
    ]


def _row(example: Example, trial: Trial, full: Trial) -> dict[str, Any]:
    workshop, P = example.workshop, example.point
    pairs = list(zip(trial.displacements, full.displacements, strict=True))
    at_point = [relative(u[P], exact[P]) for u, exact in pairs]
    whole = np.array([workshop.errors(u, exact) for u, exact in pairs])
    return {
        "method": trial.method,
        "bases": trial.bases,
        "error_at_P_mean": float(np.mean(at_point)),
        "error_at_P_max": float(np.max(at_point)),
        "displacement_error_mean": float(whole[:, 0].mean()),
        "von_mises_error_mean": float(whole[:, 1].mean()),
        "full_ms": 1e3 * full.seconds,
        "reduced_ms": 1e3 * trial.seconds,
        "cpu_ratio": full.seconds / trial.seconds,
        "unconverged": trial.unconverged,
    }


def _write(path: Path, rows: list[dict[str, Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()})


def claims_of_figure_1(rows: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Whether POD is the most accurate and the fastest, in numbers.

    Returns
    -------
    dict
        ``pod_least_error``: numbers of bases ``compared``, and at how many of them POD has the
        least error at P and over the whole field of stress; it holds if at all of them.
        ``pod_best_cpu_ratio``: at how many of them its ratio is best, and the median of its ratio
        over the best other; ``at_accuracy``: each method's ratio with the fewest bases whose error
        at P is within each of ``ACCURACIES``, None where none is.  It holds if POD's is best by
        ``MARGIN`` at each of those.
    """
    by_size: dict[int, dict[str, dict[str, Any]]] = {}
    for row in rows:
        by_size.setdefault(row["bases"], {})[row["method"]] = row
    common = [methods for methods in by_size.values() if "POD" in methods]
    advantage = [_ratio_over_others(methods) for methods in common]
    least = {
        key: sum(min(methods, key=lambda name: methods[name][key]) == "POD" for methods in common)
        for key in ("error_at_P_mean", "von_mises_error_mean")
    }
    ratios = {
        f"{accuracy:g}": {
            name: _ratio_at_accuracy(rows, name, accuracy) for name in ("MOD", "RITZ", "POD")
        }
        for accuracy in ACCURACIES
    }
    return {
        "pod_least_error": {
            "holds": set(least.values()) == {len(common)},
            "compared": len(common),
            "least_at_P": least["error_at_P_mean"],
            "least_in_stress": least["von_mises_error_mean"],
        },
        "pod_best_cpu_ratio": {
            "holds": all(
                (best["POD"] or 0.0) > MARGIN * max(best["MOD"] or 0.0, best["RITZ"] or 0.0)
                for best in ratios.values()
            ),
            "compared": len(common),
            "best_at_equal_bases": sum(over > 1 for over in advantage),
            "over_best_other_at_equal_bases": float(np.median(advantage)),
            "at_accuracy": ratios,
        },
    }


def _ratio_over_others(methods: dict[str, dict[str, Any]]) -> float:
    """CPU ratio of POD over the best of the others that answer at all, as RITZ does."""
    others = [
        row["cpu_ratio"]
        for name, row in methods.items()
        if name != "POD" and row["error_at_P_mean"] < paper_pictures.NO_ANSWER
    ]
    return float(methods["POD"]["cpu_ratio"] / max(others))


def _ratio_at_accuracy(rows: list[dict[str, Any]], method: str, accuracy: float) -> float | None:
    """CPU ratio with the fewest bases that are accurate enough."""
    accurate = [
        row for row in rows if row["method"] == method and row["error_at_P_mean"] <= accuracy
    ]
    return float(accurate[0]["cpu_ratio"]) if accurate else None


# --- figures 2c and 2d ---------------------------------------------------------------------------


@dataclass(frozen=True)
class FieldErrors:
    """Values (n,) of the full model and relative errors (n,) of a reduced one, node by node.

    Attributes
    ----------
    displacement, von_mises : tuple of ndarray
        Value (mm, kPa) and relative error; nan where the value is zero.
    near_support : ndarray, bool
        Nodes of an element that touches it.
    """

    displacement: tuple[Array, Array]
    von_mises: tuple[Array, Array]
    near_support: NDArray[np.bool_]

    @classmethod
    def of(
        cls, workshop: Workshop, reduced: tuple[Array, Array], full: tuple[Array, Array]
    ) -> FieldErrors:
        """Of displacements (n, 3) and von Mises stresses (n,)."""
        (u, found), (exact, stress) = reduced, full
        moved = np.linalg.norm(exact, axis=1)
        return cls(
            (moved, _over(np.linalg.norm(u - exact, axis=1), moved)),
            (stress, _over(np.abs(found - stress), stress)),
            ~workshop.beyond_clamped_layer,
        )

    @property
    def contours(self) -> dict[str, Array]:
        """Errors by what the pictures call them."""
        return {"displacement": self.displacement[1], "von Mises stress": self.von_mises[1]}


def field_errors(example: Example, known: Array, bases: int) -> FieldErrors:
    """Errors in POD bases at the greatest load that is not a snapshot.

    The reduced equilibrium is polished, so that the error is that of the bases and no solver's.
    """
    workshop, model = example.workshop, example.workshop.model
    basis = pod(model, known.reshape(len(known), -1), bases)
    factor = factors()[1][-1]
    answer = Galerkin("POD", "", model, basis, Cubature.full(model)).solve(example.case(factor))
    u = polished(example, basis, answer.state[: basis.shape[1]], factor)
    exact = model.solve(factor * example.load, known[-1]).displacement
    fields = [(x, workshop.von_mises(x)) for x in (u, exact)]
    return FieldErrors.of(workshop, *fields)


def _over(error: Array, value: Array) -> Array:
    """Relative error, nan where there is nothing to approximate."""
    return np.divide(error, value, out=np.full_like(value, np.nan), where=value > 0)


def polished(example: Example, basis: Array, q: Array, factor: float) -> Array:
    """Displacement (n, 3) mm, ``POLISH`` Newton steps (the paper's equation 2) after ``q``."""
    model = example.workshop.model
    load = factor * example.load.ravel()[model.free]
    u, force = np.zeros(example.load.size), np.zeros(example.load.size)
    for _ in range(POLISH):
        u[model.free] = basis @ q
        model.internal(u, force)
        residual = basis.T @ (force[model.free] - load)
        tangent = basis.T @ (model.stiffness(u) @ basis)
        q = q - np.linalg.solve(tangent, residual)
    u[model.free] = basis @ q
    return u.reshape(-1, 3)


def claims_of_figure_2(errors: FieldErrors) -> dict[str, dict[str, Any]]:
    """Where the errors are largest, in numbers.

    Returns
    -------
    dict
        ``error_largest_where_value_smallest``, for displacement and stress: median relative errors
        of the tenth of nodes with the least and with the greatest values, and the rank correlation
        of value and error; it holds if no other tenth has a larger median than the first.
        ``stress_best_near_support``: medians near the support and elsewhere, and whether the
        largest stress is near it, as the paper says too.
    """
    smallest = {
        name: _tenths(*pair)
        for name, pair in (("displacement", errors.displacement), ("von_mises", errors.von_mises))
    }
    stress, error = errors.von_mises
    near, elsewhere = (
        float(np.nanmedian(error[where])) for where in (errors.near_support, ~errors.near_support)
    )
    return {
        "error_largest_where_value_smallest": {
            "holds": all(found["holds"] for found in smallest.values())
        }
        | smallest,
        "stress_best_near_support": {
            "holds": near < elsewhere,
            "near": near,
            "elsewhere": elsewhere,
            "largest_stress_is_near": bool(errors.near_support[np.argmax(stress)]),
        },
    }


def _tenths(value: Array, error: Array) -> dict[str, Any]:
    known = np.isfinite(error)
    value, error = value[known], error[known]
    medians = [float(np.median(error[part])) for part in np.array_split(np.argsort(value), 10)]
    return {
        "holds": medians[0] == max(medians),
        "least_values": medians[0],
        "greatest_values": medians[-1],
        "rank_correlation": float(spearmanr(value, error).statistic),
    }
