"""Uvicorn's WebSockets, bounded: what a client may pile up here, and how it is told to go."""

import asyncio
import socket
from time import perf_counter
from typing import Any

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.http11 import Request

STOPPING = 1012
"""Code of the ``websocket.disconnect`` that asks an application to say goodbye itself."""

PENDING = "palpate.pending"
"""Key of the ASGI scope's extensions: a function that tells whether a message can be received
without waiting."""

READ_AT = "palpate.read_at"
"""Key of the ASGI scope's extensions: a function that tells when the newest message was read, s of
`time.perf_counter`."""

RECEIVE_BUFFER = 16 * 1024
"""Bytes the system keeps for a client that sends faster than it is read.

All of them are parsed in one go, some microseconds for every small frame, while others wait.
"""

SEND_BUFFER = 128 * 1024
"""Bytes the system keeps for a client that does not read: a few replies with fields."""

LINGER = 1.0
"""Seconds a client gets to take what was sent before its connection is cut."""


class Protocol(WebSocketsSansIOProtocol):
    """Like uvicorn's, but for seven things.

    An application can tell whether there is more to read, and when it was read. The system's
    buffers are small, so that what waits in them is recent. A service that stops lets its
    applications answer what they have and close with a reason. Closing does not wait long for a
    client that says nothing. A connection whose application has ended is cut even if its client
    never reads what is left. A refusal is no error of the application, and not logged as one.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.close_timeout = LINGER
        self.read_at = 0.0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take over a connection."""
        super().connection_made(transport)
        connection = transport.get_extra_info("socket")
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)

    def data_received(self, data: bytes) -> None:
        """Take what the client sent."""
        self.read_at = perf_counter()
        super().data_received(data)

    def handle_connect(self, event: Request) -> None:
        """Begin a session, if the handshake is right."""
        super().handle_connect(event)
        if self.response.status_code == 101:
            extensions: dict[str, Any] = self.scope["extensions"]
            extensions[PENDING] = lambda: not self.queue.empty()
            extensions[READ_AT] = lambda: self.read_at

    def shutdown(self) -> None:
        """Ask the application to end the connection."""
        if self.close_sent or not self.handshake_complete:
            super().shutdown()
        else:
            self.queue.put_nowait({"type": "websocket.disconnect", "code": STOPPING})
            self.loop.call_later(LINGER, self.transport.abort)

    async def send(self, message: Any) -> None:
        """Send a message of the application."""
        await super().send(message)
        if message["type"] == "websocket.http.response.body":
            self.handshake_complete = True

    def on_task_complete(self, task: asyncio.Task[None]) -> None:
        """Forget the application and, soon, its client."""
        super().on_task_complete(task)
        self.loop.call_later(LINGER, self.transport.abort)


OPTIONS: dict[str, Any] = {
    "ws": Protocol,
    # deflating a frame takes longer than solving it
    "ws_per_message_deflate": False,
    # sessions watch for silent clients themselves
    "ws_ping_interval": None,
    "ws_max_size": 4096,
    # what is not over then is cut; the whole shutdown must fit into five seconds
    "timeout_graceful_shutdown": 3,
}
"""Options of `uvicorn.Config` that sessions rely on."""
