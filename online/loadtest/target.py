"""What a load test is put on."""

import socket
from typing import NamedTuple
from urllib.parse import quote, urlsplit


class Target(NamedTuple):
    """A scene of a service.

    Parameters
    ----------
    url, scene : str
    token : str, optional
    """

    url: str
    scene: str
    token: str | None = None

    def connect(self) -> socket.socket:
        """Open a connection that sends at once whatever it is given."""
        parts = urlsplit(self.url)
        connection = socket.create_connection((parts.hostname, parts.port or 80), timeout=10)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return connection

    def path(self, verb: str) -> str:
        """Return the path of an endpoint of the scene."""
        return f"/scenes/{quote(self.scene, safe='')}/{verb}"

    def head(self, method: str, path: str, **headers: str) -> str:
        """Write the head of a request, but for the blank line that ends it."""
        lines = [
            f"{method} {path} HTTP/1.1",
            f"host: {urlsplit(self.url).netloc}",
            *(f"{name.replace('_', '-')}: {value}" for name, value in headers.items()),
            *([f"authorization: Bearer {self.token}"] if self.token else []),
        ]
        return "".join(f"{line}\r\n" for line in lines)
