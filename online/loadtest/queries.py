"""HTTP queries as a stream of load, over some connections.

A query that is due while every connection waits for an answer is sent as soon as one is free; its
latency counts from when it was due. If that takes longer than a user's patience it is dropped.
"""

import json
import re
import socket
from collections import deque
from collections.abc import Sequence

import numpy as np
from httptools import HttpResponseParser
from numpy.typing import NDArray

from palpate.online.client.connection import connect, split_address
from palpate.online.loadtest.generator import DROPPED, Stream
from palpate.online.serve.wire import BINARY, JSON

PATIENCE = 1.0
"""Seconds that a query waits for a free connection."""

_PHASES = re.compile(rb"\bsolve;dur=([\d.]+), recover;dur=([\d.]+)")


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
        if self._free:
            self._push(self._free.popleft(), number)
        else:
            self._queue.append(number)

    def take(self, connection: socket.socket, chunk: bytes, now: int) -> bool:
        """Take a part of an answer; the connection stays open."""
        answer = self._answers[connection]
        answer.parser.feed_data(chunk)
        if answer.whole:
            log, number = self.log, answer.number
            log.received[number] = now
            log.outcome[number] = answer.parser.get_status_code()
            log.solve[number], log.recover[number] = answer.phases
            del self._answers[connection]
            self._go_on(connection, now)
        return True

    def _go_on(self, connection: socket.socket, now: int) -> None:
        """Send the next query that has not waited too long, if there is one."""
        while self._queue:
            number = self._queue.popleft()
            if now - self.log.due[number] < 1e9 * PATIENCE:
                self._push(connection, number)
                return
            self.log.outcome[number] = DROPPED
        self._free.append(connection)

    def _push(self, connection: socket.socket, number: int) -> None:
        # A request is far shorter than an empty socket's buffer.
        try:
            connection.sendall(self._requests[number])
        except OSError as error:
            self.complaint = f"the connection broke: {error.strerror}"
            return
        self._answers[connection] = _Answer(number)

    def lose(self, connection: socket.socket, why: str) -> bool:
        """Go on with the other connections."""
        self._answers.pop(connection, None)
        if connection in self._free:
            self._free.remove(connection)
        return super().lose(connection, why)


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
    """Write requests for loads: positions (n, 3) mm and pressures (n,) kPa.

    Answers are asked for in binary, with the fields of the nodes of `region`.
    """
    head = [f"POST {path} HTTP/1.1", f"host: {split_address(url).netloc}"]
    head += [f"accept: {BINARY}", f"content-type: {JSON}"]
    if token:
        head.append(f"authorization: Bearer {token}")
    requests = []
    for position, pressure in zip(*(values.tolist() for values in loads), strict=True):
        contact = {"position": position, "pressure": pressure}
        body = json.dumps({"contacts": [contact], "region": region})
        lines = [*head, f"content-length: {len(body)}", "", body]
        requests.append("\r\n".join(lines).encode())
    return requests
