"""HTTP queries as a stream of load, over some connections.

A query that is due while every connection waits for an answer is sent as soon as one is free; its
latency counts from when it was due. If that takes longer than a user's patience it is dropped.
"""

import json
import re
import socket
from collections import deque

import numpy as np
from numpy.typing import NDArray

from palpate.online.loadtest.generator import DROPPED, Stream
from palpate.online.loadtest.target import Target
from palpate.online.serve.negotiation import BINARY, JSON

PATIENCE = 1.0
"""Seconds that a query waits for a free connection."""

_LENGTH = re.compile(rb"\r\ncontent-length: *(\d+)", re.I)
_PHASES = re.compile(rb"\bsolve;dur=([\d.]+), recover;dur=([\d.]+)")


class QueryStream(Stream):
    """The loads given, to be solved with fields in binary or only checked.

    Parameters
    ----------
    target : Target
    due : ndarray, shape (n,), s
    positions : ndarray, shape (n, 3), mm
    pressures : ndarray, shape (n,), kPa
    region : str
        The nodes to ask fields for: ``none``, ``surface`` or ``all``.
    connections : int
    verb : str
        Endpoint of the scene: ``solve`` or ``check``.
    """

    def __init__(
        self,
        target: Target,
        due: NDArray[np.float64],
        positions: NDArray[np.float64],
        pressures: NDArray[np.float64],
        region: str,
        connections: int,
        verb: str = "solve",
    ) -> None:
        super().__init__(due, [target.connect() for _ in range(connections)])
        head = target.head("POST", target.path(verb), accept=BINARY, content_type=JSON)
        self._requests = [
            _request(head, position, pressure, region)
            for position, pressure in zip(positions.tolist(), pressures.tolist(), strict=True)
        ]
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
        if not answer.take(chunk):
            return True
        log, number = self.log, answer.number
        log.received[number] = now
        log.outcome[number] = answer.status
        log.solve_us[number], log.recover_us[number] = answer.phases_us
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
    """An HTTP response on its way."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.status = 0
        self.phases_us = 0.0, 0.0
        self._head = b""
        self._missing = 0

    def take(self, chunk: bytes) -> bool:
        """Take a part of it; tell whether it is whole."""
        if self.status:
            self._missing -= len(chunk)
        else:
            self._head += chunk
            head, blank, body = self._head.partition(b"\r\n\r\n")
            if not blank:
                return False
            self.status = int(head[9:12])
            length, phases = _LENGTH.search(head), _PHASES.search(head)
            self._missing = (int(length[1]) if length else 0) - len(body)
            if phases:
                self.phases_us = 1e3 * float(phases[1]), 1e3 * float(phases[2])
        return self._missing <= 0


def _request(head: str, position: list[float], pressure: float, region: str) -> bytes:
    contact = {"position": position, "pressure": pressure}
    body = json.dumps({"contacts": [contact], "region": region})
    return f"{head}content-length: {len(body)}\r\n\r\n{body}".encode()
