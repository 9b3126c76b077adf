"""What the service counts, for ``GET /metrics``.

The numbers of every worker stand in one table in shared memory, a row of float64 cells per worker,
so that any of them can tell those of all. A worker holds its row by a file lock: when it is killed
the system frees the lock, and the worker that takes its place counts on from where it was.

Prometheus' own client takes some 2 µs for every number, of which a frame changes ten, and
milliseconds to write the text, in which nobody is answered. This takes 1 µs and 0.2 ms.
"""

import mmap
import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from itertools import accumulate, product
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numba import njit

from palpate.online.serve.errors import STATUS
from palpate.online.session.frames import Flag
from palpate.shared.errors import PalpateError

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
"""Of the text format of Prometheus."""

BOUNDS = tuple(m * 10.0**e for e in range(-6, 1) for m in (1.0, 2.0, 5.0))
"""Upper bounds of the histograms' buckets, s: 1 µs to 5 s, one more beyond them."""

KINDS = ("query", "session")
PHASES = ("decode", "solve", "recover", "encode")
FLAGS = {
    Flag.CONTACT: "contact",
    Flag.CONVERGED: "unconverged",
    Flag.IN_RANGE: "out_of_range",
    Flag.CLAMPED: "clamped",
    Flag.FALLBACK: "fallback",
    Flag.STALLED: "stalled",
}
FRAMES = ("answered", "superseded", "refused")

_FLAGS = len(FLAGS)
_ABSENT = int(Flag.CONVERGED | Flag.IN_RANGE)  # bits that are news when they are not set

Borders: TypeAlias = tuple[float, float, float, float, float]


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


_TIMED = tuple(product(KINDS, PHASES))
_OF_FLAGS = (("query", "out_of_range"), *product(("session",), FLAGS.values()))
_CODES, _OUTCOMES = tuple(product(STATUS)), tuple(product(FRAMES))

FAMILIES = (
    Family("histogram", "palpate_phase_seconds", "Time per phase", ("kind", "phase"), _TIMED),
    Family(
        "histogram", "palpate_queue_seconds", "Wait for a turn", ("kind",), tuple(product(KINDS))
    ),
    Family("counter", "palpate_flags_total", "Answers by flag", ("kind", "flag"), _OF_FLAGS),
    Family("counter", "palpate_refusals_total", "Requests refused", ("code",), _CODES),
    Family("counter", "palpate_frames_total", "Session frames", ("outcome",), _OUTCOMES),
    Family("gauge", "palpate_sessions", "Open sessions"),
    Family("counter", "palpate_sessions_opened_total", "Sessions opened"),
    Family("counter", "palpate_worker_starts_total", "Starts of the worker"),
    Family("gauge", "palpate_worker_pid", "Process number of the worker"),
)
"""A query's or a frame's wait is from when it was read to when its turn came."""

_FIRST = (0, *accumulate(len(family.values) * family.width for family in FAMILIES))
WIDTH = _FIRST[-1]
"""Cells of a row."""


def _cell(name: str, *value: str) -> int:
    """Find the first cell of a label value of a metric."""
    for family, first in zip(FAMILIES, _FIRST, strict=False):
        if family.name == name:
            return first + family.values.index(value) * family.width
    raise KeyError(name)


_BUCKETS = np.array(BOUNDS)
_EDGES = (*map(repr, BOUNDS), "+Inf")
_WIDE = len(BOUNDS) + 2
_QUERY_PHASES, _FRAME_PHASES = (_cell("palpate_phase_seconds", kind, PHASES[0]) for kind in KINDS)
_QUERY_QUEUE, _FRAME_QUEUE = (_cell("palpate_queue_seconds", kind) for kind in KINDS)
_QUERY_OUT_OF_RANGE = _cell("palpate_flags_total", "query", "out_of_range")
_FRAME_FLAGS = _cell("palpate_flags_total", "session", "contact")
_ANSWERED, _SUPERSEDED, _REFUSED = (_cell("palpate_frames_total", name) for name in FRAMES)
_SESSIONS = _cell("palpate_sessions")
_SESSIONS_OPENED = _cell("palpate_sessions_opened_total")
_STARTS = _cell("palpate_worker_starts_total")
_PID = _cell("palpate_worker_pid")
_REFUSALS = {code: _cell("palpate_refusals_total", code) for code in STATUS}


@njit(cache=True, error_model="numpy", nogil=True)
def _observe(row, first, seconds):
    """Count a duration in the histogram that begins at cell `first`."""
    row[first + np.searchsorted(_BUCKETS, seconds)] += 1.0
    row[first + _WIDE - 1] += seconds


@njit(cache=True, error_model="numpy", nogil=True)
def _observe_phases(row, first, start, decoded, solved, recovered, encoded):
    """Count the durations of all phases, given their borders."""
    _observe(row, first, decoded - start)
    _observe(row, first + _WIDE, solved - decoded)
    _observe(row, first + 2 * _WIDE, recovered - solved)
    _observe(row, first + 3 * _WIDE, encoded - recovered)


@njit(cache=True, error_model="numpy", nogil=True)
def _count_frame(row, waited, start, decoded, solved, recovered, encoded, news, superseded):
    _observe(row, _FRAME_QUEUE, waited)
    _observe_phases(row, _FRAME_PHASES, start, decoded, solved, recovered, encoded)
    for bit in range(_FLAGS):
        row[_FRAME_FLAGS + bit] += news >> bit & 1
    row[_ANSWERED] += 1.0
    row[_SUPERSEDED] += superseded


class Metrics:
    """The numbers of one worker.

    Parameters
    ----------
    table : Path, optional
        File that the workers share, made by `make_table`. Default: this is the only worker.

    Attributes
    ----------
    worker : int
        Number of the row.

    Raises
    ------
    PalpateError
        If every row of the table is taken.
    """

    def __init__(self, table: Path | None = None) -> None:
        self.worker, memory = (0, mmap.mmap(-1, 8 * WIDTH)) if table is None else _claim(table)
        self._rows = np.frombuffer(memory).reshape(-1, WIDTH)
        self._row = self._rows[self.worker]
        self._row[_SESSIONS] = 0.0  # those of a killed worker are gone
        self._row[_STARTS] += 1.0
        self._row[_PID] = os.getpid()

    @property
    def restarted(self) -> bool:
        """Whether this worker takes the place of one that died."""
        return bool(self._row[_STARTS] > 1.0)

    def count_wait(self, seconds: float) -> None:
        """Count how long a request waited for its turn."""
        _observe(self._row, _QUERY_QUEUE, seconds)

    def count_query(self, borders: Borders, in_range: bool) -> None:
        """Count an answered query.

        Parameters
        ----------
        borders : tuple of 5 floats, s
            When the first of `PHASES` began and when each ended.
        in_range : bool
        """
        _observe_phases(self._row, _QUERY_PHASES, *borders)
        self._row[_QUERY_OUT_OF_RANGE] += not in_range

    def count_frame(self, waited: float, borders: Borders, flags: int, superseded: int) -> None:
        """Count an answered frame of a session.

        Parameters
        ----------
        waited : float, s
            From when it was read to when its turn came.
        borders : tuple of 5 floats, s
            When the first of `PHASES` began and when each ended.
        flags : int
            Bits of `session.frames.Flag`.
        superseded : int
            Frames that were dropped for it.
        """
        _count_frame(self._row, waited, *borders, flags ^ _ABSENT, superseded)

    def count_refused_frame(self) -> None:
        """Count a message of a session that was no frame."""
        self._row[_REFUSED] += 1.0

    def count_refusal(self, code: str) -> None:
        """Count a refusal, by its code."""
        self._row[_REFUSALS[code]] += 1.0

    def count_session(self, opened: bool) -> None:
        """Count a session that was opened, or that ended."""
        self._row[_SESSIONS] += 1.0 if opened else -1.0
        self._row[_SESSIONS_OPENED] += opened

    def text(self) -> str:
        """Write the numbers of all workers, labelled with theirs, as Prometheus reads them."""
        rows = self._rows.tolist()
        started = [worker for worker, row in enumerate(rows) if row[_PID]]
        lines = []
        for family, first in zip(FAMILIES, _FIRST, strict=False):
            lines += [f"# HELP {family.name} {family.help}", f"# TYPE {family.name} {family.type}"]
            for worker in started:
                lines += _samples(family, worker, rows[worker][first:])
        lines += _memory({worker: int(rows[worker][_PID]) for worker in started})
        return "\n".join(lines) + "\n"


def make_table(path: Path, workers: int) -> None:
    """Make the file by which `workers` processes share their numbers."""
    path.write_bytes(bytes(8 * WIDTH * workers))


def _claim(path: Path) -> tuple[int, mmap.mmap]:
    """Map the shared table and take a free row of it, until this process ends."""
    import fcntl  # only workers need it, and only POSIX has both

    with ExitStack() as stack:
        descriptor = os.open(path, os.O_RDWR)
        stack.callback(os.close, descriptor)
        table = stack.enter_context(mmap.mmap(descriptor, 0))
        for worker in range(len(table) // (8 * WIDTH)):
            try:
                fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, worker)
            except OSError:
                continue
            stack.pop_all()  # they stay open: closing either would free the row
            return worker, table
    raise PalpateError(f"{path}: more workers than rows")


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
