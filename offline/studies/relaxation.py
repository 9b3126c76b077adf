"""Press, hold, release: the depth of the dent and the force over time, of both models."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from tqdm import tqdm

from palpate.offline.run.tables import write_csv
from palpate.offline.validate.compare import opened, play
from palpate.offline.validate.queries import HISTORIES, Place
from palpate.shared.arrays import Array

PRESSED = 0.8  # pressure over its limit

Phases = Sequence[tuple[float, int, float]]
"""Seconds, steps, and the share of the load at the end of each phase of a history."""

PHASES = ((0.2, 10, 1.0), (4.0, 40, 1.0), (0.1, 5, 0.0), (4.0, 40, 0.0))
"""Press, hold, release, rest."""


def relaxation(artifact: Path, position: Sequence[float] | None = None) -> dict[str, Any]:
    """Press one place (mm) of an artifact's surface, or its middle, hold, release, wait.

    Returns
    -------
    dict
        Depths (mm) at once and after the hold, the depth left after the rest, the largest
        difference of the two models' depths, and the median time of a step (µs).

    Raises
    ------
    QueryError
        If the place is out of reach.
    """
    atlas, problem = opened(artifact, HISTORIES)
    vertices = atlas.surface.vertices
    middle = vertices[np.linalg.norm(vertices - vertices.mean(axis=0), axis=1).argmin()]
    if position is not None:
        atlas.check(position, 0.0)
    place = Place.at(atlas, middle if position is None else np.array(position))
    steps = load_steps(PHASES)
    loads = [place.press(-place.normal, share * PRESSED, dt) for dt, share in steps]
    play(atlas, loads[:1])  # compiles
    answers, moved, past = play(atlas, loads), [], None
    for load, answer in zip(tqdm(loads, "full"), answers, strict=True):
        found = problem.solve(load, past)
        past, under = found.past, problem.under(place.position, found.displacement)
        moved.append((under, answer.contact_displacement))
    times, depth = np.cumsum([dt for dt, _ in steps]), -np.array(moved) @ place.normal
    force = np.array([np.linalg.norm(answer.force) for answer in answers])
    report = artifact.parent / atlas.name / "report"
    names = "time_s", "force_mN", "depth_full_mm", "depth_reduced_mm"
    rows = np.column_stack([times, force, depth]).tolist()
    write_csv(report / "relaxation.csv", [dict(zip(names, row, strict=True)) for row in rows])
    _draw(report / "relaxation.png", times, force, *depth.T)
    pressed, held, released = (np.cumsum([count for _, count, _ in PHASES]) - 1)[[0, 1, 3]]
    return {
        "depth_pressed_mm": float(depth[pressed, 0]),
        "depth_held_mm": float(depth[held, 0]),
        "dent_left_mm": float(depth[released, 0]),
        "largest_difference_mm": float(np.abs(depth[:, 0] - depth[:, 1]).max()),
        "step_us": 1e6 * float(np.median([answer.solve_seconds for answer in answers])),
    }


def load_steps(phases: Phases) -> list[tuple[float, float]]:
    """Time steps (s) and shares of the load at their ends."""
    steps, level = [], 0.0
    for seconds, count, share in phases:
        # while the load rests, less and less happens, and steps grow
        ends = seconds * np.linspace(0, 1, count + 1) ** (2 if share == level else 1)
        levels = np.linspace(level, share, count + 1)
        steps += list(zip(np.diff(ends).tolist(), levels[1:].tolist(), strict=True))
        level = share
    return steps


def _draw(path: Path, times: Array, force: Array, full: Array, reduced: Array) -> None:
    """Force above, depth below, over time."""
    figure = Figure(figsize=(8, 4.8), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(1, 2))
    ends = np.cumsum([seconds for seconds, _, _ in PHASES])
    for axes in (above, below):
        axes.spines[["top", "right"]].set_visible(False)
        for end in ends[:-1]:
            axes.axvline(end, color="0.85", linewidth=0.8)
    t, force, full = (np.append(0.0, x) for x in (times, force, full))
    above.plot(t, force, color="0.3")
    above.set_ylabel("force, mN")
    below.plot(t, full, color="tab:blue", label="full model")
    below.plot(times[::2], reduced[::2], ".", color="tab:orange", label="reduced model")
    below.set(ylabel="depth of the dent, mm", xlabel="time, s")
    below.legend(frameon=False)
    for name, left, right in (("hold", *ends[:2]), ("released", *ends[2:])):
        above.text((left + right) / 2, 0.5 * force.max(), name, ha="center", color="0.4")
    figure.savefig(path, dpi=110)
