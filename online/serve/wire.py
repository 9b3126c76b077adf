"""The three formats of an answer: JSON, msgpack and the binary layout below.

A document is a JSON-able head and some named arrays. JSON has the arrays as nested lists under
``fields``. Msgpack has each there as ``{"dtype", "shape", "data"}``, with the bytes as in the
binary layout. That layout, version 1, everything little-endian:

====== ======== ==========================================================================
offset type     meaning
====== ======== ==========================================================================
0      4 bytes  magic, ``PLPT``
4      uint16   version of the layout, 1
6      uint16   number of arrays
8      uint32   H, the length of the head in bytes, padding included; a multiple of 8
12     uint32   P, the length of the payload in bytes
16     H bytes  the head: JSON in UTF-8, padded with spaces
16 + H P bytes  the payload: the arrays one after the other, C order, no gaps
====== ======== ==========================================================================

The head is the JSON answer with ``arrays`` in place of ``fields``: a list of
``{"name", "dtype", "shape", "offset"}`` in payload order, `offset` in bytes from the payload's
start, `dtype` one of ``float32``, ``int32`` and ``uint8``. Four-byte arrays come first, so that
each can be viewed in place (``new Float32Array(buffer, 16 + H + offset, n)``).
"""

import math
import re
import struct
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import msgpack
import numpy as np
import orjson
from numpy.typing import NDArray

from palpate.online.serve.errors import Refusal
from palpate.shared.errors import PalpateError

JSON = "application/json"
BINARY = "application/octet-stream"
MSGPACK = "application/msgpack"
OFFERED = (JSON, BINARY, MSGPACK)

MAGIC = b"PLPT"
VERSION = 1

_PREFIX = struct.Struct("<4sHHII")
_DTYPES = {"float32": "<f4", "int32": "<i4", "uint8": "|u1"}

Head = dict[str, Any]
Arrays = Mapping[str, NDArray[Any]]


def encode(media_type: str, head: Head, arrays: Arrays) -> bytes:
    """Write a document in one of the formats on offer.

    Arrays are C-contiguous, of the dtypes float32, int32 and uint8, the last kind last.
    """
    if media_type == JSON:
        return orjson.dumps({**head, "fields": arrays}, option=orjson.OPT_SERIALIZE_NUMPY)
    if media_type == MSGPACK:
        fields = {
            name: {"dtype": array.dtype.name, "shape": array.shape, "data": array.tobytes()}
            for name, array in arrays.items()
        }
        return msgpack.packb({**head, "fields": fields})
    entries = []
    offset = 0
    for name, array in arrays.items():
        entries.append(
            {"name": name, "dtype": array.dtype.name, "shape": array.shape, "offset": offset}
        )
        offset += array.nbytes
    text = orjson.dumps({**head, "arrays": entries})
    text += b" " * (-len(text) % 8)
    prefix = _PREFIX.pack(MAGIC, VERSION, len(entries), len(text), offset)
    return b"".join((prefix, text, *(array.data for array in arrays.values())))


def decode(body: bytes) -> tuple[Head, dict[str, NDArray[Any]]]:
    """Read a document of the binary layout: its head, and its arrays as views into `body`.

    Raises `PalpateError` for bytes that are none.
    """
    if len(body) < _PREFIX.size:
        raise PalpateError(f"{len(body)} bytes are too few for a document")
    magic, version, count, head_length, payload_length = _PREFIX.unpack_from(body)
    if magic != MAGIC:
        raise PalpateError("not a Palpate document: wrong magic")
    if version != VERSION:
        raise PalpateError(f"layout version {version}; this reader knows version {VERSION}")
    start = _PREFIX.size + head_length
    if len(body) != start + payload_length:
        raise PalpateError(f"{len(body)} bytes where the prefix says {start + payload_length}")
    head = orjson.loads(body[_PREFIX.size : start])
    entries = head.pop("arrays")
    if len(entries) != count:
        raise PalpateError(f"{len(entries)} arrays where the prefix says {count}")
    arrays = {}
    for entry in entries:
        size = math.prod(entry["shape"])
        flat = np.frombuffer(body, _DTYPES[entry["dtype"]], size, start + entry["offset"])
        arrays[entry["name"]] = flat.reshape(entry["shape"])
    return head, arrays


_QUALITY = re.compile(r"0(\.\d{0,3})?|1(\.0{0,3})?", re.ASCII)
"""How much a type is liked, from 0 to 1."""


@lru_cache(maxsize=64)
def negotiate(accept: str) -> str:
    """Choose the offered media type that `accept` likes best; JSON if it does not mind.

    Of types liked equally the first on offer wins, unless another is named more exactly.
    """
    qualities = {}  # of media ranges; zero where they make no sense
    for part in (accept.strip() or "*/*").split(","):
        name, *parameters = (piece.strip().lower() for piece in part.split(";"))
        quality = next((p[2:] for p in parameters if p.startswith("q=")), "1")
        qualities[name] = float(quality) if _QUALITY.fullmatch(quality) else 0.0

    def liking(offered: str) -> tuple[float, int]:
        """Quality of the most exact range that matches, even if it says no; how exact it is."""
        kinds = ("*/*", offered.split("/")[0] + "/*", offered)
        exactness = max((i for i, kind in enumerate(kinds) if kind in qualities), default=0)
        return qualities.get(kinds[exactness], 0.0), exactness

    best = max(OFFERED, key=liking)
    if liking(best)[0] == 0.0:
        message = "None of the accepted formats is on offer"
        raise Refusal("not_acceptable", "accept", message, OFFERED)
    return best
