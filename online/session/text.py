"""Text messages of a session: positions in JSON, for people, and commands to keep a state."""

from typing import Literal

import orjson
from pydantic import Field

from palpate.online.serve.errors import Refusal
from palpate.online.serve.schemas import Position, Strict, parse
from palpate.online.session import frames
from palpate.online.session.frames import REASONS_MEAN, Flag, Output, Reason, Request

MOST_SNAPSHOTS = 8
"""Largest number of states that a session keeps."""


class TextRequest(Strict):
    """A position of the tip; `seq` and `client_time` are echoed."""

    seq: int = Field(0, ge=0, lt=2**32)
    client_time: float = 0.0
    position: Position
    outputs: list[Literal["coordinates", "displacement", "von_mises", "stress"]] = Field(
        [], max_length=4
    )


class TextCommand(Strict):
    """A request to keep the state of a session's tissue, or to go back to one that was kept."""

    snapshot: int | None = Field(None, ge=0, lt=MOST_SNAPSHOTS)
    restore: int | None = Field(None, ge=0, lt=MOST_SNAPSHOTS)


def read_request(text: str) -> Request:
    """Read a position; raise `Refusal` with the field that is wrong."""
    read = parse(TextRequest, text)
    x, y, z = read.position
    outputs = sum(Output[name.upper()] for name in set(read.outputs))
    return Request(read.seq, read.client_time, (x, y, z), outputs)


def is_command(text: str | None) -> bool:
    """Whether a message is a `TextCommand` rather than a position."""
    return text is not None and ('"snapshot"' in text or '"restore"' in text)


def read_command(text: str) -> tuple[str, int]:
    """Read a command: ``snapshot`` or ``restore``, and the number; raise `Refusal` for nonsense."""
    given = parse(TextCommand, text).model_dump(exclude_none=True)
    if len(given) != 1:
        raise Refusal(
            "invalid_value",
            "snapshot",
            "One of snapshot and restore is wanted",
            list(TextCommand.model_fields),
        )
    return next(iter(given.items()))


def write_reply(frame: bytes) -> str:
    """Write a reply in JSON: its fields by name, bits as lists of names, the reason in words.

    Infinite numbers are null.
    """
    reply = frames.decode_reply(frame)
    document = {name: value for name, value in reply._asdict().items() if value is not None}
    for name, bits in (("flags", Flag), ("outputs", Output)):
        document[name] = [str(bit.name).lower() for bit in bits(document[name])]
    document["reason"] = REASONS_MEAN[Reason(reply.reason)]
    return orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY).decode()
