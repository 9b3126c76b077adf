"""The endpoints."""

from typing import Annotated, Any

import numpy as np
import orjson
from fastapi import FastAPI, Path, Request, Response
from fastapi.responses import PlainTextResponse
from starlette.routing import WebSocketRoute

from palpate.online.serve import wire
from palpate.online.serve.answer import answer
from palpate.online.serve.errors import Refusal
from palpate.online.serve.guard import METRICS
from palpate.online.serve.history import answer_history
from palpate.online.serve.metrics import CONTENT_TYPE, Metrics
from palpate.online.serve.negotiation import BINARY, JSON, MSGPACK, negotiate
from palpate.online.serve.schemas import (
    Accessible,
    Answer,
    Checked,
    HistoryAnswer,
    Mesh,
    MeshRegion,
    Problem,
    SceneList,
    SceneSummary,
    Status,
    parse_request,
)
from palpate.online.serve.settings import Settings
from palpate.online.serve.store import Model, Store
from palpate.online.session import frames
from palpate.online.session.echo import ECHO, Echo
from palpate.online.session.session import Sessions

SceneName = Annotated[str, Path(description="Name of a served scene.", examples=["turbinate"])]

_BODY = {
    "required": True,
    "content": {JSON: {"schema": {"$ref": "#/components/schemas/SolveRequest"}}},
}
_NAME = {
    "name": "name",
    "in": "path",
    "required": True,
    "description": "Name of a served scene.",
    "schema": {"type": "string"},
    "example": "turbinate",
}
# The hot endpoints take the bare request: reading its path and body here is 25 µs faster than
# having the framework do it, so their parameters are declared by hand.
_BY_HAND: dict[str, Any] = {"parameters": [_NAME], "requestBody": _BODY}


def _problems(*codes: int) -> dict[int | str, dict[str, Any]]:
    """Describe the refusals of an endpoint: its own `codes` and those of the guard."""
    return {code: {"model": Problem} for code in sorted({401, 403, 421, 429, 503, *codes})}


def _document(model: type, what: str) -> dict[int | str, dict[str, Any]]:
    """Describe an answer that comes in three formats."""
    binary = {"type": "string", "format": "binary"}
    return {
        200: {
            "model": model,
            "description": what,
            "content": {
                BINARY: {"schema": {**binary, "description": wire.__doc__}},
                MSGPACK: {
                    "schema": {**binary, "description": "The JSON document, but for arrays."}
                },
            },
        }
    }


def add_routes(app: FastAPI, store: Store, settings: Settings, metrics: Metrics) -> None:
    """Give `app` its endpoints, the hot ones first: the router tries them in this order."""

    @app.post(
        "/scenes/{name}/solve",
        tags=["scenes"],
        response_model=None,
        responses={
            **_document(Answer, "How the tissue answers"),
            **_problems(404, 406, 413, 415, 422),
        },
        openapi_extra=_BY_HAND,
    )
    async def solve(request: Request) -> Response:
        """Press the tissue: force, displacement and stress under a load.

        Every request is answered from rest, independently of those before it. The header
        Server-Timing tells the time taken to decode, solve, recover and encode, in ms.
        """
        media_type = _media_type(request)
        model = store.model(request.path_params["name"])
        body = await _read(request, settings.max_body)
        return answer(model, body, media_type, settings.max_json_numbers, metrics)

    @app.post(
        "/scenes/{name}/history",
        tags=["scenes"],
        response_model=None,
        responses={
            **_document(HistoryAnswer, "How the tissue answers, step by step"),
            **_problems(404, 406, 413, 415, 422),
        },
        openapi_extra={
            "parameters": [_NAME],
            "requestBody": {
                "required": True,
                "content": {JSON: {"schema": {"$ref": "#/components/schemas/HistoryRequest"}}},
            },
        },
    )
    async def history(request: Request) -> Response:
        """Press visco-elastic tissue over time: force and displacement at every step.

        Every request starts at rest. Elastic scenes know no time and refuse.
        """
        media_type = _media_type(request)
        model = store.model(request.path_params["name"])
        body = await _read(request, settings.max_body)
        return answer_history(model, body, media_type, settings.max_json_numbers, metrics)

    @app.post(
        "/scenes/{name}/check",
        tags=["scenes"],
        response_model=None,
        responses={200: {"model": Checked}, **_problems(404, 413, 415, 422)},
        openapi_extra=_BY_HAND,
    )
    async def check(request: Request) -> Response:
        """Check that a solve request is well-formed, without solving it."""
        store.model(request.path_params["name"])
        parse_request(await _read(request, settings.max_body))
        return Response(b'{"valid":true}', media_type=JSON)

    @app.get("/health", tags=["service"], response_model=Status)
    async def health() -> Any:
        """Tell that the process lives."""
        return {"status": "ok"}

    @app.get("/ready", tags=["service"], response_model=Status, responses={503: {"model": Problem}})
    async def ready() -> Any:
        """Tell whether every model is loaded and warm."""
        store.require_ready()
        if not store.models:
            reasons = "; ".join(refused.reason for refused in store.refused)
            raise Refusal("not_ready", "", f"No artifact could be loaded: {reasons}")
        return {"status": "ready"}

    @app.get(METRICS, tags=["service"], response_class=PlainTextResponse, responses=_problems())
    async def tell_metrics() -> Response:
        """Tell what was counted and timed, of every worker, in the text format of Prometheus."""
        return Response(metrics.text(), media_type=CONTENT_TYPE)

    @app.get("/scenes", tags=["scenes"], response_model=SceneList, responses=_problems())
    async def scenes() -> Any:
        """List the scenes that are served, and the files that had to be refused."""
        store.require_ready()
        served = [
            {"name": name, "description": model.atlas.scene.description}
            for name, model in store.models.items()
        ]
        refused = [{"file": r.file, "reason": r.reason} for r in store.refused]
        return _json({"scenes": served, "refused": refused})

    @app.get(
        "/scenes/{name}",
        tags=["scenes"],
        response_model=SceneSummary,
        responses=_problems(404, 422),
    )
    async def scene(name: SceneName) -> Any:
        """Say what may be asked of a scene, and how well it is answered."""
        return _json(_summary(store.model(name)))

    @app.get(
        "/scenes/{name}/mesh",
        tags=["scenes"],
        response_model=None,
        responses={**_document(Mesh, "The mesh"), **_problems(404, 406, 422)},
    )
    async def mesh(name: SceneName, request: Request, region: MeshRegion = "surface") -> Response:
        """Get the undeformed mesh that the fields of a region belong to.

        In the binary formats nodes are float32, triangles and surface_nodes int32, clamped uint8
        (0 or 1, in JSON too).
        """
        media_type = _media_type(request)
        model = store.model(name)
        body = model.meshes.get((region, media_type))
        if body is None:
            body = model.meshes[region, media_type] = _mesh(model, region, media_type)
        return Response(body, media_type=media_type)

    @app.get(
        "/scenes/{name}/accessible",
        tags=["scenes"],
        response_model=None,
        responses={
            **_document(Accessible, "The accessible surface"),
            **_problems(404, 406, 422),
        },
    )
    async def accessible(name: SceneName, request: Request) -> Response:
        """Get the part of the surface that the endoscope can touch, undeformed.

        It is finer than the mesh of the fields. In the binary formats vertices and normals are
        float32, triangles int32.
        """
        media_type = _media_type(request)
        atlas = store.model(name).atlas
        arrays = {
            "vertices": atlas.surface.vertices.astype(np.float32),
            "normals": atlas.surface.normals.astype(np.float32),
            "triangles": np.ascontiguousarray(atlas.surface.triangles, np.int32),
        }
        return Response(wire.encode(media_type, {"scene": name}, arrays), media_type=media_type)

    @app.get(
        "/scenes/{name}/session",
        tags=["scenes"],
        response_model=None,
        responses={
            101: {"description": frames.__doc__ + "\n\n" + frames.tables()},
            **_problems(404, 422, 426),
        },
    )
    async def session(name: SceneName) -> Response:
        """Open a session (WebSocket): send positions of the tip, get forces.

        The first message of the service is a hello in JSON that states the layout of the frames.
        A text message is answered in JSON, a binary one in binary.
        """
        store.model(name)
        raise Refusal("upgrade_required", "upgrade", "A session is opened by a WebSocket handshake")

    app.router.routes.append(
        WebSocketRoute("/scenes/{name}/session", Sessions(store, settings, metrics))
    )
    if settings.echo:
        app.router.routes.append(WebSocketRoute(ECHO, Echo()))


def _media_type(request: Request) -> str:
    return negotiate(",".join(request.headers.getlist("accept")))


async def _read(request: Request, limit: int) -> bytes:
    """Read the body of a JSON request, of at most `limit` bytes."""
    content_type = request.headers.get("content-type", "")
    if content_type.split(";", 1)[0].strip().lower() != JSON:
        raise Refusal("unsupported_media_type", "content-type", "The body must be JSON", [JSON])
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > limit:
            raise Refusal("body_too_large", "body", "The body is too large", {"max_bytes": limit})
    return body


def _json(document: dict[str, Any]) -> Response:
    return Response(orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY), media_type=JSON)


def _mesh(model: Model, region: str, media_type: str) -> bytes:
    atlas = model.atlas
    surface = np.ascontiguousarray(atlas.surface_nodes, np.int32)
    triangles = np.ascontiguousarray(atlas.surface_triangles, np.int32)
    whole = region == "all"
    arrays: dict[str, Any] = {
        "nodes": (atlas.nodes if whole else atlas.nodes[surface]).astype(np.float32),
        "triangles": surface[triangles] if whole else triangles,
        "surface_nodes": surface,
        "clamped": (atlas.clamped if whole else atlas.clamped[surface]).astype(np.uint8),
    }
    return wire.encode(media_type, {"scene": atlas.name, "region": region}, arrays)


def _summary(model: Model) -> dict[str, Any]:
    atlas = model.atlas
    scene = atlas.scene
    return {
        "name": atlas.name,
        "description": scene.description,
        "ranges": {
            "pressure": [0.0, atlas.pressure_max],
            "tilt": [0.0, scene.endoscope.max_tilt],
            "radius": scene.endoscope.radius,
            "reach": scene.endoscope.reach,
        },
        "tolerance": scene.tolerance.model_dump(),
        "size": {
            "nodes": len(atlas.nodes),
            "dofs": 3 * len(atlas.nodes),
            "surface_nodes": len(atlas.surface_nodes),
            "triangles": len(atlas.surface_triangles),
        },
        "info": atlas.info,
        "example": {"contacts": [model.example]},
    }
