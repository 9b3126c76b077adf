"""A small client of the HTTP service: answers as arrays, refusals as exceptions."""

import http.client
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self
from urllib.parse import quote

import numpy as np
from numpy.typing import ArrayLike, NDArray

from palpate.online.client.session import (
    Session,
    no_service,
    refusal,
    scene_path,
    secure,
    split_address,
)
from palpate.online.serve import layout
from palpate.online.serve.layout import BINARY, JSON, Accessible, Answers, Mesh
from palpate.shared.arrays import Array, Field
from palpate.shared.errors import PalpateError


class Answer(NamedTuple):
    """How the tissue answers a load; names are those of ``shared.answer.Answer``."""

    contact_point: Array  # (3,) mm, on the surface
    normal: Array  # (3,) outward there
    distance: float  # mm, of the queried position from the surface
    direction: Array  # (3,) of the load
    pressure: float  # kPa
    radius: float  # mm
    force: Array  # (3,) mN, on the tool
    contact_displacement: Array  # (3,) mm
    converged: bool
    iterations: int
    in_range: bool
    out_of_range: tuple[str, ...]
    error_displacement: float  # estimated, relative; infinite beyond the range
    error_von_mises: float
    min_jacobian: float
    pressure_limit: float  # kPa
    depth_limit: float  # mm; 0 in a scene without a tip
    time: float = 0.0  # s, since rest, of a history's step
    displacement: Field | None = None  # (k, 3) mm; this and stress are None if not asked for
    von_mises: Field | None = None  # (k,) kPa
    peak: Mapping[str, Any] | None = None  # largest displacement and stress, if asked for
    timing: Mapping[str, float] = {}  # µs, where the service's time went


def _answer(head: Mapping[str, Any], **more: Any) -> Answer:
    """An answer of what a document says of it."""
    contact, trust = head["contact"], head["trust"]
    errors = {
        f"error_{name}": math.inf if error is None else error
        for name, error in trust["error_estimate"].items()
    }
    told = {**contact, **trust, **head, **errors, **more}
    told |= {"contact_point": contact["position"], "out_of_range": tuple(trust["out_of_range"])}
    told["depth_limit"] = contact["depth_limit"] or 0.0
    vectors = "contact_point", "normal", "direction", "force", "contact_displacement"
    told |= {name: np.array(told[name]) for name in vectors}
    return Answer(**{name: told[name] for name in Answer._fields if name in told})


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
        self._headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        self._connection = http.client.HTTPConnection(parts.netloc, timeout=timeout)
        if parts.scheme == "https":
            self._connection = http.client.HTTPSConnection(
                parts.netloc, timeout=timeout, context=secure()
            )

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
        young: float | None = None,
    ) -> Answer:
        """Press the tissue at a position (mm) with a pressure (kPa).

        The direction is by default the inward normal, the radius (mm) the scene's. `outputs` are
        the fields to return, for the nodes of `region`: ``none``, ``surface`` or ``all``; with
        ``peak`` among them the answer has the largest values of the whole body as well. The
        tissue has the scene's Young's modulus unless `young` (kPa) is given, here and below.
        Raises `ServiceError` if the service refuses.
        """
        contact = _contact(position, pressure, direction, radius)
        asked = {"contacts": [contact], "outputs": list(outputs), "region": region, "young": young}
        head, fields = self._document("POST", name, "/solve", json.dumps(asked).encode())
        return _answer(head, **fields)

    def history(
        self,
        name: str,
        steps: Sequence[tuple[float, Sequence[float] | None, float]],
        outputs: Sequence[str] = ("displacement", "von_mises"),
        region: str = "none",
        young: float | None = None,
    ) -> list[Answer]:
        """Press visco-elastic tissue over time: times (s), positions (mm) and pressures (kPa).

        Without a position nothing presses. Fields are those at the end, in the last answer.
        """
        asked = {
            "steps": [
                {"time": time, "contact": None if at is None else _contact(at, pressure)}
                for time, at, pressure in steps
            ],
            "outputs": list(outputs),
            "region": region,
            "young": young,
        }
        head, fields = self._document("POST", name, "/history", json.dumps(asked).encode())
        *before, last = head["steps"]
        return [*map(_answer, before), _answer(last, timing=head["timing"], **fields)]

    def solve_many(
        self,
        name: str,
        positions: ArrayLike,
        pressures: ArrayLike,
        directions: ArrayLike | None = None,
        young: float | None = None,
    ) -> Answers:
        """Press with many loads: positions (n, 3) mm, pressures (n,) kPa, directions (n, 3)."""
        asked = {"positions": positions, "pressures": pressures, "directions": directions}
        return self._many(name, "/solve-many", asked, young)

    def touch(self, name: str, positions: ArrayLike, young: float | None = None) -> Answers:
        """Touch with the rigid tip at many positions (n, 3) mm of its centre, each from rest."""
        return self._many(name, "/touch", {"positions": positions}, young)

    def _many(
        self,
        name: str,
        rest: str,
        asked: Mapping[str, ArrayLike | None],
        young: float | None,
    ) -> Answers:
        given = {key: np.array(rows, float) for key, rows in asked.items() if rows is not None}
        body = layout.encode({"young": young}, given)
        found = self._document("POST", name, rest, body, BINARY)[1]
        return Answers(**found)

    def session(self, name: str, record: Path | None = None, reconnect: float = 0.0) -> Session:
        """Open a session of a scene, on a connection of its own; see `Session`."""
        return Session(self._url, name, self._token, self._timeout, record, reconnect)

    def _document(
        self, method: str, name: str, rest: str, body: bytes | None = None, kind: str = JSON
    ) -> tuple[layout.Head, dict[str, NDArray[Any]]]:
        return layout.decode(self._request(method, scene_path(name, rest), BINARY, body, kind))

    def _request(
        self, method: str, path: str, accept: str, body: bytes | None = None, kind: str = JSON
    ) -> bytes:
        headers = {"Accept": accept, "Content-Type": kind, **self._headers}
        for kept in (self._connection.sock is not None, False):
            try:
                self._connection.request(method, path, body, headers)
                response = self._connection.getresponse()
                content = response.read()
                break
            except TimeoutError:
                self._connection.close()
                raise PalpateError(f"{self._url}: no answer in {self._timeout} s") from None
            except (OSError, http.client.HTTPException) as error:
                self._connection.close()
                if not kept:  # else it may only have been closed meanwhile
                    raise no_service(self._url, error) from error
        if response.status != 200:
            raise refusal(response.status, content)
        return content


def _contact(
    position: Sequence[float],
    pressure: float,
    direction: Sequence[float] | None = None,
    radius: float | None = None,
) -> dict[str, Any]:
    """A contact of a request, without what is left to the service."""
    asked: dict[str, Any] = {"position": list(map(float, position)), "pressure": pressure}
    if direction is not None:
        asked["direction"] = list(map(float, direction))
    return asked if radius is None else {**asked, "radius": radius}
