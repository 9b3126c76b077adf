"""Uvicorn's WebSockets with limits on what a client may send, and a way to close them in order."""

import asyncio
import logging
import socket
from time import perf_counter
from typing import Any

from starlette.websockets import WebSocket
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import CloseCode, Frame
from websockets.http11 import Request

from palpate.online.session.frames import REPLY

logger = logging.getLogger(__name__)

ECHO = "/echo"
"""Path of `echo`, if the service has it."""

STOPPING = 1012
"""Code of the ``websocket.disconnect`` that asks an application to close the connection itself."""

CONNECTION = "palpate.connection"
"""Key of the ASGI scope's extensions: the `SessionProtocol`."""

RECEIVE_BUFFER = 16 * 1024
"""Bytes the system keeps of a client that sends faster; they are parsed in one go."""

SEND_BUFFER = 128 * 1024
"""Bytes the system keeps for a client that does not read: a few replies with fields."""

MOST_FRAMES = 10_000
"""Frames a second: no more messages are read of a client, and more of others cut it off."""

MOST_PARTS = 64
"""Frames that a message may come in; even empty ones take memory until it is whole."""

LINGER = 1.0
"""Seconds a client gets to take what was sent before its connection is cut."""


class SessionProtocol(WebSocketsSansIOProtocol):
    """Uvicorn's, with limits.

    An application can tell whether there is more to read (`queue`), and when the newest message was
    read (`read_at`, s of `time.perf_counter`); what waits in the system's small buffers is recent.
    A service that stops lets its applications answer what they have and close with a reason.
    Closing waits for no client that says nothing or reads nothing, and one that floods the service
    with pings and parts of messages is cut off.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.close_timeout = LINGER
        self.read_at = 0.0
        self.asides, self.asides_since = 0, 0.0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take over a connection."""
        super().connection_made(transport)
        for option, size in (socket.SO_RCVBUF, RECEIVE_BUFFER), (socket.SO_SNDBUF, SEND_BUFFER):
            transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, option, size)

    def data_received(self, data: bytes) -> None:
        """Take what the client sent."""
        self.read_at = perf_counter()
        super().data_received(data)

    def handle_connect(self, event: Request) -> None:
        """Begin a session, if the handshake is right."""
        super().handle_connect(event)
        if self.response.status_code == 101:
            extensions: dict[str, Any] = self.scope["extensions"]
            extensions[CONNECTION] = self

    def send_receive_event_to_app(self) -> None:
        """Pass on a message, unless it says that it is text and is none."""
        if self.curr_msg_data_type == "text":
            try:
                b"".join(self.frames).decode()
            except UnicodeDecodeError:
                self.conn.fail(CloseCode.INVALID_DATA, "not UTF-8")
                self.handle_parser_exception()
                return
        super().send_receive_event_to_app()

    def handle_parser_exception(self) -> None:
        """End a connection whose bytes mean nothing; before a handshake nobody is told."""
        if self.conn.close_sent is None:
            self.transport.close()
        else:
            super().handle_parser_exception()
            self.disconnected = True  # what the application still sends goes nowhere

    def handle_ping(self) -> None:
        """Answer a ping, unless the answers to those before pile up here."""
        if not self.writable.is_set():
            self.cut_off("it leaves the answers to its pings unread")
        elif self.is_bearable():
            super().handle_ping()

    def handle_pong(self, event: Frame) -> None:
        """Take a pong."""
        if self.is_bearable():
            super().handle_pong(event)

    def handle_cont(self, event: Frame) -> None:
        """Take a further part of a message."""
        if len(self.frames) >= MOST_PARTS:
            self.cut_off(f"it sends a message in more than {MOST_PARTS} parts")
        elif self.is_bearable():
            super().handle_cont(event)

    def is_bearable(self) -> bool:
        """Count a frame that is no message; cut the client off if there are too many a second."""
        if self.read_at - self.asides_since >= 1.0:
            self.asides, self.asides_since = 0, self.read_at
        self.asides += 1
        if self.asides > MOST_FRAMES:
            self.cut_off("it floods the service with frames that are no messages")
        return not self.transport.is_closing()

    def cut_off(self, why: str) -> None:
        """End the connection at once, whatever else has been read of it."""
        if not self.transport.is_closing():
            logger.warning("a client is cut off: %s", why)
            self.transport.abort()

    def shutdown(self) -> None:
        """Ask the application to end the connection."""
        if self.close_sent or not self.handshake_complete:
            super().shutdown()
        else:
            self.queue.put_nowait({"type": "websocket.disconnect", "code": STOPPING})
            self.loop.call_later(LINGER, self.transport.abort)

    async def send(self, message: Any) -> None:
        """Send a message of the application; a refusal is none of its errors, nor logged as one."""
        await super().send(message)
        if message["type"] == "websocket.http.response.body":
            self.handshake_complete = True

    def on_task_complete(self, task: asyncio.Task[None]) -> None:
        """Forget the application and, soon, its client."""
        super().on_task_complete(task)
        self.loop.call_later(LINGER, self.transport.abort)


async def echo(client: WebSocket) -> None:
    """Answer frames with empty replies of their number: what a WebSocket costs by itself."""
    await client.accept()
    await client.send_text("{}")
    rest = bytes(REPLY.itemsize - 8)
    async for frame in client.iter_bytes():
        await client.send_bytes(bytes(4) + frame[4:8] + rest)


OPTIONS: dict[str, Any] = {
    "ws": SessionProtocol,
    # deflating a frame takes longer than solving it
    "ws_per_message_deflate": False,
    # sessions watch for silent clients themselves
    "ws_ping_interval": None,
    "ws_max_size": 4096,
    # what is not over then is cut; the whole shutdown must fit into five seconds
    "timeout_graceful_shutdown": 3,
    # who a client is only its connection tells
    "proxy_headers": False,
}
"""Options of `uvicorn.Config` that sessions and limits rely on."""
