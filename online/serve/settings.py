"""What the service can be told; ``palpate serve --help`` says how."""

import ipaddress
import socket
from dataclasses import dataclass
from pathlib import Path

from palpate.shared.errors import PalpateError


@dataclass(frozen=True)
class Settings:
    """Settings of one service.

    Parameters
    ----------
    artifacts : Path
        Directory of the artifacts to serve.
    token : str, optional
        What clients must present as ``Authorization: Bearer``. Default: nobody is asked.
    origins : tuple of str
        Origins whose web pages may use the service, besides its own; ``*`` for any.
    hosts : tuple of str
        Names that clients may call the service by, besides loopback addresses. Default: any.
    max_body : int, bytes
        Largest request body. A query needs some hundred bytes.
    max_json_numbers : int
        Most field values in one JSON answer. The event loop serves nobody else while it writes
        them (about 25 ns each); larger fields are for the binary formats.
    rate_limit : float, 1/s
        Requests per second and client address that are answered in the long run, and at once
        after a pause of a second; 0 for no limit. Of sessions only the opening counts.
    max_wait : float, s
        Longest that a request may have waited for its turn when it gets it; one that has waited
        longer is told to come back, so that a queue never grows beyond what is useful.
    max_sessions : int
        Most sessions at a time, of one worker.
    session_idle : float, s
        A session that has sent nothing for so long is closed.
    workers : int
        Processes that share the work.
    realtime : bool
        Whether to ask the system for real-time scheduling.
    log_format, log_level : str
        One of `serve.logs.FORMATS` and of `serve.logs.LEVELS`.
    access_log : bool
        Whether to log every request.
    echo : bool
        Whether ``/echo`` answers, for measurements.
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
    """Tell whether an address, or every address of a name, is reached from this machine alone.

    Raises
    ------
    PalpateError
        If the name has no address.
    """
    if not host:
        return False  # any interface
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except OSError as error:
        raise PalpateError(f"--host {host}: {error.strerror}") from error
    return all(ipaddress.ip_address(str(address[4][0])).is_loopback for address in found)
