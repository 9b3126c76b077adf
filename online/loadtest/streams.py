"""Streams of load: a session's frames, and HTTP queries over some connections.

Frames are on a bare socket and written before the test starts: with a WebSocket library the library
would be measured too. A query that is due while every connection waits for an answer is sent as
soon as one is free; its latency counts from when it was due. If that takes longer than a user's
patience it is dropped.
"""

import json
import re
import socket
import struct
from collections import deque
from collections.abc import Sequence

import numpy as np
from httptools import HttpResponseParser
from numpy.typing import NDArray

from palpate.online.client.connection import connect, split_address
from palpate.online.loadtest.generator import ANSWERED, DROPPED, SUPERSEDED, Stream
from palpate.online.serve.wire import BINARY, JSON
from palpate.online.session.frames import REPLY, Request, encode_request

PATIENCE = 1.0
"""Seconds that a query waits for a free connection."""

_PHASES = re.compile(rb"\bsolve;dur=([\d.]+), recover;dur=([\d.]+)")

_TEXT, _BINARY, _CLOSE, _PING, _PONG = 1, 2, 8, 9, 10
_FINAL, _MASKED = 0x80, 0x80

_OFFSETS = {name: int(field[1]) for name, field in (REPLY.fields or {}).items()}
_SOLVED, _DROPPED = _OFFSETS["solve_time"], _OFFSETS["superseded"]
_NEWS = struct.Struct(f"<2xHI{_SOLVED - 8}xf{_DROPPED - _SOLVED - 4}xI")
"""Flags, number, solve_time and superseded of a reply."""


class FrameStream(Stream):
    """A session or an echo, greeted already, that is sent positions (n, 3) mm when due (s)."""

    def __init__(
        self,
        connection: socket.socket,
        due: NDArray[np.float64],
        positions: NDArray[np.float64],
        outputs: int = 0,
    ) -> None:
        super().__init__(due, [connection])
        self._messages = [
            _message(_BINARY, encode_request(Request(number, time, position, outputs)))
            for number, (time, position) in enumerate(zip(due, positions.tolist(), strict=True))
        ]
        self._received = self._unsent = b""
        self._last_sent = self._last_answered = -1

    @property
    def waiting(self) -> bool:
        """Whether the last frame sent has no answer yet."""
        return bool(self.sockets) and self._last_answered < self._last_sent

    def send(self, number: int, now: int) -> None:
        """Send a frame."""
        if not self.sockets:
            return
        self.log.sent[number] = now
        self._last_sent = number
        self._push(self._unsent + self._messages[number])

    def take(self, connection: socket.socket, chunk: bytes, now: int) -> None:
        """Take replies, and what else the service has to say."""
        received = self._received + chunk if self._received else chunk
        start, end = 0, len(received)
        while (frame := _frame(received, start, end)) is not None:
            opcode, begin, start = frame
            payload = b"" if opcode == _BINARY else received[begin:start]
            if opcode == _BINARY:
                self._record(received, begin, now)
            elif opcode == _PING:
                self._push(self._unsent + _message(_PONG, payload))
            elif opcode == _TEXT:
                self.complaint = payload.decode()
            elif opcode == _CLOSE:
                self.lose(connection, payload[2:].decode() or "the service ended the session")
                return
        self._received = received[start:]
        if self._unsent:
            self._push(self._unsent)

    def _record(self, received: bytes, begin: int, now: int) -> None:
        flags, number, solve_time, superseded = _NEWS.unpack_from(received, begin)
        log = self.log
        log.received[number] = now
        log.outcome[number] = ANSWERED
        log.flags[number] = flags
        log.solve[number] = 1e6 * solve_time
        for dropped in range(max(number - superseded, self._last_answered + 1), number):
            log.outcome[dropped] = SUPERSEDED
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
        self._push(self._unsent + _message(_CLOSE, struct.pack("!H", 1000)))
        super().close()


def _message(opcode: int, payload: bytes) -> bytes:
    """Write a short WebSocket frame (RFC 6455, section 5.2); its mask of zeros changes nothing."""
    return bytes((_FINAL | opcode, _MASKED | len(payload), 0, 0, 0, 0)) + payload


def _frame(received: bytes, start: int, end: int) -> tuple[int, int, int] | None:
    """Find a server's frame: its opcode, where its payload begins and where it ends."""
    if end - start < 2:
        return None
    length, begin = received[start + 1], start + 2
    if length > 125:  # the length follows, in 2 or 8 bytes
        begin += 2 if length == 126 else 8
        length = int.from_bytes(received[start + 2 : begin], "big")
    return (received[start] & 0x0F, begin, begin + length) if begin + length <= end else None


class QueryStream(Stream):
    """Requests to be sent when they are due, over `connections` to the service at `url`."""

    def __init__(
        self, url: str, connections: int, due: NDArray[np.float64], requests: Sequence[bytes]
    ) -> None:
        super().__init__(due, [connect(url, timeout=10.0) for _ in range(connections)])
        self._requests = requests
        self._free = deque(self.sockets)
        self._queue: deque[int] = deque()
        self._answers: dict[socket.socket, _Answer] = {}

    @property
    def waiting(self) -> bool:
        """Whether a query has no answer yet."""
        return bool(self._answers)

    def send(self, number: int, now: int) -> None:
        """Send a query, or queue it until a connection is free."""
        self.log.sent[number] = now
        self._queue.append(number)
        self._go_on(now)

    def take(self, connection: socket.socket, chunk: bytes, now: int) -> None:
        """Take a part of an answer."""
        answer = self._answers[connection]
        answer.parser.feed_data(chunk)
        if answer.whole:
            log, number = self.log, answer.number
            log.received[number] = now
            log.outcome[number] = answer.parser.get_status_code()
            log.solve[number], log.recover[number] = answer.phases
            del self._answers[connection]
            self._free.append(connection)
            self._go_on(now)

    def _go_on(self, now: int) -> None:
        """Send queries that have not waited too long, while connections are free."""
        while self._queue and self._free:
            number = self._queue.popleft()
            if now - self.log.due[number] >= 1e9 * PATIENCE:
                self.log.outcome[number] = DROPPED
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
        self.phases = 0.0, 0.0  # solve and recover, µs
        self.whole = False

    def on_header(self, name: bytes, value: bytes) -> None:
        if name.lower() == b"server-timing" and (found := _PHASES.search(value)):
            self.phases = 1e3 * float(found[1]), 1e3 * float(found[2])

    def on_message_complete(self) -> None:
        self.whole = True


def write_requests(
    url: str,
    path: str,
    token: str | None,
    loads: tuple[NDArray[np.float64], NDArray[np.float64]],
    region: str,
) -> list[bytes]:
    """Write requests for loads, positions (n, 3) mm and pressures (n,) kPa, answered in binary."""
    head = [f"POST {path} HTTP/1.1", f"host: {split_address(url).netloc}", f"accept: {BINARY}"]
    head += [f"content-type: {JSON}", *([f"authorization: Bearer {token}"] if token else [])]
    contacts = zip(*(values.tolist() for values in loads), strict=True)
    bodies = (
        json.dumps({"contacts": [{"position": at, "pressure": pressure}], "region": region})
        for at, pressure in contacts
    )
    return ["\r\n".join([*head, f"content-length: {len(b)}", "", b]).encode() for b in bodies]
