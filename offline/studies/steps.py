"""Who fails under which time steps, and who says so: the rigid tip on visco-elastic tissue.

Histories that a client may send and training has not seen, each answered step by step by the
reduced and the full model: very small and very large steps, long holds, sudden reversals, fast
tools, depths beyond the range, and a hundred thousand steps.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from palpate.offline.run.workshop import Workshop
from palpate.offline.validate.moments import covered_moments
from palpate.offline.validate.tip import QUANTITIES
from palpate.offline.validate.tip_histories import Course, compare_course
from palpate.shared.artifact import read_artifact
from palpate.shared.errors import QueryError
from palpate.shared.mechanics.footprint import TIP_DEPTH
from palpate.shared.model import ReducedModel
from palpate.shared.reduced.history import History

Array = NDArray[np.float64]

MANY = 100_000
"""Steps of the longest case."""

PERIOD = 50
"""Steps of a period in it; after ten of them the full model's answer is periodic, too."""

PERIODS = 10


class Case(NamedTuple):
    """A stressor: depths over their limit, places aside (mm) and lengths of steps (s)."""

    name: str
    levels: Array
    asides: Array
    times: Array


@dataclass
class Outcome:
    """What became of a case.

    Attributes
    ----------
    case : str
    steps : int
    unconverged : int
        Steps without an answer.
    flagged : float
        Share of steps that say ``in_range: false``.
    finite : bool
        Whether every force, tangent and estimate was finite.
    displacement, von_mises, force : float
        Largest error of a moment over the largest norm until then; NaN where the full model found
        no equilibrium.
    covered : float
        Share of moments within all three estimates.
    """

    case: str
    steps: int
    unconverged: int
    flagged: float
    finite: bool
    displacement: float
    von_mises: float
    force: float
    covered: float


def steps(artifact: Path, many: int = MANY) -> dict[str, Any]:
    """Stress an artifact with time steps, amid its surface.

    Writes ``steps.csv`` and ``steps.png`` to the report beside the artifact.

    Parameters
    ----------
    artifact : Path
    many : int
        Steps of the longest case, a multiple of ``PERIOD``.

    Returns
    -------
    dict
        By case what ``Outcome`` holds; and ``drift``: how far the force of the last period of
        ``many`` steps is from that of the full model after ten, over its largest.
    """
    atlas = ReducedModel.load(artifact)
    if atlas.models.viscous_tips is None:
        raise QueryError("scene", f"{atlas.name!r} has no tip that knows of time")
    workshop = Workshop.of_artifact(read_artifact(artifact))
    rows = [_outcome(atlas, workshop, case) for case in tqdm(list(_cases()), "cases")]
    report = artifact.parent / artifact.stem / "report"
    report.mkdir(parents=True, exist_ok=True)
    _write(report / "steps.csv", rows)
    _draw(report / "steps.png", rows)
    return {row.case: asdict(row) for row in rows} | {"drift": _drift(atlas, workshop, many)}


def _cases() -> Iterator[Case]:
    """Every stressor; each begins with a press from above."""
    rng = np.random.default_rng(1)

    def case(name: str, levels: Any, times: Any, asides: Any = 0.0) -> Case:
        levels = np.asarray(levels, float)
        return Case(name, levels, np.broadcast_to(asides, levels.shape), np.broadcast_to(
            np.asarray(times, float), levels.shape))  # fmt: skip

    yield case("steps of 0.01 ms", np.linspace(0.0, 0.8, 60), 1e-5)
    yield case("steps of 0.01 ms, held", np.full(40, 0.8), [1e-5] * 39 + [1.0])
    yield case("steps of 10 s", np.tile([0.8, 0.3], 10), 10.0)
    yield case("steps of a day", np.tile([0.8, 0.3], 5), 86400.0)
    yield case("steps of all lengths", rng.uniform(0.2, 0.9, 40), 10 ** rng.uniform(-6, 3, 40))
    yield case("sudden reversals", np.tile([0.8, -0.05, 0.8, 0.4], 8), np.tile([0, 0, 0, 0.05], 8))
    yield case("held for an hour", np.full(60, 0.8), [0.0, *np.full(59, 61.0)])
    yield case("taps at 20 Hz", np.tile([0.4, 0.8, 0.4, -0.05], 12), 0.0125)
    yield case(
        "slides at 300 mm/s", np.full(30, 0.6), 1e-3,
        2.0 * np.sin(np.linspace(0.0, 1.5 * np.pi, 30)),
    )  # fmt: skip
    yield case("half as deep again as the limit", [*np.linspace(0, 1.5, 12), *np.full(8, 1.5)], 0.1)


def _course(atlas: ReducedModel, case: Case) -> Course:
    """Positions of a case amid the surface."""
    vertices = atlas.surface.vertices
    middle = vertices[((vertices - vertices.mean(axis=0)) ** 2).sum(axis=1).argmin()]
    _, normal, _, _ = atlas.surface.locate(middle, atlas.limits)
    across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    across /= np.linalg.norm(across)
    positions = []
    for level, aside in zip(case.levels, case.asides, strict=True):
        x, n, _, fields = atlas.surface.locate(middle + aside * across, atlas.limits)
        positions.append(x + (atlas.scene.endoscope.radius - level * fields[TIP_DEPTH]) * n)
    return Course(np.array(positions), case.times.tolist())


def _outcome(atlas: ReducedModel, workshop: Workshop, case: Case) -> Outcome:
    course = _course(atlas, case)
    history, answers = History(), []
    for position, dt in zip(*course, strict=True):
        answer, history = atlas.touch_step(history, dt, position)
        answers.append(answer)
    numbers = [
        np.concatenate([a.force, a.tangent.ravel(), [a.error_displacement, a.error_force]])
        for a in answers
    ]
    full = workshop.follow_tip(*course)
    row = None if full is None else compare_course(workshop, atlas, course, full)
    return Outcome(
        case=case.name,
        steps=len(answers),
        unconverged=sum(not answer.converged for answer in answers),
        flagged=float(np.mean([not answer.in_range for answer in answers])),
        finite=bool(np.isfinite(numbers).all()),
        displacement=np.nan if row is None else row.worst_displacement,
        von_mises=np.nan if row is None else row.worst_von_mises,
        force=np.nan if row is None else row.worst_force,
        covered=np.nan if row is None else covered_moments([row], QUANTITIES)["covered"],
    )


def _drift(atlas: ReducedModel, workshop: Workshop, many: int) -> float:
    """How far the force of the last of many periods is from the full model's."""
    phase = 2 * np.pi * np.arange(PERIOD) / PERIOD
    levels = 0.5 - 0.3 * np.cos(phase)
    period = Case("", levels, np.zeros(PERIOD), np.full(PERIOD, 0.02))
    course = _course(atlas, period)
    full = workshop.follow_tip(np.tile(course.positions, (PERIODS, 1)), course.times * PERIODS)
    assert full is not None, "depths are well within the range"
    history, forces = History(), np.empty((PERIOD, 3))
    for number in tqdm(range(many), "many steps"):
        at = number % PERIOD
        answer, history = atlas.touch_step(history, course.times[at], course.positions[at])
        forces[at] = answer.force
    exact = full[2][-PERIOD:]
    away, size = np.linalg.norm(forces - exact, axis=1), np.linalg.norm(exact, axis=1)
    return float(away.max() / size.max())


def _write(path: Path, rows: list[Outcome]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, asdict(rows[0]), lineterminator="\n")
        writer.writeheader()
        for row in rows:
            values = asdict(row).items()
            writer.writerow({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in values})


def _draw(path: Path, rows: list[Outcome]) -> None:
    """Largest errors by case, on a logarithmic axis."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 0.45 * len(rows) + 1.2), layout="constrained")
    axes = figure.subplots()
    places = np.arange(len(rows))[::-1]
    for name, label, marker in (
        ("displacement", "displacement", "o"),
        ("von_mises", "von Mises stress", "s"),
        ("force", "force", "^"),
    ):
        errors = [100 * getattr(row, name) for row in rows]
        axes.plot(errors, places, marker, label=label, alpha=0.8)
    notes = [
        f"{row.unconverged} without an answer, {100 * row.flagged:.0f} % flagged" for row in rows
    ]
    axes.set_yticks(
        places, [f"{r.case}\n{n}" for r, n in zip(rows, notes, strict=True)], fontsize=8
    )
    axes.set_xscale("log")
    axes.set_xlabel("largest error of a moment, % of the largest norm until then")
    axes.grid(axis="x", color="0.9")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=110)
