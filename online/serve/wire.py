"""The three formats of an answer: JSON, msgpack and the binary layout of ``serve.layout``.

A document is a JSON-able head and some named arrays. JSON has the arrays as nested lists under
``fields``. Msgpack has each there as ``{"dtype", "shape", "data"}``, with the bytes as in the
binary layout.
"""

import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import msgpack
import orjson
from numpy.typing import NDArray

from palpate.online.serve import layout
from palpate.online.serve.errors import Refusal
from palpate.online.serve.layout import BINARY, JSON, Head

MSGPACK = "application/msgpack"
OFFERED = (JSON, BINARY, MSGPACK)

Arrays = Mapping[str, NDArray[Any]]


def encode(media_type: str, head: Head, arrays: Arrays) -> bytes:
    """Write a document in one of the formats on offer.

    Arrays are C-contiguous, of the dtypes of the layout, wider ones first.
    """
    if media_type == JSON:
        return orjson.dumps({**head, "fields": arrays}, option=orjson.OPT_SERIALIZE_NUMPY)
    if media_type == MSGPACK:
        fields = {
            name: {"dtype": array.dtype.name, "shape": array.shape, "data": array.tobytes()}
            for name, array in arrays.items()
        }
        return msgpack.packb({**head, "fields": fields})
    return layout.encode(head, arrays, orjson.dumps)


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
