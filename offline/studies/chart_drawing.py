"""The speed-accuracy chart as a picture.

Colours stand for groups of methods (palette of Okabe and Ito, safe for colour-blind eyes), markers
for the methods of a group; a line joins the sizes of one method.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from palpate.offline.info import duration, percent
from palpate.shared.scene import Scene

Row = Mapping[str, Any]
"""A method of one size: ``key``, ``family``, ``label``, ``unknowns``, ``time_us``, ``unconverged``
and ``FIELD_STATISTIC`` for all of those; errors are fractions, nan where there is nothing to
compare: another mesh has no error of reduction."""

SHIPPED, TWIN, FULL = "artifact 1", "artifact, warm 1", "full 1"
"""Keys of the artifact, of the artifact without memory, and of the full model on its own mesh."""

FIELDS = ("displacement", "von_mises", "total", "total_von_mises")
"""Errors of two fields: beside the full model on the scene's mesh, and beside graded meshes."""

STATISTICS = ("median", "p95", "max")

ACCENT, DARK_ACCENT = "#D55E00", "#A34700"
"""Of what is Palpate's; the second for letters."""


class Look(NamedTuple):
    """How a method is drawn."""

    group: str
    name: str
    colour: str
    marker: str
    size: float = 5.5  # points
    above: int = 3  # higher than others where they meet


LOOKS = {
    "artifact": Look("Palpate", "this artifact", ACCENT, "*", 17.0, 5),
    "artifact, warm": Look("Palpate", "the same without memory", ACCENT, "P", 11.0, 4),
    "full": Look("Finite elements", "full model, several meshes", "#000000", "o"),
    "modal": Look("Modes of the body at rest", "vibration modes", "#0072B2", "o"),
    "ritz": Look("Modes of the body at rest", "responses to loads (Ritz)", "#0072B2", "s"),
    "krylov": Look("Modes of the body at rest", "load-dependent vectors (Krylov)", "#0072B2", "^"),
    "pod-ecm": Look("POD, hyper-reduced", "cubature of points (ECM)", "#E69F00", "o"),
    "pod-ecsw": Look("POD, hyper-reduced", "cubature of elements (ECSW)", "#E69F00", "s"),
    "pod-deim": Look("POD, hyper-reduced", "interpolation (DEIM)", "#E69F00", "^"),
    "pod-gappy": Look("POD, hyper-reduced", "least squares (gappy POD)", "#E69F00", "D"),
    "ritz-at-hand": Look("Modes made for each load", "Ritz vectors", "#56B4E9", "o"),
    "derivatives": Look("Modes made for each load", "static derivatives", "#56B4E9", "s"),
    "pod": Look("POD of full solutions", "energy norm", "#009E73", "o"),
    "pod-euclidean": Look("POD of full solutions", "Euclidean norm", "#009E73", "s"),
    "linear": Look("No equilibrium solved", "linear response", "#CC79A7", "o"),
    "regression": Look("No equilibrium solved", "regression (RBF)", "#CC79A7", "s"),
    "mass-spring": Look("Springs and tetrahedra", "mass-spring", "#7A7A7A", "o"),
    "tensor-mass": Look("Springs and tetrahedra", "tensor-mass", "#7A7A7A", "s"),
}
"""Methods by family, in groups of a colour."""

NAMES = {
    "linear 160": ("linear\nresponse", (4, -28), "right"),
    "regression 20": ("regression", (-4, 14), "left"),
    "pod-ecm 80": ("POD, hyper-reduced", (-8, -14), "right"),
    "pod 80": ("POD", (8, -4), "left"),
    "modal 80": ("linear modes", (0, 10), "left"),
    "mass-spring 1": ("mass-spring", (8, 3), "left"),
    "tensor-mass 1": ("tensor-mass", (8, -3), "left"),
    "derivatives 9": ("static\nderivatives", (-8, -28), "right"),
    "full 0.75": ("coarser mesh", (-8, -4), "right"),
    "full 1.25": ("finer mesh", (8, -16), "right"),
}
"""What is written beside points: text, offset in points and alignment."""


def pareto(rows: Sequence[Row], error: str = "displacement_p95") -> list[Row]:
    """The points, fastest first, that no other beats in both time and an error.

    The artifact without memory is no competitor: it answers another question.
    """
    front: list[Row] = []
    least = math.inf
    for row in sorted(rows, key=lambda row: (row["time_us"], row[error])):
        if row["key"] != TWIN and row[error] < least:
            front.append(row)
            least = row[error]
    return front


class Panel(NamedTuple):
    """One pair of axes: an error and a statistic of it."""

    title: str
    field: str
    statistic: str = "p95"
    axis: str = "error, 95th percentile"

    @property
    def is_total(self) -> bool:
        """Whether the error of the mesh is in it."""
        return self.field.startswith("total")

    @property
    def quantity(self) -> str:
        """What errs."""
        return "von_mises" if self.field.endswith("von_mises") else "displacement"

    @property
    def error(self) -> str:
        """The column that is drawn."""
        return f"{self.field}_{self.statistic}"

    def plotted(self, rows: Sequence[Row]) -> list[Row]:
        """Points that have this error; the full model on its own mesh has none but rounding."""
        known = [row for row in rows if not math.isnan(row[self.error])]
        return [row for row in known if self.is_total or row["key"] != FULL]


class Layout(NamedTuple):
    """A chart: its file, what a time is of, panels."""

    name: str
    per: str
    panels: tuple[Panel, ...]
    grid: tuple[int, int]  # of the panels and of the legend, which comes last


FIELD_PANELS = Panel("Displacement", "displacement"), Panel("Von Mises stress", "von_mises")
TOTAL = "total error beside graded meshes, 95th percentile"
TOTAL_PANELS = (
    Panel("Displacement, mesh and reduction", "total", axis=TOTAL),
    Panel("Von Mises stress, mesh and reduction", "total_von_mises", axis=TOTAL),
)
OF_LOADS = Layout("chart", "query", (*TOTAL_PANELS, *FIELD_PANELS), (2, 3))
IN_TIME = Layout("chart_in_time", "step", FIELD_PANELS, (1, 3))
NOTE = """\
A point is a method of one size; a line joins its sizes.
Errors are relative L2 norms against the full model over
random queries, or histories, that no method has seen;
whiskers show the worst. At 100 % an answer is no better
than none. Dashed: the Pareto front; nothing is both
faster and more accurate than what lies on it."""


def looks(rows: Sequence[Row]) -> Iterator[tuple[Look, list[Row]]]:
    """Every method that has points, with these."""
    for family, look in LOOKS.items():
        if own := [row for row in rows if row["family"] == family]:
            yield look, own


# --- picture -------------------------------------------------------------------------------------


def draw(path: Path, rows: Sequence[Row], scene: Scene, layout: Layout) -> None:
    """Draw the chart; its legend takes the place of a last panel."""
    down, across = layout.grid
    figure = Figure(figsize=(6.25 * across, 5.4 * down), layout="constrained")
    grid = figure.subplots(down, across).ravel()
    title = f"Speed and accuracy of methods on the scene {scene.name!r}: lower left is better"
    figure.suptitle(title, fontsize=15, fontweight="bold")
    for axes, panel in zip(grid, layout.panels, strict=False):
        _draw_panel(axes, panel, rows, layout.per)
        _draw_goals(axes, panel, rows, scene, layout.per)
        _draw_names(axes, panel, rows)
    for axes in grid[len(layout.panels) :]:
        axes.axis("off")
    _draw_legend(grid[-1], rows)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def _draw_panel(axes: Axes, panel: Panel, rows: Sequence[Row], per: str) -> None:
    """Points of all methods and the Pareto front."""
    kept, error = panel.plotted(rows), panel.error
    axes.set(xscale="log", yscale="log", xlabel=f"time per {per} on one core", ylabel=panel.axis)
    axes.set_title(panel.title, fontsize=12.5, fontweight="bold", loc="left")
    axes.xaxis.set_major_formatter(lambda x, _: duration(1e-6 * x))
    axes.yaxis.set_major_formatter(lambda y, _: f"{100 * y:g} %")
    axes.grid(color="0.9", linewidth=0.7)
    axes.tick_params(labelbottom=True)
    for look, own in looks(kept):
        times, errors = [row["time_us"] for row in own], [row[error] for row in own]
        largest = [row[f"{panel.field}_max"] for row in own]
        axes.vlines(times, errors, largest, look.colour, lw=0.8, alpha=0.3)
        axes.plot(
            times, errors, look.marker, ls="-", lw=0.9, color=look.colour, markersize=look.size,
            markeredgecolor="white", markeredgewidth=0.6, zorder=look.above,
        )  # fmt: skip
    times, errors = [row["time_us"] for row in rows], [row[error] for row in kept]
    axes.set_xlim(min(times) / 1.8, max(times) * 2)
    axes.set_ylim(min(errors) / 3, max(2 * max(errors), 1.5))
    front = pareto(kept, error)
    times = [*(row["time_us"] for row in front), axes.get_xlim()[1]]
    errors = [row[error] for row in (*front, front[-1])]
    axes.step(times, errors, where="post", color="0.25", lw=1.3, ls=(0, (4, 2)), zorder=2)


def _draw_goals(axes: Axes, panel: Panel, rows: Sequence[Row], scene: Scene, per: str) -> None:
    """The full model on the scene's mesh, what the tolerance leaves to an error, and the budget."""
    full = next(row for row in rows if row["key"] == FULL)
    (left, right), (bottom, top), error = axes.get_xlim(), axes.get_ylim(), full[panel.error]
    if panel.is_total:
        axes.axhline(error, color="0.4", lw=0.9, ls=":")
        _write(axes, f"scene's own\nmesh: {percent(error)}", (left, error), (8, 4))
    else:
        axes.axvline(full["time_us"], color="black", lw=0.9, ls=":")
        where = full["time_us"], bottom ** (2 / 3) * top ** (1 / 3)
        time = duration(1e-6 * full["time_us"])
        _write(axes, f"full model:\n{time},\nno error", where, (6, 0))
    allowed = scene.tolerance.total if panel.is_total else scene.tolerance.reduction
    tolerance = getattr(allowed, panel.quantity)
    text = f"aim: {percent(tolerance)}"
    if per == "query":
        right = 1e6 * scene.budget.query
        text += f" in {duration(scene.budget.query)}"
    axes.fill_between([left, right], bottom, tolerance, color=ACCENT, alpha=0.12, lw=0)
    _write(axes, text, (left, bottom), (8, 8), color=DARK_ACCENT)


def _draw_names(axes: Axes, panel: Panel, rows: Sequence[Row]) -> None:
    kept = panel.plotted(rows)
    twin = [row["time_us"] for row in kept if row["key"] == TWIN]
    for row in kept:
        at = time, error = row["time_us"], row[panel.error]
        if row["key"] in NAMES:
            text, offset, side = NAMES[row["key"]]
            _write(axes, text, at, offset, ha=side, color=LOOKS[row["family"]].colour)
        elif row["key"] == SHIPPED:
            text = f"Palpate: {percent(error)}\nin {duration(1e-6 * time)}"
            text += "".join(f",\n{time / x:.1f} x that without memory" for x in twin)
            _write(axes, text, at, (12, -32), color=DARK_ACCENT, fontweight="bold")


def _write(
    axes: Axes, text: str, where: tuple[float, float], offset: tuple[float, float], **how: Any
) -> None:
    """Write next to a point, on white so that lines do not cross the letters."""
    halo = [withStroke(linewidth=2.5, foreground="white", alpha=0.8)]
    style: dict[str, Any] = {"fontsize": 9.5, "path_effects": halo, "zorder": 6} | how
    axes.annotate(text, where, offset, textcoords="offset points", **style)


def _draw_legend(axes: Axes, rows: Sequence[Row]) -> None:
    """Groups with their methods in two columns, and what the chart shows."""
    handles: list[Line2D] = []
    for title, own in groupby((look for look, _ in looks(rows)), lambda look: look.group):
        handles.append(Line2D([], [], ls="", label=title))
        handles += [
            Line2D([], [], color=look.colour, marker=look.marker, label=look.name, lw=0.9,
                   markersize=min(look.size, 12.0)) for look in own
        ]  # fmt: skip
    legend = axes.legend(
        handles=handles, loc="upper left", bbox_to_anchor=(-0.05, 1.03), frameon=False,
        fontsize=9.5, ncols=2,
    )  # fmt: skip
    words = axes.text(0, 0, NOTE, transform=axes.transAxes, fontsize=9.5, linespacing=1.4)
    for text in legend.get_texts():
        if text.get_text() in {look.group for look in LOOKS.values()}:
            text.set_fontweight("bold")
    for artist in (legend, words):
        artist.set_in_layout(False)
