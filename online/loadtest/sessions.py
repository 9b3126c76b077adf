"""Sessions as a stream of load: WebSocket frames on a bare socket, written before the test starts.

Of a WebSocket library we would measure the library.
"""

import base64
import os
import socket
import struct
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from palpate.online.loadtest.generator import ANSWERED, CHUNK, SUPERSEDED, Log
from palpate.online.loadtest.target import Target
from palpate.online.session.frames import REPLY, REQUEST, VERSION
from palpate.shared.errors import PalpateError

_TEXT, _BINARY, _CLOSE, _PING, _PONG = 1, 2, 8, 9, 10
_FINAL, _MASKED = 0x80, 0x80


def _offset(name: str) -> int:
    assert REPLY.fields is not None
    return int(REPLY.fields[name][1])


_FLAGS_SEQ = struct.Struct("<HI")
_SOLVE_TIME = struct.Struct("<f")
_SUPERSEDED = struct.Struct("<I")
_AT_FLAGS, _AT_SOLVE_TIME, _AT_SUPERSEDED = map(_offset, ("flags", "solve_time", "superseded"))
assert _offset("seq") == _AT_FLAGS + 2


class Session:
    """One session that sends its positions when they are due.

    Parameters
    ----------
    target : Target
    due : ndarray, shape (n,), s
    positions : ndarray, shape (n, 3), mm
    outputs : int
        Bits of `session.frames.Output`.

    Attributes
    ----------
    complaint : str
        What the server said last that was no answer.
    """

    def __init__(
        self,
        target: Target,
        due: NDArray[np.float64],
        positions: NDArray[np.float64],
        outputs: int = 0,
    ) -> None:
        self.log = Log(due)
        self.complaint = ""
        self._messages = _messages(due, positions, outputs)
        self._size = len(self._messages) // len(due)
        self._unsent = b""
        self._last_sent = self._last_answered = -1
        self._open = True
        self._socket, self._received = _open(target)
        self.sockets: Sequence[socket.socket] = (self._socket,)
        self._socket.setblocking(False)

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

    def receive(self, connection: socket.socket, now: int) -> bool:
        """Take replies; tell whether the session is still open."""
        try:
            chunk = connection.recv(CHUNK)
        except BlockingIOError:
            return True
        except OSError as error:
            self._close(f"the connection broke: {error.strerror}")
            return False
        if not chunk:
            self._close("the service hung up")
            return False
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
        flags, number = _FLAGS_SEQ.unpack_from(received, begin + _AT_FLAGS)
        log = self.log
        log.received[number] = now
        log.outcome[number] = ANSWERED
        log.flags[number] = flags
        log.solve_us[number] = 1e6 * _SOLVE_TIME.unpack_from(received, begin + _AT_SOLVE_TIME)[0]
        (superseded,) = _SUPERSEDED.unpack_from(received, begin + _AT_SUPERSEDED)
        for dropped in range(max(number - superseded, self._last_answered + 1), number):
            log.outcome[dropped] = SUPERSEDED
        self._last_answered = number

    def _control(self, opcode: int, payload: bytes) -> None:
        if opcode == _PING:
            self._push(self._unsent + _message(_PONG, payload))
        elif opcode == _CLOSE:
            self._close(payload[2:].decode() or "the service ended the session")
        elif opcode == _TEXT:
            self.complaint = payload.decode()

    def _push(self, message: bytes) -> None:
        """Send what the socket takes and keep the rest."""
        try:
            sent = self._socket.send(message)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            self._close(f"the connection broke: {error.strerror}")
            return
        self._unsent = message[sent:]

    def _close(self, reason: str) -> None:
        self._open = False
        self.complaint = reason

    def close(self) -> None:
        """Hang up, with a word if there is anybody to hear it."""
        if self._open:
            self._push(self._unsent + _message(_CLOSE, struct.pack("!H", 1000)))
        self._socket.close()


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


def _open(target: Target) -> tuple[socket.socket, bytes]:
    """Open a session and wait for its hello; returns the socket and what came after that."""
    connection = target.connect()
    try:
        return connection, _shake_hands(connection, target)
    except BaseException:
        connection.close()
        raise


def _shake_hands(connection: socket.socket, target: Target) -> bytes:
    head = target.head(
        "GET",
        "session",
        connection="upgrade",
        upgrade="websocket",
        sec_websocket_version="13",
        sec_websocket_key=base64.b64encode(os.urandom(16)).decode(),
    )
    connection.sendall(f"{head}\r\n".encode())
    received = b""
    while b"\r\n\r\n" not in received:
        received += _more(connection)
    answer, _, received = received.partition(b"\r\n\r\n")
    if not answer.startswith(b"HTTP/1.1 101"):
        raise PalpateError(f"no session: {answer.decode('latin-1').splitlines()[0]} {received!r}")
    while (hello := _frame(received, 0, len(received))) is None:
        received += _more(connection)
    if hello[0] != _TEXT:
        raise PalpateError("the session does not begin with a hello")
    return received[hello[2] :]


def _more(connection: socket.socket) -> bytes:
    chunk = connection.recv(CHUNK)
    if not chunk:
        raise PalpateError("the service closed the connection")
    return chunk
