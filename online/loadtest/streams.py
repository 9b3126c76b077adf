"""Streams of load, a session's frames and HTTP queries, and the loop that sends them on time.

Every message has a time at which it is due, whatever became of those before it, and its latency
counts from then: a service that stalls is charged with all that should have been sent meanwhile
(no "coordinated omission"). Asyncio's timers tick in milliseconds; this loop never sleeps and looks
at the clock every few microseconds. How late it sent nevertheless is recorded, as is the time that
the machine's host took from it. Times are in s from the start.

Frames are written before the test starts. A query that is due while every connection waits for an
answer is sent as soon as one is free. If that takes longer than a user's patience it is dropped.
"""

import gc
import os
import re
import select
import socket
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from functools import partial
from itertools import count, repeat
from operator import itemgetter
from time import perf_counter
from typing import NamedTuple

import numpy as np
from httptools import HttpResponseParser
from websockets.frames import Frame, Opcode
from websockets.protocol import Protocol, Side

from palpate.online.session.frames import REPLY, Request, encode_request
from palpate.shared.arrays import Array

WINDOW = 0.25
"""Seconds over which it is judged whether machine and generator were on time."""

DRAIN = 1.5
"""Seconds that are waited for answers after the last message."""

PATIENCE = 1.0
"""Seconds that a query waits for a free connection."""

CHUNK = 1 << 18
"""Most bytes taken from a socket at once."""

LOST, DROPPED, SUPERSEDED, ANSWERED = 0, 1, 2, 200
"""What became of a message; other numbers are HTTP statuses of refusals.

A dropped query never went out; a superseded frame was left by the service for a newer one.
"""

MESSAGE = np.dtype(
    [
        ("due", "f8"),  # s
        ("lateness", "f8"),  # µs, from when it was due to its turn; NaN if that never came
        ("latency", "f8"),  # µs, from when it was due to its answer; NaN without one
        ("solve", "f8"),  # µs, that the service says it took to solve; NaN without an answer
        ("recover", "f8"),  # µs, the same to recover the fields of a query
        ("window", "i4"),  # of the machine, in which it was due
        ("outcome", "i4"),
        ("flags", "i4"),  # of a frame: `session.frames.Flag`
    ]
)

_PHASES = re.compile(rb"\bsolve;dur=([\d.]+), recover;dur=([\d.]+)")


class Stream(ABC):
    """Messages of a kind, with open sockets; `complaint` says what went wrong last."""

    def __init__(self, kind: str, due: Array, sockets: Sequence[socket.socket]) -> None:
        self.kind = kind
        self.log = np.full(len(due), np.array((0, *4 * [np.nan], 0, LOST, 0), MESSAGE))
        self.log["due"] = due
        self.sockets = list(sockets)
        self.complaint = ""
        for connection in self.sockets:
            connection.setblocking(False)

    @property
    @abstractmethod
    def waiting(self) -> bool:
        """Whether an answer may still come."""

    @abstractmethod
    def send(self, number: int, now: float) -> None:
        """Send a message whose turn it is at `now`."""

    @abstractmethod
    def take(self, connection: socket.socket, chunk: bytes, now: float) -> None:
        """Take what has come at `now`."""

    def sent(self, number: int, now: float) -> None:
        """Note that it was a message's turn."""
        self.log["lateness"][number] = 1e6 * (now - self.log["due"][number])

    def answered(self, number: int, now: float, solve: float, recover: float) -> None:
        """Note that a message's answer is whole, and what the service says it spent on it (s)."""
        log = self.log
        log["outcome"][number] = ANSWERED
        log["latency"][number] = 1e6 * (now - log["due"][number])
        log["solve"][number], log["recover"][number] = 1e6 * solve, 1e6 * recover

    def lose(self, connection: socket.socket, why: str) -> None:
        """Do without a socket that broke."""
        self.complaint = why
        self.sockets.remove(connection)
        connection.close()

    def receive(self, connection: socket.socket, now: float) -> bool:
        """Read a socket at `now`; tell whether more may come on it."""
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


class FrameStream(Stream):
    """A session or an echo, greeted already, that is sent positions (n, 3) mm when due."""

    def __init__(
        self, kind: str, due: Array, connection: socket.socket, positions: Array, outputs: int = 0
    ) -> None:
        super().__init__(kind, due, [connection])
        self._messages = [
            Frame(Opcode.BINARY, encode_request(Request(*request))).serialize(mask=True)
            for request in zip(count(), due.tolist(), positions.tolist(), repeat(outputs))
        ]
        self._protocol = Protocol(Side.CLIENT, max_size=None)
        self._unsent = b""
        self._last_sent = self._last_answered = -1

    @property
    def waiting(self) -> bool:
        """Whether the last frame sent has no answer yet."""
        return bool(self.sockets) and self._last_answered < self._last_sent

    def send(self, number: int, now: float) -> None:
        """Send a frame."""
        if self.sockets:
            self.sent(number, now)
            self._last_sent = number
            self._push(self._unsent + self._messages[number])

    def take(self, connection: socket.socket, chunk: bytes, now: float) -> None:
        """Take replies, and what else the service has to say."""
        protocol = self._protocol
        protocol.receive_data(chunk)
        for frame in protocol.events_received():
            if isinstance(frame, Frame) and frame.opcode is Opcode.BINARY:
                self._take_reply(bytes(frame.data), now)
            elif isinstance(frame, Frame) and frame.opcode is Opcode.TEXT:
                self.complaint = bytes(frame.data).decode()
        if protocol.close_rcvd is not None:
            self.lose(connection, protocol.close_rcvd.reason or "the service ended the session")
        elif message := self._unsent + b"".join(protocol.data_to_send()):
            self._push(message)

    def _take_reply(self, frame: bytes, now: float) -> None:
        reply = np.frombuffer(frame, REPLY, 1)[0]
        number = int(reply["seq"])
        self.answered(number, now, reply["solve_time"], 0.0)
        self.log["flags"][number] = reply["flags"]
        first = max(number - int(reply["superseded"]), self._last_answered + 1)
        self.log["outcome"][first:number] = SUPERSEDED
        self._last_answered = number

    def _push(self, message: bytes) -> None:
        """Send what the socket takes and keep the rest."""
        for connection in self.sockets:
            try:
                message = message[connection.send(message) :]
            except BlockingIOError:
                pass
            except OSError as error:
                self.lose(connection, f"the connection broke: {error.strerror}")
        self._unsent = message

    def close(self) -> None:
        """Hang up, with a close message if there is anybody to hear it."""
        if self.sockets:
            self._protocol.send_close(1000)
            self._push(self._unsent + b"".join(self._protocol.data_to_send()))
        super().close()


class QueryStream(Stream):
    """HTTP requests to be sent when they are due, each over a socket that is free."""

    def __init__(
        self, kind: str, due: Array, sockets: Sequence[socket.socket], requests: Sequence[bytes]
    ) -> None:
        super().__init__(kind, due, sockets)
        self._requests = requests
        self._free = deque(self.sockets)
        self._queue: deque[int] = deque()
        self._answers: dict[socket.socket, _Answer] = {}

    @property
    def waiting(self) -> bool:
        """Whether a query has no answer yet."""
        return bool(self._answers)

    def send(self, number: int, now: float) -> None:
        """Send a query, or queue it until a connection is free."""
        self.sent(number, now)
        self._queue.append(number)
        self._go_on(now)

    def take(self, connection: socket.socket, chunk: bytes, now: float) -> None:
        """Take a part of an answer."""
        answer = self._answers[connection]
        answer.parser.feed_data(chunk)
        if answer.whole:
            if (status := answer.parser.get_status_code()) == ANSWERED:
                self.answered(answer.number, now, *answer.phases)
            self.log["outcome"][answer.number] = status
            del self._answers[connection]
            self._free.append(connection)
            self._go_on(now)

    def _go_on(self, now: float) -> None:
        """Send queries that have not waited too long, while connections are free."""
        while self._queue and self._free:
            number = self._queue.popleft()
            if now - self.log["due"][number] >= PATIENCE:
                self.log["outcome"][number] = DROPPED
                continue
            connection = self._free.popleft()
            try:
                connection.sendall(self._requests[number])  # far shorter than an empty buffer
                self._answers[connection] = _Answer(number)
            except OSError as error:
                self.complaint = f"the connection broke: {error.strerror}"

    def lose(self, connection: socket.socket, why: str) -> None:
        """Go on with the other connections."""
        self._answers.pop(connection, None)
        if connection in self._free:
            self._free.remove(connection)
        super().lose(connection, why)


class _Answer:
    """An HTTP response on its way, and what its parser finds in it."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.parser = HttpResponseParser(self)
        self.phases = 0.0, 0.0  # solve and recover, s
        self.whole = False

    def on_header(self, name: bytes, value: bytes) -> None:
        if name.lower() == b"server-timing" and (found := _PHASES.search(value)):
            self.phases = 1e-3 * float(found[1]), 1e-3 * float(found[2])

    def on_message_complete(self) -> None:
        self.whole = True


class Machine(NamedTuple):
    """How the machine did, window by window."""

    borders: Array  # (w + 1,), s
    steal: Array  # (w,), s that the host took from all cores; 0 where nobody tells


def drive(streams: Sequence[Stream]) -> Machine:
    """Send every message of every stream when it is due, and take the answers."""
    messages = (
        (due, number, stream.send)
        for stream in streams
        for number, due in enumerate(stream.log["due"].tolist())
    )
    timetable = deque(sorted(messages, key=itemgetter(0)))
    poll = select.poll()
    receivers = {
        c.fileno(): partial(stream.receive, c) for stream in streams for c in stream.sockets
    }
    for descriptor in receivers:
        poll.register(descriptor, select.POLLIN)
    limit = timetable[-1][0] + DRAIN
    samples = [(0.0, _steal())]
    gc.collect()
    gc.disable()
    try:
        start = perf_counter()
        now = 0.0
        while now < limit and (timetable or any(stream.waiting for stream in streams)):
            while timetable and timetable[0][0] <= now:
                _, number, send = timetable.popleft()
                send(number, now)
                now = perf_counter() - start
            for descriptor, _ in poll.poll(0):
                if not receivers[descriptor](perf_counter() - start):
                    poll.unregister(descriptor)
            if now - samples[-1][0] >= WINDOW:
                samples.append((now, _steal()))
            now = perf_counter() - start
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
