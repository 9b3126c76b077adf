"""Which format on offer a client's ``Accept`` header asks for (RFC 9110, section 12.5.1)."""

import re
from functools import lru_cache

from palpate.online.serve.errors import Refusal

JSON = "application/json"
BINARY = "application/octet-stream"
MSGPACK = "application/msgpack"
OFFERED = (JSON, BINARY, MSGPACK)

_RANGE = re.compile(
    r"\s*([\w!#$&^.+*-]+)/([\w!#$&^.+*-]+)\s*((?:;[^,]*)?)", re.ASCII
)  # type, subtype, parameters
_QUALITY = re.compile(r";\s*q\s*=\s*(0(?:\.\d{0,3})?|1(?:\.0{0,3})?)\s*(?:;|$)", re.I | re.ASCII)


@lru_cache(maxsize=64)
def negotiate(accept: str) -> str:
    """Choose the offered media type that `accept` likes best; JSON if it does not mind.

    Of types liked equally, the one named more exactly wins, then the first on offer.
    """
    ranges = [_parse(part) for part in accept.split(",")] if accept.strip() else [("*/*", 1.0)]
    best, score = "", (0.0, 0)
    for offered in OFFERED:
        # the most exact range that matches a type decides on it, even if it says no
        exactness, quality = max((_exactness(pattern, offered), q) for pattern, q in ranges)
        if exactness > 0 and quality > 0.0 and (quality, exactness) > score:
            best, score = offered, (quality, exactness)
    if not best:
        raise Refusal(
            "not_acceptable", "accept", "None of the accepted formats is on offer", OFFERED
        )
    return best


def _parse(part: str) -> tuple[str, float]:
    """Split a media range from its quality; a malformed one matches nothing."""
    match = _RANGE.fullmatch(part.rstrip())
    if match is None:
        return "", 0.0
    main, sub, parameters = match.groups()
    quality = _QUALITY.search(parameters)
    if quality is None and re.search(r";\s*q\s*=", parameters, re.I):
        return "", 0.0
    return f"{main}/{sub}".lower(), float(quality[1]) if quality else 1.0


def _exactness(pattern: str, offered: str) -> int:
    """Rank a match: 3 for the type itself, 2 for ``application/*``, 1 for ``*/*``, 0 for none."""
    if pattern == offered:
        return 3
    if pattern == offered.split("/")[0] + "/*":
        return 2
    return 1 if pattern == "*/*" else 0
