"""Whether the claims of Radermacher & Reese hold, in numbers; see ``offline.studies.paper``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from palpate.offline.fem.problem import FullProblem
from palpate.offline.studies.references import Fields

Array = NDArray[np.float64]

ACCURACIES = (0.01, 0.001)
"""Errors at P at which the methods' times are compared."""

MARGIN = 1.25
"""Factor by which ratios of CPU times must differ to be told apart on a busy machine."""


def claims_of_figure_1(rows: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Whether POD is the most accurate and the fastest, in numbers.

    Returns
    -------
    dict
        ``pod_least_error``: numbers of bases ``compared``, and at how many of them POD has the
        least error at P and over the whole field of stress; it holds if at all of them.
        ``pod_best_cpu_ratio``, ``at_accuracy``: each method's ratio with the fewest bases whose
        error at P is within each of ``ACCURACIES``, None where none is.  It holds if POD's is best
        by ``MARGIN`` at each of those.
    """
    by_size: dict[int, dict[str, dict[str, Any]]] = {}
    for row in rows:
        by_size.setdefault(row["bases"], {})[row["method"]] = row
    common = [methods for methods in by_size.values() if "POD" in methods]
    least = {
        name: sum(min(x, key=lambda method: x[method][key]) == "POD" for x in common)
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
    return {
        "pod_least_error": {
            "holds": set(least.values()) == {len(common)},
            "compared": len(common),
        }
        | least,
        "pod_best_cpu_ratio": {"holds": all(fastest), "at_accuracy": ratios},
    }


@dataclass(frozen=True)
class FieldErrors:
    """A reduced model beside the full one, node by node.

    Attributes
    ----------
    values : dict of ndarray, shape (n,)
        The full model's displacement (mm) and von Mises stress (kPa).
    errors : dict of ndarray, shape (n,)
        Relative errors of both; nan where there is nothing to approximate.
    near_support : ndarray, bool
        Nodes of an element that touches it.
    """

    values: dict[str, Array]
    errors: dict[str, Array]
    near_support: NDArray[np.bool_]

    @classmethod
    def of(cls, problem: FullProblem, reduced: Fields, full: Fields) -> FieldErrors:
        """Compare the fields of one moment."""
        (u, found), (exact, stress) = ((field[0] for field in fields) for fields in (reduced, full))
        values = {"displacement": np.linalg.norm(exact, axis=1), "von Mises stress": stress}
        off = np.linalg.norm(u - exact, axis=1), np.abs(found - stress)
        errors = {
            name: np.divide(error, value, out=np.full_like(value, np.nan), where=value > 0)
            for (name, value), error in zip(values.items(), off, strict=True)
        }
        return cls(values, errors, ~problem.beyond_clamped_layer)


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
    displacement, stress = errors.values.values()
    error_of_displacement, error = errors.errors.values()
    smallest = {
        "displacement": _tenths(displacement, error_of_displacement),
        "von_mises": _tenths(stress, error),
    }
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
