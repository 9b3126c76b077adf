"""A small client of the HTTP service: answers as arrays, refusals as exceptions."""

import http.client
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from palpate.online.client.session import ServiceError, Session, scene_path, split_address
from palpate.online.serve import wire
from palpate.online.serve.schemas import Accessible, Mesh
from palpate.online.serve.wire import BINARY, JSON
from palpate.shared.arrays import Array, Field
from palpate.shared.errors import PalpateError


class Answer(NamedTuple):
    """How the tissue answers a load; fields are None if they were not asked for."""

    contact: dict[str, Any]  # this, trust and timing are described by the service's /docs
    trust: dict[str, Any]
    timing: dict[str, float]
    force: Array  # (3,), mN, on the tool
    contact_displacement: Array  # (3,), mm
    displacement: Field | None  # (k, 3), mm
    von_mises: Field | None  # (k,), kPa


class Client:
    """One connection to a service, with the `token` it asks for and how long to wait (s).

    Examples
    --------
    >>> with Client("http://127.0.0.1:8000") as client:             # doctest: +SKIP
    ...     answer = client.solve("turbinate", (10.0, 20.0, 11.0), pressure=3.5, region="surface")
    ...     print(answer.force, answer.displacement.max())
    """

    def __init__(self, url: str, token: str | None = None, timeout: float = 10.0) -> None:
        parts = split_address(url)
        self._url, self._token, self._timeout = url, token, timeout
        self._headers = {"Content-Type": JSON}
        if token is not None:
            self._headers["Authorization"] = f"Bearer {token}"
        self._connection = http.client.HTTPConnection(parts.netloc, timeout=timeout)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()

    def scenes(self) -> dict[str, Any]:
        """Ask what is served and what was refused."""
        return json.loads(self._request("GET", "/scenes", JSON))

    def scene(self, name: str) -> dict[str, Any]:
        """Ask what may be asked of a scene, and how well it is answered."""
        return json.loads(self._request("GET", scene_path(name), JSON))

    def mesh(self, name: str, region: str = "surface") -> Mesh:
        """Get the undeformed mesh of a region, ``surface`` or ``all``."""
        return Mesh(**self._document("GET", name, f"/mesh?region={quote(region)}")[1])

    def accessible(self, name: str) -> Accessible:
        """Get the undeformed surface that the endoscope can touch."""
        return Accessible(**self._document("GET", name, "/accessible")[1])

    def solve(
        self,
        name: str,
        position: Sequence[float],
        pressure: float,
        direction: Sequence[float] | None = None,
        radius: float | None = None,
        outputs: Sequence[str] = ("displacement", "von_mises"),
        region: str = "none",
    ) -> Answer:
        """Press the tissue at a position (mm) with a pressure (kPa).

        The direction is by default the inward normal, the radius (mm) the scene's. `outputs` are
        the fields to return, for the nodes of `region`: ``none``, ``surface`` or ``all``.
        Raises `ServiceError` if the service refuses.
        """
        contact = {
            "position": list(position),
            "pressure": pressure,
            "direction": None if direction is None else list(direction),
            "radius": radius,
        }
        body = json.dumps({"contacts": [contact], "outputs": list(outputs), "region": region})
        head, fields = self._document("POST", name, "/solve", body.encode())
        vectors = {name: np.array(head[name]) for name in ("force", "contact_displacement")}
        return Answer._make(map({**head, **vectors, **fields}.get, Answer._fields))

    def session(self, name: str, record: Path | None = None) -> Session:
        """Open a session of a scene, on a connection of its own; see `Session`."""
        return Session(self._url, name, self._token, self._timeout, record)

    def _document(
        self, method: str, name: str, rest: str, body: bytes | None = None
    ) -> tuple[wire.Head, dict[str, NDArray[Any]]]:
        return wire.decode(self._request(method, scene_path(name, rest), BINARY, body))

    def _request(self, method: str, path: str, accept: str, body: bytes | None = None) -> bytes:
        try:
            self._connection.request(method, path, body, {"Accept": accept, **self._headers})
            response = self._connection.getresponse()
        except ConnectionRefusedError:
            raise PalpateError(f"{self._url}: no service answers there") from None
        content = response.read()
        if response.status != 200:
            raise ServiceError(response.status, json.loads(content)["error"])
        return content
