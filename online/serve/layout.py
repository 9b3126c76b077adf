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
start, `dtype` one of ``float64``, ``float32``, ``int32``, ``int16`` and ``uint8``. Wider ones come
first, so that each can be viewed in place (``new Float32Array(buffer, 16 + H + offset, n)``).
"""

import json
import math
import struct
from collections.abc import Callable, Mapping
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from palpate.shared.errors import PalpateError

JSON = "application/json"
BINARY = "application/octet-stream"

MAGIC = b"PLPT"
VERSION = 1

PREFIX = struct.Struct("<4sHHII")
DTYPES = {"float64": "<f8", "float32": "<f4", "int32": "<i4", "int16": "<i2", "uint8": "|u1"}

Head = dict[str, Any]
Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
Integers = NDArray[np.int32]
Shorts = NDArray[np.int16]
Bits = NDArray[np.uint8]

MOST = 32767
"""Steps of the largest value of a mode."""


def _dumps(document: Head) -> bytes:
    return json.dumps(document, separators=(",", ":")).encode()


def encode(
    head: Head, arrays: Mapping[str, NDArray[Any]], dumps: Callable[[Head], bytes] = _dumps
) -> bytes:
    """Write a document; arrays are C-contiguous, of the dtypes of the layout, wider ones first."""
    entries = []
    offset = 0
    for name, array in arrays.items():
        entries.append(
            {"name": name, "dtype": array.dtype.name, "shape": array.shape, "offset": offset}
        )
        offset += array.nbytes
    text = dumps({**head, "arrays": entries})
    text += b" " * (-len(text) % 8)
    prefix = PREFIX.pack(MAGIC, VERSION, len(entries), len(text), offset)
    return b"".join((prefix, text, *(array.data for array in arrays.values())))


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
    try:
        head = json.loads(body[PREFIX.size : start])
        entries = head.pop("arrays")
        arrays = {entry["name"]: _array(body, start, entry) for entry in entries}
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        raise PalpateError("not a Palpate document: its head says nonsense") from None
    if len(arrays) != count:
        raise PalpateError(f"{len(arrays)} arrays where the prefix says {count}")
    return head, arrays


def _array(body: bytes, start: int, entry: Head) -> NDArray[Any]:
    """An array of a document whose payload starts there, as a view."""
    shape, offset = [int(extent) for extent in entry["shape"]], int(entry["offset"])
    if min([offset, *shape]) < 0:
        raise ValueError
    flat = np.frombuffer(body, DTYPES[entry["dtype"]], math.prod(shape), start + offset)
    return flat.reshape(shape)


class Answers(NamedTuple):
    """Answers to n loads or positions of the tip, each from rest; null in JSON is infinity."""

    contact_point: Annotated[Doubles, "vector", "(n, 3), mm, on the surface, or of the tip"]
    normal: Annotated[Doubles, "vector", "(n, 3), outward there, or along the tip's force"]
    force: Annotated[Doubles, "vector", "(n, 3), mN"]
    contact_displacement: Annotated[Doubles, "vector", "(n, 3), mm, under a load"]
    distance: Annotated[Doubles, "value", "(n,), mm, of the position from the surface"]
    error_displacement: Annotated[Doubles, "estimate", "(n,), estimated, relative"]
    error_von_mises: Annotated[Doubles, "estimate", "(n,), estimated, relative"]
    error_force: Annotated[Doubles, "estimate", "(n,), estimated, relative, of the tip"]
    min_jacobian: Annotated[Doubles, "value", "(n,), smallest volume ratio"]
    limit: Annotated[Doubles, "value", "(n,), kPa or mm of depth, largest trained there"]
    iterations: Annotated[Integers, "number", "(n,), Newton steps"]
    converged: Annotated[Bits, "bit", "(n,), 0 where there is no equilibrium, and no force"]
    in_range: Annotated[Bits, "bit", "(n,), 1 within what the model was trained for"]


class Mesh(NamedTuple):
    """The undeformed mesh of a region: of each array what a row is, and its meaning."""

    nodes: Annotated[Floats, "vector", "(k, 3), mm; the order of every field of this region"]
    triangles: Annotated[Integers, "triangle", "(t, 3), nodes counter-clockwise from outside"]
    surface_nodes: Annotated[Integers, "number", "(s,), region surface's nodes among those of all"]
    clamped: Annotated[Bits, "bit", "(k,), 1 if held fixed"]

    def normals(self, displacement: ArrayLike = 0.0) -> NDArray[np.float64]:
        """Outward unit normals (k, 3) of the surface as it is displaced (k, 3) mm; inside 0."""
        at = np.asarray(self.nodes, float) + np.asarray(displacement, float)
        a, b, c = (at[self.triangles[:, corner]] for corner in range(3))
        found = np.zeros_like(at)
        np.add.at(found, self.triangles, np.cross(b - a, c - a)[:, None])
        length = np.linalg.norm(found, axis=1, keepdims=True)
        return np.divide(found, length, out=found, where=length > 0.0)


class Accessible(NamedTuple):
    """The surface that the endoscope can touch; its normal varies linearly over each triangle."""

    vertices: Annotated[Floats, "vector", "(v, 3), mm"]
    normals: Annotated[Floats, "vector", "(v, 3), outward unit normals at the vertices"]
    pressure_limit: Annotated[Floats, "value", "(v,), kPa, largest trained along the inward normal"]
    triangles: Annotated[Integers, "triangle", "(t, 3), vertices counter-clockwise from outside"]
    depth_limit: Annotated[
        Floats | None, "value", "(v,), mm, largest trained of the tip; absent without one"
    ] = None


class Centres(NamedTuple):
    """The local models of a scene, by their numbers."""

    centres: Annotated[Floats, "vector", "(p, 3), mm, on the surface"]


class Modes(NamedTuple):
    """Modes of a local model at the surface's nodes, orthonormal in energy."""

    steps: Annotated[Floats, "value", "(r,), mm, of each mode"]
    modes: Annotated[Shorts, "steps", "(s, r, 3), in steps"]
