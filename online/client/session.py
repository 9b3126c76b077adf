"""The client's side of a session: positions out, forces in.

`Session` keeps to one thread and one socket, for loops that wait for each reply or spin until it is
there (`Session.poll`); `AsyncSession` is for asyncio. Both speak binary frames.
"""

import asyncio
import json
import select
import socket
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from time import perf_counter
from types import TracebackType
from typing import Any, Self
from urllib.parse import quote, urlsplit

from websockets.asyncio.client import ClientConnection, connect
from websockets.client import ClientProtocol
from websockets.exceptions import ConnectionClosed, InvalidState, InvalidStatus
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
        Of the WebSocket; 1006 if the connection broke.
    reason : str
    """

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(f"the session has ended: {reason or 'no reason given'} ({code})")
        self.code = code
        self.reason = reason


class _Dialogue:
    """What both kinds of session do alike: numbers, frames, recording."""

    hello: dict[str, Any]

    def __init__(self, record: Path | None) -> None:
        self._seq = 0
        self._record = record
        self._recorder: Recorder | None = None

    def _begin(self, message: str | bytes) -> None:
        self.hello = json.loads(message)
        if self._record is not None:
            self._recorder = Recorder(self._record, self.hello)

    def _ask(
        self, position: Sequence[float], outputs: int, client_time: float | None
    ) -> tuple[int, bytes]:
        """Make the next frame: its number and its bytes."""
        self._seq = (self._seq + 1) % 2**32
        x, y, z = position
        now = perf_counter() if client_time is None else client_time
        request = Request(self._seq, now, (x, y, z), outputs)
        if self._recorder is not None:
            self._recorder.sent(request)
        return self._seq, frames.encode_request(request)

    def _understand(self, message: str | bytes) -> Reply:
        """Make a reply of a message of the service, or raise its complaint."""
        if isinstance(message, str):
            raise ServiceError(0, json.loads(message)["error"])
        if self._recorder is not None:
            self._recorder.received(message, perf_counter())
        return frames.decode_reply(message)

    def _confirmed(self, message: str | bytes, command: dict[str, int]) -> bool:
        """Whether a message confirms a command; raise a complaint, note other replies."""
        if isinstance(message, bytes):
            self._understand(message)
            return False
        document = json.loads(message)
        if document != command:
            raise ServiceError(0, document["error"])
        if self._recorder is not None:
            ((name, number),) = command.items()
            self._recorder.obeyed(name == "restore", number)
        return True

    def _end(self) -> None:
        if self._recorder is not None:
            self._recorder.close()
            self._recorder = None


class Session(_Dialogue):
    """An open session.

    Parameters
    ----------
    url : str
        Of the service, such as ``http://127.0.0.1:8000``.
    scene : str
    token : str, optional
        What the service asks for, if it does.
    timeout : float, s
        Longest wait for a reply. A session that could not send in this time is of no more use.
    record : Path, optional
        File to record the session to, for `palpate replay`; overwritten.

    Attributes
    ----------
    hello : dict
        What the service said of the scene and of its frames.

    Raises
    ------
    ServiceError
        If the service refuses the session.

    Examples
    --------
    >>> with Session("http://127.0.0.1:8000", "turbinate") as session:      # doctest: +SKIP
    ...     reply = session.step((13.1, 20.0, 11.4))
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
        super().__init__(record)
        address, parts = _address(url, scene), urlsplit(url)
        self._received: deque[str | bytes] = deque()
        self._protocol = ClientProtocol(parse_uri(address), max_size=None)
        self._socket = socket.create_connection((parts.hostname, parts.port or 80), timeout)
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._shake_hands(token)
            self._begin(self._message())
        except BaseException:
            self._socket.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def fileno(self) -> int:
        """Tell the socket's number, for those who wait for several."""
        return self._socket.fileno()

    def close(self) -> None:
        """End the session."""
        if self._protocol.state is State.OPEN:
            self._protocol.send_close(1000)
            with suppress(OSError):  # it may have ended already
                self._flush()
        self._socket.close()
        self._end()

    def send(
        self, position: Sequence[float], outputs: int = 0, client_time: float | None = None
    ) -> int:
        """Send a position of the tip (mm); return the number that its reply will have.

        Parameters
        ----------
        position : sequence of 3 floats, mm
        outputs : int
            Bits of `session.frames.Output`.
        client_time : float, s, optional
            Echoed; now, by default.
        """
        seq, frame = self._ask(position, outputs, client_time)
        self.send_bytes(frame)
        return seq

    def send_bytes(self, frame: bytes) -> None:
        """Send a frame as it is."""
        try:
            self._protocol.send_binary(frame)
            self._flush()
        except (InvalidState, ConnectionError):
            while True:  # until the service's last word, or the end of the line
                self._take()

    def receive(self) -> Reply:
        """Wait for a reply.

        Raises
        ------
        ServiceError
            If the service could make nothing of a frame.
        SessionClosed
            If the session has ended.
        TimeoutError
        """
        return self._understand(self._message())

    def poll(self) -> Reply | None:
        """Return a reply if there is one; raise what `receive` raises."""
        if not self._received and select.select([self._socket], [], [], 0)[0]:
            self._take()
        return self.receive() if self._received else None

    def step(self, position: Sequence[float], outputs: int = 0) -> Reply:
        """Send a position and wait for its reply; older ones are dropped."""
        seq = self.send(position, outputs)
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
        self._protocol.send_text(json.dumps(command).encode())
        self._flush()
        while not self._confirmed(self._message(), command):
            pass

    def _shake_hands(self, token: str | None) -> None:
        request = self._protocol.connect()
        if token is not None:
            request.headers["Authorization"] = f"Bearer {token}"
        self._protocol.send_request(request)
        self._flush()
        while self._protocol.state.name == "CONNECTING" and self._protocol.handshake_exc is None:
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
        try:
            data = self._socket.recv(1 << 18)
        except ConnectionError:
            data = b""
        if data:
            self._protocol.receive_data(data)
        else:
            self._protocol.receive_eof()
        with suppress(ConnectionError):
            self._flush()  # the protocol has answers to pings and to a farewell
        for event in self._protocol.events_received():
            if isinstance(event, Frame) and event.opcode == Opcode.BINARY:
                self._received.append(bytes(event.data))
            elif isinstance(event, Frame) and event.opcode == Opcode.TEXT:
                self._received.append(bytes(event.data).decode())
        if not data and not self._received and self._protocol.handshake_exc is None:
            farewell = self._protocol.close_rcvd
            if farewell is None:
                raise SessionClosed(1006, "the connection broke")
            raise SessionClosed(farewell.code, farewell.reason)

    def _flush(self) -> None:
        for data in self._protocol.data_to_send():
            if data:
                self._socket.sendall(data)


class AsyncSession(_Dialogue):
    """A session for asyncio; opened by ``async with``. For parameters and errors see `Session`."""

    def __init__(
        self,
        url: str,
        scene: str,
        token: str | None = None,
        timeout: float = 10.0,
        record: Path | None = None,
    ) -> None:
        super().__init__(record)
        self._timeout = timeout
        self._connecting = connect(
            _address(url, scene),
            additional_headers={} if token is None else {"Authorization": f"Bearer {token}"},
            compression=None,
            max_size=None,
            ping_interval=None,
            open_timeout=timeout,
            close_timeout=timeout,
            proxy=None,
        )

    async def __aenter__(self) -> Self:
        try:
            self._connection: ClientConnection = await self._connecting
        except InvalidStatus as error:
            raise _refusal(error) from None
        try:
            self._begin(await self._message())
        except BaseException:
            await self._connection.close()
            raise
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            await self._connection.close()
        finally:
            self._end()

    async def send(
        self, position: Sequence[float], outputs: int = 0, client_time: float | None = None
    ) -> int:
        """Send a position; see `Session.send`."""
        seq, frame = self._ask(position, outputs, client_time)
        try:
            await self._connection.send(frame)
        except ConnectionClosed as error:
            raise _ending(error) from None
        return seq

    async def receive(self) -> Reply:
        """Wait for a reply; see `Session.receive`."""
        return self._understand(await self._message())

    async def step(self, position: Sequence[float], outputs: int = 0) -> Reply:
        """Send a position and wait for its reply; older ones are dropped."""
        seq = await self.send(position, outputs)
        while (reply := await self.receive()).seq != seq:
            pass
        return reply

    async def snapshot(self, number: int = 0) -> None:
        """Keep the state of the tissue; see `Session.snapshot`."""
        await self._command({"snapshot": number})

    async def restore(self, number: int = 0) -> None:
        """Go back to a state that was kept; see `Session.restore`."""
        await self._command({"restore": number})

    async def _command(self, command: dict[str, int]) -> None:
        try:
            await self._connection.send(json.dumps(command))
        except ConnectionClosed as error:
            raise _ending(error) from None
        while not self._confirmed(await self._message(), command):
            pass

    async def _message(self) -> str | bytes:
        try:
            async with asyncio.timeout(self._timeout):
                return await self._connection.recv()
        except ConnectionClosed as error:
            raise _ending(error) from None


def _address(url: str, scene: str) -> str:
    parts = urlsplit(url)
    if parts.scheme != "http" or parts.hostname is None:
        raise PalpateError(f"{url}: not an address like http://127.0.0.1:8000")
    return f"ws://{parts.netloc}/scenes/{quote(scene, safe='')}/session"


def _refusal(error: Exception) -> PalpateError:
    """Make an error of a handshake that failed."""
    if isinstance(error, InvalidStatus) and error.response.body:
        try:
            return ServiceError(
                error.response.status_code, json.loads(error.response.body)["error"]
            )
        except (ValueError, KeyError):
            pass
    return PalpateError(f"no session: {error}")


def _ending(error: ConnectionClosed) -> SessionClosed:
    if error.rcvd is None:
        return SessionClosed(1006, "the connection broke")
    return SessionClosed(error.rcvd.code, error.rcvd.reason)
