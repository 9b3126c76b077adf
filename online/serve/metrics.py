"""What the service counts, for ``GET /metrics``.

The numbers of every worker stand in one table in shared memory, a row of float64 cells per worker,
so that any of them can tell those of all. A worker holds its row by a file lock: when it is killed
the system frees the lock, and the worker that takes its place counts on from where it was.

Prometheus' own client takes some 2 µs for every number, of which a frame changes ten, and
milliseconds to write the text, in which nobody is answered. This takes 1.5 µs and 0.2 ms.
"""

import math
import mmap
import os
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from itertools import accumulate, product
from pathlib import Path
from typing import NamedTuple

from palpate.online.serve.errors import STATUS
from palpate.online.session.frames import Flag
from palpate.shared.errors import PalpateError

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
"""Of the text format of Prometheus."""

BOUNDS = tuple(m * 10.0**e for e in range(-6, 1) for m in (1.0, 2.0, 5.0))
"""Upper bounds of the histograms' buckets, s: 1 µs to 5 s, one more beyond them."""

_SUM = len(BOUNDS) + 1

KINDS = ("query", "session")
PHASES = ("decode", "solve", "recover", "encode")
FLAGS = {bit: str(bit.name).lower() for bit in Flag}
FLAGS |= {Flag.CONVERGED: "unconverged", Flag.IN_RANGE: "out_of_range"}
_ABSENT = Flag.CONVERGED | Flag.IN_RANGE
"""Flags that are counted where they are absent."""

FRAMES = ("answered", "superseded", "refused")

Borders = tuple[float, float, float, float, float]
"""Start of the first phase and ends of all, s."""


class Family(NamedTuple):
    """A metric: a histogram's cells hold its buckets and its sum."""

    type: str
    name: str  # without the prefix "palpate_"
    help: str
    labels: tuple[str, ...] = ()
    values: Sequence[tuple[str, ...]] = ((),)


_TIMED = tuple(product(KINDS, PHASES))
_FLAGGED = (("query", "out_of_range"), *product(("session",), FLAGS.values()))

FAMILIES = (
    Family("histogram", "phase_seconds", "Time per phase", ("kind", "phase"), _TIMED),
    Family("histogram", "queue_seconds", "Wait for a turn", ("kind",), [*product(KINDS)]),
    Family("counter", "flags_total", "Answers by flag", ("kind", "flag"), _FLAGGED),
    Family("counter", "refusals_total", "Requests refused", ("code",), [*product(STATUS)]),
    Family("counter", "frames_total", "Session frames", ("outcome",), [*product(FRAMES)]),
    Family("gauge", "sessions", "Open sessions"),
    Family("counter", "sessions_opened_total", "Sessions opened"),
    Family("counter", "worker_starts_total", "Starts of the worker"),
    Family("gauge", "worker_pid", "Process number of the worker"),
    Family("gauge", "worker_resident_bytes", "Memory that the worker holds"),
    Family("gauge", "worker_own_bytes", "The same, what n processes share counted as an nth"),
)
_KEYS = [(family, (family.name, *value)) for family in FAMILIES for value in family.values]
_WIDTHS = (_SUM + 1 if family.type == "histogram" else 1 for family, _ in _KEYS)
*_FIRST, WIDTH = accumulate(_WIDTHS, initial=0)
_CELLS = dict(zip((key for _, key in _KEYS), _FIRST, strict=True))
"""First cell of each metric and label value."""

_QUERY_PHASES, _FRAME_PHASES = (_CELLS["phase_seconds", k, PHASES[0]] for k in KINDS)
_QUERY_QUEUE, _FRAME_QUEUE = (_CELLS["queue_seconds", kind] for kind in KINDS)
_QUERY_OUT_OF_RANGE = _CELLS["flags_total", "query", "out_of_range"]
_ANSWERED, _SUPERSEDED, _ = (_CELLS["frames_total", name] for name in FRAMES)
_SESSIONS, _, _STARTS, _PID, _RESIDENT, _OWN = (_CELLS[f.name,] for f in FAMILIES[-6:])

_FRAME_FLAGS = [
    [_ANSWERED]
    + [_CELLS["flags_total", "session", FLAGS[bit]] for bit in Flag if (flags ^ _ABSENT) & bit]
    for flags in range(2 * max(Flag))
]
"""For every value of a frame's flags, the cells that count it."""


class Metrics:
    """The numbers of one worker, in a row of the `table` that `make_table` made.

    Without one this is the only worker. Raises `PalpateError` if every row is taken.
    """

    def __init__(self, table: Path | None = None) -> None:
        self.worker, memory = (0, mmap.mmap(-1, 8 * WIDTH)) if table is None else _claim(table)
        cells = memoryview(memory).cast("d")
        self._rows = [cells[first : first + WIDTH] for first in range(0, len(cells), WIDTH)]
        self._row = self._rows[self.worker]
        self._row[_SESSIONS] = 0.0  # those of a killed worker are gone
        self._row[_RESIDENT] = self._row[_OWN] = math.nan
        self._row[_PID] = os.getpid()
        self._row[_STARTS] += 1.0  # last: who reads the start reads the rest as it is now

    @property
    def restarted(self) -> bool:
        """Whether this worker takes the place of one that died."""
        return self._row[_STARTS] > 1.0

    def count(self, name: str, *labels: str, by: float = 1.0) -> None:
        """Count by the name of a metric, without its prefix, and the values of its labels."""
        self._row[_CELLS[name, *labels]] += by

    def count_wait(self, seconds: float) -> None:
        """Count how long a request waited for its turn."""
        self._observe(_QUERY_QUEUE, seconds)

    def count_query(self, borders: Borders, in_range: bool) -> None:
        """Count an answered query."""
        self._observe_phases(_QUERY_PHASES, borders)
        self._row[_QUERY_OUT_OF_RANGE] += not in_range

    def count_frame(self, waited: float, borders: Borders, flags: int, superseded: int) -> None:
        """Count an answered frame, how long it waited (s), and those dropped for it."""
        self._observe(_FRAME_QUEUE, waited)
        self._observe_phases(_FRAME_PHASES, borders)
        for cell in _FRAME_FLAGS[flags]:
            self._row[cell] += 1.0
        self._row[_SUPERSEDED] += superseded

    def _observe(self, first: int, *durations: float) -> None:
        """Count durations (s) in the histograms that follow one another from cell `first`."""
        row = self._row
        for seconds in durations:
            row[first + bisect_left(BOUNDS, seconds)] += 1.0
            row[first + _SUM] += seconds
            first += _SUM + 1

    def _observe_phases(self, first: int, borders: Borders) -> None:
        start, decoded, solved, recovered, encoded = borders
        self._observe(
            first, decoded - start, solved - decoded, recovered - solved, encoded - recovered
        )

    def text(self) -> str:
        """Write the numbers of all workers, labelled with theirs, as Prometheus reads them."""
        rows = {worker: row.tolist() for worker, row in enumerate(self._rows) if row[_PID]}
        for row in rows.values():
            with suppress(OSError):  # not every system says it
                pages = Path(f"/proc/{int(row[_PID])}/statm").read_text().split()[1]
                row[_RESIDENT] = int(pages) * mmap.PAGESIZE
                rollup = Path(f"/proc/{int(row[_PID])}/smaps_rollup").read_text()
                row[_OWN] = 1024 * int(rollup.partition("\nPss:")[2].split()[0])
        lines = []
        for family in FAMILIES:
            name = f"palpate_{family.name}"
            lines += [f"# HELP {name} {family.help}", f"# TYPE {name} {family.type}"]
            for worker, row in rows.items():
                lines += _samples(family, worker, row)
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


def _samples(family: Family, worker: int, row: Sequence[float]) -> Iterator[str]:
    """Write the samples of a metric of a worker."""
    for value in family.values:
        labels = "".join(f'{n}="{v}",' for n, v in zip(family.labels, value, strict=True))
        labels += f'worker="{worker}"'
        name, first = f"palpate_{family.name}", _CELLS[family.name, *value]
        if family.type != "histogram":
            yield f"{name}{{{labels}}} {row[first]!r}"
            continue
        upto = list(accumulate(row[first : first + _SUM]))
        for edge, count in zip((*BOUNDS, "+Inf"), upto, strict=True):
            yield f'{name}_bucket{{{labels},le="{edge}"}} {count!r}'
        yield f"{name}_count{{{labels}}} {upto[-1]!r}"
        yield f"{name}_sum{{{labels}}} {row[first + _SUM]!r}"
