"""A picture of a load test: latency over time and how it is distributed."""

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from palpate.online.loadtest.report import Messages, quantiles
from palpate.online.loadtest.run import Outcome

COLOURS = {"frames": "C0", "queries": "C1"}
MARKS = {"p50_us": ("50 %", "top"), "p99_us": ("99 %", "top"), "p999_us": ("99.9 %", "bottom")}
BINS_PER_DECADE = 40


def draw(outcome: Outcome, path: Path) -> None:
    """Write a PNG: latencies over time, unclean windows in grey, and their histogram."""
    with matplotlib.rc_context({"font.size": 9}):
        figure = Figure(figsize=(11, 4.2), layout="constrained")
        over_time, counts = figure.subplots(1, 2, width_ratios=(3, 2), sharey=True)
        _shade(over_time, outcome)
        for label, colour in COLOURS.items():
            messages = outcome.messages.get(label)
            if messages is None:
                continue
            milliseconds = messages.latency / 1e3
            over_time.plot(messages.due, milliseconds, ".", color=colour, ms=1, label=label)
            _histogram(counts, messages, colour, label)
        over_time.set(yscale="log", xlabel="time [s]", ylabel="latency from when due [ms]")
        over_time.legend(loc="upper right", markerscale=8)
        counts.set(xscale="log", xlabel="messages")
        for axes in (over_time, counts):
            axes.grid(alpha=0.3)
        figure.savefig(path, dpi=130)


def _shade(axes: Axes, outcome: Outcome) -> None:
    borders = 1e-9 * outcome.machine.borders
    for start, end, clean in zip(borders, borders[1:], outcome.clean, strict=False):
        if not clean:
            axes.axvspan(start, end, color="0.9", lw=0)


def _histogram(axes: Axes, messages: Messages, colour: str, label: str) -> None:
    """Draw how many messages took how long, and the quantiles of all of them."""
    known = messages.latency[np.isfinite(messages.latency)]
    if not len(known):
        return
    low, high = np.log10(known.min()), np.log10(known.max())
    bins = np.logspace(low, high, 2 + int(BINS_PER_DECADE * (high - low)))
    axes.hist(known / 1e3, (bins / 1e3).tolist(), orientation="horizontal", color=colour, alpha=0.6)
    found = quantiles(known)
    for name, (text, side) in MARKS.items():
        value = found[name]
        assert value is not None
        axes.axhline(value / 1e3, color=colour, lw=0.8, ls="--")
        axes.annotate(
            f"{label}: {text} {value:.0f} µs",
            (1.0, value / 1e3),
            xycoords=("axes fraction", "data"),
            xytext=(-2, 1 if side == "bottom" else -1),
            textcoords="offset points",
            ha="right",
            va=side,
            fontsize=7,
        )
