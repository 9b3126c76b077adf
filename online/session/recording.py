"""The positions of a tool and the answers to them, in a file.

A recording is an HDF5 file with one dataset for each field of a reply (`session.frames`), with a
row for each reply in order of arrival, and beside them what was asked for and when. Every dataset
has ``units`` and a ``description``. Since an answer depends on those before it, and on how many
positions were solved for each (``steps``), the recording of a whole session is enough to answer it
again, bit for bit (`session.tracker.replay`). Where a client had to connect again, the sessions
follow one another: each begins with a reply that says `Flag.FIRST`.
"""

import json
import logging
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from contextlib import closing
from io import BytesIO, FileIO
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from palpate.online.session.frames import REPLY, REPLY_FIELDS, REQUEST, Field, Request
from palpate.shared.arrays import Array
from palpate.shared.errors import PalpateError
from palpate.shared.files import open_regular

logger = logging.getLogger(__name__)

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

_ASKED = np.dtype([(f.name, f.type, f.shape) for f in ASKED])

ORDERS = "snapshot", "restore", "young"
"""Commands of a session by their numbers in a recording."""

_COMMAND = (
    f"a row per command: number of replies before it; {', '.join(ORDERS)}: 0, 1, 2; its value"
)
COMMANDS = Field("commands", "float64", "", _COMMAND, (3,))


class _Disk(FileIO):
    """A file whose writes all succeed for HDF5, which otherwise would crash the process.

    From the first ``failure`` on nothing is written, so that what was there before can be read.
    """

    failure: OSError | None = None

    def write(self, data: Any) -> int:
        """Write the data, unless that fails or has failed before."""
        left = memoryview(data).cast("B")
        try:
            while self.failure is None and len(left):
                left = left[super().write(left) :]
        except OSError as error:
            self.failure = error
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        """Change the size, unless that fails or has failed before."""
        try:
            if self.failure is None:
                super().truncate(size)
        except OSError as error:
            self.failure = error
        return size or 0


class Recorder:
    """Writes a session with this greeting to a file, which is overwritten, as it goes.

    Where that fails, as on a full disk, a warning is logged and the recording ends; what was
    written until then can be read. Only ``close`` raises `PalpateError` for it, and the beginning.
    """

    def __init__(self, path: Path | BytesIO, greeting: dict[str, Any]) -> None:
        self._requests: OrderedDict[int, Request] = OrderedDict()
        self._asked: list[tuple[Any, ...]] = []
        self._replies: list[bytes] = []
        self._written = 0
        self._disk = None if isinstance(path, BytesIO) else _Disk(path, "w+")
        self._file = h5py.File(self._disk or path, "w")
        about = {"format": FORMAT, "format_version": FORMAT_VERSION, "scene": greeting["scene"]}
        self._file.attrs.update(about, greeting=json.dumps(greeting))
        for name, kind, unit, meaning, shape in (*ASKED, *REPLY_FIELDS, COMMANDS):
            size = {"shape": (0, *shape), "maxshape": (None, *shape), "chunks": (CHUNK, *shape)}
            dataset = self._file.create_dataset(name, dtype=kind, **size)
            dataset.attrs.update(units=unit, description=meaning)
        self._file.flush()
        if self._failure is not None:
            self.close()

    @property
    def _failure(self) -> OSError | None:
        """Why the recording has ended; None if it goes on."""
        return None if self._disk is None else self._disk.failure

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
        replies = self._written + len(self._replies)
        self.commands([(replies, ORDERS.index(command), value)])

    def commands(self, rows: Sequence[Any] | NDArray[Any]) -> None:
        """Write rows of ``COMMANDS``."""
        if self._failure is None:
            _append(self._file[COMMANDS.name], rows)

    def exchanged(self, asked: NDArray[Any], replies: NDArray[Any]) -> None:
        """Write what was asked, with fields as in ``ASKED``, and the replies to it."""
        if self._failure is not None:
            return
        for table in (asked, replies):
            for name in table.dtype.names or ():
                _append(self._file[name], table[name])
        self._file.flush()
        if self._failure is None:
            self._written += len(replies)
        else:
            logger.warning("%s", self._ending())

    def close(self) -> None:
        """Write what is left and close the file; raise `PalpateError` if some was not written."""
        self._write()
        self._file.close()
        if self._disk is not None:
            self._disk.close()
        if self._failure is not None:
            raise PalpateError(self._ending())

    def _ending(self) -> str:
        """Say why the recording has ended, and where."""
        assert self._disk is not None
        assert self._disk.failure is not None
        why = self._disk.failure.strerror
        return f"{self._disk.name}: {why}; the recording ends after {self._written} replies"

    def _write(self) -> None:
        if not self._replies:
            return
        self.exchanged(np.array(self._asked, _ASKED), np.frombuffer(b"".join(self._replies), REPLY))
        self._asked.clear()
        self._replies.clear()


def recorded(head: dict[str, Any], arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """File of a session of which a client kept all frames.

    Parameters
    ----------
    head : dict
        ``greeting``, as it came, and ``commands``, rows of `COMMANDS`.
    arrays : mapping
        ``requests`` and ``replies``, bytes of the frames (without what replies hold on request),
        those that were answered and their answers, in order; ``received``, when they came, s.

    Raises
    ------
    PalpateError
        If they are none.
    """
    try:
        requests = np.frombuffer(arrays["requests"].tobytes(), REQUEST)
        replies = np.frombuffer(arrays["replies"].tobytes(), REPLY)
        commands = np.array(head["commands"], float).reshape(-1, *COMMANDS.shape)
        if not np.array_equal(requests["seq"], replies["seq"]):
            raise ValueError("the replies are not those to the requests")
        if not (np.isfinite(commands).all() and np.isin(commands[:, 1], range(len(ORDERS))).all()):
            raise ValueError("a command is none")
        asked = np.zeros(len(replies), _ASKED)
        asked["asked_position"], asked["asked_outputs"] = requests["position"], requests["outputs"]
        asked["received"] = arrays["received"]
        with closing(Recorder(file := BytesIO(), dict(head["greeting"]))) as recorder:
            recorder.exchanged(asked, replies)
            recorder.commands(commands)
    except (KeyError, TypeError, ValueError) as error:
        raise PalpateError(f"not what was kept of a session: {error}") from None
    return file.getvalue()


def _append(dataset: h5py.Dataset, rows: Sequence[Any] | NDArray[Any]) -> None:
    if len(rows) == 0:
        return
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
        with open_regular(path) as whole, h5py.File(whole, "r") as file:
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
