"""The layout of frames as data and as text, made from the tables of `session.frames`.

``python -m palpate.online.session.protocol`` writes ``online/PROTOCOL.md``.
"""

from collections.abc import Sequence
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
    return {
        "size": dtype.itemsize,
        "fields": [
            {
                "name": field.name,
                "offset": _offset(dtype, field),
                "type": field.type,
                "shape": field.shape,
                "unit": field.unit,
                "meaning": field.meaning,
            }
            for field in fields
        ],
    }


def tables() -> str:
    """Describe the layout in Markdown."""
    lines = []
    for title, fields, dtype in (
        ("Request", REQUEST_FIELDS, REQUEST),
        ("Reply", REPLY_FIELDS, REPLY),
    ):
        lines += [f"{title}, {dtype.itemsize} bytes:", ""]
        lines += ["| offset | field | type | unit | meaning |", "|---|---|---|---|---|"]
        lines += [
            f"| {_offset(dtype, f)} | {f.name} | {f.type}{_suffix(f)} | {f.unit} | {f.meaning} |"
            for f in fields
        ]
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


def _offset(dtype: np.dtype[Any], field: Field) -> int:
    assert dtype.fields is not None
    return int(dtype.fields[field.name][1])


def _suffix(field: Field) -> str:
    return "".join(f"[{n}]" for n in field.shape)


if __name__ == "__main__":
    PATH.write_text(document())
