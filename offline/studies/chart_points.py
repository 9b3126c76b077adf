"""Points of the speed-accuracy charts, and those that no other beats."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

SHIPPED, TWIN, FULL = "artifact 1", "artifact, warm 1", "full 1"
"""Keys of the artifact, of the artifact without memory, and of the full model on its own mesh."""

FIELDS = ("displacement", "von_mises", "refined")
"""Errors: of two fields on the scene's mesh, and of displacement against a refined one."""

STATISTICS = ("median", "p95", "max")


@dataclass(frozen=True)
class Point:
    """A method of one size; errors are fractions, over all queries.

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
    """The points, fastest first, that no other beats in both time and an error.

    The artifact without memory is no competitor: it answers another question.
    """
    front: list[Point] = []
    least = math.inf
    points = [point for point in points if point.key != TWIN]
    for point in sorted(points, key=lambda point: (point.time_us, point.error(field, statistic))):
        if point.error(field, statistic) < least:
            front.append(point)
            least = point.error(field, statistic)
    return front
