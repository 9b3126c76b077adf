"""The layout of frames as data and as text, made from the tables of `session.frames`.

``python -m palpate.online.session.protocol`` writes ``online/PROTOCOL.md``.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from palpate.online.session import frames
from palpate.online.session.frames import REPLY, REPLY_FIELDS, REQUEST, REQUEST_FIELDS, Field

PATH = Path(__file__).parents[1] / "PROTOCOL.md"


def document() -> str:
    """Describe the frames in a Markdown document."""
    return f"# Frames of a session\n\n{frames.__doc__}\n{tables()}".replace("``", "`")


def layout() -> dict[str, Any]:
    """Describe the layout, for the greeting of a session; JSON-able."""
    return {
        "version": frames.VERSION,
        "byte_order": "little",
        "request": _layout(REQUEST_FIELDS, REQUEST),
        "reply": _layout(REPLY_FIELDS, REPLY),
        "outputs": {bit.name: bit.value for bit in frames.Output},
        "flags": {bit.name: bit.value for bit in frames.Flag},
        "reasons": {reason.name: reason.value for reason in frames.Reason},
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
    for title, frame in (("Request", layout()["request"]), ("Reply", layout()["reply"])):
        lines += [f"{title}, {frame['size']} bytes:", ""]
        lines += ["| offset | field | type | unit | meaning |", "|---|---|---|---|---|"]
        for field in frame["fields"]:
            kind = field["type"] + "".join(f"[{n}]" for n in field["shape"])
            cells = field["offset"], field["name"], kind, field["unit"], field["meaning"]
            lines.append(f"| {' | '.join(map(str, cells))} |")
        lines.append("")
    values: dict[str, dict[Any, str]] = {
        "bit of `outputs`": frames.OUTPUTS_MEAN,
        "bit of `flags`": frames.FLAGS_MEAN,
        "`reason`": frames.REASONS_MEAN,
    }
    for title, meanings in values.items():
        lines += [f"| {title} | name | meaning |", "|---|---|---|"]
        lines += [f"| {v.value} | {v.name} | {meaning} |" for v, meaning in meanings.items()]
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    PATH.write_text(document())
