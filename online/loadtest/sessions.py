"""Sessions as a stream of load: WebSocket frames on a bare socket, written before the test starts.

With a WebSocket library the library would be measured too.
"""

import socket
import struct

import numpy as np
from numpy.typing import NDArray

from palpate.online.loadtest.generator import ANSWERED, SUPERSEDED, Stream
from palpate.online.session.frames import REPLY, REQUEST, VERSION

_TEXT, _BINARY, _CLOSE, _PING, _PONG = 1, 2, 8, 9, 10
_FINAL, _MASKED = 0x80, 0x80

_OFFSETS = {name: int(field[1]) for name, field in (REPLY.fields or {}).items()}
_SOLVED, _DROPPED = _OFFSETS["solve_time"], _OFFSETS["superseded"]
_NEWS = struct.Struct(f"<2xHI{_SOLVED - 8}xf{_DROPPED - _SOLVED - 4}xI")
"""Flags, number, solve_time and superseded of a reply."""


class FrameStream(Stream):
    """A session, or an echo, that is sent positions (n, 3) mm when they are due (n,) s.

    Its socket is one whose greeting was read; outputs are bits of `session.frames.Output`.
    """

    def __init__(
        self,
        connection: socket.socket,
        due: NDArray[np.float64],
        positions: NDArray[np.float64],
        outputs: int = 0,
    ) -> None:
        super().__init__(due, [connection])
        self._socket = connection
        self._messages = _messages(due, positions, outputs)
        self._size = len(self._messages) // len(due)
        self._received = self._unsent = b""
        self._last_sent = self._last_answered = -1
        self._open = True

    @property
    def waiting(self) -> bool:
        """Whether the last frame sent has no answer yet."""
        return self._open and self._last_answered < self._last_sent

    def send(self, number: int, now: int) -> None:
        """Send a frame."""
        if not self._open:
            return
        self.log.sent[number] = now
        self._last_sent = number
        message = self._messages[number * self._size : (number + 1) * self._size]
        self._push(self._unsent + message if self._unsent else message)

    def take(self, connection: socket.socket, chunk: bytes, now: int) -> bool:
        """Take replies; tell whether the session is still open."""
        received = self._received + chunk if self._received else chunk
        start, end = 0, len(received)
        while (frame := _frame(received, start, end)) is not None:
            opcode, begin, start = frame
            if opcode == _BINARY:
                self._record(received, begin, now)
            else:
                self._control(opcode, received[begin:start])
        self._received = received[start:]
        if self._unsent:
            self._push(self._unsent)
        return self._open

    def _record(self, received: bytes, begin: int, now: int) -> None:
        flags, number, solve_time, superseded = _NEWS.unpack_from(received, begin)
        log = self.log
        log.received[number] = now
        log.outcome[number] = ANSWERED
        log.flags[number] = flags
        log.solve[number] = 1e6 * solve_time
        for dropped in range(max(number - superseded, self._last_answered + 1), number):
            log.outcome[dropped] = SUPERSEDED
        self._last_answered = number

    def _control(self, opcode: int, payload: bytes) -> None:
        if opcode == _PING:
            self._push(self._unsent + _message(_PONG, payload))
        elif opcode == _CLOSE:
            self.lose(self._socket, payload[2:].decode() or "the service ended the session")
        elif opcode == _TEXT:
            self.complaint = payload.decode()

    def _push(self, message: bytes) -> None:
        """Send what the socket takes and keep the rest."""
        try:
            sent = self._socket.send(message)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            self.lose(self._socket, f"the connection broke: {error.strerror}")
            return
        self._unsent = message[sent:]

    def lose(self, connection: socket.socket, why: str) -> bool:
        """End the session."""
        self._open = False
        return super().lose(connection, why)

    def close(self) -> None:
        """Hang up, with a close message if there is anybody to hear it."""
        if self._open:
            self._push(self._unsent + _message(_CLOSE, struct.pack("!H", 1000)))
        super().close()


def _messages(due: NDArray[np.float64], positions: NDArray[np.float64], outputs: int) -> bytes:
    """Write all frames of a session, of equal length."""
    head = _message(_BINARY, bytes(REQUEST.itemsize))[: -REQUEST.itemsize]
    messages = np.zeros(len(due), [("head", f"V{len(head)}"), ("frame", REQUEST)])
    messages["head"] = np.void(head)
    frame = messages["frame"]
    frame["version"], frame["outputs"] = VERSION, outputs
    frame["seq"], frame["client_time"], frame["position"] = np.arange(len(due)), due, positions
    return messages.tobytes()


def _message(opcode: int, payload: bytes) -> bytes:
    """Write a WebSocket frame of a client with up to 125 bytes (RFC 6455, section 5.2).

    The mask that clients owe is all zeros, so it changes nothing.
    """
    return bytes((_FINAL | opcode, _MASKED | len(payload), 0, 0, 0, 0)) + payload


def _frame(received: bytes, start: int, end: int) -> tuple[int, int, int] | None:
    """Find a server's frame: its opcode, where its payload begins and where it ends."""
    if end - start < 2:
        return None
    length, begin = received[start + 1], start + 2
    if length == 126:
        length, begin = int.from_bytes(received[begin : begin + 2], "big"), begin + 2
    elif length == 127:
        length, begin = int.from_bytes(received[begin : begin + 8], "big"), begin + 8
    if begin + length > end:
        return None
    return received[start] & 0x0F, begin, begin + length
