"""What a session says of its frames, and its messages in text.

Positions come in JSON from people, and so do commands to keep a state. The layout of frames is
described as data and in Markdown, from the tables of `session.frames`:
``python -m palpate.online.session.protocol`` writes ``online/PROTOCOL.md``.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import orjson
import pydantic

from palpate.online.serve.errors import Refusal
from palpate.online.serve.schemas import Position, Strict, parse
from palpate.online.session import frames
from palpate.online.session.frames import Field, Flag, Output, Reason, Request

PATH = Path(__file__).parents[1] / "PROTOCOL.md"


def document() -> str:
    """Describe the frames in a Markdown document."""
    return f"# Frames of a session\n\n{frames.__doc__}\n{tables()}".replace("``", "`")


def layout() -> dict[str, Any]:
    """Describe the layout, for the greeting of a session; JSON-able."""
    return {
        "version": frames.VERSION,
        "byte_order": "little",
        "request": _layout(frames.REQUEST_FIELDS, frames.REQUEST),
        "reply": _layout(frames.REPLY_FIELDS, frames.REPLY),
        "outputs": {bit.name: bit.value for bit in Output},
        "flags": {bit.name: bit.value for bit in Flag},
        "reasons": {reason.name: reason.value for reason in Reason},
    }


def _layout(fields: Sequence[Field], dtype: np.dtype[Any]) -> dict[str, Any]:
    offsets: Mapping[str, Any] = dtype.fields or {}
    return {
        "size": dtype.itemsize,
        "fields": [field._asdict() | {"offset": offsets[field.name][1]} for field in fields],
    }


def tables() -> str:
    """Describe the layout in Markdown."""
    lines = []
    for title in ("request", "reply"):
        frame = layout()[title]
        lines += [f"{title.capitalize()}, {frame['size']} bytes:", ""]
        lines += ["| offset | field | type | unit | meaning |", "|---|---|---|---|---|"]
        for f in frame["fields"]:
            kind = f["type"] + "".join(f"[{n}]" for n in f["shape"])
            lines.append(f"| {f['offset']} | {f['name']} | {kind} | {f['unit']} | {f['meaning']} |")
        lines.append("")
    for title, meanings in (
        ("bit of `outputs`", [(bit, bit.meaning) for bit in Output]),
        ("bit of `flags`", [(bit, bit.meaning) for bit in Flag]),
        ("`reason`", frames.REASONS_MEAN.items()),
    ):
        lines += [f"| {title} | name | meaning |", "|---|---|---|"]
        lines += [f"| {v.value} | {v.name} | {meaning} |" for v, meaning in meanings]
        lines.append("")
    return "\n".join(lines)


MOST_SNAPSHOTS = 8
"""Largest number of states that a session keeps."""


class TextRequest(Strict):
    """A position of the tip; `seq` and `client_time` are echoed."""

    seq: int = pydantic.Field(0, ge=0, lt=2**32)
    client_time: float = 0.0
    position: Position
    outputs: list[Literal["coordinates", "displacement", "von_mises", "stress"]] = pydantic.Field(
        [], max_length=4
    )


class TextCommand(Strict):
    """A request to keep the state of a session's tissue, or to go back to one that was kept."""

    snapshot: int | None = pydantic.Field(None, ge=0, lt=MOST_SNAPSHOTS)
    restore: int | None = pydantic.Field(None, ge=0, lt=MOST_SNAPSHOTS)


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
        message, allowed = "One of snapshot and restore is wanted", list(TextCommand.model_fields)
        raise Refusal("invalid_value", "snapshot", message, allowed)
    return next(iter(given.items()))


def names(bits: Output | Flag) -> list[str]:
    """List bits as messages in JSON have them."""
    return [str(bit.name).lower() for bit in bits]


def write_reply(frame: bytes) -> str:
    """Write a reply in JSON: bits as lists of names, the reason in words, null for infinity."""
    reply = frames.decode_reply(frame)
    document = {name: value for name, value in reply._asdict().items() if value is not None}
    document["flags"], document["outputs"] = names(Flag(reply.flags)), names(Output(reply.outputs))
    document["reason"] = frames.REASONS_MEAN[Reason(reply.reason)]
    return orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY).decode()


if __name__ == "__main__":
    PATH.write_text(document())
