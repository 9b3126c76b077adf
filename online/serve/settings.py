"""The settings of a service."""

import ipaddress
import socket
from dataclasses import dataclass
from pathlib import Path

from palpate.shared.errors import PalpateError


@dataclass(frozen=True)
class Settings:
    """Settings of one service: the options of ``palpate serve``, whose help says what they mean.

    `hosts` are names that clients may call the service by, besides loopback; any, if empty.
    """

    artifacts: Path
    token: str | None = None
    origins: tuple[str, ...] = ()
    hosts: tuple[str, ...] = ()
    max_body: int = 64 * 1024
    max_json_numbers: int = 100_000
    rate_limit: float = 2000.0
    max_wait: float = 0.1
    max_sessions: int = 16
    session_idle: float = 60.0
    workers: int = 1
    realtime: bool = False
    log_format: str = "json"
    log_level: str = "info"
    access_log: bool = False
    echo: bool = False


def is_loopback(host: str) -> bool:
    """Tell whether every address of a name, which must have one, is of this machine alone."""
    if not host:
        return False  # any interface
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except OSError as error:
        raise PalpateError(f"--host {host}: {error.strerror}") from error
    return all(ipaddress.ip_address(str(address[4][0])).is_loopback for address in found)
