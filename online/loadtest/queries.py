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
from numpy.typing import NDArray

from palpate.online.loadtest.generator import CHUNK, DROPPED, Log
from palpate.online.loadtest.target import Target
from palpate.online.serve.negotiation import BINARY, JSON

PATIENCE = 1.0
"""Seconds that a query waits for a free connection."""

_LENGTH = re.compile(rb"\r\ncontent-length: *(\d+)", re.I)
_SOLVE = re.compile(rb"\bsolve;dur=([\d.]+)")


class Queries:
    """Solves of the loads given, with fields in binary.

    Parameters
    ----------
    target : Target
    due : ndarray, shape (n,), s
    positions : ndarray, shape (n, 3), mm
    pressures : ndarray, shape (n,), kPa
    region : str
        The nodes to ask fields for: ``none``, ``surface`` or ``all``.
    connections : int

    Attributes
    ----------
    complaint : str
        What went wrong last with a connection.
    """

    def __init__(
        self,
        target: Target,
        due: NDArray[np.float64],
        positions: NDArray[np.float64],
        pressures: NDArray[np.float64],
        region: str,
        connections: int,
    ) -> None:
        self.log = Log(due)
        self.complaint = ""
        head = target.head("POST", "solve", accept=BINARY, content_type=JSON)
        self._requests = [
            _request(head, position, pressure, region)
            for position, pressure in zip(positions.tolist(), pressures.tolist(), strict=True)
        ]
        self.sockets: Sequence[socket.socket] = [target.connect() for _ in range(connections)]
        for connection in self.sockets:
            connection.setblocking(False)
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

    def receive(self, connection: socket.socket, now: int) -> bool:
        """Take a part of an answer; tell whether the connection is still open."""
        try:
            chunk = connection.recv(CHUNK)
        except BlockingIOError:
            return True
        except OSError as error:
            return self._lose(connection, f"a connection broke: {error.strerror}")
        if not chunk:
            return self._lose(connection, "the service closed a connection")
        answer = self._answers[connection]
        if not answer.take(chunk):
            return True
        log, number = self.log, answer.number
        log.received[number] = now
        log.outcome[number] = answer.status
        log.solve_us[number] = answer.solve_us
        del self._answers[connection]
        self._go_on(connection, now)
        return True

    def _go_on(self, connection: socket.socket, now: int) -> None:
        """Send the next query that is worth it, if any waits."""
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
            self.complaint = f"a connection broke: {error.strerror}"
            return
        self._answers[connection] = _Answer(number)

    def _lose(self, connection: socket.socket, why: str) -> bool:
        self.complaint = why
        self._answers.pop(connection, None)
        if connection in self._free:
            self._free.remove(connection)
        return False

    def close(self) -> None:
        """Hang up."""
        for connection in self.sockets:
            connection.close()


class _Answer:
    """An HTTP response on its way."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.status = 0
        self.solve_us = 0.0
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
            length, solve = _LENGTH.search(head), _SOLVE.search(head)
            self._missing = (int(length[1]) if length else 0) - len(body)
            self.solve_us = 1e3 * float(solve[1]) if solve else 0.0
        return self._missing <= 0


def _request(head: str, position: list[float], pressure: float, region: str) -> bytes:
    contact = {"position": position, "pressure": pressure}
    body = json.dumps({"contacts": [contact], "region": region})
    return f"{head}content-length: {len(body)}\r\n\r\n{body}".encode()
