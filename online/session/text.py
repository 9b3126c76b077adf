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
    """A position of the tip."""

    seq: int = Field(0, ge=0, lt=2**32, description="The client's number of this message, echoed.")
    client_time: float = Field(
        0.0, description="The client's clock, s, echoed; the time of visco-elastic tissue."
    )
    position: Position = Field(description="Centre of the tip, [x, y, z] mm.")
    outputs: list[Literal["coordinates", "displacement", "von_mises", "stress"]] = Field(
        [], max_length=4, description="What is wanted beyond force and tangent."
    )


class TextCommand(Strict):
    """A request to keep the state of a session's tissue, or to go back to one that was kept."""

    snapshot: int | None = Field(None, ge=0, lt=MOST_SNAPSHOTS, description="Number to keep it by.")
    restore: int | None = Field(None, ge=0, lt=MOST_SNAPSHOTS, description="Number to go back to.")


def read_request(text: str) -> Request:
    """Read a position; raise `Refusal` with the field that is wrong."""
    read = parse(TextRequest, text)
    x, y, z = read.position
    outputs = sum(Output[name.upper()] for name in set(read.outputs))
    return Request(read.seq, read.client_time, (x, y, z), outputs)


def is_command(text: str | None) -> bool:
    """Whether a message is a `TextCommand` rather than a position."""
    return text is not None and ('"snapshot"' in text or '"restore"' in text)


def read_command(text: str) -> tuple[bool, int]:
    """Read a command: whether it restores, and the number; raise `Refusal` for nonsense."""
    read = parse(TextCommand, text)
    if (read.snapshot is None) == (read.restore is None):
        raise Refusal(
            "invalid_value",
            "snapshot",
            "One of snapshot and restore is wanted",
            list(TextCommand.model_fields),
        )
    if read.restore is not None:
        return True, read.restore
    assert read.snapshot is not None
    return False, read.snapshot


def write_reply(frame: bytes) -> str:
    """Write a reply in JSON: its fields by name, bits as lists of names, the reason in words.

    Infinite numbers are null.
    """
    reply = frames.decode_reply(frame)
    document = {name: value for name, value in reply._asdict().items() if value is not None}
    document["flags"] = [str(bit.name).lower() for bit in Flag(reply.flags)]
    document["outputs"] = [str(bit.name).lower() for bit in Output(reply.outputs)]
    document["reason"] = REASONS_MEAN[Reason(reply.reason)]
    return orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY).decode()
