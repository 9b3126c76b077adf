"""What the service counts, for ``GET /metrics``.

The numbers of every worker stand in one table in shared memory, a row of float64 cells per worker,
so that any of them can tell those of all. A worker holds its row by a file lock: when it is killed
the system frees the lock, and the worker that takes its place counts on from where it was.

Prometheus' own counters cost 2 µs a call, which a session at 1 kHz would pay six times a frame;
these cost 0.4 µs. Its text format and its types are used as they are.
"""

import mmap
import os
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from prometheus_client import CollectorRegistry
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)

from online.errors import STATUS
from shared.errors import PalpateError

BOUNDS = tuple(m * 10.0**e for e in range(-6, 1) for m in (1.0, 2.0, 5.0))
"""Upper bounds of the histograms' buckets, s: 1 µs to 5 s, one more beyond them."""

KINDS = ("query", "session")
PHASES = ("decode", "solve", "recover", "encode")
FLAGS = (
    ("query", "out_of_range"),
    ("session", "contact"),
    ("session", "out_of_range"),
    ("session", "unconverged"),
    ("session", "clamped"),
    ("session", "fallback"),
)
FRAMES = ("answered", "superseded", "refused")


Cells: TypeAlias = "memoryview[float]"
Sampled = CounterMetricFamily | GaugeMetricFamily | HistogramMetricFamily


class Family(NamedTuple):
    """A metric: its name, its unit in the name, and the label values it is kept for."""

    type: type[Sampled]
    name: str
    help: str
    labels: tuple[str, ...] = ()
    values: tuple[tuple[str, ...], ...] = ((),)

    @property
    def width(self) -> int:
        """Cells of one label value: a number, or all buckets and the sum."""
        return len(BOUNDS) + 2 if self.type is HistogramMetricFamily else 1


FAMILIES = (
    Family(
        HistogramMetricFamily,
        "palpate_phase_seconds",
        "Time to answer a query or a session's frame, by phase",
        ("kind", "phase"),
        tuple((kind, phase) for kind in KINDS for phase in PHASES),
    ),
    Family(
        HistogramMetricFamily,
        "palpate_queue_seconds",
        "Time from when a request or frame was read to when its turn came",
        ("kind",),
        tuple((kind,) for kind in KINDS),
    ),
    Family(
        CounterMetricFamily,
        "palpate_flags",
        "Answers that carry a flag",
        ("kind", "flag"),
        FLAGS,
    ),
    Family(
        CounterMetricFamily,
        "palpate_refusals",
        "Requests refused, by the code of the refusal",
        ("code",),
        tuple((code,) for code in STATUS),
    ),
    Family(
        CounterMetricFamily,
        "palpate_frames",
        "Session frames, by what became of them",
        ("outcome",),
        tuple((outcome,) for outcome in FRAMES),
    ),
    Family(GaugeMetricFamily, "palpate_sessions", "Open sessions"),
    Family(CounterMetricFamily, "palpate_sessions_opened", "Sessions opened"),
    Family(CounterMetricFamily, "palpate_worker_starts", "Starts of the worker"),
    Family(GaugeMetricFamily, "palpate_worker_pid", "Process number of the worker"),
)
WIDTH = sum(len(family.values) * family.width for family in FAMILIES)
"""Cells of a row."""


class Histogram:
    """Counts of durations."""

    __slots__ = ("_cells",)

    def __init__(self, cells: Cells) -> None:
        self._cells = cells

    def observe(self, seconds: float) -> None:
        """Count a duration, s."""
        cells = self._cells
        cells[bisect_left(BOUNDS, seconds)] += 1.0
        cells[-1] += seconds


class Number:
    """A count or a level."""

    __slots__ = ("_cells",)

    def __init__(self, cells: Cells) -> None:
        self._cells = cells

    def add(self, amount: float = 1.0) -> None:
        """Change it by `amount`."""
        self._cells[0] += amount

    def set(self, value: float) -> None:
        """Make it `value`."""
        self._cells[0] = value

    @property
    def value(self) -> float:
        """What it is now."""
        return float(self._cells[0])


class Metrics:
    """The numbers of one worker.

    Parameters
    ----------
    table : Path, optional
        File that the workers share, made by `make_table`. Default: this is the only worker.

    Attributes
    ----------
    phase, queue : dict from label values to Histogram
        Such as ``phase["query", "solve"]`` and ``queue["query"]``.
    flag, refusal, frame : dict from label values to Number
    sessions, sessions_opened, starts : Number
    worker : int
        Number of the row.

    Raises
    ------
    PalpateError
        If every row of the table is taken.
    """

    def __init__(self, table: Path | None = None) -> None:
        self.worker, self._table = (0, mmap.mmap(-1, 8 * WIDTH)) if table is None else _claim(table)
        row = memoryview(self._table).cast("d")[self.worker * WIDTH :][:WIDTH]
        found = dict(_cells(row))
        self.phase = _kept(found, "palpate_phase_seconds", Histogram)
        self.queue = _kept(found, "palpate_queue_seconds", Histogram)
        self.flag = _kept(found, "palpate_flags", Number)
        self.refusal = _kept(found, "palpate_refusals", Number)
        self.frame = _kept(found, "palpate_frames", Number)
        self.sessions = Number(found["palpate_sessions", ()])
        self.sessions_opened = Number(found["palpate_sessions_opened", ()])
        self.starts = Number(found["palpate_worker_starts", ()])
        self.sessions.set(0.0)  # those of a killed worker are gone
        self.starts.add()
        Number(found["palpate_worker_pid", ()]).set(os.getpid())

    def registry(self) -> CollectorRegistry:
        """Make a registry that collects the rows of all workers, labelled with their numbers."""
        registry = CollectorRegistry(auto_describe=False)
        registry.register(self)
        return registry

    def collect(self) -> Iterator[Metric]:
        """Yield every metric of every worker that has started."""
        cells = memoryview(self._table).cast("d")
        rows = [dict(_cells(cells[i:][:WIDTH])) for i in range(0, len(cells), WIDTH)]
        pids = [int(row["palpate_worker_pid", ()][0]) for row in rows]
        for family in FAMILIES:
            metric = family.type(family.name, family.help, labels=(*family.labels, "worker"))
            for worker, row in enumerate(rows):
                if pids[worker]:
                    for value in family.values:
                        _add(metric, [*value, str(worker)], row[family.name, value])
            yield metric
        yield _memory(pids)


def make_table(path: Path, workers: int) -> None:
    """Make the file by which `workers` processes share their numbers."""
    path.write_bytes(bytes(8 * WIDTH * workers))


def _claim(path: Path) -> tuple[int, mmap.mmap]:
    """Map the shared table and take a free row of it, until this process ends."""
    import fcntl  # only workers need it, and only POSIX has both

    descriptor = os.open(path, os.O_RDWR)
    table = mmap.mmap(descriptor, 0)
    for worker in range(len(table) // (8 * WIDTH)):
        try:
            fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, worker)
        except OSError:
            continue
        return worker, table
    raise PalpateError(f"{path}: more workers than rows")


def _cells(
    row: Cells,
) -> Iterator[tuple[tuple[str, tuple[str, ...]], Cells]]:
    """Cut a row into the cells of each metric and label value."""
    start = 0
    for family in FAMILIES:
        for value in family.values:
            yield (family.name, value), row[start : start + family.width]
            start += family.width


def _kept(found: dict[Any, Cells], name: str, kind: Any) -> dict[Any, Any]:
    """Make the histograms or numbers of a family, by label value (bare where it is one)."""
    return {
        value[0] if len(value) == 1 else value: kind(cells)
        for (family, value), cells in found.items()
        if family == name
    }


def _add(metric: Any, labels: Sequence[str], cells: Cells) -> None:
    """Add a sample to a family of Prometheus."""
    if isinstance(metric, HistogramMetricFamily):
        metric.add_metric(labels, list(_cumulated(cells)), sum_value=cells[-1])
    else:
        metric.add_metric(labels, cells[0])


def _cumulated(cells: Iterable[float]) -> Iterator[tuple[str, float]]:
    """Turn counts per bucket into counts up to each bound, as Prometheus wants them."""
    total = 0.0
    for bound, count in zip((*map(repr, BOUNDS), "+Inf"), cells, strict=False):
        total += count
        yield bound, total


def _memory(pids: Sequence[int]) -> Metric:
    """Tell the memory of each worker, where the system says it."""
    metric = GaugeMetricFamily(
        "palpate_worker_resident_bytes", "Memory that the worker holds", labels=("worker",)
    )
    for worker, pid in enumerate(pids):
        try:
            pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        except OSError:
            continue
        metric.add_metric([str(worker)], pages * mmap.PAGESIZE)
    return metric
