"""The reduced against the full model on loads it has not seen, over the whole surface and range."""

from __future__ import annotations

import csv as csv_format
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from palpate.offline.reduce.sampling import cone, random_points_and_rim
from palpate.offline.run.streams import Stage, stream
from palpate.offline.run.workers import completed, worker_pool
from palpate.offline.run.workshop import Load, Workshop, open_artifact
from palpate.offline.validate.norms import relative, statistics
from palpate.shared.artifact import read_artifact
from palpate.shared.errors import PalpateError
from palpate.shared.geometry.surface import Surface
from palpate.shared.local_models import Estimator
from palpate.shared.mechanics.footprint import pressure_limit
from palpate.shared.model import ReducedModel
from palpate.shared.scene import Scene

Array = NDArray[np.float64]

ESTIMATED = ("displacement", "von_mises")

COVERAGE = 0.96
"""Share of known errors that the estimate must cover, for 95 % of unseen ones to be."""

DAMPING = 0.3
"""Holds the coefficients of the estimate back, since known errors are few for many features."""


@dataclass
class Comparison:
    """One load answered by both models; errors are relative L2 norms.

    Attributes
    ----------
    x, y, z : float, mm
    pressure, limit : float, kPa
    load, tilt : float
        Fractions of the limits.
    departure, residual : float
        Departure from the linear response and predicted residual, see ``shared.answer.Answer``.
    features : ndarray
        Of the error estimate.
    displacement, von_mises : float
        Errors over all nodes, and over all nodes outside the clamped layer.
    peak_displacement : float, mm
    von_mises_p99 : float
        Relative error of the field's 99th percentile.
    estimated_displacement, estimated_von_mises : float
    converged, in_range : bool
    iterations : int
    """

    x: float
    y: float
    z: float
    pressure: float
    limit: float
    load: float
    tilt: float
    departure: float
    residual: float
    displacement: float
    von_mises: float
    peak_displacement: float
    von_mises_p99: float
    converged: bool
    in_range: bool
    iterations: int
    features: Array = field(repr=False)
    estimated_displacement: float = field(default=float("nan"))
    estimated_von_mises: float = field(default=float("nan"))

    @property
    def typical(self) -> bool:
        """Whether it counts for the error estimate."""
        return self.converged

    def estimate(self, estimator: Estimator) -> None:
        """Fill in the estimated errors."""
        self.estimated_displacement, self.estimated_von_mises = estimator(self.features)


def write_rows(path: Path, rows: Sequence[Any]) -> None:
    """Write dataclasses, one row each, but for what is not shown (``features``)."""
    with path.open("w", newline="") as file:
        names = [part.name for part in fields(rows[0]) if part.repr]
        writer = csv_format.DictWriter(file, names, lineterminator="\n")
        writer.writeheader()
        for row in rows:
            values = ((name, getattr(row, name)) for name in names)
            writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in values})


def validate(artifact: Path, queries: int, seed: int, csv: Path | None = None) -> dict[str, Any]:
    """Compare an artifact with its full model on new random loads.

    Parameters
    ----------
    artifact : Path
    queries : int
        Loads, over the whole surface, cone of directions and range of pressures.
    seed : int
        Of the loads; those of training come from none.
    csv : Path, optional
        Where to write one row per load.

    Returns
    -------
    dict
        As ``summarise``, and ``without_equilibrium``: loads that the full model had no answer to,
        and which count in nothing else.
    """
    atlas, workshop, rng = unseen(artifact, seed)
    loads = random_loads(atlas.surface, atlas.limits, atlas.scene, queries, rng)

    def judge(i: int, reference: Array | None) -> Comparison | None:
        return None if reference is None else compare(workshop, atlas, loads[i], reference)

    tasks = [(Workshop.sample, load) for load in loads]
    nothing = "the full model has no equilibrium under any of the loads"
    return verdict(artifact, tasks, judge, summarise, nothing, csv)


def unseen(artifact: Path, seed: int) -> tuple[ReducedModel, Workshop, np.random.Generator]:
    """An artifact, its full model, and random numbers that training has not seen."""
    atlas = ReducedModel.load(artifact)
    workshop = Workshop.of_artifact(read_artifact(artifact))
    return atlas, workshop, stream(atlas.scene.seed, Stage.UNSEEN, seed)


def verdict(
    artifact: Path,
    tasks: Sequence[tuple[Any, ...]],
    judge: Callable[[int, Any], Any | None],
    summarise: Callable[[Sequence[Any]], dict[str, Any]],
    nothing: str,
    csv: Path | None,
) -> dict[str, Any]:
    """Summary of what ``judge`` makes of the full model's results, each told its task's number.

    None, where the full model has no answer, is left out and counted as ``without_equilibrium``;
    ``csv`` gets a row of each other.

    Raises
    ------
    PalpateError
        If all are; ``nothing`` is what it says then.
    """
    numbered = {str(i): task for i, task in enumerate(tasks)}
    rows = {}
    with worker_pool(open_artifact, artifact) as pool:
        for name, found in tqdm(completed(pool, numbered), "full solutions", len(numbered)):
            row = judge(int(name), found)
            if row is not None:
                rows[int(name)] = row
    if not rows:
        raise PalpateError(f"{artifact}: {nothing}")
    ordered = [rows[i] for i in sorted(rows)]
    if csv:
        csv.parent.mkdir(parents=True, exist_ok=True)
        write_rows(csv, ordered)
    return summarise(ordered) | {"without_equilibrium": len(tasks) - len(ordered)}


def unseen_loads(atlas: ReducedModel, count: int, seed: int) -> list[Load]:
    """Random loads that training has not seen, whatever the seed."""
    rng = stream(atlas.scene.seed, Stage.UNSEEN, seed)
    return random_loads(atlas.surface, atlas.limits, atlas.scene, count, rng)


def random_loads(
    surface: Surface, limits: Array, scene: Scene, count: int, rng: np.random.Generator
) -> list[Load]:
    """Random loads over the whole surface, cone of directions and range of pressures.

    Contact points are uniform over the area, one in eight on the rim of the surface; directions are
    uniform in the cone, one in eight on its border; pressures are denser towards the limit.
    """
    loads = []
    for i, point in enumerate(random_points_and_rim(surface, count, rng)):
        x, normal, _, fields = surface.locate(point, limits)
        tilt = scene.endoscope.max_tilt
        direction = cone(normal, tilt, 1, rng, border=i % 8 == 1)[0]
        limit = pressure_limit(fields, normal, direction)
        loads.append(Load(x, direction, float(limit * np.sqrt(rng.random()))))
    return loads


def compare(workshop: Workshop, atlas: ReducedModel, load: Load, reference: Array) -> Comparison:
    """Answer a load with the reduced model and compare with the full ``reference`` (n, 3) mm."""
    solution = atlas.press(load.position, load.pressure, load.direction)
    displacement = atlas.displacement(solution).astype(float)
    exact, stress = workshop.von_mises(reference), atlas.von_mises(solution).astype(float)
    kept = workshop.beyond_clamped_layer
    p99 = np.percentile(exact[kept], 99)
    x, y, z = solution.contact_point.tolist()
    return Comparison(
        x=x,
        y=y,
        z=z,
        pressure=load.pressure,
        limit=solution.pressure_limit,
        load=load.pressure / solution.pressure_limit,
        tilt=solution.tilt / atlas.scene.endoscope.max_tilt,
        departure=solution.departure,
        residual=solution.residual,
        displacement=relative(displacement, reference),
        von_mises=relative(stress[kept], exact[kept]),
        peak_displacement=float(np.linalg.norm(reference, axis=1).max()),
        von_mises_p99=float(abs(np.percentile(stress[kept], 99) - p99) / p99),
        converged=solution.converged,
        in_range=solution.in_range,
        iterations=solution.iterations,
        features=solution.features,
        estimated_displacement=solution.error_displacement,
        estimated_von_mises=solution.error_von_mises,
    )


def summarise(rows: Sequence[Comparison]) -> dict[str, Any]:
    """Errors of the converged answers; ``covered``: the share within both estimates."""
    unconverged = sum(not r.converged for r in rows)
    rows = [r for r in rows if r.converged]
    covered, ratios = coverage(rows, ESTIMATED)
    return {
        "queries": len(rows) + unconverged,
        "unconverged": unconverged,
        "covered": covered,
        "displacement": statistics([r.displacement for r in rows]),
        "von_mises": statistics([r.von_mises for r in rows]),
        "von_mises_p99": statistics([r.von_mises_p99 for r in rows]),
        "estimate_over_error_median": ratios,
    }


def calibrate(
    rows: Sequence[Any],
    quantities: Sequence[str] = ESTIMATED,
    share: float = COVERAGE,
    damping: float = DAMPING,
) -> Estimator:
    """Fit the error estimate to known errors: it covers a share of them in all quantities.

    A least-squares fit of their logs is raised by a constant for each quantity.  The rows that need
    not be covered are those that would raise one most.  What counts is how far a row lies from a
    fit to the others, or the estimate would cover fewer of new ones.
    """
    rows = [r for r in rows if r.typical]
    X = np.array([r.features for r in rows])
    spread = X.std(axis=0)
    scale = np.where(spread > 1e-9, spread, np.inf)  # the constant one; others may be, too
    middle = X.mean(axis=0)
    A = np.column_stack([(X - middle) / scale, np.ones(len(rows))])
    ridge = np.diag([damping] * len(middle) + [0.0])
    leverage = np.sum(A * np.linalg.pinv(np.vstack([A, ridge])).T[: len(A)], axis=1)
    coefficients, rests = [], []
    for name in quantities:
        y = np.log([max(getattr(r, name), 1e-8) for r in rows])
        c = np.linalg.lstsq(np.vstack([A, ridge]), np.append(y, np.zeros(len(ridge))))[0]
        c, constant = c[:-1] / scale, c[-1]
        c[0] = constant - c @ middle
        rest = y - X @ c
        c[0] += np.median(rest)
        coefficients.append(c)
        rests.append((rest - np.median(rest)) / (1 - leverage))
    covered = np.argsort(np.max(rests, axis=0))[: int(np.ceil(share * (len(rows) + 1)))]
    for c, rest in zip(coefficients, rests, strict=True):
        c[0] += rest[covered].max()
    return Estimator(np.array(coefficients))


def calibrate_by_halves(
    rows: Sequence[Any], fit: Callable[[Sequence[Any]], Estimator]
) -> Estimator:
    """Fit an estimate to all rows; those of the rows themselves come from one of the other half."""
    for half, other in ((rows[::2], rows[1::2]), (rows[1::2], rows[::2])):
        estimator = fit(other)
        for row in half:
            row.estimate(estimator)
    return fit(rows)


def coverage(rows: Sequence[Any], quantities: Sequence[str]) -> tuple[float, dict[str, float]]:
    """Share of rows whose errors are all within their estimates; median of estimate over error.

    Of the rows in range: outside it there is no estimate.
    """
    rows = [r for r in rows if getattr(r, f"estimated_{quantities[0]}") != math.inf]
    covered = [
        all(getattr(r, name) <= getattr(r, f"estimated_{name}") for name in quantities)
        for r in rows
    ]
    ratios = {
        name: float(
            np.median(
                [getattr(r, f"estimated_{name}") / max(getattr(r, name), 1e-12) for r in rows]
            )
        )
        for name in quantities
    }
    return float(np.mean(covered)), ratios
