"""What the service adds to a solve: round trips of a closed loop on one connection.

The reference is ``/check``, which reads and checks the same body in the same application and does
nothing else. All kinds of request take turns, so that the machine's moods touch them alike.
"""

import json
import re
import socket
from statistics import median
from time import perf_counter
from urllib.parse import quote, urlsplit

from online.client import Client
from online.negotiation import BINARY, JSON
from shared.errors import PalpateError

_LENGTH = re.compile(rb"\r\ncontent-length: *(\d+)", re.I)
_PHASE = re.compile(rb"(\w+);dur=([\d.]+)")
WARM_UP = 100


def measure(url: str, scene: str, rounds: int) -> dict[str, float]:
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
    with Client(url) as client:
        example = client.scene(scene)["example"]
    path = f"/scenes/{quote(scene, safe='')}"
    with _Connection(url) as connection:
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


class _Connection:
    """A bare keep-alive connection: of an HTTP library we would measure the library."""

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        self._host = parts.netloc
        self._socket = socket.create_connection((parts.hostname, parts.port or 80), timeout=10)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def __enter__(self) -> "_Connection":
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def request(self, path: str, accept: str, document: object) -> bytes:
        """Make the bytes of a POST."""
        body = json.dumps(document).encode()
        head = (
            f"POST {path} HTTP/1.1\r\nhost: {self._host}\r\naccept: {accept}\r\n"
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
