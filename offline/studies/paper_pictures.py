"""Charts and contours of ``offline.studies.paper``; the contours need the extra ``pictures``."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from palpate.offline.methods.galerkin import TOLERANCE
from palpate.offline.pictures import INK, body, new_plotter, ring, save
from palpate.shared.arrays import Array
from palpate.shared.local_models import Mesh

STYLES = {"MOD": ("#0072B2", "o"), "RITZ": ("#E69F00", "s"), "POD": ("#009E73", "D")}
"""Colours that the colour-blind tell apart (Okabe & Ito), and marks for print."""

NO_ANSWER = 0.99
"""Error at P from which on bases do not answer the load at all: there is nothing to time."""

SIZE = (1200, 940)
VIEWS = {
    "medial side, pressed in the ring": (1.0, -0.7, 0.35),
    "lateral side (grey: value is zero)": (-1.0, 0.7, 0.35),
}
DECADES = 4  # most powers of ten that a scale of colours shows


def chart(path: Path, rows: list[dict[str, Any]], title: str) -> None:
    """Figures 1a and 1b: error at P and ratio of CPU times against the number of bases."""
    figure = Figure(figsize=(9.6, 4.4), layout="constrained")
    figure.suptitle(title, fontsize=12)
    errors, ratios = figure.subplots(1, 2)
    for name, (colour, mark) in STYLES.items():
        own = [row for row in rows if row["method"] == name]
        timed = [row for row in own if row["error_at_P_mean"] < NO_ANSWER]
        for axes, kept, key, factor in (
            (errors, own, "error_at_P_mean", 100),
            (ratios, timed, "cpu_ratio", 1),
        ):
            x, y = [row["bases"] for row in kept], [factor * row[key] for row in kept]
            axes.plot(x, y, color=colour, marker=mark, label=name)
    errors.axhline(100 * TOLERANCE, color="0.4", linestyle=":")
    ticks = sorted({row["bases"] for row in rows})
    words = {"va": "top", "color": "0.3", "fontsize": 9}
    errors.text(ticks[0], 80 * TOLERANCE, "tolerance of the solver", **words)
    for axes in (errors, ratios):
        axes.set(xscale="log", yscale="log", xlim=(0.9 * ticks[0], 1.1 * ticks[-1]))
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.xaxis.set_minor_formatter("")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_xlabel("number of bases", fontsize=12)
        axes.grid(color="0.9")
    ratios.yaxis.set_minor_locator(LogLocator(subs=(2, 5)))
    ratios.yaxis.set_minor_formatter("{x:g}")
    errors.set_ylabel("(a) relative error of displacement at P, %", fontsize=12)
    ratios.set_ylabel("(b) CPU time, full model / reduced", fontsize=12)
    ratios.legend(fontsize=11, loc="lower left")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def contours(path: Path, mesh: Mesh, errors: dict[str, Array], at: Array, radius: float) -> None:
    """Figures 2c and 2d: relative errors (n,) on the body, a column each, seen from both sides.

    Errors that are nan are grey: no displacement, or stress cut off at zero.  The footprint at
    ``at`` (3,) mm is ringed.
    """
    _, surface = body(mesh.nodes, mesh.elements, at, errors)
    rim, plotter = ring(surface, at, radius, 0.05), new_plotter((len(VIEWS), len(errors)), SIZE)
    for column, (name, error) in enumerate(errors.items()):
        for row, (title, towards) in enumerate(VIEWS.items()):
            plotter.subplot(row, column)
            painted = plotter.add_mesh(
                surface.copy(), scalars=name, cmap="viridis", clim=_scale(error), log_scale=True,
                nan_color="lightgrey", show_scalar_bar=False, lighting=False,
            )  # fmt: skip
            plotter.add_mesh(rim, color="white", lighting=False)
            plotter.add_text(title, position=(0.04, 0.92), viewport=True, font_size=11, color=INK)
            plotter.view_vector(towards, viewup=(0, 0, 1))
            plotter.camera.parallel_projection = True
            plotter.camera.zoom(1.15)
        plotter.add_scalar_bar(
            f"relative error of {name}\n", mapper=painted.mapper, color=INK, fmt="%.0e",
            position_x=0.15, width=0.7, position_y=0.03, height=0.13,
            n_labels=3, title_font_size=20, label_font_size=18,
        )  # fmt: skip
    save(plotter, path)


def _scale(error: Array) -> tuple[float, float]:
    """Whole powers of ten about the errors, outliers at either end left out."""
    low, high = np.nanpercentile(error, (2, 99.5))
    top = np.ceil(np.log10(high))
    return 10.0 ** max(np.floor(np.log10(low)), top - DECADES), 10.0**top
