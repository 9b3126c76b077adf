"""What the service counts, for ``GET /metrics``.

The numbers of every worker stand in one table in shared memory, a row of float64 cells per worker,
so that any of them can tell those of all. A worker holds its row by a file lock: when it is killed
the system frees the lock, and the worker that takes its place counts on from where it was.

Prometheus' own client takes 2 µs a call, which a session would pay six times a frame, and writes
the text for some milliseconds, in which nobody is answered; this takes 0.4 µs and 0.2 ms.
"""

import mmap
import os
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

from online.errors import STATUS
from online.frames import Flag
from shared.errors import PalpateError

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
"""Of the text format of Prometheus."""

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


class Family(NamedTuple):
    """A metric: its type, its name with the unit, and the label values it is kept for."""

    type: Literal["counter", "gauge", "histogram"]
    name: str
    help: str
    labels: tuple[str, ...] = ()
    values: tuple[tuple[str, ...], ...] = ((),)

    @property
    def width(self) -> int:
        """Cells of one label value: a number, or all buckets and the sum."""
        return len(BOUNDS) + 2 if self.type == "histogram" else 1


FAMILIES = (
    Family(
        "histogram",
        "palpate_phase_seconds",
        "Time to answer a query or a session's frame, by phase",
        ("kind", "phase"),
        tuple((kind, phase) for kind in KINDS for phase in PHASES),
    ),
    Family(
        "histogram",
        "palpate_queue_seconds",
        "Time from when a request or frame was read to when its turn came",
        ("kind",),
        tuple((kind,) for kind in KINDS),
    ),
    Family(
        "counter",
        "palpate_flags_total",
        "Answers that carry a flag",
        ("kind", "flag"),
        FLAGS,
    ),
    Family(
        "counter",
        "palpate_refusals_total",
        "Requests refused, by the code of the refusal",
        ("code",),
        tuple((code,) for code in STATUS),
    ),
    Family(
        "counter",
        "palpate_frames_total",
        "Session frames, by what became of them",
        ("outcome",),
        tuple((outcome,) for outcome in FRAMES),
    ),
    Family("gauge", "palpate_sessions", "Open sessions"),
    Family("counter", "palpate_sessions_opened_total", "Sessions opened"),
    Family("counter", "palpate_worker_starts_total", "Starts of the worker"),
    Family("gauge", "palpate_worker_pid", "Process number of the worker"),
)

_FIRST = (0, *accumulate(len(family.values) * family.width for family in FAMILIES))
WIDTH = _FIRST[-1]
"""Cells of a row."""

_PID = WIDTH - 1
assert FAMILIES[-1].name == "palpate_worker_pid"
_EDGES = (*map(repr, BOUNDS), "+Inf")


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
        self.flag = _kept(found, "palpate_flags_total", Number)
        self.refusal = _kept(found, "palpate_refusals_total", Number)
        self.frame = _kept(found, "palpate_frames_total", Number)
        self.sessions = Number(found["palpate_sessions", ()])
        self.sessions_opened = Number(found["palpate_sessions_opened_total", ()])
        self.starts = Number(found["palpate_worker_starts_total", ()])
        self._frame_phases = [self.phase["session", phase].observe for phase in PHASES]
        self._flagged = [self._of_flags(flags) for flags in range(2 * max(Flag))]
        self.sessions.set(0.0)  # those of a killed worker are gone
        self.starts.add()
        Number(found["palpate_worker_pid", ()]).set(os.getpid())

    def count_frame(
        self, waited: float, times: Sequence[float], flags: int, superseded: int
    ) -> None:
        """Count an answered frame of a session.

        Parameters
        ----------
        waited : float, s
            From when it was read to when its turn came.
        times : sequence of 5 floats, s
            The borders of its `PHASES`.
        flags : int
            Bits of `online.frames.Flag`.
        superseded : int
            Frames that were dropped for it.
        """
        self.queue["session"].observe(waited)
        for observe, start, end in zip(self._frame_phases, times, times[1:], strict=False):
            observe(end - start)
        for number in self._flagged[flags]:
            number.add()
        self.frame["answered"].add()
        if superseded:
            self.frame["superseded"].add(superseded)

    def text(self) -> str:
        """Write the numbers of all workers, labelled with theirs, as Prometheus reads them."""
        cells = memoryview(self._table).cast("d").tolist()
        rows = [cells[start : start + WIDTH] for start in range(0, len(cells), WIDTH)]
        started = [worker for worker, row in enumerate(rows) if row[_PID]]
        lines = []
        for family, first in zip(FAMILIES, _FIRST, strict=False):
            lines += [f"# HELP {family.name} {family.help}", f"# TYPE {family.name} {family.type}"]
            for worker in started:
                lines += _samples(family, worker, rows[worker][first:])
        lines += _memory({worker: int(rows[worker][_PID]) for worker in started})
        return "\n".join(lines) + "\n"

    def _of_flags(self, flags: int) -> list[Number]:
        """Find the numbers that count an answer with these flags."""
        counted = {
            "contact": flags & Flag.CONTACT,
            "out_of_range": not flags & Flag.IN_RANGE,
            "unconverged": not flags & Flag.CONVERGED,
            "clamped": flags & Flag.CLAMPED,
            "fallback": flags & Flag.FALLBACK,
        }
        return [self.flag["session", name] for name, counts in counted.items() if counts]


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


def _cells(row: Cells) -> Iterator[tuple[tuple[str, tuple[str, ...]], Cells]]:
    """Cut a row into the cells of each metric and label value."""
    for family, first in zip(FAMILIES, _FIRST, strict=False):
        for i, value in enumerate(family.values):
            yield (family.name, value), row[first + i * family.width :][: family.width]


def _kept(found: dict[Any, Cells], name: str, kind: Any) -> dict[Any, Any]:
    """Make the histograms or numbers of a family, by label value (bare where it is one)."""
    return {
        value[0] if len(value) == 1 else value: kind(cells)
        for (family, value), cells in found.items()
        if family == name
    }


def _samples(family: Family, worker: int, cells: Sequence[float]) -> Iterator[str]:
    """Write the samples of a metric of a worker, whose cells come first in `cells`."""
    for i, value in enumerate(family.values):
        labels = "".join(f'{n}="{v}",' for n, v in zip(family.labels, value, strict=True))
        labels += f'worker="{worker}"'
        own = cells[i * family.width : (i + 1) * family.width]
        if family.type != "histogram":
            yield f"{family.name}{{{labels}}} {own[0]!r}"
            continue
        upto = list(accumulate(own[:-1]))
        for edge, count in zip(_EDGES, upto, strict=True):
            yield f'{family.name}_bucket{{{labels},le="{edge}"}} {count!r}'
        yield f"{family.name}_count{{{labels}}} {upto[-1]!r}"
        yield f"{family.name}_sum{{{labels}}} {own[-1]!r}"


def _memory(pids: dict[int, int]) -> Iterator[str]:
    """Write the memory of each worker, where the system says it."""
    name = "palpate_worker_resident_bytes"
    yield f"# HELP {name} Memory that the worker holds"
    yield f"# TYPE {name} gauge"
    for worker, pid in pids.items():
        try:
            pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        except OSError:
            continue
        yield f'{name}{{worker="{worker}"}} {pages * mmap.PAGESIZE}'
