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

from offline.studies.chart_points import FULL, SHIPPED, Point, pareto
from shared.scene import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class Group:
    """Methods of one kind, by family; a marker each, in the order of ``MARKERS``."""

    title: str
    colour: str
    methods: dict[str, str]


GROUPS = (
    Group("Palpate", "#D55E00", {"artifact": "this artifact"}),
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


NOTE = """\
A point is a method of one size, a line its sizes: with more
unknowns further right. Errors are relative L2 norms over all
nodes; markers: 95th percentile of random loads no method has
seen; whiskers: the worst of them. 100 %: no better than no answer.
Dashed: Pareto front, what nothing else beats in both.
Dotted below: error of the scene's own mesh."""


@dataclass(frozen=True)
class Panel:
    """One pair of axes: an error of ``chart_points.FIELDS`` and what it is called."""

    field: str
    title: str
    error: str


PANELS = (
    Panel("displacement", "Displacement", "error against the full model"),
    Panel("von_mises", "Von Mises stress", "error against the full model"),
    Panel("refined", "Displacement, mesh error included", "error against a refined mesh"),
)


@dataclass(frozen=True)
class Look:
    """How a method is drawn."""

    family: str
    name: str
    group: Group
    index: int

    @property
    def size(self) -> float:
        """Of the marker, points: the artifact stands out."""
        return 17.0 if self.family == "artifact" else 5.5

    @property
    def marker(self) -> str:
        """Matplotlib's."""
        return "*" if self.family == "artifact" else MARKERS[self.index]

    @property
    def page_marker(self) -> str:
        """Plotly's."""
        return "star" if self.family == "artifact" else PAGE_MARKERS[self.index]


def looks(points: Sequence[Point]) -> Iterator[Look]:
    """Every method that has points, the artifact last so that it lies on top."""
    families = {point.family for point in points}
    for group in (*GROUPS[1:], GROUPS[0]):
        for index, (family, name) in enumerate(group.methods.items()):
            if family in families:
                yield Look(family, name, group, index)


def plotted(points: Sequence[Point], field: str) -> list[Point]:
    """Points that have this error; the full model on its own mesh has none but rounding."""
    own = field != "refined"
    return [
        point
        for point in points
        if not np.isnan(point.p95(field)) and not (own and point.key == FULL)
    ]


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


def draw(path: Path, points: Sequence[Point], scene: Scene) -> None:
    """Draw the chart; the fourth corner is its legend."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.5, 10.2), layout="constrained")
    grid = figure.subplots(2, 2, sharex=True)
    figure.suptitle(
        f"Speed and accuracy of methods for the scene {scene.name!r}: lower left is better",
        fontsize=15,
        fontweight="bold",
    )
    for axes, panel in zip(grid.ravel(), PANELS, strict=False):
        _draw_panel(axes, panel, points, scene)
    _draw_legend(grid[1, 1], points)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def _draw_panel(axes: Axes, panel: Panel, points: Sequence[Point], scene: Scene) -> None:
    kept = plotted(points, panel.field)
    axes.set(xscale="log", yscale="log")
    axes.set_title(panel.title, fontsize=12, fontweight="bold", loc="left")
    axes.set_ylabel(panel.error)
    axes.set_xlabel("time per query on one core")
    axes.xaxis.set_major_formatter(lambda x, _: duration(x))
    axes.yaxis.set_major_formatter(lambda y, _: f"{100 * y:g} %")
    axes.grid(color="0.9", linewidth=0.7)
    axes.tick_params(labelbottom=True)
    for look in looks(kept):
        _draw_method(axes, look, [p for p in kept if p.family == look.family], panel.field)
    _limit(axes, panel, points, kept)
    _draw_front(axes, kept, panel.field)
    _draw_aim(axes, panel, scene)
    _draw_full(axes, panel, points)
    _draw_names(axes, panel, kept)


def _limit(axes: Axes, panel: Panel, points: Sequence[Point], kept: Sequence[Point]) -> None:
    times = [point.time_us for point in points]
    errors = [point.p95(panel.field) for point in kept]
    axes.set_xlim(min(times) / 1.8, max(times) * 2.5)
    axes.set_ylim(min(errors) / 3, max(2 * max(errors), 1.5))


def _draw_method(axes: Axes, look: Look, points: Sequence[Point], field: str) -> None:
    times = [point.time_us for point in points]
    errors = [point.p95(field) for point in points]
    axes.vlines(
        times, errors, [p.largest(field) for p in points], look.group.colour, lw=0.8, alpha=0.35
    )
    axes.plot(
        times,
        errors,
        look.marker,
        linestyle="-",
        linewidth=0.8,
        color=look.group.colour,
        markersize=look.size,
        markeredgecolor="white",
        markeredgewidth=0.6,
        alpha=0.9,
        zorder=5 if look.family == "artifact" else 3,
    )


def _draw_front(axes: Axes, kept: Sequence[Point], field: str) -> None:
    front = pareto(kept, field)
    times = [*(p.time_us for p in front), axes.get_xlim()[1]]
    errors = [p.p95(field) for p in front]
    axes.step(
        times, [*errors, errors[-1]], where="post", color="0.25", lw=1.4, ls=(0, (4, 2)), zorder=2
    )


def _draw_aim(axes: Axes, panel: Panel, scene: Scene) -> None:
    """Box of the tolerance and the budget; a tolerance is one of reduction."""
    if panel.field == "refined":
        return
    tolerance = getattr(scene.tolerance, panel.field)
    budget = 1e6 * scene.budget.query
    (left, _), (bottom, _) = axes.get_xlim(), axes.get_ylim()
    axes.fill_between([left, budget], bottom, tolerance, color="#D55E00", alpha=0.12, lw=0)
    axes.annotate(
        f"aim: {duration(budget)}, {percent(tolerance)}",
        (left, tolerance),
        xytext=(6, -6),
        textcoords="offset points",
        va="top",
        color="#A34700",
        fontsize=9.5,
    )


def _draw_full(axes: Axes, panel: Panel, points: Sequence[Point]) -> None:
    """Where the full model on the scene's mesh is: a time without error, or the mesh's error."""
    full = next(point for point in points if point.key == FULL)
    if panel.field == "refined":
        axes.axhline(full.refined_p95, color="0.4", lw=0.8, ls=":")
        return
    axes.axvline(full.time_us, color="black", lw=1.0, ls=":")
    axes.annotate(
        f"full model: {duration(full.time_us)}, no error",
        (full.time_us, axes.get_ylim()[0]),
        xytext=(-4, 6),
        textcoords="offset points",
        rotation=90,
        ha="right",
        va="bottom",
        fontsize=9,
    )


def _draw_names(axes: Axes, panel: Panel, kept: Sequence[Point]) -> None:
    shipped = next(point for point in kept if point.key == SHIPPED)
    axes.annotate(
        f"Palpate\n{duration(shipped.time_us)}, {percent(shipped.p95(panel.field))}",
        (shipped.time_us, shipped.p95(panel.field)),
        xytext=(12, -4),
        textcoords="offset points",
        va="top",
        color="#A34700",
        fontweight="bold",
        fontsize=10,
    )


def _draw_legend(axes: Axes, points: Sequence[Point]) -> None:
    from matplotlib.lines import Line2D

    axes.axis("off")
    entries: list[Any] = []
    for group in GROUPS:
        own = [look for look in looks(points) if look.group is group]
        if own:
            entries.append(Line2D([], [], linestyle="", label=group.title))
        entries += [
            Line2D(
                [], [], color=look.group.colour, marker=look.marker, lw=0.8, label=look.name,
                markersize=min(look.size, 12.0),
            )
            for look in own
        ]  # fmt: skip
    legend = axes.legend(handles=entries, loc="upper left", ncols=2, frameon=False, fontsize=9.5)
    axes.text(0.02, 0.0, NOTE, va="bottom", fontsize=9.5, linespacing=1.5)
    for text in legend.get_texts():
        if text.get_text() in {group.title for group in GROUPS}:
            text.set_fontweight("bold")


# --- page ----------------------------------------------------------------------------------------


def write_page(path: Path, points: Sequence[Point], scene: Scene) -> None:
    """Write the chart as a page that needs no network: every point tells its figures."""
    from plotly.subplots import make_subplots

    figure = make_subplots(2, 2, subplot_titles=[f"<b>{panel.title}</b>" for panel in PANELS])
    for number, panel in enumerate(PANELS):
        where = {"row": 1 + number // 2, "col": 1 + number % 2}
        kept = plotted(points, panel.field)
        for look in looks(points):
            own = [point for point in kept if point.family == look.family]
            figure.add_trace(_trace(look, own, panel), **where)
        figure.add_trace(_front(kept, panel), **where)
        figure.update_xaxes(type="log", title="time per query on one core, µs", **where)
        figure.update_yaxes(type="log", title=panel.error, tickformat=".1~%", **where)
        if panel.field != "refined":
            _aim(figure, panel, kept, scene, where)
    figure.update_layout(
        title=f"Speed and accuracy of methods for the scene {scene.name!r}: lower left is better",
        template="plotly_white",
        height=1000,
        legend={"groupclick": "toggleitem"},
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.write_html(path, include_plotlyjs=True)


def _trace(look: Look, points: Sequence[Point], panel: Panel) -> dict[str, Any]:
    errors = np.array([point.p95(panel.field) for point in points])
    largest = np.array([point.largest(panel.field) for point in points])
    return {
        "type": "scatter",
        "mode": "lines+markers",
        "x": [point.time_us for point in points],
        "y": errors,
        "error_y": {
            "array": largest - errors,
            "arrayminus": 0 * errors,
            "thickness": 0.6,
            "width": 0,
        },
        "name": look.name,
        "text": [_hover(point, panel.field) for point in points],
        "hovertemplate": f"<b>{look.name}</b><br>%{{text}}<extra></extra>",
        "marker": {
            "color": look.group.colour,
            "symbol": look.page_marker,
            "size": 18 if look.family == "artifact" else 9,
            "line": {"color": "white", "width": 1},
        },
        "line": {"color": look.group.colour, "width": 1},
        "legendgroup": look.group.title,
        "legendgrouptitle": {"text": look.group.title},
        # the last panel has all methods
        "showlegend": panel is PANELS[-1],
    }


def _hover(point: Point, field: str) -> str:
    lines = (
        f"{point.label}; {point.unknowns} unknowns",
        f"{duration(point.time_us)} per query",
        f"error {percent(point.p95(field))} (p95), {percent(point.largest(field))} (max)",
        f"{point.unconverged} loads without an answer",
    )
    return "<br>".join(lines)


def _front(kept: Sequence[Point], panel: Panel) -> dict[str, Any]:
    front = pareto(kept, panel.field)
    return {
        "type": "scatter",
        "mode": "lines",
        "x": [point.time_us for point in front],
        "y": [point.p95(panel.field) for point in front],
        "line": {"color": "#404040", "dash": "dash", "shape": "hv"},
        "name": "Pareto front",
        "hoverinfo": "skip",
        "showlegend": panel is PANELS[-1],
    }


def _aim(
    figure: Any, panel: Panel, kept: Sequence[Point], scene: Scene, where: dict[str, int]
) -> None:
    figure.add_shape(
        type="rect",
        x0=min(point.time_us for point in kept) / 2,
        x1=1e6 * scene.budget.query,
        y0=min(point.p95(panel.field) for point in kept) / 2,
        y1=getattr(scene.tolerance, panel.field),
        fillcolor=GROUPS[0].colour,
        opacity=0.12,
        line_width=0,
        **where,
    )
