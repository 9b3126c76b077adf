"""What the service can be told."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Settings:
    """Settings of one service.

    Parameters
    ----------
    artifacts : Path
        Directory of the artifacts to serve.
    max_body : int, bytes
        Largest request body. A query needs some hundred bytes.
    max_json_numbers : int
        Most field values in one JSON answer. The event loop serves nobody else while it writes
        them (about 25 ns each); larger fields are for the binary formats.
    max_sessions : int
        Most sessions at a time.
    session_idle : float, s
        A session that has sent nothing for so long is closed.
    echo : bool
        Whether ``/echo`` answers, for measurements.
    """

    artifacts: Path
    max_body: int = 64 * 1024
    max_json_numbers: int = 100_000
    max_sessions: int = 16
    session_idle: float = 60.0
    echo: bool = False
