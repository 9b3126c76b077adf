"""What becomes of a method's answers to hard cases, and the map of it.

A method that gives a wrong answer and vouches for it has failed silently, which is the one failure
a user cannot guard against; most methods have no way to fail otherwise.  One kind of wrong answer
is told apart and counted with the others: where a load has several equilibria, the one that its
path does not lead to.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from palpate.offline.fem.problem import FullProblem
from palpate.offline.info import percent
from palpate.offline.run.tables import write_csv
from palpate.offline.studies.hard_cases import CONTROL
from palpate.offline.studies.references import Fields

ROUGHLY = 0.1
"""Displacement error up to which a wrong answer is roughly right.  Right is what is within the
tolerance of the scene, that of mesh and reduction together: who vouches promises that."""

OUTCOMES = {
    "right": "#0072B2",
    "right but flagged": "#8CC5E8",
    "wrong but flagged": "#C8C8C8",
    "another equilibrium but flagged": "#EBC9DB",
    "refused, or rightly none": "#ECECEC",
    "not converged": "#7F7F7F",
    "silently another equilibrium": "#CC79A7",
    "silently wrong, displacement within 10 %": "#F0E442",
    "silently wrong": "#D55E00",
    "silently inverted": "#000000",
}
"""What can become of an answer, and its colour: after Okabe & Ito, safe for colour-blind eyes."""

RIGHT, RIGHT_FLAGGED, WRONG_FLAGGED, ANOTHER_FLAGGED, REFUSED, DIVERGED, *SILENT_OUTCOMES = OUTCOMES
ANOTHER, ROUGH, SILENT, INVERTED = SILENT_OUTCOMES


@dataclass(frozen=True)
class Result:
    """What became of a method's answer to a case.

    Errors are relative, nan without an answer or without an equilibrium.
    """

    outcome: str  # a key of ``OUTCOMES``
    displacement: float = math.nan
    von_mises: float = math.nan
    inverted: bool = False  # whether the answer turns an element inside out
    nan: bool = False  # whether it is not finite
    crashed: bool = False  # whether the method raised
    drift: float | None = None  # of a long history, how far it ends from a brief one's answer


Table = Mapping[str, Mapping[str, Sequence[Result]]]
"""Results by method and kind of case."""


def classify(
    problem: FullProblem,
    found: Fields | None,
    trusted: bool,
    exact: Fields | None,
    other: Fields | None = None,
) -> Result:
    """Compare an answer, for which the method vouches or not, with the full model's.

    ``other`` is another equilibrium of the same load.
    """
    if found is None:
        return Result(REFUSED if exact is None else DIVERGED)
    if not all(np.isfinite(values).all() for values in found):
        return Result(DIVERGED, nan=True)
    force, tolerance = np.empty(found.displacements[0].size), problem.scene.tolerance
    inverted = any(
        not problem.model.internal(u.ravel(), force)[1] > 0.0 for u in found.displacements
    )
    errors, others = (
        (math.nan, math.nan) if fields is None else found.errors(problem, fields)
        for fields in (exact, other)
    )
    right, another = (
        displacement <= tolerance.displacement and von_mises <= tolerance.von_mises
        for displacement, von_mises in (errors, others)
    )
    kind = 0 if right else 1 if another else 2
    if not trusted:
        outcome = (RIGHT_FLAGGED, ANOTHER_FLAGGED, WRONG_FLAGGED)[kind]
    elif inverted:
        outcome = INVERTED
    else:
        outcome = (RIGHT, ANOTHER, ROUGH if errors[0] <= ROUGHLY else SILENT)[kind]
    return Result(outcome, *errors, inverted)


# --- report --------------------------------------------------------------------------------------


def publish(report: Path, name: str, table: Table, kinds: Sequence[str], asked: str) -> None:
    """Write the map as ``NAME.csv``, a row per method and kind of case, and as ``NAME.png``."""
    rows = [
        _row(method, kind, results[kind])
        for method, results in table.items()
        for kind in kinds
        if kind in results
    ]
    write_csv(report / f"{name}.csv", rows)
    _draw(report / f"{name}.png", rows, kinds, asked)


def _row(method: str, kind: str, results: Sequence[Result]) -> dict[str, Any]:
    """Counts of outcomes, median and largest errors."""
    counts = Counter(result.outcome for result in results)
    row: dict[str, Any] = {"method": method, "stressor": kind, "cases": len(results)}
    row |= {outcome: counts[outcome] for outcome in OUTCOMES}
    row["inverted"] = sum(result.inverted for result in results)
    for name in ("displacement", "von_mises"):
        known = [e for result in results if not math.isnan(e := getattr(result, name))]
        row[f"{name}_median"] = float(np.median(known)) if known else math.nan
        row[f"{name}_max"] = max(known, default=math.nan)
    return row


def summaries(table: Table) -> dict[str, Any]:
    """By method how often it failed, and how far its trust can be relied on.

    ``right_but_flagged`` is the share of its right answers that it flagged, of all cases and in
    range; ``drift`` of long histories by kind.
    """
    report: dict[str, Any] = {}
    for method, results in table.items():
        every = [result for own in results.values() for result in own]
        counts = Counter(result.outcome for result in every)
        report[method] = {
            "cases": len(every),
            "silently_wrong": sum(counts[outcome] for outcome in SILENT_OUTCOMES),
            "of_these_another_equilibrium": counts[ANOTHER],
            "nan": sum(result.nan for result in every),
            "crashes": sum(result.crashed for result in every),
            "right_but_flagged": _flagged(every),
            "outcomes": {outcome: counts[outcome] for outcome in OUTCOMES if counts[outcome]},
        }
        if CONTROL in results:
            report[method]["right_but_flagged_in_range"] = _flagged(results[CONTROL])
        drifts = {
            kind: own[0].drift for kind, own in results.items() if own and own[0].drift is not None
        }
        report[method] |= {"drift": drifts} if drifts else {}
    return report


def _flagged(results: Sequence[Result]) -> float:
    counts = Counter(result.outcome for result in results)
    right = counts[RIGHT] + counts[RIGHT_FLAGGED]
    return counts[RIGHT_FLAGGED] / right if right else 0.0


def _draw(
    path: Path, rows: Sequence[Mapping[str, Any]], columns: Sequence[str], asked: str
) -> None:
    """Draw a bar of outcomes for each method and kind of case, its median error below."""
    methods = list(dict.fromkeys(row["method"] for row in rows))
    size = 3.2 + 0.72 * len(columns), 2.8 + 0.44 * len(methods)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.add_subplot()
    left = np.array([columns.index(row["stressor"]) - 0.45 for row in rows])
    y = np.array([methods.index(row["method"]) for row in rows])
    axes.barh(y, 0.9, 0.46, left, fill=False, edgecolor="0.4", linewidth=0.5, zorder=2)
    for row, x, middle in zip(rows, left + 0.45, y, strict=True):
        error = percent(row["displacement_median"])
        axes.text(x, middle + 0.37, error, ha="center", va="center", size=8)
    for outcome, colour in OUTCOMES.items():
        width = np.array([0.9 * row[outcome] / row["cases"] for row in rows])
        axes.barh(y, width, 0.46, left, color=colour, linewidth=0)
        left += width
    axes.set_xticks(range(len(columns)), columns, rotation=40, ha="left", rotation_mode="anchor")
    axes.xaxis.tick_top()
    axes.set_yticks(range(len(methods)), methods)
    axes.set(xlim=(-0.55, len(columns) - 0.45), ylim=(len(methods) - 0.33, -0.43))
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    handles = [Patch(facecolor=c, edgecolor="0.4", label=name) for name, c in OUTCOMES.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle(
        "Who fails under what, and who says so: what became of the answers to "
        f"{rows[0]['cases']} {asked} of each kind\n"
        "Below each bar: median error of displacement of the answers given, flagged ones included",
        fontsize=13,
    )
    figure.savefig(path, dpi=100)
