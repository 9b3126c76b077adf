"""The binary layout of an answer, version 1, everything little-endian; for client and service.

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

import json
import math
import struct
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.shared.errors import PalpateError

JSON = "application/json"
BINARY = "application/octet-stream"

MAGIC = b"PLPT"
VERSION = 1

PREFIX = struct.Struct("<4sHHII")
DTYPES = {"float32": "<f4", "int32": "<i4", "uint8": "|u1"}

Head = dict[str, Any]
Floats = NDArray[np.float32]
Integers = NDArray[np.int32]
Bits = NDArray[np.uint8]


def decode(body: bytes) -> tuple[Head, dict[str, NDArray[Any]]]:
    """Read a document of the binary layout: its head, and its arrays as views into `body`.

    Raises `PalpateError` for bytes that are none.
    """
    if len(body) < PREFIX.size:
        raise PalpateError(f"{len(body)} bytes are too few for a document")
    magic, version, count, head_length, payload_length = PREFIX.unpack_from(body)
    if magic != MAGIC:
        raise PalpateError("not a Palpate document: wrong magic")
    if version != VERSION:
        raise PalpateError(f"layout version {version}; this reader knows version {VERSION}")
    start = PREFIX.size + head_length
    if len(body) != start + payload_length:
        raise PalpateError(f"{len(body)} bytes where the prefix says {start + payload_length}")
    head = json.loads(body[PREFIX.size : start])
    entries = head.pop("arrays")
    if len(entries) != count:
        raise PalpateError(f"{len(entries)} arrays where the prefix says {count}")
    arrays = {}
    for entry in entries:
        size = math.prod(entry["shape"])
        flat = np.frombuffer(body, DTYPES[entry["dtype"]], size, start + entry["offset"])
        arrays[entry["name"]] = flat.reshape(entry["shape"])
    return head, arrays


class Mesh(NamedTuple):
    """The undeformed mesh of a region: of each array what a row is, and its meaning."""

    nodes: Annotated[Floats, "vector", "(k, 3), mm; the order of every field of this region"]
    triangles: Annotated[Integers, "triangle", "(t, 3), nodes counter-clockwise from outside"]
    surface_nodes: Annotated[Integers, "number", "(s,), region surface's nodes among those of all"]
    clamped: Annotated[Bits, "bit", "(k,), 1 if held fixed"]


class Accessible(NamedTuple):
    """The surface that the endoscope can touch; its normal varies linearly over each triangle."""

    vertices: Annotated[Floats, "vector", "(v, 3), mm"]
    normals: Annotated[Floats, "vector", "(v, 3), outward unit normals at the vertices"]
    pressure_limit: Annotated[Floats, "value", "(v,), kPa, largest trained along the inward normal"]
    triangles: Annotated[Integers, "triangle", "(t, 3), vertices counter-clockwise from outside"]
    depth_limit: Annotated[
        Floats | None, "value", "(v,), mm, largest trained of the tip; absent without one"
    ] = None
