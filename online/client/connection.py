"""A WebSocket to the service on one thread and one socket, for loops that wait or spin."""

import json
import select
import socket
from collections import deque
from contextlib import suppress
from typing import Any
from urllib.parse import SplitResult, quote, urlsplit

from websockets.client import ClientProtocol
from websockets.exceptions import InvalidState, InvalidStatus
from websockets.frames import Close, Frame, Opcode
from websockets.protocol import State
from websockets.uri import parse_uri

from palpate.shared.errors import PalpateError


class ServiceError(PalpateError):
    """The service refused a request, for the `error` it sent.

    The `status` is that of HTTP; 0 for a message in a session, which goes on.
    """

    def __init__(self, status: int, error: dict[str, Any]) -> None:
        self.status = status
        self.code: str = error["code"]
        self.field: str = error["field"]
        self.allowed: Any = error["allowed"]
        super().__init__(f"{self.field}: {error['message']}" if self.field else error["message"])


class SessionClosed(PalpateError):
    """The session has ended, with a code of its WebSocket; 1006 if the connection broke."""

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(f"the session has ended: {reason or 'no reason given'} ({code})")
        self.code, self.reason = code, reason


class Connection:
    """An open WebSocket at a path of a service; `ServiceError` if the handshake is refused."""

    def __init__(self, url: str, path: str, token: str | None, timeout: float) -> None:
        address = f"ws://{split_address(url).netloc}{path}"
        self._received: deque[str | bytes] = deque()
        self.protocol = ClientProtocol(parse_uri(address), max_size=None)
        self.socket = connect(url, timeout)
        request = self.protocol.connect()
        if token is not None:
            request.headers["Authorization"] = f"Bearer {token}"
        self.protocol.send_request(request)
        try:
            self.flush()
            while self.protocol.state is State.CONNECTING and self.protocol.handshake_exc is None:
                self._take()
            if self.protocol.handshake_exc is not None:
                raise _refusal(self.protocol.handshake_exc)
        except BaseException:
            self.socket.close()
            raise

    def close(self) -> None:
        """Say goodbye, if there is anybody to hear it, and hang up."""
        if self.protocol.state is State.OPEN:
            self.protocol.send_close(1000)
            with suppress(OSError):  # it may have ended already
                self.flush()
        self.socket.close()

    def send(self, message: str | bytes) -> None:
        """Send a message; raise `SessionClosed` if the connection has ended."""
        try:
            if isinstance(message, str):
                self.protocol.send_text(message.encode())
            else:
                self.protocol.send_binary(message)
            self.flush()
        except (InvalidState, ConnectionError):
            while True:  # until the service's close message, or the end of the connection
                self._take()

    def receive(self) -> str | bytes:
        """Wait for a message; raise `SessionClosed` if the connection has ended."""
        while not self._received:
            self._take()
        return self._received.popleft()

    def poll(self) -> bool:
        """Tell whether there is a message, without waiting for one."""
        if not self._received and select.select([self.socket], [], [], 0)[0]:
            self._take()
        return bool(self._received)

    def flush(self) -> None:
        """Send what the protocol has to say."""
        self.socket.sendall(b"".join(self.protocol.data_to_send()))

    def _take(self) -> None:
        """Wait for bytes and sort out the messages in them."""
        if self.socket.fileno() < 0:
            raise SessionClosed(1000, "this client closed it")
        try:
            data = self.socket.recv(1 << 18)
        except ConnectionError:
            data = b""
        if data:
            self.protocol.receive_data(data)
        else:
            self.protocol.receive_eof()
        with suppress(ConnectionError):
            self.flush()  # the protocol has answers to pings and to a close message
        for event in self.protocol.events_received():
            if isinstance(event, Frame) and event.opcode in (Opcode.TEXT, Opcode.BINARY):
                message = bytes(event.data)
                self._received.append(
                    message if event.opcode is Opcode.BINARY else message.decode()
                )
        if not data and not self._received and self.protocol.handshake_exc is None:
            closed = self.protocol.close_rcvd or Close(1006, "the connection broke")
            raise SessionClosed(closed.code, closed.reason)


def connect(url: str, timeout: float) -> socket.socket:
    """Open a connection to a service that sends at once whatever it is given."""
    parts = split_address(url)
    connection = socket.create_connection((parts.hostname, parts.port or 80), timeout)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def scene_path(scene: str, rest: str = "") -> str:
    """Return the path of a scene on a service, or of something in it, such as ``/solve``."""
    return f"/scenes/{quote(scene, safe='')}{rest}"


def split_address(url: str) -> SplitResult:
    """Split the address of a service; raise `PalpateError` for what is none."""
    parts = urlsplit(url)
    if parts.scheme != "http" or parts.hostname is None:
        raise PalpateError(f"{url}: not an address like http://127.0.0.1:8000")
    return parts


def _refusal(error: Exception) -> PalpateError:
    """Make an error of a handshake that failed."""
    if isinstance(error, InvalidStatus) and error.response.body:
        with suppress(ValueError, KeyError):
            body = json.loads(error.response.body)
            return ServiceError(error.response.status_code, body["error"])
    return PalpateError(f"no session: {error}")
