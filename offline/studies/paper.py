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
- The turbinate: our own section, in a mesh of their size; the pressure is a round footprint's.  P
  lies under it.
- Elastic tissue follows a curve in one parameter, and a handful of POD bases hold it to within the
  reduced solver's tolerance; where fields are looked at, that is as small as can be.

Tissue that knows time is pressed, held, let go, and rests.  Full and reduced models take the same
time steps, each from its own past, and times are those of steps.  POD learns from one history and
is asked another: less pressure, and slower.  Errors are relative L2 norms over all moments, since
at the end there is nothing left to be relative to; the largest is that of a moment, over the
largest value in the history.  On the cube the relaxed tissue is softer and would sway under less:
the pressure is smaller by the share of the shear modulus that is lost.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import spearmanr
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
from palpate.offline.studies.chart import play
from palpate.offline.studies.references import Fields
from palpate.offline.studies.relaxation import Phases, load_steps
from palpate.shared.arrays import Array, Flags
from palpate.shared.geometry.quadrature import surface_quadrature
from palpate.shared.scene import Block

Claims = dict[str, dict[str, Any]]
Nodes = dict[str, tuple[Array, Array]]
"""Values (n,) by name, mm or kPa, and their relative errors, nan where there is no value."""

SNAPSHOTS = 20
ROUNDS = 3  # how often every step is timed
SIZES = (1, 2, 3, 4, 5, 7, 10, 15, 20, 30)
"""Numbers of bases; POD ends where its snapshots have no more to give."""

CONTOUR_BASES = 5  # of the paper's figures 2c and 2d
CUBE_PRESSURE = 2.5  # kPa
MEDIAL = (10.0, 20.0, 11.0)  # in the middle of the turbinate's medial side, mm
TRAINING: Phases = ((0.2, 10, 1.0), (2.0, 14, 1.0), (0.1, 5, 0.0), (2.0, 14, 0.0))
QUERY: Phases = ((0.3, 10, 0.9), (1.5, 14, 0.9), (0.15, 5, 0.0), (1.5, 14, 0.0))
"""Press, hold, release, rest: what POD is trained on, and what all methods answer, in time."""

HELD = 23  # step of both at whose end the load has been held
ACCURACIES = (0.01, 0.001)  # errors at P at which the methods' times are compared
MARGIN = 1.25  # factor by which ratios of CPU times must differ to be told apart on a busy machine
EXACT = 1e-6  # tolerance of the reduced solver where fields are looked at


@dataclass(frozen=True)
class Example:
    """A body under a load that grows."""

    problem: FullProblem
    load: Array  # (n, 3) mN, at its greatest
    pressure: float  # kPa, the same
    at: Array  # (3,) mm, the load's centre

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


def figures(scene: str, report: Path) -> dict[str, Any]:
    """Figure 1 for the cube or turbinate of a scene; of the elastic turbinate 2c and 2d, too.

    See ``compare``.
    """
    found = find_scene(scene)
    if isinstance(found.geometry, Block):
        return compare(covered(FullProblem(found)), report)
    if not found.tissue.prony:
        require_pyvista()
    return compare(footprint(FullProblem(found)), report, contours=not found.tissue.prony)


def covered(problem: FullProblem) -> Example:
    """Pressure all over the flat top of a block."""
    mesh = problem.mesh
    pressure = CUBE_PRESSURE * (1.0 - sum(share for share, _ in problem.model.prony))
    top = surface_quadrature(mesh.nodes, mesh.faces[mesh.accessible])
    areas = np.zeros(len(mesh.nodes))
    np.add.at(areas, top.nodes, top.areas[:, None] * top.shape)
    load = -pressure * areas[:, None] * top.normals[0]
    return Example(problem, load, pressure, top.points.mean(axis=0))


def footprint(problem: FullProblem) -> Example:
    """A footprint pressed straight in, up to the pressure that is trained for there."""
    at, *_ = problem.surface.project(np.array(MEDIAL))
    areas, normal = problem.unit_load(at)
    pressure = float(load_range(problem, at)[0])
    return Example(problem, -pressure * areas[:, None] * normal, pressure, at)


def compare(example: Example, report: Path, contours: bool = False) -> dict[str, Any]:
    """Errors and times of the three methods, and whether the paper's claims hold.

    Writes ``paper_NAME.csv`` (a row per method and number of bases), ``paper_NAME.png`` (figures 1a
    and 1b) and, if wanted, ``paper_NAME_contours.png`` (2c and 2d) to the folder ``report``.

    Returns
    -------
    dict
        ``load``; ``figure_1``: per method and number of bases what the table holds; ``claims``, see
        ``claims_of_figure_1`` and ``claims_of_figure_2``, in time of the moment when the load has
        been held; ``claims_with_fewer_bases``: the latter by number of bases, of elastic tissue.
    """
    problem, name = example.problem, example.problem.scene.name
    training = snapshots(example)
    rows = measure(example, training)
    moved = float(np.linalg.norm(training[:, example.point], axis=1).max())
    title = f"{name}, pressed with up to {example.pressure:.3g} kPa"
    title += f"{', held and let go' if example.in_time else ''}: P moves {moved:.1f} mm"
    write_csv(report / f"paper_{name}.csv", rows)
    paper_pictures.chart(report / f"paper_{name}.png", rows, title)
    claims: dict[int, Claims] = {}
    for size in range(CONTOUR_BASES if example.in_time else 1, CONTOUR_BASES + 1):
        nodes = node_by_node(example, training, size)
        claims[size] = claims_of_figure_2(nodes, ~problem.beyond_clamped_layer)
    if contours:
        path, radius = report / f"paper_{name}_contours.png", problem.scene.endoscope.radius
        errors = {name: error for name, (_, error) in nodes.items()}
        paper_pictures.contours(path, problem.mesh, errors, example.at, radius)
    return {
        "load": {
            "pressure_kPa": example.pressure,
            "point_P_mm": problem.mesh.nodes[example.point].tolist(),
            "P_moves_mm": moved,
        },
        "figure_1": {f"{row['method']} {row['bases']}": row for row in rows},
        "claims": claims_of_figure_1(rows) | claims.pop(CONTOUR_BASES),
        "claims_with_fewer_bases": {str(size): own for size, own in claims.items()},
    }


def snapshots(example: Example) -> Array:
    """Full solutions (t, n, 3) mm of the history that POD learns from."""
    full = Full(example.problem)
    states, *_ = play(full, tqdm(example.training(), desc="snapshots"))
    return np.array([full.displacement(state) for state in states])


def measure(example: Example, training: Array) -> list[dict[str, Any]]:
    """Rows of the table: a method and number of bases each."""
    problem, model, most = example.problem, example.problem.model, max(SIZES)
    bases = {
        "MOD": modal(model, most),
        "RITZ": krylov(model, mass(model), example.load.reshape(-1, 1)[model.free], most),
        "POD": pod(model, training.reshape(len(training), -1), most),
    }
    methods: dict[tuple[str, int], Method] = {("full", 0): Full(problem)}
    methods |= {
        (name, size): Galerkin(problem, basis[:, :size].copy(), in_time=example.in_time)
        for name, basis in bases.items()
        for size in SIZES
        if size <= basis.shape[1]
    }
    histories = example.queries()
    for method in methods.values():  # compiled code comes in from disk
        method.solve(histories[0][0][0])
    seconds: dict[tuple[str, int], list[Array]] = {key: [] for key in methods}
    for _ in tqdm(range(ROUNDS), desc="full and reduced solves"):
        fields: dict[tuple[str, int], list[Fields]] = {key: [] for key in methods}
        unconverged = dict.fromkeys(methods, 0)
        for history in histories:
            for key, method in methods.items():
                states, times, missed = play(method, history)
                seconds[key].append(times)
                fields[key].append(Fields.of(method, states))
                unconverged[key] += missed
    full, *others = methods
    taken = {key: float(np.median(np.concatenate(own))) for key, own in seconds.items()}
    return [
        {"method": key[0], "bases": key[1]}
        | _errors(example, fields[key], fields[full])
        | {"full_ms": 1e3 * taken[full], "reduced_ms": 1e3 * taken[key]}
        | {"cpu_ratio": taken[full] / taken[key], "unconverged": unconverged[key]}
        for key in others
    ]


def _errors(example: Example, found: list[Fields], full: list[Fields]) -> dict[str, float]:
    """Columns of the table; means and maxima are over histories."""
    pairs = list(zip(found, full, strict=True))
    points = [[own.displacements[:, example.point] for own in pair] for pair in pairs]
    worst = [
        np.linalg.norm(u - exact, axis=1).max() / np.linalg.norm(exact, axis=1).max()
        for u, exact in points
    ]
    errors = [own.errors(example.problem, exact) for own, exact in pairs]
    displacement, stress = np.mean(errors, axis=0).tolist()
    return {
        "error_at_P_mean": float(np.mean([relative(*pair) for pair in points])),
        "error_at_P_max": float(np.max(worst)),
        "displacement_error_mean": displacement,
        "von_mises_error_mean": stress,
    }


def node_by_node(example: Example, training: Array, bases: int) -> Nodes:
    """Displacement and stress when the load has been held, or is the greatest, in POD bases."""
    problem = example.problem
    basis = pod(problem.model, training.reshape(len(training), -1), bases)
    steps = example.queries()[-1][: HELD + 1]
    methods = Galerkin(problem, basis, None, example.in_time, EXACT), Full(problem)
    ends = [play(method, steps)[0][-1:] for method in methods]
    (u, stress), (exact, full) = (
        [field[0] for field in Fields.of(*own)] for own in zip(methods, ends, strict=True)
    )
    return {
        name: (value, np.divide(off, value, out=np.full_like(value, np.nan), where=value > 0))
        for name, value, off in (
            ("displacement", np.linalg.norm(exact, axis=1), np.linalg.norm(u - exact, axis=1)),
            ("von Mises stress", full, np.abs(stress - full)),
        )
    }


# --- the paper's claims ------------------------------------------------------------------------


def claims_of_figure_1(rows: list[dict[str, Any]]) -> Claims:
    """Whether POD is the most accurate and the fastest, in numbers.

    ``pod_least_error``: numbers of bases ``compared``, and at how many of them POD has the least
    error at P and over the whole field of stress; it holds if at all of them.
    ``pod_best_cpu_ratio``, ``at_accuracy``: each method's ratio with the fewest bases whose error
    at P is within each of ``ACCURACIES``, None where none is.  It holds if POD's is best by
    ``MARGIN`` at each of those.
    """
    sizes = [row["bases"] for row in rows if row["method"] == "POD"]
    alike = [[row for row in rows if row["bases"] == size] for size in sizes]
    least = {
        name: sum(min(own, key=itemgetter(key))["method"] == "POD" for own in alike)
        for name, key in (
            ("least_at_P", "error_at_P_mean"),
            ("least_in_stress", "von_mises_error_mean"),
        )
    }
    ratios: dict[str, dict[str, float | None]] = {}
    for accuracy in ACCURACIES:
        accurate = [row for row in rows if row["error_at_P_mean"] <= accuracy]
        first = {row["method"]: row["cpu_ratio"] for row in reversed(accurate)}
        ratios[f"{accuracy:g}"] = {name: first.get(name) for name in ("MOD", "RITZ", "POD")}
    fastest = [
        (best["POD"] or 0.0) > MARGIN * max(best["MOD"] or 0.0, best["RITZ"] or 0.0)
        for best in ratios.values()
    ]
    holds = set(least.values()) == {len(sizes)}
    return {
        "pod_least_error": {"holds": holds, "compared": len(sizes)} | least,
        "pod_best_cpu_ratio": {"holds": all(fastest), "at_accuracy": ratios},
    }


def claims_of_figure_2(nodes: Nodes, near_support: Flags) -> Claims:
    """Where the errors are largest, in numbers.

    ``error_largest_where_value_smallest``, for displacement and stress: median relative errors of
    the tenth of nodes with the least and with the greatest values, and the rank correlation of
    value and error; it holds if no other tenth has a larger median than the first.
    ``stress_best_near_support``: medians near the support and elsewhere, and whether the largest
    stress is near it, as the paper says too.
    """
    displacement, (stress, error) = nodes.values()
    tenths = {"displacement": _tenths(*displacement), "von_mises": _tenths(stress, error)}
    near, elsewhere = (float(np.nanmedian(error[w])) for w in (near_support, ~near_support))
    holds = all(found["holds"] for found in tenths.values())
    return {
        "error_largest_where_value_smallest": {"holds": holds} | tenths,
        "stress_best_near_support": {
            "holds": near < elsewhere,
            "near": near,
            "elsewhere": elsewhere,
            "largest_stress_is_near": bool(near_support[np.argmax(stress)]),
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
