"""Press, hold, release: what an examiner's hand would feel and see, of both models."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from palpate.offline.run.workshop import Load, Workshop
from palpate.offline.validate.histories import Press, play
from palpate.shared.artifact import read_artifact
from palpate.shared.errors import QueryError
from palpate.shared.model import ReducedModel

Array = NDArray[np.float64]

PRESSED = 0.8
"""Pressure over its limit."""

Phases = Sequence[tuple[float, int, float]]
"""Of a course: seconds, steps, and the share of the load at the end."""

PHASES = ((0.2, 10, 1.0), (4.0, 40, 1.0), (0.1, 5, 0.0), (4.0, 40, 0.0))
"""Press, hold, release, rest."""


def relaxation(artifact: Path, position: Array | None = None) -> dict[str, Any]:
    """Press one place of an artifact's surface, hold, release, wait.

    Writes ``relaxation.csv`` and ``relaxation.png`` to the report beside the artifact.

    Parameters
    ----------
    artifact : Path
    position : ndarray, shape (3,), mm, optional
        Amid the surface if absent.

    Returns
    -------
    dict
        Depths (mm) at once and after the hold, what is left of the dent after the rest, largest
        difference of the two models' depths, and median times of a step (µs).
    """
    atlas = ReducedModel.load(artifact)
    if atlas.models.viscous is None:
        raise QueryError("scene", f"{atlas.name!r} is elastic: nothing relaxes")
    workshop = Workshop.of_artifact(read_artifact(artifact))
    vertices = atlas.surface.vertices
    if position is None:
        position = vertices[((vertices - vertices.mean(axis=0)) ** 2).sum(axis=1).argmin()]
    x, normal, _, fields = atlas.surface.locate(position, atlas.limits)
    presses = [
        Press(dt, x, -normal, share * PRESSED * float(fields[0])) for dt, share in course(PHASES)
    ]
    play(atlas, presses[:2])  # compiles
    moments = play(atlas, presses)
    force = np.array([np.linalg.norm(moment.force) for moment in moments])
    reduced = np.array([-moment.contact_displacement @ normal for moment in moments])
    full = _full_depth(workshop, presses, normal)
    times = np.cumsum([press.dt for press in presses])
    report = artifact.parent / artifact.stem / "report"
    report.mkdir(parents=True, exist_ok=True)
    _write(report / "relaxation.csv", times, force, full, reduced)
    _draw(report / "relaxation.png", times, force, full, reduced)
    pressed, held, released = (np.cumsum([steps for _, steps, _ in PHASES]) - 1)[[0, 1, 3]]
    return {
        "depth_pressed_mm": float(full[pressed]),
        "depth_held_mm": float(full[held]),
        "dent_left_mm": float(full[released]),
        "largest_difference_mm": float(np.abs(full - reduced).max()),
        "step_us": 1e6 * float(np.median([moment.solve_seconds for moment in moments])),
    }


def course(phases: Phases) -> list[tuple[float, float]]:
    """Time steps (s) and shares of the load at their ends."""
    course, level = [], 0.0
    for seconds, steps, share in phases:
        rest = share == level  # as less happens, steps grow
        ends = seconds * np.linspace(0, 1, steps + 1) ** (2 if rest else 1)
        levels = np.linspace(level, share, steps + 1)
        course += list(zip(np.diff(ends).tolist(), levels[1:].tolist(), strict=True))
        level = share
    return course


def _full_depth(workshop: Workshop, presses: list[Press], normal: Array) -> Array:
    history, depth = workshop.model.at_rest, []
    for press in tqdm(presses, "full model"):
        load = Load(press.position, press.direction, press.pressure)
        _, history = workshop.model.step(history, workshop.load_vector(load), press.dt)
        depth.append(-float(workshop.under(press.position, history.displacement) @ normal))
    return np.array(depth)


def _write(path: Path, *columns: Array) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["time_s", "force_mN", "depth_full_mm", "depth_reduced_mm"])
        writer.writerows([[f"{value:.5g}" for value in row] for row in np.column_stack(columns)])


def _draw(path: Path, times: Array, force: Array, full: Array, reduced: Array) -> None:
    """Force above, depth below, over time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4.8), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(1, 2))
    ends = np.concatenate([[0.0], np.cumsum([seconds for seconds, _, _ in PHASES])])
    for axes in (above, below):
        for end in ends[1:-1]:
            axes.axvline(end, color="0.85", linewidth=0.8)
        axes.spines[["top", "right"]].set_visible(False)
    start = np.zeros(1)
    t = np.concatenate([start, times])
    above.plot(t, np.concatenate([start, force]), color="0.3")
    above.set_ylabel("force, mN")
    below.plot(t, np.concatenate([start, full]), color="tab:blue", label="full model")
    below.plot(times[::2], reduced[::2], ".", color="tab:orange", label="reduced model")
    below.set_ylabel("depth of the dent, mm")
    below.set_xlabel("time, s")
    below.legend(frameon=False)
    for name, left, right in (("hold", ends[1], ends[2]), ("released", ends[3], ends[4])):
        above.text((left + right) / 2, 0.5 * force.max(), name, ha="center", color="0.4")
    figure.savefig(path, dpi=110)
