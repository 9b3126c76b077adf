"""The client's side of a session: positions out, forces in.

On one thread and one socket, for loops that wait or spin.
"""

import json
import select
import socket
import ssl
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from time import perf_counter, sleep
from typing import TYPE_CHECKING, Any, Self
from urllib.parse import SplitResult, quote, urlsplit

from websockets.client import ClientProtocol
from websockets.exceptions import InvalidState, InvalidStatus
from websockets.frames import Close, Frame, Opcode
from websockets.protocol import State
from websockets.uri import parse_uri

from palpate.online.session import frames
from palpate.online.session.frames import Reply, Request
from palpate.shared.errors import PalpateError

if TYPE_CHECKING:
    from palpate.online.session.recording import Recorder

LOST = {1001, 1006, 4000}
"""Codes of ends that a new session helps against: of the service, the connection, the patience."""

SHORTEST_PAUSE, LONGEST_PAUSE = 0.05, 2.0
"""Seconds between attempts to connect again; each is twice the one before."""

BUSY = {429, 503}
"""Statuses of refusals that may pass."""


class ServiceError(PalpateError):
    """The service refused a request, for the `error` it sent.

    The `status` is that of HTTP; 0 for a message in a session, which goes on.
    """

    def __init__(self, status: int, error: dict[str, Any]) -> None:
        self.status = status
        self.code: str = error["code"]
        self.field: str = error["field"]
        self.allowed: Any = error["allowed"]
        message = f"{self.field}: {error['message']}" if self.field else error["message"]
        super().__init__(f"{message}; allowed: {self.allowed}" if self.allowed else message)


class SessionClosed(PalpateError):
    """The session has ended, with a code of its WebSocket; 1006 if the connection broke."""

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(f"the session has ended: {reason or 'no reason given'} ({code})")
        self.code, self.reason = code, reason


CLOSED = "this client closed it"


class Connection:
    """An open WebSocket at a path of a service; `ServiceError` if the handshake is refused."""

    def __init__(self, url: str, path: str, token: str | None, timeout: float) -> None:
        parts = split_address(url)
        address = f"{'wss' if parts.scheme == 'https' else 'ws'}://{parts.netloc}{path}"
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
        if not self._received:
            decrypted = isinstance(self.socket, ssl.SSLSocket) and self.socket.pending() > 0
            if self.closed or decrypted or select.select([self.socket], [], [], 0)[0]:
                self._take()
        return bool(self._received)

    @property
    def closed(self) -> bool:
        """Whether this client has closed it."""
        return self.socket.fileno() < 0

    def flush(self) -> None:
        """Send what the protocol has to say."""
        self.socket.sendall(b"".join(self.protocol.data_to_send()))

    def _take(self) -> None:
        """Wait for bytes and sort out the messages in them."""
        if self.closed:
            raise SessionClosed(1000, CLOSED)
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
            if isinstance(event, Frame) and event.opcode is Opcode.BINARY:
                self._received.append(bytes(event.data))
            elif isinstance(event, Frame) and event.opcode is Opcode.TEXT:
                self._received.append(bytes(event.data).decode())
        if not data and not self._received and self.protocol.handshake_exc is None:
            closed = self.protocol.close_rcvd or Close(1006, "the connection broke")
            raise SessionClosed(closed.code, closed.reason)


def connect(url: str, timeout: float) -> socket.socket:
    """Open a connection to a service that sends at once whatever it is given."""
    parts = split_address(url)
    safe = parts.scheme == "https"
    try:
        connection = socket.create_connection(
            (parts.hostname, parts.port or (443 if safe else 80)), timeout
        )
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if safe:
            return secure().wrap_socket(connection, server_hostname=parts.hostname)
    except OSError as error:
        raise no_service(url, error) from error
    return connection


@cache
def secure() -> ssl.SSLContext:
    """What is believed of services by https: the system's authorities, or ``SSL_CERT_FILE``'s."""
    return ssl.create_default_context()


def no_service(url: str, error: Exception) -> PalpateError:
    """Make the error of a service that cannot be reached."""
    if isinstance(error, ConnectionRefusedError):
        return PalpateError(f"{url}: no service answers there")
    return PalpateError(f"{url}: {error or type(error).__name__}")


def scene_path(scene: str, rest: str = "") -> str:
    """Return the path of a scene on a service, or of something in it, such as ``/solve``."""
    return f"/scenes/{quote(scene, safe='')}{rest}"


def split_address(url: str) -> SplitResult:
    """Split the address of a service; raise `PalpateError` for what is none."""
    with suppress(ValueError):  # of a port that is none
        parts = urlsplit(url)
        usable = parts.scheme in ("http", "https") and parts.port != 0
        if usable and parts.hostname and parts.hostname.isascii() and parts.hostname.isprintable():
            return parts
    raise PalpateError(f"{url}: not an address like http://127.0.0.1:8000")


def refusal(status: int, body: bytes) -> PalpateError:
    """Make the error of a response other than the one asked for."""
    with suppress(ValueError, KeyError, TypeError):
        return ServiceError(status, json.loads(body)["error"])
    return PalpateError(f"the service says {status}, which is none of its own refusals")


def _refusal(error: Exception) -> PalpateError:
    """Make an error of a handshake that failed."""
    if isinstance(error, InvalidStatus):
        return refusal(error.response.status_code, bytes(error.response.body or b""))
    return PalpateError(f"no session: {error}")


def _recorder(path: Path, greeting: dict[str, Any]) -> "Recorder":
    from palpate.online.session.recording import Recorder  # HDF5 is for those who record

    return Recorder(path, greeting)


class Session:
    """An open session of a scene on the service at `url`, which may ask for a `token`.

    The `timeout` (s) is the longest wait for a reply; a session that could not send in this time
    is of no more use. What is sent and answered is recorded to the file `record`, for
    ``palpate replay``; once the disk is full the session goes on unrecorded: a warning is logged,
    what was written can be replayed, and `close` raises `PalpateError`. The `greeting` is what the
    service said of the scene and of its frames. Raises `ServiceError` if the service refuses the
    session.

    With `reconnect` (s) a `step` that finds its session lost begins another one and goes on; no
    attempt is made later than that. The tissue is at rest then and snapshots are gone: the answer
    is `Reply.first`, and `reconnections` counts.

    Examples
    --------
    >>> with Session("http://127.0.0.1:8000", "turbinate") as session:      # doctest: +SKIP
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
        reconnect: float = 0.0,
    ) -> None:
        self._open = partial(Connection, url, scene_path(scene, "/session"), token, timeout)
        self._seq, self._patience, self.reconnections = 0, reconnect, 0
        self._connection, self.greeting = self._begin()
        try:
            self._recorder = None if record is None else _recorder(record, self.greeting)
        except BaseException:
            self._connection.socket.close()
            raise

    def _begin(self) -> tuple[Connection, dict[str, Any]]:
        """Connect and be greeted."""
        connection = self._open()
        try:
            return connection, json.loads(connection.receive())
        except BaseException:
            connection.socket.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def fileno(self) -> int:
        """Return the socket's number, for those who wait for several; `reconnect` changes it."""
        return self._connection.socket.fileno()

    def close(self) -> None:
        """End the session; raise `PalpateError` if it could not be recorded to its end."""
        self._connection.close()
        recorder, self._recorder = self._recorder, None
        if recorder is not None:
            recorder.close()

    def send(
        self,
        position: Sequence[float],
        outputs: int | Sequence[str] = 0,
        client_time: float | None = None,
    ) -> int:
        """Send a position of the tip (mm); return the number that its reply will have.

        `outputs` are bits of `session.frames.Output`, or their names, such as ``stress``. The
        client's time (s, by default now) is echoed, and that of visco-elastic tissue.
        """
        self._seq = (self._seq + 1) % 2**32
        x, y, z = position
        client_time = perf_counter() if client_time is None else client_time
        request = Request(self._seq, client_time, (x, y, z), frames.output_bits(outputs))
        if self._recorder is not None:
            self._recorder.sent(request)
        self._connection.send(frames.encode_request(request))
        return self._seq

    def receive(self) -> Reply:
        """Wait for a reply; raise `ServiceError`, `SessionClosed` or `TimeoutError`."""
        return self._decoded(self._connection.receive())

    def poll(self) -> Reply | None:
        """Return a reply if there is one; raise what `receive` raises."""
        return self.receive() if self._connection.poll() else None

    def step(
        self,
        position: Sequence[float],
        outputs: int | Sequence[str] = 0,
        client_time: float | None = None,
    ) -> Reply:
        """Send a position and wait for its reply; older replies are dropped. See `send`."""
        try:
            return self._step(position, outputs, client_time)
        except SessionClosed as closed:
            if not self._patience or closed.code not in LOST:
                raise
        self.reconnect()
        return self._step(position, outputs, client_time)

    def _step(
        self, position: Sequence[float], outputs: int | Sequence[str], client_time: float | None
    ) -> Reply:
        seq = self.send(position, outputs, client_time)
        while (reply := self.receive()).seq != seq:
            pass
        return reply

    def reconnect(self) -> None:
        """Begin another session, as `step` does, for who sends and receives without it.

        Raises what the last attempt did; `step` may then be called again. Who has closed a session
        gets no other: `SessionClosed`.
        """
        if self._connection.closed:
            raise SessionClosed(1000, CLOSED)
        end, pause, lost = perf_counter() + self._patience, SHORTEST_PAUSE, self._connection.socket
        while True:
            try:
                self._connection, self.greeting = self._begin()
                break
            except (PalpateError, OSError) as error:
                refused = isinstance(error, ServiceError) and error.status not in BUSY
                if refused or perf_counter() + pause > end:
                    raise
            sleep(pause)
            pause = min(2.0 * pause, LONGEST_PAUSE)
        lost.close()
        self.reconnections += 1

    def snapshot(self, number: int = 0) -> None:
        """Let the service keep the state of the tissue; replies still under way are dropped."""
        self._command("snapshot", number)

    def restore(self, number: int = 0) -> None:
        """Go back to a state that was kept; see `snapshot`."""
        self._command("restore", number)

    def young(self, young: float) -> None:
        """Give the tissue another Young's modulus, kPa, from the next position on."""
        self._command("young", float(young))

    def _command(self, name: str, value: float) -> None:
        """Send a command and wait until the service confirms it by echoing it."""
        command = {name: value}
        self._connection.send(json.dumps(command))
        while isinstance(message := self._connection.receive(), bytes) or (
            json.loads(message) != command
        ):
            self._decoded(message)
        if self._recorder is not None:
            self._recorder.obeyed(name, value)

    def _decoded(self, message: str | bytes) -> Reply:
        """Read a reply, or raise the error that the service sent instead."""
        if isinstance(message, str):
            raise ServiceError(0, json.loads(message)["error"])
        if self._recorder is not None:
            self._recorder.received(message, perf_counter())
        return frames.decode_reply(message)
