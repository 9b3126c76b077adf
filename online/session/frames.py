"""Frames of a session: the binary layout of what a tool sends and what it feels.

Version 2, everything little-endian, every field at a fixed offset that is a multiple of its size:
a C struct with the same members in the same order has this layout. One request frame asks for one
reply frame. The tables in ``online/PROTOCOL.md``, in the OpenAPI document and in a session's
greeting are made from `REQUEST_FIELDS` and `REPLY_FIELDS`.

Replies of version 1 had neither `depth_limit` nor `reason`; requests were the same. The fields of a
reply are followed by what was asked for, without gaps, in this order:

1. ``COORDINATES``: float32 (4, coordinates), mm mN energy norm; a row per local model, zeros where
   `model` is -1;
2. ``DISPLACEMENT``: (nodes, 3), mm, of the nodes of the surface's mesh;
3. ``VON_MISES``: (nodes,), kPa;

the last two as float32, or as float16 with ``HALF``.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.shared.errors import QueryError

if TYPE_CHECKING:
    from palpate.shared.answer import Answer

VERSION = 2

MODELS = 4
"""Local models that can take part in an answer."""

FARTHEST = 1e4
"""Largest coordinate of a position, mm."""


class Output(IntFlag):
    """What a request wants beyond the fields of every reply."""

    COORDINATES = 1
    DISPLACEMENT = 2
    VON_MISES = 4
    STRESS = 8
    HALF = 16


class Flag(IntFlag):
    """What a reply says of itself."""

    CONTACT = 1
    CONVERGED = 2
    IN_RANGE = 4
    CLAMPED = 8
    FALLBACK = 16
    STALLED = 32


class Reason(IntEnum):
    """Why a reply is not for the position asked for."""

    NONE = 0
    NO_EQUILIBRIUM = 1
    BELOW_SURFACE = 2


OUTPUTS_MEAN = {
    Output.COORDINATES: "reduced coordinates",
    Output.DISPLACEMENT: "displacement of the surface",
    Output.VON_MISES: "von Mises stress of the surface",
    Output.STRESS: "`max_von_mises` and `p99_von_mises`",
    Output.HALF: "fields as float16",
}

FLAGS_MEAN = {
    Flag.CONTACT: "the tip touches",
    Flag.CONVERGED: "an equilibrium was found at `position`",
    Flag.IN_RANGE: "the state is of the kind the model was trained for",
    Flag.CLAMPED: "the step was too long for its time: `position` is short of the one asked for",
    Flag.FALLBACK: "no answer there: all is the last good answer's, but the errors are infinite",
    Flag.STALLED: "more time than `longest_step` had passed, or less than none: it was cut to that",
}

REASONS_MEAN = {
    Reason.NONE: "",
    Reason.NO_EQUILIBRIUM: "no equilibrium was found there",
    Reason.BELOW_SURFACE: "the tip's centre lies below the surface of the tissue",
}


@dataclass(frozen=True)
class Field:
    """A field of a frame."""

    name: str
    type: str
    unit: str
    meaning: str
    shape: tuple[int, ...] = ()


REQUEST_FIELDS = (
    Field("version", "uint16", "", "of this layout, 2"),
    Field("outputs", "uint16", "", "what is wanted, bits"),
    Field("seq", "uint32", "", "the client's number of this frame, echoed"),
    Field("client_time", "float64", "s", "echoed; the time of visco-elastic tissue"),
    Field("position", "float64", "mm", "centre of the tip", (3,)),
)

REPLY_FIELDS = (
    Field("version", "uint16", "", "of this layout, 2"),
    Field("flags", "uint16", "", "bits"),
    Field("seq", "uint32", "", "of the request that is answered"),
    Field("client_time", "float64", "s", "of the request"),
    Field("server_received", "float64", "s", "when the request came, on the server's clock"),
    Field("server_sent", "float64", "s", "when the reply went, on the server's clock"),
    Field("position", "float64", "mm", "centre of the tip that all below belongs to", (3,)),
    Field("force", "float64", "mN", "on the tool", (3,)),
    Field("tangent", "float64", "mN/mm", "derivative of `force` by `position`, by rows", (3, 3)),
    Field("energy", "float64", "mN mm", "stored in the tissue"),
    Field("solve_time", "float32", "s", "spent on solving"),
    Field("valid_radius", "float32", "mm", "how far from `position` force and tangent hold"),
    Field("contact_point", "float32", "mm", "on the tissue", (3,)),
    Field("normal", "float32", "", "outward, unit, at the contact", (3,)),
    Field("depth", "float32", "mm", "of the tip below the surface at rest"),
    Field("penetration", "float32", "mm", "of the tip into the deformed surface"),
    Field("error_displacement", "float32", "", "estimated relative error; infinite: unknown"),
    Field("error_von_mises", "float32", "", "estimated relative error; infinite: unknown"),
    Field("error_force", "float32", "", "estimated relative error; infinite: unknown"),
    Field("min_jacobian", "float32", "", "smallest volume ratio; 1 at rest, 0 is collapse"),
    Field("max_von_mises", "float32", "kPa", "largest in the body; 0 if not asked for"),
    Field("p99_von_mises", "float32", "kPa", "99th percentile of it; 0 if not asked for"),
    Field("model", "int32", "", "local models that answer, -1 for none", (MODELS,)),
    Field("weight", "float32", "", "their shares", (MODELS,)),
    Field("superseded", "uint32", "", "requests dropped for newer ones since the last reply"),
    Field("nodes", "uint32", "", "nodes of the fields that follow, or 0"),
    Field("iterations", "uint16", "", "Newton steps taken"),
    Field("steps", "uint16", "", "positions solved on the way here"),
    Field("coordinates", "uint16", "", "reduced coordinates per local model that follow, or 0"),
    Field("outputs", "uint16", "", "what follows or is filled in, bits"),
    Field("depth_limit", "float32", "mm", "largest trained depth there"),
    Field("reason", "uint32", "", "why `position` is not the one asked for; 0 if it is"),
)


_CODES = {"uint16": "H", "uint32": "I", "int32": "i", "float32": "f", "float64": "d"}


def _struct(fields: Sequence[Field]) -> struct.Struct:
    codes = (f"{math.prod(field.shape)}{_CODES[field.type]}" for field in fields)
    return struct.Struct("<" + "".join(codes))


def _dtype(fields: Sequence[Field]) -> np.dtype[Any]:
    return np.dtype([(f.name, f"<{np.dtype(f.type).str[1:]}", f.shape) for f in fields])


REQUEST = _dtype(REQUEST_FIELDS)
REPLY = _dtype(REPLY_FIELDS)

_REQUEST = _struct(REQUEST_FIELDS)
_REPLY = _struct(REPLY_FIELDS)
_OUTPUTS = sum(Output)
_LARGEST = float(np.finfo(np.float32).max)
# enumerations are slow to calculate with
_COORDINATES, _DISPLACEMENT, _VON_MISES, _, _HALF = map(int, Output)
_IN_RANGE = int(Flag.IN_RANGE)


class FrameError(QueryError):
    """A message that is no frame, or asks for nonsense; `field` is the field at fault."""


class VersionError(FrameError):
    """A frame of another layout."""


class Request(NamedTuple):
    """A request frame; for the fields see `REQUEST_FIELDS`."""

    seq: int
    client_time: float
    position: tuple[float, float, float]
    outputs: int = 0


def encode_request(request: Request) -> bytes:
    """Write a request frame."""
    return _REQUEST.pack(
        VERSION, request.outputs, request.seq, request.client_time, *request.position
    )


def decode_request(frame: bytes) -> Request:
    """Read a request frame.

    Raises
    ------
    VersionError
        If it is of another version.
    FrameError
        If its size, a bit or a number is wrong.
    """
    if len(frame) >= 2 and (version := int.from_bytes(frame[:2], "little")) != VERSION:
        raise VersionError("version", f"is {version}; this service speaks version {VERSION}")
    if len(frame) != _REQUEST.size:
        raise FrameError("frame", f"must have {_REQUEST.size} bytes, not {len(frame)}")
    _, outputs, seq, client_time, x, y, z = _REQUEST.unpack(frame)
    return check_request(Request(seq, client_time, (x, y, z), outputs))


def check_request(request: Request) -> Request:
    """Return a request whose numbers make sense; raise `FrameError` for any other."""
    if request.outputs & ~_OUTPUTS:
        raise FrameError("outputs", f"has bits other than those of {_OUTPUTS}")
    if not math.isfinite(request.client_time):
        raise FrameError("client_time", "must be a finite number of seconds")
    # NaN compares false
    if not all(abs(coordinate) <= FARTHEST for coordinate in request.position):
        raise FrameError("position", f"must be three numbers from {-FARTHEST:g} to {FARTHEST:g} mm")
    return request


class Extras(NamedTuple):
    """What a reply holds on request.

    Parameters
    ----------
    outputs : int
        Bits of `Output`: what is there.
    coordinates : ndarray, shape (MODELS, r), float32
    displacement : ndarray, shape (n, 3), float32 or float16, mm
    von_mises : ndarray, shape (n,), float32 or float16, kPa
    max_von_mises, p99_von_mises : float, kPa
    """

    outputs: int = 0
    coordinates: NDArray[Any] | None = None
    displacement: NDArray[Any] | None = None
    von_mises: NDArray[Any] | None = None
    max_von_mises: float = 0.0
    p99_von_mises: float = 0.0


NO_EXTRAS = Extras()


class ToolAnswer(NamedTuple):
    """The answer to a position of the tool.

    Parameters
    ----------
    touch : Answer
    flags : int
        Bits of `Flag`.
    steps : int
        Positions solved on the way.
    valid_radius : float, mm
        How far from the position force and tangent hold.
    solve_seconds : float
    reason : int
        A `Reason`.
    """

    touch: Answer
    flags: int
    steps: int
    valid_radius: float
    solve_seconds: float
    reason: int


def encode_reply(
    request: Request,
    answer: ToolAnswer,
    extras: Extras = NO_EXTRAS,
    superseded: int = 0,
    received: float = 0.0,
    sent: float = 0.0,
) -> bytes:
    """Write a reply frame.

    Parameters
    ----------
    request : Request
        What is answered.
    answer : ToolAnswer
        Outside the trained range its estimated errors count as infinite.
    extras : Extras
        C-contiguous.
    superseded : int
    received, sent : float, s
        On the server's clock.
    """
    touch = answer.touch
    patches = touch.parts
    unknown = 0.0 if answer.flags & _IN_RANGE else math.inf
    head = _REPLY.pack(
        VERSION,
        answer.flags,
        request.seq,
        request.client_time,
        received,
        sent,
        *touch.position.tolist(),
        *touch.force.tolist(),
        *touch.tangent.ravel().tolist(),
        touch.energy,
        answer.solve_seconds,
        answer.valid_radius,
        *touch.contact_point.tolist(),
        *touch.normal.tolist(),
        touch.depth,
        touch.penetration,
        _estimate(touch.error_displacement + unknown),
        _estimate(touch.error_von_mises + unknown),
        _estimate(touch.error_force + unknown),
        touch.min_jacobian,
        extras.max_von_mises,
        extras.p99_von_mises,
        *([patch[0] for patch in patches] + [-1] * (MODELS - len(patches))),
        *([patch[1] for patch in patches] + [0.0] * (MODELS - len(patches))),
        superseded,
        _nodes(extras),
        touch.iterations,
        answer.steps,
        0 if extras.coordinates is None else extras.coordinates.shape[1],
        extras.outputs,
        touch.depth_limit,
        answer.reason,
    )
    if extras is NO_EXTRAS:
        return head
    parts = (extras.coordinates, extras.displacement, extras.von_mises)
    return b"".join((head, *(part.data for part in parts if part is not None)))


def _estimate(error: float) -> float:
    """Return an error that fits into a float32; infinity, which means unknown, if it does not."""
    return error if error <= _LARGEST else math.inf


def _nodes(extras: Extras) -> int:
    for field in (extras.displacement, extras.von_mises):
        if field is not None:
            return len(field)
    return 0


class Reply(NamedTuple):
    """A reply frame; for the fields see `REPLY_FIELDS`. Arrays are views into the frame.

    Parameters
    ----------
    coordinates : ndarray, shape (MODELS, r), float32, or None
    displacement : ndarray, shape (n, 3), float32 or float16, mm, or None
    von_mises : ndarray, shape (n,), float32 or float16, kPa, or None
    """

    flags: int
    seq: int
    client_time: float
    server_received: float
    server_sent: float
    position: NDArray[np.float64]
    force: NDArray[np.float64]
    tangent: NDArray[np.float64]
    energy: float
    solve_time: float
    valid_radius: float
    contact_point: NDArray[np.float32]
    normal: NDArray[np.float32]
    depth: float
    penetration: float
    error_displacement: float
    error_von_mises: float
    error_force: float
    min_jacobian: float
    max_von_mises: float
    p99_von_mises: float
    model: NDArray[np.int32]
    weight: NDArray[np.float32]
    superseded: int
    nodes: int
    iterations: int
    steps: int
    outputs: int
    depth_limit: float
    reason: int
    coordinates: NDArray[np.float32] | None
    displacement: NDArray[Any] | None
    von_mises: NDArray[Any] | None

    @property
    def contact(self) -> bool:
        """Whether the tip touches."""
        return bool(self.flags & Flag.CONTACT)

    @property
    def good(self) -> bool:
        """Whether this is a trained-for equilibrium at the position asked for."""
        asked = Flag.CONVERGED | Flag.IN_RANGE | Flag.CLAMPED | Flag.FALLBACK
        return self.flags & asked == Flag.CONVERGED | Flag.IN_RANGE


_HEAD = Reply._fields[:-3]


def decode_reply(frame: bytes) -> Reply:
    """Read a reply frame.

    Raises
    ------
    VersionError
        If it is of another version.
    FrameError
        If it is not as long as it says.
    """
    if len(frame) >= 2 and (version := int.from_bytes(frame[:2], "little")) != VERSION:
        raise VersionError("version", f"is {version}; this reader knows version {VERSION}")
    if len(frame) < REPLY.itemsize:
        raise FrameError("frame", f"{len(frame)} bytes are too few for a reply")
    record = np.frombuffer(frame, REPLY, 1)[0]
    outputs, nodes, r = (int(record[name]) for name in ("outputs", "nodes", "coordinates"))
    half = np.dtype("<f2" if outputs & _HALF else "<f4")
    parts = {
        "coordinates": (outputs & _COORDINATES, np.dtype("<f4"), (MODELS, r)),
        "displacement": (outputs & _DISPLACEMENT, half, (nodes, 3)),
        "von_mises": (outputs & _VON_MISES, half, (nodes,)),
    }
    offset = REPLY.itemsize
    arrays: dict[str, NDArray[Any] | None] = dict.fromkeys(parts)
    for name, (wanted, dtype, shape) in parts.items():
        size = math.prod(shape) if wanted else 0
        if offset + size * dtype.itemsize > len(frame):
            raise FrameError("frame", f"{len(frame)} bytes end within {name}")
        if wanted:
            arrays[name] = np.frombuffer(frame, dtype, size, offset).reshape(shape)
        offset += size * dtype.itemsize
    if offset != len(frame):
        raise FrameError("frame", f"{len(frame)} bytes where its fields say {offset}")
    values: list[Any] = [record[name] for name in _HEAD]
    head = [value.item() if value.ndim == 0 else value for value in values]
    return Reply(*head, *arrays.values())
