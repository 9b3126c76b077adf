"""The speed-accuracy chart as a picture and as a page to explore.

Colours stand for groups of methods (palette of Okabe and Ito, safe for colour-blind eyes), markers
for the methods of a group; a line joins the sizes of one method.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from palpate.offline.studies.chart_points import FULL, SHIPPED, STATISTICS, TWIN, Point, pareto
from palpate.shared.scene import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D


@dataclass(frozen=True)
class Group:
    """Methods of one kind, by family; a marker each, in the order of ``MARKERS``."""

    title: str
    colour: str
    methods: dict[str, str]


ACCENT, DARK_ACCENT = "#D55E00", "#A34700"
"""Of what is Palpate's; the second for letters."""

GROUPS = (
    Group(
        "Palpate",
        ACCENT,
        {"artifact": "this artifact", "artifact, warm": "the same without memory"},
    ),
    Group("Finite elements", "#000000", {"full": "full model, several meshes"}),
    Group(
        "Modes of the body at rest",
        "#0072B2",
        {
            "modal": "vibration modes",
            "ritz": "responses to loads (Ritz)",
            "krylov": "load-dependent vectors (Krylov)",
        },
    ),
    Group(
        "Modes made for each load",
        "#56B4E9",
        {"ritz-at-hand": "Ritz vectors", "derivatives": "static derivatives"},
    ),
    Group(
        "POD of full solutions",
        "#009E73",
        {"pod": "energy norm", "pod-euclidean": "Euclidean norm"},
    ),
    Group(
        "POD, hyper-reduced",
        "#E69F00",
        {
            "pod-ecm": "cubature of points (ECM)",
            "pod-ecsw": "cubature of elements (ECSW)",
            "pod-deim": "interpolation (DEIM)",
            "pod-gappy": "least squares (gappy POD)",
        },
    ),
    Group(
        "No equilibrium solved",
        "#CC79A7",
        {"linear": "linear response", "regression": "regression (RBF)"},
    ),
    Group(
        "Springs and tetrahedra",
        "#7A7A7A",
        {
            "mass-spring": "mass-spring",
            "tensor-mass linear": "tensor-mass, linear",
            "tensor-mass nonlinear": "tensor-mass, St. Venant-Kirchhoff",
        },
    ),
)

MARKERS = ("o", "s", "^", "D")
PAGE_MARKERS = ("circle", "square", "triangle-up", "diamond")


@dataclass(frozen=True)
class Panel:
    """One pair of axes: a statistic of an error of ``chart_points.FIELDS``."""

    title: str
    error: str
    field: str
    statistic: str = "p95"

    def of(self, point: Point) -> float:
        """The error of a point that its marker shows."""
        return point.error(self.field, self.statistic)

    def front(self, points: Sequence[Point]) -> list[Point]:
        """The points that no other beats."""
        return pareto(points, self.field, self.statistic)

    def plotted(self, points: Sequence[Point]) -> list[Point]:
        """Points that have this error; the full model on its own mesh has none but rounding."""
        known = [point for point in points if not np.isnan(self.of(point))]
        return [point for point in known if self.field == "refined" or point.key != FULL]


@dataclass(frozen=True)
class Layout:
    """A chart: title with a place for the scene's name, what a time is of, panels, and a note."""

    title: str
    per: str
    panels: tuple[Panel, ...]
    note: str

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of the panels and of the legend, which comes last."""
        return (2, 2) if len(self.panels) == 3 else (1, len(self.panels) + 1)


OF_LOADS = Layout(
    "Speed and accuracy of methods on the scene {!r}: lower left is better",
    "query",
    (
        Panel("Displacement", "error against the full model, 95th percentile", "displacement"),
        Panel("Von Mises stress", "error against the full model, 95th percentile", "von_mises"),
        Panel(
            "Displacement, error of the mesh included",
            "error against a refined mesh, median",
            "refined",
            "median",
        ),
    ),
    """\
A point is a method of one size; a line joins its sizes. Errors are
relative L2 norms over random loads that no method has seen: markers
show the 95th percentile (lower left: the median), whiskers the worst.
At 100 % an answer is no better than none. Dashed: the Pareto front;
nothing is both faster and more accurate than what lies on it.""",
)
IN_TIME = Layout(
    "Speed and accuracy over histories of the scene {!r}: lower left is better",
    "step",
    (
        Panel("Displacement", "error over a history, 95th percentile", "displacement"),
        Panel("Von Mises stress", "error over a history, 95th percentile", "von_mises"),
    ),
    """\
A point is a method of one size; a line joins its sizes. Errors are
relative L2 norms over random histories that no method has seen:
markers show the 95th percentile, whiskers the worst. Dashed: the
Pareto front; nothing is both faster and more accurate than what
lies on it.""",
)

NAMES = {
    "linear 160": ("linear\nresponse", (-4, -26), "left"),
    "regression 20": ("regression", (-4, 14), "left"),
    "pod-ecm 80": ("POD, hyper-reduced", (-8, -14), "right"),
    "pod 80": ("POD", (8, -4), "left"),
    "modal 80": ("linear modes", (0, 10), "left"),
    "mass-spring 1": ("mass-spring", (8, 3), "left"),
    "tensor-mass linear 2": ("tensor-mass", (8, -3), "left"),
    "derivatives 9": ("static\nderivatives", (-8, -28), "right"),
    "full 0.75": ("coarser mesh", (-8, -4), "right"),
    "full 1.5": ("finer mesh", (8, -16), "right"),
}
"""What is written beside points: text, offset in points and alignment."""


@dataclass(frozen=True)
class Look:
    """How a method is drawn."""

    family: str
    name: str
    group: Group
    index: int

    @property
    def ours(self) -> bool:
        """Whether it is Palpate's, which stands out."""
        return self.group is GROUPS[0]

    @property
    def marker(self) -> str:
        """Matplotlib's."""
        return "*P"[self.index] if self.ours else MARKERS[self.index]

    @property
    def page_marker(self) -> str:
        """Plotly's."""
        return ("star", "cross")[self.index] if self.ours else PAGE_MARKERS[self.index]


def looks(points: Sequence[Point]) -> Iterator[Look]:
    """Every method that has points, Palpate's last so that they lie on top."""
    families = {point.family for point in points}
    for group in (*GROUPS[1:], GROUPS[0]):
        for index, (family, name) in enumerate(group.methods.items()):
            if family in families:
                yield Look(family, name, group, index)


def duration(microseconds: float) -> str:
    """A time for people."""
    for factor, unit in ((1e6, "s"), (1e3, "ms")):
        if microseconds >= factor:
            return f"{microseconds / factor:.3g} {unit}"
    return f"{microseconds:.3g} µs"


def percent(error: float) -> str:
    """An error for people."""
    return f"{100 * error:.2g} %" if error < 0.995 else f"{100 * error:.0f} %"


# --- picture -------------------------------------------------------------------------------------


def draw(path: Path, points: Sequence[Point], scene: Scene, layout: Layout) -> None:
    """Draw the chart; its legend takes the place of a last panel."""
    from matplotlib.figure import Figure

    rows, columns = layout.grid
    figure = Figure(figsize=(6.25 * columns, 5.4 * rows), layout="constrained")
    grid = figure.subplots(rows, columns).ravel()
    figure.suptitle(layout.title.format(scene.name), fontsize=15, fontweight="bold")
    for axes, panel in zip(grid, layout.panels, strict=False):
        _draw_panel(axes, panel, points, scene, layout.per)
    _draw_legend(grid[-1], points, layout.note)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def _draw_panel(axes: Axes, panel: Panel, points: Sequence[Point], scene: Scene, per: str) -> None:
    kept = panel.plotted(points)
    axes.set(xscale="log", yscale="log")
    axes.set_title(panel.title, fontsize=12.5, fontweight="bold", loc="left")
    axes.set_xlabel(f"time per {per} on one core")
    axes.set_ylabel(panel.error)
    axes.xaxis.set_major_formatter(lambda x, _: duration(x))
    axes.yaxis.set_major_formatter(lambda y, _: f"{100 * y:g} %")
    axes.grid(color="0.9", linewidth=0.7)
    axes.tick_params(labelbottom=True)
    for look in looks(kept):
        _draw_method(axes, look, [p for p in kept if p.family == look.family], panel)
    times, errors = [p.time_us for p in points], [panel.of(p) for p in kept]
    axes.set_xlim(min(times) / 1.8, max(times) * 2)
    axes.set_ylim(min(errors) / 3, max(2 * max(errors), 1.5))
    _draw_front(axes, kept, panel)
    _draw_aim(axes, panel, scene, per)
    _draw_full(axes, panel, points)
    _draw_names(axes, panel, kept)


def _draw_method(axes: Axes, look: Look, points: Sequence[Point], panel: Panel) -> None:
    times = [point.time_us for point in points]
    errors = [panel.of(point) for point in points]
    largest = [point.error(panel.field, "max") for point in points]
    axes.vlines(times, errors, largest, look.group.colour, lw=0.8, alpha=0.3)
    axes.plot(
        times,
        errors,
        look.marker,
        linestyle="-",
        linewidth=0.9,
        color=look.group.colour,
        markersize={"*": 17.0, "P": 11.0}.get(look.marker, 5.5),
        markeredgecolor="white",
        markeredgewidth=0.6,
        zorder=5 if look.ours else 3,
    )


def _draw_front(axes: Axes, kept: Sequence[Point], panel: Panel) -> None:
    front = panel.front(kept)
    times = [*(point.time_us for point in front), axes.get_xlim()[1]]
    errors = [panel.of(point) for point in front]
    dashes = (0, (4, 2))
    axes.step(times, [*errors, errors[-1]], where="post", color="0.25", lw=1.3, ls=dashes, zorder=2)


def _draw_aim(axes: Axes, panel: Panel, scene: Scene, per: str) -> None:
    """Box of the scene's tolerance, which is one of reduction, and of its budget for a query."""
    if panel.field == "refined":
        return
    tolerance = getattr(scene.tolerance, panel.field)
    (left, right), (bottom, _) = axes.get_xlim(), axes.get_ylim()
    text = f"aim: {percent(tolerance)}"
    if per == "query":
        right = 1e6 * scene.budget.query
        text += f" in {duration(right)}"
    axes.fill_between([left, right], bottom, tolerance, color=ACCENT, alpha=0.12, lw=0)
    _write(axes, text, (left, bottom), (8, 8), color=DARK_ACCENT)


def _draw_full(axes: Axes, panel: Panel, points: Sequence[Point]) -> None:
    """Where the full model on the scene's mesh is: a time without error, or the mesh's error."""
    full = next(point for point in points if point.key == FULL)
    if panel.field == "refined":
        axes.axhline(panel.of(full), color="0.4", lw=0.9, ls=":")
        text = f"error of the\nscene's mesh: {percent(panel.of(full))}"
        _write(axes, text, (axes.get_xlim()[0], panel.of(full)), (8, -28))
        return
    axes.axvline(full.time_us, color="black", lw=0.9, ls=":")
    text = f"full model:\n{duration(full.time_us)},\nno error"
    (bottom, top) = axes.get_ylim()
    _write(axes, text, (full.time_us, bottom ** (2 / 3) * top ** (1 / 3)), (6, 0))


def _draw_names(axes: Axes, panel: Panel, kept: Sequence[Point]) -> None:
    colours = {look.family: look.group.colour for look in looks(kept)}
    without_memory = [point.time_us for point in kept if point.key == TWIN]
    for point in kept:
        if point.key in NAMES:
            text, offset, side = NAMES[point.key]
            where = point.time_us, panel.of(point)
            _write(axes, text, where, offset, ha=side, color=colours[point.family])
        elif point.key == SHIPPED:
            text = f"Palpate: {percent(panel.of(point))}\nin {duration(point.time_us)}"
            for time in without_memory:
                text += f",\n{point.time_us / time:.1f} x that without memory"
            _write(
                axes, text, (point.time_us, panel.of(point)), (12, -32),
                color=DARK_ACCENT, fontweight="bold", fontsize=11,
            )  # fmt: skip


def _write(
    axes: Axes, text: str, where: tuple[float, float], offset: tuple[float, float], **how: Any
) -> None:
    """Write next to a point, on white so that lines do not cross the letters."""
    from matplotlib.patheffects import withStroke

    halo = [withStroke(linewidth=2.5, foreground="white", alpha=0.8)]
    style: dict[str, Any] = {
        "fontsize": 9.5,
        "path_effects": halo,
        "zorder": 6,
        "linespacing": 1.1,
    } | how
    axes.annotate(text, where, offset, textcoords="offset points", **style)


def _draw_legend(axes: Axes, points: Sequence[Point], note: str) -> None:
    from matplotlib.legend import Legend

    axes.axis("off")
    known = list(looks(points))
    for column, left in ((GROUPS[:5], -0.05), (GROUPS[5:], 0.48)):
        handles = [handle for group in column for handle in _handles(group, known)]
        legend = Legend(
            axes,
            handles,
            [str(handle.get_label()) for handle in handles],
            loc="upper left",
            bbox_to_anchor=(left, 1.03),
            frameon=False,
            fontsize=9.5,
        )
        legend.set_in_layout(False)
        axes.add_artist(legend)
        for text in legend.get_texts():
            if any(text.get_text() == group.title for group in GROUPS):
                text.set_fontweight("bold")
    words = axes.text(0, 0, note, transform=axes.transAxes, fontsize=9.5, linespacing=1.4)
    words.set_in_layout(False)


def _handles(group: Group, known: Sequence[Look]) -> list[Line2D]:
    """Entries of a group in the legend: its title and its methods."""
    from matplotlib.lines import Line2D

    own = [look for look in known if look.group is group]
    methods = [
        Line2D(
            [], [], color=group.colour, marker=look.marker, markersize=12.0 if look.ours else 5.5,
            linewidth=0.9, label=look.name,
        )
        for look in own
    ]  # fmt: skip
    return [Line2D([], [], linestyle="", label=group.title), *methods] if own else []


# --- page ----------------------------------------------------------------------------------------


def write_page(path: Path, points: Sequence[Point], scene: Scene, layout: Layout) -> None:
    """Write the chart as a page that needs no network: every point tells its figures."""
    from plotly.subplots import make_subplots

    rows, columns = layout.grid
    titles = [f"<b>{panel.title}</b>" for panel in layout.panels]
    figure = make_subplots(rows, columns, subplot_titles=titles)
    for number, panel in enumerate(layout.panels):
        where = {"row": 1 + number // columns, "col": 1 + number % columns}
        kept, last = panel.plotted(points), panel is layout.panels[-1]
        for look in looks(points):
            own = [point for point in kept if point.family == look.family]
            figure.add_trace(_trace(look, own, panel) | {"showlegend": last}, **where)
        figure.add_trace(_front(kept, panel) | {"showlegend": last}, **where)
        title = f"time per {layout.per} on one core"
        figure.update_xaxes(type="log", title=title, tickformat="~s", ticksuffix="s", **where)
        figure.update_yaxes(type="log", title=panel.error, tickformat="~%", **where)
        if panel.field != "refined":
            _aim(figure, panel, kept, scene, where)
    figure.update_layout(
        title=layout.title.format(scene.name), template="plotly_white", height=500 * rows
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.write_html(path, include_plotlyjs=True)


def _trace(look: Look, points: Sequence[Point], panel: Panel) -> dict[str, Any]:
    errors = np.array([panel.of(point) for point in points])
    above = np.array([point.error(panel.field, "max") for point in points]) - errors
    colour, size = look.group.colour, 18 if look.ours else 9
    return {
        "type": "scatter",
        "mode": "lines+markers",
        "x": [1e-6 * point.time_us for point in points],
        "y": errors,
        "error_y": {"array": above, "arrayminus": 0 * errors, "thickness": 0.6, "width": 0},
        "name": look.name,
        "text": [_hover(point, panel.field) for point in points],
        "hovertemplate": f"<b>{look.name}</b><br>%{{text}}<extra></extra>",
        "marker": {"color": colour, "symbol": look.page_marker, "size": size},
        "line": {"color": colour, "width": 1},
        "legendgroup": look.group.title,
        "legendgrouptitle": {"text": look.group.title},
    }


def _hover(point: Point, field: str) -> str:
    errors = [f"{percent(point.error(field, name))} ({name})" for name in STATISTICS]
    lines = (
        f"{point.label}; {point.unknowns} unknowns",
        duration(point.time_us),
        "error " + ", ".join(errors),
        f"{point.unconverged} queries without an answer",
    )
    return "<br>".join(lines)


def _front(kept: Sequence[Point], panel: Panel) -> dict[str, Any]:
    front = panel.front(kept)
    return {
        "type": "scatter",
        "mode": "lines",
        "x": [1e-6 * point.time_us for point in front],
        "y": [panel.of(point) for point in front],
        "line": {"color": "#404040", "dash": "dash", "shape": "hv"},
        "name": "Pareto front",
        "hoverinfo": "skip",
    }


def _aim(
    figure: Any, panel: Panel, kept: Sequence[Point], scene: Scene, where: dict[str, int]
) -> None:
    figure.add_shape(
        type="rect",
        x0=1e-6 * min(point.time_us for point in kept) / 2,
        x1=scene.budget.query,
        y0=min(panel.of(point) for point in kept) / 2,
        y1=getattr(scene.tolerance, panel.field),
        fillcolor=ACCENT,
        opacity=0.12,
        line_width=0,
        **where,
    )
