"""A generator of load that is on time: one loop that never sleeps.

Every message has a time at which it is due, whatever became of those before it, and its latency
counts from then: a service that stalls is charged with all that should have been sent meanwhile
(no "coordinated omission"). Asyncio's timers tick in milliseconds; this loop looks at the clock
every few microseconds. How late it sent nevertheless is recorded, as is the time that the machine's
host took from it.
"""

import gc
import os
import select
import socket
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from functools import partial
from operator import itemgetter
from time import perf_counter_ns
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

WINDOW = 0.25
"""Seconds over which it is judged whether machine and generator were on time."""

DRAIN = 1.5
"""Seconds that are waited for answers after the last message."""

CHUNK = 1 << 18
"""Most bytes taken from a socket at once."""

LOST, DROPPED, SUPERSEDED, ANSWERED = 0, 1, 2, 200
"""What became of a message; other numbers are HTTP statuses of refusals.

A dropped query never went out; a superseded frame was left by the service for a newer one.
"""


class Log:
    """What became of every message of a stream; times in ns from the start, 0 for never."""

    def __init__(self, due: NDArray[np.float64]) -> None:
        self.due: list[int] = (1e9 * due).astype(np.int64).tolist()
        count = len(self.due)
        self.sent = [0] * count  # when it was its turn
        self.received = [0] * count  # when its answer was whole
        self.outcome = [LOST] * count
        self.flags = [0] * count  # of frames: `session.frames.Flag`
        # what the server says it took to solve, and to recover the fields of a query, µs
        self.solve, self.recover = [0.0] * count, [0.0] * count


class Stream(ABC):
    """A source of messages, with its open sockets; `complaint` says what went wrong last."""

    def __init__(self, due: NDArray[np.float64], sockets: Sequence[socket.socket]) -> None:
        self.log = Log(due)
        self.sockets = list(sockets)
        self.complaint = ""
        for connection in self.sockets:
            connection.setblocking(False)

    @property
    @abstractmethod
    def waiting(self) -> bool:
        """Whether an answer may still come."""

    @abstractmethod
    def send(self, number: int, now: int) -> None:
        """Send a message, now being `now` (ns)."""

    @abstractmethod
    def take(self, connection: socket.socket, chunk: bytes, now: int) -> None:
        """Take what has come at `now` (ns)."""

    def lose(self, connection: socket.socket, why: str) -> None:
        """Do without a socket that broke."""
        self.complaint = why
        self.sockets.remove(connection)
        connection.close()

    def receive(self, connection: socket.socket, now: int) -> bool:
        """Read a socket at `now` (ns); tell whether more may come on it."""
        try:
            chunk, why = connection.recv(CHUNK), "the service hung up"
        except BlockingIOError:
            return True
        except OSError as error:
            chunk, why = b"", f"the connection broke: {error.strerror}"
        if chunk:
            self.take(connection, chunk, now)
        else:
            self.lose(connection, why)
        return connection in self.sockets

    def close(self) -> None:
        """Hang up."""
        for connection in self.sockets:
            connection.close()


class Machine(NamedTuple):
    """How the machine did, window by window."""

    borders: NDArray[np.int64]  # (w + 1,), ns
    steal: NDArray[np.float64]  # (w,), s that the host took from all cores; 0 where nobody tells


def drive(streams: Sequence[Stream]) -> Machine:
    """Send every message of every stream when it is due, and take the answers."""
    messages = (
        (due, number, stream.send)
        for stream in streams
        for number, due in enumerate(stream.log.due)
    )
    timetable = deque(sorted(messages, key=itemgetter(0)))
    poll = select.poll()
    receivers = {
        c.fileno(): partial(stream.receive, c) for stream in streams for c in stream.sockets
    }
    for descriptor in receivers:
        poll.register(descriptor, select.POLLIN)
    limit = timetable[-1][0] + int(1e9 * DRAIN)
    window = int(1e9 * WINDOW)
    samples = [(0, _steal())]
    gc.collect()
    gc.disable()
    try:
        start = perf_counter_ns()
        now = 0
        while now < limit and (timetable or any(stream.waiting for stream in streams)):
            while timetable and timetable[0][0] <= now:
                _, number, send = timetable.popleft()
                send(number, now)
                now = perf_counter_ns() - start
            for descriptor, _ in poll.poll(0):
                if not receivers[descriptor](perf_counter_ns() - start):
                    poll.unregister(descriptor)
            if now - samples[-1][0] >= window:
                samples.append((now, _steal()))
            now = perf_counter_ns() - start
    finally:
        gc.enable()
    borders, ticks = zip(*samples, (now, _steal()), strict=True)
    return Machine(np.array(borders), np.diff(ticks) / os.sysconf("SC_CLK_TCK"))


def _steal() -> int:
    """Ticks that the host took from this machine's cores since it started (Linux, proc(5))."""
    try:
        with open("/proc/stat", "rb", buffering=0) as file:
            return int(file.read(256).split(None, 9)[8])
    except OSError:
        return 0
