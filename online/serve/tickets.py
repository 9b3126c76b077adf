"""Tickets to sessions: browsers send no ``Authorization`` with a handshake.

Who has the token gets a ticket for a moment, which stands in the address of the session. It is a
time signed with the token, so that any worker knows it for one.
"""

import hmac
import secrets
from hashlib import sha256

VALID = 30
"""Seconds that a ticket is valid."""


def issue(token: str, now: float) -> str:
    """Make a ticket at a time (s since the epoch)."""
    text = f"{int(now) + VALID}.{secrets.token_hex(8)}"
    return f"{text}.{_signature(token, text)}"


def is_valid(ticket: str, token: str, now: float) -> bool:
    """Whether a ticket was issued with this token and has not expired."""
    text, _, signature = ticket.rpartition(".")
    if not hmac.compare_digest(signature.encode(), _signature(token, text).encode()):
        return False
    return now <= int(text.partition(".")[0])


def _signature(token: str, text: str) -> str:
    return hmac.new(token.encode(), f"ticket {text}".encode(), sha256).hexdigest()
