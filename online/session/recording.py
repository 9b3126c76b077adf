"""The positions of a tool and the answers to them, in a file.

A recording is an HDF5 file with one dataset for each field of a reply (`session.frames`), with a
row for each reply in order of arrival, and beside them what was asked for and when. Every dataset
has ``units`` and a ``description``. Since an answer depends on those before it, and on how many
positions were solved for each (``steps``), the recording of a whole session is enough to answer it
again, bit for bit (`session.tracker.replay`). Where a client had to connect again, the sessions
follow one another: each begins with a reply that says `Flag.FIRST`.
"""

import json
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from palpate.online.session.frames import REPLY, REPLY_FIELDS, Field, Request
from palpate.shared.arrays import Array
from palpate.shared.errors import PalpateError

FORMAT = "palpate-session"
FORMAT_VERSION = 4

CHUNK = 2000
"""Replies that are kept in memory until they are written."""

MOST_UNANSWERED = 100_000
"""Requests that are remembered for their replies: more than the buffers on the way can hold."""

ASKED = (
    Field("asked_position", "float64", "mm", "centre of the tip that was asked for", (3,)),
    Field("asked_outputs", "uint16", "", "what was wanted, bits"),
    Field("received", "float64", "s", "when the reply came, on the client's clock"),
)

ORDERS = "snapshot", "restore", "young"
"""Commands of a session by their numbers in a recording."""

_COMMAND = (
    f"a row per command: number of replies before it; {', '.join(ORDERS)}: 0, 1, 2; its value"
)
COMMANDS = Field("commands", "float64", "", _COMMAND, (3,))


class Recorder:
    """Writes a session with this greeting to a file, which is overwritten, as it goes."""

    def __init__(self, path: Path, greeting: dict[str, Any]) -> None:
        self._requests: OrderedDict[int, Request] = OrderedDict()
        self._asked: list[tuple[Any, ...]] = []
        self._replies: list[bytes] = []
        self._file = h5py.File(path, "w")
        about = {"format": FORMAT, "format_version": FORMAT_VERSION, "scene": greeting["scene"]}
        self._file.attrs.update(about, greeting=json.dumps(greeting))
        for name, kind, unit, meaning, shape in (*ASKED, *REPLY_FIELDS, COMMANDS):
            size = {"shape": (0, *shape), "maxshape": (None, *shape), "chunks": (CHUNK, *shape)}
            dataset = self._file.create_dataset(name, dtype=kind, **size)
            dataset.attrs.update(units=unit, description=meaning)

    def sent(self, request: Request) -> None:
        """Note a request."""
        self._requests[request.seq] = request
        if len(self._requests) > MOST_UNANSWERED:
            self._requests.popitem(last=False)

    def received(self, reply: bytes, now: float) -> None:
        """Note the reply (a frame) to one of the requests noted, which came at `now` (s)."""
        seq = int(np.frombuffer(reply, REPLY, 1)[0]["seq"])
        if seq not in self._requests:
            return  # nobody knows what was asked
        while (request := self._requests.popitem(last=False)[1]).seq != seq:
            pass  # replies come in order: what was sent earlier was dropped or refused
        self._asked.append((request.position, request.outputs, now))
        self._replies.append(reply[: REPLY.itemsize])
        if len(self._replies) >= CHUNK:
            self._write()

    def obeyed(self, command: str, value: float) -> None:
        """Note that a command was obeyed after the replies received so far."""
        replies = len(self._file["seq"]) + len(self._replies)
        _append(self._file[COMMANDS.name], [(replies, ORDERS.index(command), value)])

    def close(self) -> None:
        """Write what is left and close the file."""
        self._write()
        self._file.close()

    def _write(self) -> None:
        if not self._replies:
            return
        asked = np.array(self._asked, [(f.name, f.type, f.shape) for f in ASKED])
        for table in (asked, np.frombuffer(b"".join(self._replies), REPLY)):
            for name in table.dtype.names or ():
                _append(self._file[name], table[name])
        self._file.flush()
        self._asked.clear()
        self._replies.clear()


def _append(dataset: h5py.Dataset, rows: Sequence[Any] | NDArray[Any]) -> None:
    dataset.resize(len(dataset) + len(rows), axis=0)
    dataset[-len(rows) :] = rows


class Recording(NamedTuple):
    """A recorded session, in order of the replies."""

    scene: str
    requests: list[Request]  # those that were answered
    replies: NDArray[Any]  # (n,), of `session.frames.REPLY`
    received: Array  # (n,), s on the client's clock
    commands: list[tuple[int, str, float]]  # replies before it, its name and value


def read_recording(path: Path) -> Recording:
    """Read a recording; raise `PalpateError` if it is missing, damaged or of another version."""
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT:
                raise PalpateError(f"{path}: not a recording of a session")
            if (version := file.attrs["format_version"]) != FORMAT_VERSION:
                raise PalpateError(
                    f"{path}: format version {version}; this program reads {FORMAT_VERSION}"
                )
            replies = np.zeros(len(file["seq"]), REPLY)
            for name in REPLY.names or ():
                replies[name] = file[name][:]
            asked = (file[n] for n in ("seq", "client_time", "asked_position", "asked_outputs"))
            requests = list(map(Request, *(column[:].tolist() for column in asked)))
            rows = file[COMMANDS.name][:].tolist()
            commands = [(int(before), ORDERS[int(kind)], value) for before, kind, value in rows]
            scene = str(file.attrs["scene"])
            return Recording(scene, requests, replies, file["received"][:], commands)
    except (OSError, KeyError, ValueError) as error:
        raise PalpateError(f"{path}: cannot be read: {error}") from error
