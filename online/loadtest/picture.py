"""A picture of a load test: latency over time and how it is distributed."""

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from palpate.online.loadtest.run import Outcome


def draw(outcome: Outcome, path: Path) -> None:
    """Write a PNG: latencies over time, unclean windows in grey, and their distribution."""
    with matplotlib.rc_context({"font.size": 9}):
        figure = Figure(figsize=(11, 4.2), layout="constrained")
        over_time, shares = figure.subplots(1, 2, width_ratios=(3, 2), sharey=True)
        borders = 1e-9 * outcome.machine.borders
        for start, end, clean in zip(borders, borders[1:], outcome.clean, strict=False):
            if not clean:
                over_time.axvspan(start, end, color="0.9", lw=0)
        for label, colour in (("frames", "C0"), ("queries", "C1")):
            if (messages := outcome.messages.get(label)) is None:
                continue
            milliseconds = messages.latency / 1e3
            over_time.plot(messages.due, milliseconds, ".", color=colour, ms=1, label=label)
            known = np.sort(milliseconds[np.isfinite(milliseconds)])
            longer = 1.0 - np.arange(len(known)) / max(len(known), 1)
            shares.step(longer, known, color=colour, label=label)
        over_time.set(yscale="log", xlabel="time [s]", ylabel="latency from when due [ms]")
        over_time.legend(loc="upper right", markerscale=8)
        shares.set(xscale="log", xlabel="share of messages that took longer")
        for axes in (over_time, shares):
            axes.grid(alpha=0.3)
        figure.savefig(path, dpi=130)
