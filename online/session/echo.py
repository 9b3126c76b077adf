"""What a WebSocket costs by itself: frames of a session's sizes, answered without a thought."""

from starlette.types import Receive, Scope, Send

from palpate.online.session.frames import REPLY

ECHO = "/echo"
"""Where it answers, if it does."""


class Echo:
    """The ASGI application that answers every message with as many bytes as a reply has."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer until the client goes."""
        reply = bytes(REPLY.itemsize)
        await receive()
        await send({"type": "websocket.accept"})
        while (await receive())["type"] == "websocket.receive":
            await send({"type": "websocket.send", "bytes": reply})
