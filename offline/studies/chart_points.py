"""Points of the speed-accuracy chart, what stands out among them, and their table."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

SHIPPED, FULL = "artifact 1", "full 1"
"""Keys of the artifact, and of the full model on the scene's own mesh."""

FIELDS = ("displacement", "von_mises", "refined")
"""Errors: of two fields on the scene's mesh, and of displacement against a refined one."""

STATISTICS = ("median", "p95", "max")


@dataclass(frozen=True)
class Point:
    """A method of one size; errors are fractions, over all loads.

    They are nan where there is nothing to compare: another mesh has no error of reduction.
    """

    key: str
    family: str
    label: str
    unknowns: int
    time_us: float
    displacement_median: float
    displacement_p95: float
    displacement_max: float
    von_mises_median: float
    von_mises_p95: float
    von_mises_max: float
    refined_median: float
    refined_p95: float
    refined_max: float
    unconverged: int

    def error(self, field: str, statistic: str) -> float:
        """One of ``STATISTICS`` of the errors of one of ``FIELDS``."""
        return float(getattr(self, f"{field}_{statistic}"))


def pareto(
    points: Sequence[Point], field: str = "displacement", statistic: str = "p95"
) -> list[Point]:
    """The points, fastest first, that no other beats in both time and an error."""
    front: list[Point] = []
    least = math.inf
    for point in sorted(points, key=lambda point: (point.time_us, point.error(field, statistic))):
        if point.error(field, statistic) < least:
            front.append(point)
            least = point.error(field, statistic)
    return front


def write_csv(path: Path, points: Sequence[Point]) -> None:
    """Write a row per point; errors as fractions."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [asdict(point) for point in points]
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()})
