"""Charts and contours of ``offline.studies.paper``; the contours need the extra ``pictures``."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offline.mesh import Mesh
from offline.vtu import CELL_TYPES
from shared.errors import PalpateError

Array = NDArray[np.float64]

STYLES = {"MOD": ("#0072B2", "o"), "RITZ": ("#E69F00", "s"), "POD": ("#009E73", "D")}
"""Colours that the colour-blind tell apart (Okabe & Ito), and marks for print."""

SIZE = (1200, 900)
COLOURS, INK = "viridis", "#202428"
SUBDIVISIONS = 2
VIEWS = {"medial side, pressed in the ring": (1.0, -0.7, 0.35), "lateral side": (-1.0, 0.7, 0.35)}
DECADES = 4
"""Most powers of ten that a scale of colours shows."""


def chart(path: Path, rows: list[dict[str, Any]]) -> None:
    """Figures 1a and 1b: error at P and ratio of CPU times against the number of bases."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter, ScalarFormatter

    figure = Figure(figsize=(9.6, 4.2), layout="constrained")
    panels = figure.subplots(1, 2)
    for name, (colour, mark) in STYLES.items():
        own = [row for row in rows if row["method"] == name]
        for axes, key, scale in zip(
            panels, ("error_at_P_mean", "cpu_ratio"), (100, 1), strict=True
        ):
            values = [scale * row[key] for row in own]
            axes.plot([row["bases"] for row in own], values, color=colour, marker=mark, label=name)
    ticks = sorted({row["bases"] for row in rows})
    for axes in panels:
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel("number of bases", fontsize=12)
        axes.grid(color="0.9")
        axes.tick_params(labelsize=11)
    panels[0].set_ylabel("relative error of displacement at P, %", fontsize=12)
    panels[1].set_ylabel("CPU time, full model / reduced", fontsize=12)
    panels[1].yaxis.set_major_formatter(ScalarFormatter())
    panels[0].legend(fontsize=12)
    for axes, letter in zip(panels, "ab", strict=True):
        axes.set_title(f"({letter})", loc="left", fontsize=12)
    figure.savefig(path, dpi=110)


def require_pyvista() -> None:
    """Raise ``PalpateError`` if PyVista is not installed: before the work, not after."""
    if find_spec("pyvista") is None:
        raise PalpateError("contours need PyVista: pip install -e '.[pictures]'")


def contours(path: Path, mesh: Mesh, errors: dict[str, Array], load: Array) -> None:
    """Figures 2c and 2d: relative errors on the body, a column each, seen from both sides.

    Parameters
    ----------
    path : Path
        PNG.
    mesh : Mesh
    errors : dict of ndarray, shape (n,)
        Relative errors; nan is drawn grey.
    load : ndarray, shape (n, 3)
        Loaded nodes are ringed.
    """
    import pyvista as pv

    grid = pv.UnstructuredGrid({CELL_TYPES[mesh.elements.shape[1]]: mesh.elements}, mesh.nodes)
    for name, error in errors.items():
        grid[name] = error
    grid["loaded"] = np.linalg.norm(load, axis=1)
    body = grid.extract_surface(algorithm="dataset_surface", nonlinear_subdivision=SUBDIVISIONS)
    ring = body.contour([0.02 * grid["loaded"].max()], scalars="loaded")
    # VTK reports every way to a window that it tries in vain
    with pv.vtk_verbosity("off"):
        plotter = pv.Plotter(
            off_screen=True, shape=(len(VIEWS), len(errors)), window_size=SIZE, border=False
        )
    plotter.set_background("white")
    for column, (name, error) in enumerate(errors.items()):
        for row, (title, towards) in enumerate(VIEWS.items()):
            plotter.subplot(row, column)
            painted = plotter.add_mesh(
                body.copy(), scalars=name, cmap=COLOURS, clim=_scale(error), log_scale=True,
                nan_color="lightgrey", show_scalar_bar=False, lighting=False,
            )  # fmt: skip
            plotter.add_mesh(ring, color="red", line_width=3)
            plotter.add_text(f"{name}: {title}", font_size=10, color=INK)
            plotter.view_vector(towards, viewup=(0, 0, 1))
            plotter.camera.parallel_projection = True
            plotter.camera.zoom(1.1)
        plotter.add_scalar_bar(
            f"relative error, {name}", mapper=painted.mapper, color=INK, fmt="%.0e",
            position_x=0.15, width=0.7, position_y=0.02, height=0.1,
            title_font_size=18, label_font_size=16,
        )  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    plotter.screenshot(str(path))
    plotter.close()


def _scale(error: Array) -> tuple[float, float]:
    """Whole powers of ten about the errors, outliers at either end left out."""
    low, high = np.nanpercentile(error, (2, 99.5))
    top = np.ceil(np.log10(high))
    return 10.0 ** max(np.floor(np.log10(low)), top - DECADES), 10.0**top
