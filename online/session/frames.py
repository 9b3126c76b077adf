"""Frames of a session: the binary layout of what a tool sends and what it feels.

Version 2, everything little-endian, every field at a fixed offset that is a multiple of its size:
a C struct with the same members in the same order has this layout. A request frame is answered by
one reply frame, unless a newer one came before its turn: `superseded` counts those. The tables in
``online/PROTOCOL.md``, in the OpenAPI document and in a session's greeting are made from
`REQUEST_FIELDS` and `REPLY_FIELDS`.

Replies of version 1 had neither `depth_limit` nor `reason`; requests were the same. The fields of a
reply are followed by what was asked for, without gaps, in this order:

1. ``COORDINATES``: float32 (4, coordinates), mm mN energy norm; a row per local model, zeros where
   `model` is -1;
2. ``PARTS``: what the displacement of the surface is made of: uint32 m, r, d and 0; int32 (m,),
   local models; float32 (m, r), mm mN energy norm, their states times weights; int32 (d,), nodes;
   float32 (d, 3), mm, what the tip's dent adds there. The modes are those of
   ``/scenes/{name}/modes/{model}``; the past of visco-elastic tissue is in more than four models;
3. ``DISPLACEMENT``: (nodes, 3), mm, of the nodes of the surface's mesh;
4. ``VON_MISES``: (nodes,), kPa;

the last two as float32, or as float16 with ``HALF``.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from enum import IntEnum, IntFlag
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, Self, get_type_hints

import numpy as np
from numpy.typing import NDArray

from palpate.shared.errors import QueryError

if TYPE_CHECKING:
    from palpate.shared.answer import Answer

VERSION = 2

PATH = Path(__file__).parents[1] / "PROTOCOL.md"
"""Written by ``python -m palpate.online.session.frames``."""

MODELS = 4
"""Local models that can take part in an answer."""

FARTHEST = 1e4
"""Largest coordinate of a position, mm."""


class _Bits(IntFlag):
    """Bits with their meanings."""

    meaning: str

    def __new__(cls, value: int, meaning: str = "") -> Self:
        bit = int.__new__(cls, value)
        bit._value_, bit.meaning = value, meaning
        return bit

    def __str__(self) -> str:
        return ", ".join(str(bit.name).lower() for bit in self) or "none"


class Output(_Bits):
    """What a request wants beyond the fields of every reply."""

    COORDINATES = 1, "reduced coordinates"
    DISPLACEMENT = 2, "displacement of the surface"
    VON_MISES = 4, "von Mises stress of the surface"
    STRESS = 8, "`max_von_mises` and `p99_von_mises`"
    HALF = 16, "fields as float16"
    PARTS = 32, "what the displacement of the surface is made of"


class Flag(_Bits):
    """What a reply says of itself."""

    CONTACT = 1, "the tip touches"
    CONVERGED = 2, "an equilibrium was found at `position`"
    IN_RANGE = 4, "the state is of the kind the model was trained for"
    CLAMPED = 8, "the step was too long for its time: `position` is short of the one asked for"
    FALLBACK = 16, "no answer there: all is the last good answer's, but the errors are infinite"
    STALLED = 32, "more time than `longest_step` had passed, or less than none; it was cut"
    FIRST = 64, "the first answer of its session: the tissue was at rest before"
    TOO_DEEP = 128, "not in range: deeper than the model was trained for there"
    BESIDE = 256, "not in range: the tip presses what lies beyond the rim of the surface"


class Reason(IntEnum):
    """Why a reply is not for the position asked for."""

    NONE = 0
    NO_EQUILIBRIUM = 1
    BELOW_SURFACE = 2


_REASONS = {int(reason): reason for reason in Reason}

REASONS_MEAN = (
    "",
    "no equilibrium was found there",
    "the tip's centre lies below the surface of the tissue",
)
"""By the number of the `Reason`."""


class Field(NamedTuple):
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

Array = NDArray[Any]
_Estimate = Annotated[float, "float32", "", "estimated relative error; infinite: unknown"]


class Reply(NamedTuple):
    """A reply frame: of each field its type in the frame, its unit and its meaning.

    Arrays are views of the frame. The last six and `coordinates` follow the fields, and are None
    unless they were asked for; of `coordinates` the number stands among the fields.
    """

    version: Annotated[int, "uint16", "", "of this layout, 2"]
    flags: Annotated[int, "uint16", "", "bits"]
    seq: Annotated[int, "uint32", "", "of the request that is answered"]
    client_time: Annotated[float, "float64", "s", "of the request"]
    server_received: Annotated[float, "float64", "s", "when the request came, server's clock"]
    server_sent: Annotated[float, "float64", "s", "when the reply went, server's clock"]
    position: Annotated[Array, "float64", "mm", "centre of the tip that all below belongs to", (3,)]
    force: Annotated[Array, "float64", "mN", "on the tool", (3,)]
    tangent: Annotated[Array, "float64", "mN/mm", "d `force` / d `position`, by rows", (3, 3)]
    energy: Annotated[float, "float64", "mN mm", "stored in the tissue"]
    solve_time: Annotated[float, "float32", "s", "spent on solving"]
    valid_radius: Annotated[float, "float32", "mm", "how far from there force and tangent hold"]
    contact_point: Annotated[Array, "float32", "mm", "on the tissue", (3,)]
    normal: Annotated[Array, "float32", "", "outward, unit, at the contact", (3,)]
    depth: Annotated[float, "float32", "mm", "of the tip below the surface at rest"]
    penetration: Annotated[
        float, "float32", "mm", "of the tip in the surface as a footprint moves it"
    ]
    error_displacement: _Estimate
    error_von_mises: _Estimate
    error_force: _Estimate
    min_jacobian: Annotated[float, "float32", "", "smallest volume ratio; 1 at rest, 0 is collapse"]
    max_von_mises: Annotated[
        float, "float32", "kPa", "largest, 1.5 mm off the support; 0 if not asked for"
    ]
    p99_von_mises: Annotated[float, "float32", "kPa", "99th percentile of it; 0 if not asked for"]
    model: Annotated[Array, "int32", "", "local models that answer, -1 for none", (MODELS,)]
    weight: Annotated[Array, "float32", "", "their shares", (MODELS,)]
    superseded: Annotated[int, "uint32", "", "requests dropped for newer ones since the last reply"]
    nodes: Annotated[int, "uint32", "", "nodes of the fields that follow, or 0"]
    iterations: Annotated[int, "uint16", "", "Newton steps taken"]
    steps: Annotated[int, "uint16", "", "positions solved on the way here"]
    coordinates: Annotated[Array | None, "uint16", "", "how many per local model follow, or 0"]
    outputs: Annotated[int, "uint16", "", "what follows or is filled in, bits"]
    depth_limit: Annotated[float, "float32", "mm", "largest trained depth there"]
    reason: Annotated[int, "uint32", "", "why `position` is not the one asked for; 0 if it is"]
    displacement: Array | None
    von_mises: Array | None
    part_models: Array | None
    part_states: Array | None
    dented: Array | None
    dent: Array | None

    @property
    def converged(self) -> bool:
        """Whether an equilibrium was found at `position`."""
        return bool(self.flags & Flag.CONVERGED)

    @property
    def in_range(self) -> bool:
        """Whether the model was trained for such a state."""
        return bool(self.flags & Flag.IN_RANGE)

    @property
    def out_of_range(self) -> tuple[str, ...]:
        """What of the state the model was not trained for, as an `Answer` names it."""
        beyond = {"position": Flag.BESIDE, "depth": Flag.TOO_DEEP}
        return tuple(name for name, flag in beyond.items() if self.flags & flag)

    @property
    def contact(self) -> bool:
        """Whether the tip touches."""
        return bool(self.flags & Flag.CONTACT)

    @property
    def good(self) -> bool:
        """Whether this is a trained-for equilibrium at the position asked for."""
        asked = Flag.CONVERGED | Flag.IN_RANGE | Flag.CLAMPED | Flag.FALLBACK
        return self.flags & asked == Flag.CONVERGED | Flag.IN_RANGE

    @property
    def first(self) -> bool:
        """Whether the tissue was at rest before this, as at the beginning of every session."""
        return bool(self.flags & Flag.FIRST)


REPLY_FIELDS = tuple(
    Field(name, *hint.__metadata__)
    for name, hint in get_type_hints(Reply, include_extras=True).items()
    if hasattr(hint, "__metadata__")
)


def _layout(fields: Sequence[Field]) -> tuple[np.dtype[Any], struct.Struct]:
    dtype = np.dtype([(f.name, np.dtype(f.type).newbyteorder("<"), f.shape) for f in fields])
    codes = (f"{math.prod(field.shape)}{np.dtype(field.type).char}" for field in fields)
    return dtype, struct.Struct("<" + "".join(codes))


REQUEST, _REQUEST = _layout(REQUEST_FIELDS)
REPLY, _REPLY = _layout(REPLY_FIELDS)
_OUTPUTS = sum(Output)
_LARGEST = float(np.finfo(np.float32).max)
# enumerations are slow to calculate with
_COORDINATES, _DISPLACEMENT, _VON_MISES, _, _HALF, _PARTS = map(int, Output)
_IN_RANGE = int(Flag.IN_RANGE)


class FrameError(QueryError):
    """A message that is no frame, or asks for nonsense; `field` is the field at fault."""


class Request(NamedTuple):
    """A request frame; for the fields see `REQUEST_FIELDS`."""

    seq: int
    client_time: float
    position: Sequence[float]  # (3,)
    outputs: int = 0


def output_bits(outputs: int | Sequence[str]) -> int:
    """Bits of `Output`, given as such or by their names; raise `FrameError` if one is none."""
    if isinstance(outputs, int):
        return int(outputs)
    bits = 0
    for name in [outputs] if isinstance(outputs, str) else outputs:
        if str(name).upper() not in Output.__members__:
            known = ", ".join(bit.lower() for bit in Output.__members__)
            raise FrameError("outputs", f"{name!r} is none of {known}")
        bits |= Output[name.upper()]
    return bits


def encode_request(request: Request) -> bytes:
    """Write a request frame."""
    seq, client_time, position, outputs = request
    return _REQUEST.pack(VERSION, outputs, seq, client_time, *position)


def decode_request(frame: bytes) -> Request:
    """Read a request frame; raise `FrameError` if its version, size, a bit or a number is wrong."""
    _check_version(frame)
    if len(frame) != _REQUEST.size:
        raise FrameError("frame", f"must have {_REQUEST.size} bytes, not {len(frame)}")
    _, outputs, seq, client_time, x, y, z = _REQUEST.unpack(frame)
    if outputs & ~_OUTPUTS:
        raise FrameError("outputs", f"has bits other than those of {_OUTPUTS}")
    if not math.isfinite(client_time):
        raise FrameError("client_time", "must be a finite number of seconds")
    # NaN compares false
    if not (abs(x) <= FARTHEST and abs(y) <= FARTHEST and abs(z) <= FARTHEST):
        raise FrameError("position", f"must be three numbers from {-FARTHEST:g} to {FARTHEST:g} mm")
    return Request(seq, client_time, (x, y, z), outputs)


def _check_version(frame: bytes) -> None:
    if len(frame) >= 2 and (version := int.from_bytes(frame[:2], "little")) != VERSION:
        raise FrameError("version", f"is {version}; the layout spoken here is version {VERSION}")


class Extras(NamedTuple):
    """What a reply holds on request."""

    outputs: int = 0  # bits of `Output`: what is there
    coordinates: int = 0  # per local model
    nodes: int = 0  # of the fields
    max_von_mises: float = 0.0  # kPa
    p99_von_mises: float = 0.0  # kPa
    fields: Sequence[Array] = ()  # C-contiguous, all that follows in the frame


NO_EXTRAS = Extras()


class ToolAnswer(NamedTuple):
    """The answer to a position of the tool."""

    touch: Answer
    flags: int  # bits of `Flag`
    steps: int  # positions solved on the way
    valid_radius: float  # mm, how far from the position force and tangent hold
    solve_seconds: float
    reason: int  # a `Reason`


def encode_reply(
    request: Request,
    answer: ToolAnswer,
    extras: Extras = NO_EXTRAS,
    superseded: int = 0,
    received: float = 0.0,
    sent: float = 0.0,
) -> bytes:
    """Write a reply frame; `received` and `sent` (s) are on the server's clock."""
    touch = answer.touch
    absent = MODELS - len(touch.parts)
    largest = _LARGEST if answer.flags & _IN_RANGE else -1.0  # of an error that is known
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
        touch.error_displacement if touch.error_displacement <= largest else math.inf,
        touch.error_von_mises if touch.error_von_mises <= largest else math.inf,
        touch.error_force if touch.error_force <= largest else math.inf,
        touch.min_jacobian,
        extras.max_von_mises,
        extras.p99_von_mises,
        *([part[0] for part in touch.parts] + [-1] * absent),
        *([part[1] for part in touch.parts] + [0.0] * absent),
        superseded,
        extras.nodes,
        touch.iterations,
        answer.steps,
        extras.coordinates,
        extras.outputs,
        touch.depth_limit,
        answer.reason,
    )
    return b"".join((head, *(field.data for field in extras.fields)))


def decode_reply(frame: bytes) -> Reply:
    """Read a reply frame; raise `FrameError` if its version or its length is wrong."""
    _check_version(frame)
    if len(frame) < REPLY.itemsize:
        raise FrameError("frame", f"{len(frame)} bytes are too few for a reply")
    head = dict(zip(REPLY.names or (), np.frombuffer(frame, REPLY, 1)[0].item(), strict=True))
    kind, end = "<f2" if head["outputs"] & _HALF else "<f4", REPLY.itemsize
    nodes, coordinates = head["nodes"], head["coordinates"]

    def take(name: str, dtype: str, *shape: int) -> Array:
        nonlocal end
        start, end = end, end + math.prod(shape) * np.dtype(dtype).itemsize
        if end > len(frame):
            raise FrameError("frame", f"{len(frame)} bytes end within {name}")
        return np.frombuffer(frame[start:end], dtype).reshape(shape)

    head |= dict.fromkeys(Reply._fields[len(REPLY_FIELDS) :]) | {"coordinates": None}
    if head["outputs"] & _COORDINATES:
        head["coordinates"] = take("coordinates", "<f4", MODELS, coordinates)
    if head["outputs"] & _PARTS:
        m, r, d, _ = take("parts", "<u4", 4).tolist()
        head["part_models"] = take("part_models", "<i4", m)
        head["part_states"] = take("part_states", "<f4", m, r)
        head["dented"], head["dent"] = take("dented", "<i4", d), take("dent", "<f4", d, 3)
    if head["outputs"] & _DISPLACEMENT:
        head["displacement"] = take("displacement", kind, nodes, 3)
    if head["outputs"] & _VON_MISES:
        head["von_mises"] = take("von_mises", kind, nodes)
    if end != len(frame):
        raise FrameError("frame", f"{len(frame)} bytes where its fields say {end}")
    head["flags"] = Flag(head["flags"])
    head["reason"] = _REASONS.get(head["reason"], head["reason"])
    return Reply(**head)


def layout() -> dict[str, Any]:
    """Describe the layout, for the greeting of a session; JSON-able."""
    return {
        "version": VERSION,
        "byte_order": "little",
        "request": _described(REQUEST_FIELDS, REQUEST),
        "reply": _described(REPLY_FIELDS, REPLY),
        "outputs": {bit.name: bit.value for bit in Output},
        "flags": {bit.name: bit.value for bit in Flag},
        "reasons": {reason.name: reason.value for reason in Reason},
    }


def _described(fields: Sequence[Field], dtype: np.dtype[Any]) -> dict[str, Any]:
    offsets: Mapping[str, Any] = dtype.fields or {}
    return {
        "size": dtype.itemsize,
        "fields": [field._asdict() | {"offset": offsets[field.name][1]} for field in fields],
    }


def document() -> str:
    """Describe the frames in Markdown."""
    lines = ["# Frames of a session", "", str(__doc__).replace("``", "`")]
    for title in ("request", "reply"):
        frame = layout()[title]
        lines += [f"{title.capitalize()}, {frame['size']} bytes:", ""]
        lines += ["| offset | field | type | unit | meaning |", "|---|---|---|---|---|"]
        for f in frame["fields"]:
            type_ = f["type"] + "".join(f"[{n}]" for n in f["shape"])
            columns = f["offset"], f["name"], type_, f["unit"], f["meaning"]
            lines.append(f"| {' | '.join(map(str, columns))} |")
        lines.append("")
    for title, meanings in (
        ("bit of `outputs`", [(bit, bit.meaning) for bit in Output]),
        ("bit of `flags`", [(bit, bit.meaning) for bit in Flag]),
        ("`reason`", zip(Reason, REASONS_MEAN, strict=True)),
    ):
        lines += [f"| {title} | name | meaning |", "|---|---|---|"]
        lines += [f"| {v.value} | {v.name} | {meaning} |" for v, meaning in meanings]
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    PATH.write_text(document())
