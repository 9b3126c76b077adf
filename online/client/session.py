"""The client's side of a session: positions out, forces in."""

import json
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Any, Self

from palpate.online.client.connection import Connection, ServiceError, scene_path
from palpate.online.session import frames
from palpate.online.session.frames import Reply, Request
from palpate.online.session.recording import Recorder


class Session:
    """An open session of a scene on the service at `url`, which may ask for a `token`.

    The `timeout` (s) is the longest wait for a reply; a session that could not send in this time
    is of no more use. What is sent and answered is recorded to the file `record`, for
    ``palpate replay``. The `greeting` is what the service said of the scene and of its frames.
    Raises `ServiceError` if the service refuses the session.

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
        self._seq = 0
        self._connection = Connection(url, scene_path(scene, "/session"), token, timeout)
        try:
            self.greeting: dict[str, Any] = json.loads(self._connection.receive())
            self._recorder = None if record is None else Recorder(record, self.greeting)
        except BaseException:
            self._connection.socket.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def fileno(self) -> int:
        """Return the socket's number, for those who wait for several."""
        return self._connection.socket.fileno()

    def close(self) -> None:
        """End the session."""
        self._connection.close()
        if self._recorder is not None:
            self._recorder.close()
            self._recorder = None

    def send(
        self, position: Sequence[float], outputs: int = 0, client_time: float | None = None
    ) -> int:
        """Send a position of the tip (mm); return the number that its reply will have.

        `outputs` are bits of `session.frames.Output`. The client's time (s, by default now) is
        echoed, and that of visco-elastic tissue.
        """
        self._seq = (self._seq + 1) % 2**32
        x, y, z = position
        client_time = perf_counter() if client_time is None else client_time
        request = Request(self._seq, client_time, (x, y, z), outputs)
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
        self, position: Sequence[float], outputs: int = 0, client_time: float | None = None
    ) -> Reply:
        """Send a position and wait for its reply; older replies are dropped. See `send`."""
        seq = self.send(position, outputs, client_time)
        while (reply := self.receive()).seq != seq:
            pass
        return reply

    def snapshot(self, number: int = 0) -> None:
        """Let the service keep the state of the tissue; replies still under way are dropped."""
        self._command("snapshot", number)

    def restore(self, number: int = 0) -> None:
        """Go back to a state that was kept; see `snapshot`."""
        self._command("restore", number)

    def _command(self, name: str, number: int) -> None:
        """Send a command and wait until the service confirms it by echoing it."""
        command = {name: number}
        self._connection.send(json.dumps(command))
        while isinstance(message := self._connection.receive(), bytes) or (
            json.loads(message) != command
        ):
            self._decoded(message)
        if self._recorder is not None:
            self._recorder.obeyed(name == "restore", number)

    def _decoded(self, message: str | bytes) -> Reply:
        """Read a reply, or raise the error that the service sent instead."""
        if isinstance(message, str):
            raise ServiceError(0, json.loads(message)["error"])
        if self._recorder is not None:
            self._recorder.received(message, perf_counter())
        return frames.decode_reply(message)
