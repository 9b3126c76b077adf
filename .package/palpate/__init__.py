"""Palpate: soft tissue pressed in real time, by reduced finite element models."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from palpate.online.client.frame import Frame
    from palpate.online.client.http import Client
    from palpate.online.client.session import ServiceError, Session, SessionClosed
    from palpate.online.session.frames import Flag, Output
    from palpate.shared.errors import PalpateError
    from palpate.shared.model import ReducedModel
    from palpate.shared.reduced.transfer import REST

__all__ = [
    "REST",
    "Client",
    "Flag",
    "Frame",
    "Output",
    "PalpateError",
    "ReducedModel",
    "ServiceError",
    "Session",
    "SessionClosed",
]

_WHERE = {
    "REST": "palpate.shared.reduced.transfer",
    "Client": "palpate.online.client.http",
    "Frame": "palpate.online.client.frame",
    "ReducedModel": "palpate.shared.model",
    "Session": "palpate.online.client.session",
    "SessionClosed": "palpate.online.client.session",
    "ServiceError": "palpate.online.client.session",
    "Flag": "palpate.online.session.frames",
    "Output": "palpate.online.session.frames",
    "PalpateError": "palpate.shared.errors",
}

if not (Path(__file__).parent / "shared").is_dir():  # a checkout without symbolic links
    __path__.append(str(Path(__file__).parents[2]))


def __getattr__(name: str) -> Any:
    """Import what is asked for, so that a client loads no solver and a solver no client."""
    if name not in _WHERE:
        raise AttributeError(f"module 'palpate' has no attribute {name!r}")
    return getattr(import_module(_WHERE[name]), name)
