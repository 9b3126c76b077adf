"""The client's side of a session: positions out, forces in.

`Session` keeps to one thread and one socket, for loops that wait for each reply or spin until it is
there (`Session.poll`). It speaks binary frames.
"""

import json
import select
import socket
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from time import perf_counter
from typing import Any, Self
from urllib.parse import SplitResult, quote, urlsplit

from websockets.client import ClientProtocol
from websockets.exceptions import InvalidState, InvalidStatus
from websockets.frames import Frame, Opcode
from websockets.protocol import State
from websockets.uri import parse_uri

from palpate.online.session import frames
from palpate.online.session.frames import Reply, Request
from palpate.online.session.recording import Recorder
from palpate.shared.errors import PalpateError


class ServiceError(PalpateError):
    """The service refused a request.

    Parameters
    ----------
    status : int
        HTTP status; 0 for a message in a session, which goes on.
    error : dict
        ``code``, ``field``, ``message`` and ``allowed`` as the service sent them.
    """

    def __init__(self, status: int, error: dict[str, Any]) -> None:
        super().__init__(
            f"{error['field']}: {error['message']}" if error["field"] else error["message"]
        )
        self.status = status
        self.code: str = error["code"]
        self.field: str = error["field"]
        self.allowed: Any = error["allowed"]


class SessionClosed(PalpateError):
    """The session has ended.

    Parameters
    ----------
    code : int
        Close code of the WebSocket; 1006 if the connection broke.
    reason : str
    """

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(f"the session has ended: {reason or 'no reason given'} ({code})")
        self.code = code
        self.reason = reason


class Session:
    """An open session.

    Parameters
    ----------
    url : str
        Address of the service, such as ``http://127.0.0.1:8000``.
    scene : str
    token : str, optional
        What the service asks for, if it does.
    timeout : float, s
        Longest wait for a reply. A session that could not send in this time cannot be used any
        more.
    record : Path, optional
        File to record the session to, for `palpate replay`; overwritten.

    Attributes
    ----------
    greeting : dict
        What the service said of the scene and of its frames.

    Raises
    ------
    ServiceError
        If the service refuses the session.

    Examples
    --------
    >>> with Session("http://127.0.0.1:8000", "turbinate-tip") as session:      # doctest: +SKIP
    ...     reply = session.step((11.9, 20.0, 11.0))
    ...     print(reply.force, reply.tangent)
    """

    def __init__(
        self,
        url: str,
        scene: str,
        token: str | None = None,
        timeout: float = 10.0,
        record: Path | None = None,
    ) -> None:
        parts = split_address(url)
        self._seq = 0
        self._recorder: Recorder | None = None
        self._received: deque[str | bytes] = deque()
        address = f"ws://{parts.netloc}/scenes/{quote(scene, safe='')}/session"
        self._protocol = ClientProtocol(parse_uri(address), max_size=None)
        self._socket = socket.create_connection((parts.hostname, parts.port or 80), timeout)
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._shake_hands(token)
            self.greeting: dict[str, Any] = json.loads(self._message())
            if record is not None:
                self._recorder = Recorder(record, self.greeting)
        except BaseException:
            self._socket.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def fileno(self) -> int:
        """Return the socket's number, for those who wait for several."""
        return self._socket.fileno()

    def close(self) -> None:
        """End the session."""
        if self._protocol.state is State.OPEN:
            self._protocol.send_close(1000)
            with suppress(OSError):  # it may have ended already
                self._flush()
        self._socket.close()
        if self._recorder is not None:
            self._recorder.close()
            self._recorder = None

    def send(
        self, position: Sequence[float], outputs: int = 0, client_time: float | None = None
    ) -> int:
        """Send a position of the tip; return the number that its reply will have.

        Parameters
        ----------
        position : sequence of 3 floats, mm
        outputs : int
            Bits of `session.frames.Output`.
        client_time : float, s, optional
            Echoed, and the time of visco-elastic tissue. Default: now.
        """
        self._seq = (self._seq + 1) % 2**32
        x, y, z = position
        now = perf_counter() if client_time is None else client_time
        request = Request(self._seq, now, (x, y, z), outputs)
        if self._recorder is not None:
            self._recorder.sent(request)
        self.send_bytes(frames.encode_request(request))
        return self._seq

    def send_bytes(self, frame: bytes) -> None:
        """Send a frame as it is."""
        try:
            self._protocol.send_binary(frame)
            self._flush()
        except (InvalidState, ConnectionError):
            while True:  # until the service's close message, or the end of the connection
                self._take()

    def receive(self) -> Reply:
        """Wait for a reply.

        Raises
        ------
        ServiceError
            If the service could not read a frame.
        SessionClosed
            If the session has ended.
        TimeoutError
        """
        return self._decoded(self._message())

    def poll(self) -> Reply | None:
        """Return a reply if there is one; raise what `receive` raises."""
        if not self._received and select.select([self._socket], [], [], 0)[0]:
            self._take()
        return self.receive() if self._received else None

    def step(
        self, position: Sequence[float], outputs: int = 0, client_time: float | None = None
    ) -> Reply:
        """Send a position and wait for its reply; older replies are dropped. See `send`."""
        seq = self.send(position, outputs, client_time)
        while (reply := self.receive()).seq != seq:
            pass
        return reply

    def snapshot(self, number: int = 0) -> None:
        """Let the service keep the state of the tissue by a number.

        Replies that are still under way are dropped. Raises what `receive` raises.
        """
        self._command({"snapshot": number})

    def restore(self, number: int = 0) -> None:
        """Go back to a state that was kept; see `snapshot`."""
        self._command({"restore": number})

    def _command(self, command: dict[str, int]) -> None:
        """Send a command and wait until the service confirms it by echoing it."""
        self._protocol.send_text(json.dumps(command).encode())
        self._flush()
        while isinstance(message := self._message(), bytes) or json.loads(message) != command:
            self._decoded(message)
        if self._recorder is not None:
            ((name, number),) = command.items()
            self._recorder.obeyed(name == "restore", number)

    def _decoded(self, message: str | bytes) -> Reply:
        """Read a reply, or raise the error that the service sent instead."""
        if isinstance(message, str):
            raise ServiceError(0, json.loads(message)["error"])
        if self._recorder is not None:
            self._recorder.received(message, perf_counter())
        return frames.decode_reply(message)

    def _shake_hands(self, token: str | None) -> None:
        request = self._protocol.connect()
        if token is not None:
            request.headers["Authorization"] = f"Bearer {token}"
        self._protocol.send_request(request)
        self._flush()
        while self._protocol.state is State.CONNECTING and self._protocol.handshake_exc is None:
            self._take()
        if self._protocol.handshake_exc is not None:
            raise _refusal(self._protocol.handshake_exc)

    def _message(self) -> str | bytes:
        """Wait for a message."""
        while not self._received:
            self._take()
        return self._received.popleft()

    def _take(self) -> None:
        """Wait for bytes and sort out the messages in them."""
        if self.fileno() < 0:
            raise SessionClosed(1000, "this client closed it")
        try:
            data = self._socket.recv(1 << 18)
        except ConnectionError:
            data = b""
        if data:
            self._protocol.receive_data(data)
        else:
            self._protocol.receive_eof()
        with suppress(ConnectionError):
            self._flush()  # the protocol has answers to pings and to a close message
        for event in self._protocol.events_received():
            if isinstance(event, Frame) and event.opcode == Opcode.BINARY:
                self._received.append(bytes(event.data))
            elif isinstance(event, Frame) and event.opcode == Opcode.TEXT:
                self._received.append(bytes(event.data).decode())
        if not data and not self._received and self._protocol.handshake_exc is None:
            closed = self._protocol.close_rcvd
            if closed is None:
                raise SessionClosed(1006, "the connection broke")
            raise SessionClosed(closed.code, closed.reason)

    def _flush(self) -> None:
        for data in self._protocol.data_to_send():
            if data:
                self._socket.sendall(data)


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
            return ServiceError(
                error.response.status_code, json.loads(error.response.body)["error"]
            )
    return PalpateError(f"no session: {error}")
