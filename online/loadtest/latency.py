"""What the service adds to a solve: round trips of a closed loop on one connection.

The reference is ``/check``, which reads and checks the same body in the same application and does
nothing else; that of a session is ``/echo`` (``palpate serve --echo``), which answers frames of a
session's sizes. All kinds of request take turns, so that the machine's moods touch them alike.
"""

import json
import re
import socket
import struct
from statistics import median
from time import perf_counter
from typing import Self
from urllib.parse import quote, urlsplit

import numpy as np

from palpate.online.client.http import Client
from palpate.online.serve.negotiation import BINARY, JSON
from palpate.online.session.echo import ECHO
from palpate.online.session.frames import REPLY, Request, encode_request
from palpate.shared.errors import PalpateError

_LENGTH = re.compile(rb"\r\ncontent-length: *(\d+)", re.I)
_PHASE = re.compile(rb"(\w+);dur=([\d.]+)")
WARM_UP = 100
PATH = 0.3
"""Amplitude of the path of a session, mm."""


def measure(url: str, scene: str, rounds: int, token: str | None = None) -> dict[str, float]:
    """Time the service as one client sees it.

    Returns
    -------
    dict
        Medians, µs: ``empty_us``, the round trip of the empty endpoint; ``solve_us`` and
        ``fields_us``, round trips of a solve without fields and with all fields in binary;
        ``solve_added_us``, the former less the solve, and ``fields_added_us``, the latter less the
        solve and the recovery; then these two as multiples of `empty_us`, ``solve_ratio`` and
        ``fields_ratio``.
    """
    with Client(url, token) as client:
        example = client.scene(scene)["example"]
    path = f"/scenes/{quote(scene, safe='')}"
    with _Connection(url, token) as connection:
        empty = connection.request(f"{path}/check", JSON, {**example, "region": "none"})
        solve = connection.request(f"{path}/solve", JSON, {**example, "region": "none"})
        fields = connection.request(f"{path}/solve", BINARY, {**example, "region": "all"})
        for request in (empty, solve, fields) * WARM_UP:
            connection.round_trip(request)
        samples = [
            tuple(connection.round_trip(request) for request in (empty, solve, fields))
            for _ in range(rounds)
        ]

    def middle(kind: int, *phases: str) -> float:
        return median(s[kind][0] - sum(s[kind][1][p] for p in phases) for s in samples)

    report = {
        "empty_us": middle(0),
        "solve_us": middle(1),
        "fields_us": middle(2),
        "solve_added_us": middle(1, "solve"),
        "fields_added_us": middle(2, "solve", "recover"),
    }
    report["solve_ratio"] = report["solve_added_us"] / report["empty_us"]
    report["fields_ratio"] = report["fields_added_us"] / report["empty_us"]
    return report


def measure_session(
    url: str, scene: str, rounds: int, token: str | None = None
) -> dict[str, float]:
    """Time the steps of a session on a path of small steps as one client sees them.

    Returns
    -------
    dict
        Medians, µs: ``echo_us``, the round trip of an echo; ``step_us``, that of a step;
        ``solve_us``, the solve in it; ``step_added_us``, the round trip less its own solve; and
        this as a multiple of `echo_us`, ``step_ratio``.
    """
    solve_time = struct.Struct(f"<{REPLY.fields['solve_time'][1]}xf")  # type: ignore[index]
    with (
        _WebSocket(url, token, f"/scenes/{quote(scene, safe='')}/session") as session,
        _WebSocket(url, token, ECHO) as echo,
    ):
        x, y, z = json.loads(session.receive())["example"]["position"]
        path = [
            _masked(encode_request(Request(i, 0.0, (x + dx, y, z))))
            for i, dx in enumerate(PATH * np.sin(np.linspace(0, 2 * np.pi, 400)))
        ]
        samples = []
        for i in range(WARM_UP + rounds):
            frame = path[i % len(path)]
            echoed, _ = echo.exchange(frame)
            stepped, reply = session.exchange(frame)
            samples.append((echoed, stepped, 1e6 * solve_time.unpack_from(reply)[0]))
    del samples[:WARM_UP]
    report = {
        "echo_us": median(echoed for echoed, _, _ in samples),
        "step_us": median(stepped for _, stepped, _ in samples),
        "solve_us": median(solved for _, _, solved in samples),
        "step_added_us": median(stepped - solved for _, stepped, solved in samples),
    }
    report["step_ratio"] = report["step_added_us"] / report["echo_us"]
    return report


class _Connection:
    """A bare keep-alive connection: of an HTTP library we would measure the library."""

    def __init__(self, url: str, token: str | None) -> None:
        parts = urlsplit(url)
        self._headers = f"host: {parts.netloc}\r\n"
        if token is not None:
            self._headers += f"authorization: Bearer {token}\r\n"
        self._socket = socket.create_connection((parts.hostname, parts.port or 80), timeout=10)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def request(self, path: str, accept: str, document: object) -> bytes:
        """Make the bytes of a POST."""
        body = json.dumps(document).encode()
        head = (
            f"POST {path} HTTP/1.1\r\n{self._headers}accept: {accept}\r\n"
            f"content-type: application/json\r\ncontent-length: {len(body)}\r\n\r\n"
        )
        return head.encode() + body

    def round_trip(self, request: bytes) -> tuple[float, dict[str, float]]:
        """Send and wait for the whole answer: its time and the server's phases, all in µs."""
        start = perf_counter()
        self._socket.sendall(request)
        head, _, body = self._read_until_blank_line()
        length = _LENGTH.search(head)
        missing = int(length[1]) - len(body) if length else 0
        while missing > 0:
            missing -= len(self._receive())
        elapsed = 1e6 * (perf_counter() - start)
        if not head.startswith(b"HTTP/1.1 200"):
            raise PalpateError(f"the service refused: {head.decode('latin-1').splitlines()[0]}")
        return elapsed, {name.decode(): 1e3 * float(ms) for name, ms in _PHASE.findall(head)}

    def _read_until_blank_line(self) -> tuple[bytes, bytes, bytes]:
        received = self._receive()
        while b"\r\n\r\n" not in received:
            received += self._receive()
        return received.partition(b"\r\n\r\n")

    def _receive(self) -> bytes:
        chunk = self._socket.recv(1 << 18)
        if not chunk:
            raise PalpateError("the service closed the connection")
        return chunk


class _WebSocket(_Connection):
    """A bare WebSocket, for frames of up to 64 KB."""

    def __init__(self, url: str, token: str | None, path: str) -> None:
        super().__init__(url, token)
        self._socket.sendall(
            f"GET {path} HTTP/1.1\r\n{self._headers}upgrade: websocket\r\n"
            "connection: upgrade\r\nsec-websocket-version: 13\r\n"
            "sec-websocket-key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n".encode()
        )
        head, _, self._unread = self._read_until_blank_line()
        status = head.decode("latin-1").splitlines()[0]
        if " 101 " not in status:
            hint = " (start it with: palpate serve --echo)" if path == ECHO else ""
            self._socket.close()
            raise PalpateError(f"{path}: the service refused: {status}{hint}")

    def receive(self) -> bytes:
        """Wait for a message."""
        data = self._unread
        start, end = _extent(data)
        while len(data) < end:
            data += self._receive()
            start, end = _extent(data)
        self._unread = data[end:]
        return data[start:end]

    def exchange(self, frame: bytes) -> tuple[float, bytes]:
        """Send a frame and wait for the answer: the time, µs, and the answer."""
        start = perf_counter()
        self._socket.sendall(frame)
        reply = self.receive()
        return 1e6 * (perf_counter() - start), reply


def _extent(data: bytes) -> tuple[int, int]:
    """Where the payload of a server's frame starts and ends, as far as can be seen (RFC 6455)."""
    if len(data) < 2:
        return 0, 2
    if data[1] < 126:
        return 2, 2 + data[1]
    start = 4 if data[1] == 126 else 10
    if len(data) < start:
        return 0, start
    return start, start + int.from_bytes(data[2:start], "big")


def _masked(payload: bytes) -> bytes:
    """Make a client's frame of less than 126 bytes; a mask of zeros leaves it as it is."""
    return bytes((0x82, 0x80 | len(payload), 0, 0, 0, 0)) + payload
