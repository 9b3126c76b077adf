"""A small client of the HTTP service: answers as arrays, refusals as exceptions.

Sessions are opened by the clients here and live in `client.session`.
"""

import http.client
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from palpate.online.client.session import ServiceError, Session, split_address
from palpate.online.serve import wire
from palpate.online.serve.negotiation import BINARY, JSON
from palpate.shared.errors import PalpateError


@dataclass(frozen=True)
class Answer:
    """How the tissue answers a load.

    Parameters
    ----------
    contact, trust, timing : dict
        As `serve.schemas` describes them.
    force : ndarray, shape (3,), mN
        On the tool.
    contact_displacement : ndarray, shape (3,), mm
    displacement : ndarray, shape (k, 3), float32, mm, or None if not asked for
    von_mises : ndarray, shape (k,), float32, kPa, or None if not asked for
    """

    contact: dict[str, Any]
    trust: dict[str, Any]
    timing: dict[str, float]
    force: NDArray[np.float64]
    contact_displacement: NDArray[np.float64]
    displacement: NDArray[np.float32] | None
    von_mises: NDArray[np.float32] | None


@dataclass(frozen=True)
class Mesh:
    """The mesh that the fields of a region belong to.

    Parameters
    ----------
    nodes : ndarray, shape (k, 3), float32, mm
    triangles : ndarray, shape (t, 3), int32
        Indices into `nodes`, outward.
    surface_nodes : ndarray, shape (s,), int32
        The surface nodes among all nodes.
    clamped : ndarray, shape (k,), uint8
    """

    nodes: NDArray[np.float32]
    triangles: NDArray[np.int32]
    surface_nodes: NDArray[np.int32]
    clamped: NDArray[np.uint8]


@dataclass(frozen=True)
class Accessible:
    """The surface that the endoscope can touch.

    Parameters
    ----------
    vertices, normals : ndarray, shape (v, 3), float32, mm and unit
    pressure_limit : ndarray, shape (v,), float32, kPa
        Largest trained pressure along the inward normal.
    triangles : ndarray, shape (t, 3), int32
        Indices into `vertices`, outward.
    depth_limit : ndarray, shape (v,), float32, mm, or None
        Largest trained depth of the tip; None if the scene was trained without a tip.
    """

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    pressure_limit: NDArray[np.float32]
    triangles: NDArray[np.int32]
    depth_limit: NDArray[np.float32] | None = None


class Client:
    """One connection to a service.

    Parameters
    ----------
    url : str
        Such as ``http://127.0.0.1:8000``.
    token : str, optional
        What the service asks for, if it does.
    timeout : float, s

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
        return json.loads(self._request("GET", _path(name), JSON))

    def mesh(self, name: str, region: str = "surface") -> Mesh:
        """Get the undeformed mesh of a region, ``surface`` or ``all``."""
        _, arrays = self._document("GET", name, f"/mesh?region={quote(region)}")
        return Mesh(**arrays)

    def accessible(self, name: str) -> Accessible:
        """Get the undeformed surface that the endoscope can touch."""
        _, arrays = self._document("GET", name, "/accessible")
        return Accessible(**arrays)

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
        """Press the tissue.

        Parameters
        ----------
        name : str
            A served scene.
        position : sequence of 3 floats, mm
        pressure : float, kPa
        direction : sequence of 3 floats, optional
            Default: the inward normal.
        radius : float, mm, optional
            Default: the scene's.
        outputs, region
            The fields to return, and for which nodes: ``none``, ``surface`` or ``all``.

        Raises
        ------
        ServiceError
            If the service refuses.
        """
        contact = {
            "position": list(position),
            "pressure": pressure,
            "direction": None if direction is None else list(direction),
            "radius": radius,
        }
        body = json.dumps({"contacts": [contact], "outputs": list(outputs), "region": region})
        head, fields = self._document("POST", name, "/solve", body.encode())
        return Answer(
            contact=head["contact"],
            trust=head["trust"],
            timing=head["timing"],
            force=np.array(head["force"]),
            contact_displacement=np.array(head["contact_displacement"]),
            displacement=fields.get("displacement"),
            von_mises=fields.get("von_mises"),
        )

    def session(self, name: str, record: Path | None = None) -> Session:
        """Open a session of a scene, on a connection of its own; see `Session`."""
        return Session(self._url, name, self._token, self._timeout, record)

    def _document(
        self, method: str, name: str, rest: str, body: bytes | None = None
    ) -> tuple[wire.Head, dict[str, NDArray[Any]]]:
        return wire.decode(self._request(method, _path(name) + rest, BINARY, body))

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


def _path(name: str) -> str:
    return f"/scenes/{quote(name, safe='')}"
