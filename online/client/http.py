"""A small client of the HTTP service: answers as arrays, refusals as exceptions.

Sessions are opened by the clients here and live in `client.session`.
"""

import asyncio
import http.client
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, ParamSpec, Self, TypeVar
from urllib.parse import quote, urlsplit

import numpy as np
from numpy.typing import NDArray

from palpate.online.client.session import AsyncSession, ServiceError, Session
from palpate.online.serve import wire
from palpate.online.serve.negotiation import BINARY, JSON
from palpate.shared.errors import PalpateError

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class Answer:
    """How the tissue answers a load.

    Parameters
    ----------
    contact, trust, timing : dict
        As `serve.schemas` describes them.
    force : ndarray, shape (3,), mN
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
    triangles : ndarray, shape (t, 3), int32
        Indices into `vertices`, outward.
    """

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    triangles: NDArray[np.int32]


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
    ...     answer = client.solve("turbinate", (13.1, 20.0, 9.5), pressure=4.0, region="surface")
    ...     print(answer.force, answer.displacement.max())
    """

    def __init__(self, url: str, token: str | None = None, timeout: float = 10.0) -> None:
        parts = urlsplit(url)
        if parts.scheme != "http" or parts.hostname is None:
            raise PalpateError(f"{url}: not an address like http://127.0.0.1:8000")
        self._url, self._token, self._timeout = url, token, timeout
        self._headers = {"Content-Type": JSON}
        if token is not None:
            self._headers["Authorization"] = f"Bearer {token}"
        self._connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=timeout)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._connection.close()

    def scenes(self) -> dict[str, Any]:
        """Ask what is served and what was refused."""
        return json.loads(self._request("GET", "/scenes", JSON))

    def scene(self, name: str) -> dict[str, Any]:
        """Ask what may be asked of a scene, and how well it is answered."""
        return json.loads(self._request("GET", f"/scenes/{quote(name, safe='')}", JSON))

    def mesh(self, name: str, region: str = "surface") -> Mesh:
        """Get the undeformed mesh of a region, ``surface`` or ``all``."""
        path = f"/scenes/{quote(name, safe='')}/mesh?region={quote(region)}"
        _, arrays = wire.decode(self._request("GET", path, BINARY))
        return Mesh(**arrays)

    def accessible(self, name: str) -> Accessible:
        """Get the undeformed surface that the endoscope can touch."""
        path = f"/scenes/{quote(name, safe='')}/accessible"
        _, arrays = wire.decode(self._request("GET", path, BINARY))
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
        contact: dict[str, Any] = {"position": list(position), "pressure": pressure}
        if direction is not None:
            contact["direction"] = list(direction)
        if radius is not None:
            contact["radius"] = radius
        body = json.dumps({"contacts": [contact], "outputs": list(outputs), "region": region})
        path = f"/scenes/{quote(name, safe='')}/solve"
        head, fields = wire.decode(self._request("POST", path, BINARY, body.encode()))
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

    def _request(self, method: str, path: str, accept: str, body: bytes | None = None) -> bytes:
        self._connection.request(method, path, body, {"Accept": accept, **self._headers})
        response = self._connection.getresponse()
        content = response.read()
        if response.status != 200:
            raise ServiceError(response.status, json.loads(content)["error"])
        return content


class AsyncClient:
    """The same client for asyncio; one request at a time.

    Examples
    --------
    >>> async with AsyncClient("http://127.0.0.1:8000") as client:     # doctest: +SKIP
    ...     answer = await client.solve("turbinate", (13.1, 20.0, 9.5), pressure=4.0)
    ...     async with client.session("turbinate") as session:
    ...         reply = await session.step((13.1, 20.0, 11.4))
    """

    def __init__(self, url: str, token: str | None = None, timeout: float = 10.0) -> None:
        self._client = Client(url, token, timeout)
        self._url, self._token, self._timeout = url, token, timeout
        self._turn = asyncio.Lock()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        async with self._turn:
            self._client.__exit__(kind, error, trace)

    async def scenes(self) -> dict[str, Any]:
        """Ask what is served; see `Client.scenes`."""
        return await self._call(self._client.scenes)

    async def scene(self, name: str) -> dict[str, Any]:
        """Ask about a scene; see `Client.scene`."""
        return await self._call(self._client.scene, name)

    async def mesh(self, name: str, region: str = "surface") -> Mesh:
        """Get the mesh of a region; see `Client.mesh`."""
        return await self._call(self._client.mesh, name, region)

    async def solve(
        self, name: str, position: Sequence[float], pressure: float, **options: Any
    ) -> Answer:
        """Press the tissue; see `Client.solve`."""
        return await self._call(self._client.solve, name, position, pressure, **options)

    def session(self, name: str, record: Path | None = None) -> AsyncSession:
        """Make a session of a scene; ``async with`` opens it."""
        return AsyncSession(self._url, name, self._token, self._timeout, record)

    async def _call(self, method: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        async with self._turn:
            return await asyncio.to_thread(method, *args, **kwargs)
