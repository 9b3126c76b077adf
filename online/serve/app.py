"""The service as an ASGI application: how it starts, and its endpoints."""

import asyncio
import gc
import logging
import threading
from collections.abc import AsyncIterator, Callable, Collection, Coroutine
from contextlib import asynccontextmanager, suppress
from functools import partial
from importlib.metadata import version
from time import perf_counter, time
from typing import Annotated, Any, get_args, get_type_hints

import numpy as np
import orjson
from fastapi import APIRouter, FastAPI, Path, Query, Request, Response
from fastapi.responses import PlainTextResponse
from fastapi.routing import APIRoute
from starlette.exceptions import HTTPException
from starlette.middleware.cors import CORSMiddleware
from starlette.routing import WebSocketRoute
from starlette.websockets import WebSocket

from palpate.online.serve import errors, guard, layout, schemas, tickets, wire
from palpate.online.serve.answer import answer, checked
from palpate.online.serve.errors import Refusal, check_numbers
from palpate.online.serve.first_start import compile_kernels
from palpate.online.serve.metrics import CONTENT_TYPE, Metrics
from palpate.online.serve.page import pages
from palpate.online.serve.schemas import (
    HistoryRequest,
    ManyRequest,
    MeshRegion,
    SolveRequest,
    TouchRequest,
    parse,
)
from palpate.online.serve.service import ServedModel, Service
from palpate.online.serve.wire import BINARY, JSON, MSGPACK, OFFERED, negotiate
from palpate.online.session import frames, websocket
from palpate.online.session.recording import recorded
from palpate.online.session.session import Sessions
from palpate.shared.answer import Answers
from palpate.shared.arrays import number_type
from palpate.shared.errors import PalpateError, QueryError
from palpate.shared.files import printable
from palpate.shared.mechanics.footprint import TIP_DEPTH
from palpate.shared.model import ReducedModel

logger = logging.getLogger(__name__)

LOOKED = 1.0
"""Seconds between looks for artifacts that have been added, replaced or removed."""

MOST_RECORDED = 32 * 1024**2
"""Bytes of a recording that a page hands in: 100 000 answers."""

RECORDING = "application/x-hdf5"

DECODING = "palpate.decoding"
"""Key in the ASGI scope of when the decoding of the body began, s of `time.perf_counter`."""


def create_app(here: Service, on_ready: Callable[[], None] = lambda: None) -> FastAPI:
    """Make the application of a service.

    It answers at once; the models are loaded and warmed meanwhile, and ``/ready`` says when that
    is done; `on_ready` is then called on the thread that answers. One of several workers leaves
    all clients to the others until it is ready.
    """
    settings, sessions = here.settings, Sessions(here)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        ended = threading.Event()
        _prepare(here, sessions, on_ready, ended)
        if settings.workers > 1:
            await here.ready.wait()
        yield
        ended.set()

    app = FastAPI(
        title="Palpate",
        version=version("palpate"),
        summary="Press soft tissue and get its answer in real time",
        description=schemas.CONVENTIONS,
        lifespan=lifespan,
        exception_handlers=dict.fromkeys(errors.KINDS, errors.refuse),
        redirect_slashes=False,
        docs_url=None,  # the page of the service's own needs nobody else's files
        redoc_url=None,
        # Even unused it looks for a tracer in every request; the service times itself.
        telemetry={"tracing": False, "metrics": False, "logs": False},
    )
    app.state.service, app.state.sessions = here, sessions
    app.add_middleware(guard.Guard, settings=settings, metrics=here.metrics)
    if settings.origins:
        # outermost: preflights carry no token, and refusals must be readable by the page too
        app.add_middleware(
            CORSMiddleware,
            allow_origins=settings.origins,
            allow_methods=["GET", "POST"],
            allow_headers=["Authorization", "Content-Type"],
            expose_headers=["Server-Timing", "Retry-After"],
        )
    # FastAPI's own inclusion of a router makes a request 20 µs slower
    parts = queries, lists, scenes, service, pages
    app.router.routes += [route for part in parts for route in part.routes]
    sockets: dict[str, Any] = {"/scenes/{name}/session": sessions, "/{path:path}": _nothing_here}
    if settings.echo:
        sockets = {websocket.ECHO: websocket.echo, **sockets}
    app.router.routes += [WebSocketRoute(path, answers) for path, answers in sockets.items()]
    return app


async def _nothing_here(client: WebSocket) -> None:
    """Refuse a handshake at a path that has no session, as any request there."""
    response = errors.as_refusal(HTTPException(404)).response()
    await response(client.scope, client.receive, client.send)


def _prepare(
    here: Service, sessions: Sessions, on_ready: Callable[[], None], ended: threading.Event
) -> None:
    """Load and warm the models in a thread, which then looks for others until the service ends."""
    loop, warm_up = asyncio.get_running_loop(), partial(warm, sessions)

    def finish() -> None:
        gc.collect()
        gc.freeze()  # the collector need not look at the models again
        here.ready.set()
        on_ready()

    def load() -> None:
        compile_kernels(here.settings.artifacts)
        here.open(warm_up)
        with suppress(RuntimeError):  # the service has ended meanwhile
            loop.call_soon_threadsafe(finish)
        while not ended.wait(LOOKED):
            here.look(warm_up)

    logger.info("loading models; the first start of a release compiles kernels for a minute or two")
    # a daemon: a service that has to stop does not wait for it
    threading.Thread(target=load, name="loading", daemon=True).start()


def warm(sessions: Sessions, served: ServedModel) -> None:
    """Call every kernel and encoder once, so that no client pays for a first time."""
    warm_loads(served)
    warm_tip(sessions, served)


def warm_loads(served: ServedModel) -> None:
    """Ask about loads in every way."""
    uncounted, outputs = Metrics(), get_args(schemas.Output)
    for region, media_type in zip(("surface", "all", "none"), OFFERED, strict=True):
        asked = {"contacts": [served.example], "region": region, "outputs": outputs}
        body = orjson.dumps(asked)
        answer(served.model, parse(SolveRequest, body), media_type, uncounted)
    if tour := _tour(served):
        contacts = (
            {"position": at, "pressure": 0.1} for at in served.model.models.centres[tour].tolist()
        )
        steps = [{"time": 0.1 * i, "contact": contact} for i, contact in enumerate(contacts)]
        body = orjson.dumps({"steps": steps, "region": "all", "outputs": outputs})
        answer(served.model, parse(HistoryRequest, body), JSON, uncounted)
    served.model.solve_many([served.example["position"]], [served.example["pressure"]])


def warm_tip(sessions: Sessions, served: ServedModel) -> None:
    """Ask about the tip in every way, if the scene has one."""
    models, radius = served.model.models, served.model.scene.endoscope.radius
    if served.model.has_tip:
        served.model.touch_many([served.tip])
        above = [models.centres[k] + 0.9 * radius * models.frames[k, 0] for k in _tour(served)]
        sessions.prepare(served, [position.tolist() for position in above])


def _tour(served: ServedModel) -> list[int]:
    """Local models of a history: from one to the next and back; none without a past."""
    viscous = served.model.models.viscous
    if viscous is None:
        return []
    here, there = viscous.pairs[0]
    return [here, there, here]


SceneName = Annotated[str, Path(description="Name of a served scene.", examples=["turbinate"])]


class QueryRoute(APIRoute):
    """Reads path and body of a request itself; FastAPI, which describes them, takes 25 µs longer.

    Endpoints take the request, the name of the scene, and the `load` read from the body.
    """

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return what answers a request of this route."""
        kind = get_type_hints(self.endpoint)["load"]

        async def handle(request: Request) -> Response:
            body = await _read(request, request.app.state.service.settings.max_body)
            request.scope[DECODING] = perf_counter()
            load = parse(kind, body)
            response: Response = await self.endpoint(request, request.path_params["name"], load)
            return response

        return handle


class ManyRoute(APIRoute):
    """Reads a list of queries, in JSON or in the binary layout.

    Endpoints take the request, the name of the scene, and what was ``asked``, by its fields.
    """

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return what answers a request of this route."""
        kind = get_type_hints(self.endpoint)["asked"]

        async def handle(request: Request) -> Response:
            name = request.path_params["name"]
            request.app.state.service.model(name)
            body = await _read(request, schemas.MOST_BYTES, JSON, BINARY)
            if request.headers["content-type"].startswith(BINARY):
                asked = _positions(body, kind.model_fields)
            else:
                asked = parse(kind, body).model_dump()
            response: Response = await self.endpoint(request, name, asked)
            return response

        return handle


_OF_ANSWERS = {field: number_type(hint) for field, hint in get_type_hints(layout.Answers).items()}
"""Types of the arrays that answer a list."""


async def _listed(
    request: Request, name: str, count: int, work: Callable[[ReducedModel], Answers]
) -> Response:
    """Answer a list in a thread, which uses all cores; others than lists are answered meanwhile."""
    here: Service = request.app.state.service
    model, media_type = here.model(name).model, _media_type(request)
    if media_type == JSON:
        numbers = 2 * len(layout.Answers._fields) * count
        check_numbers(numbers, here.settings.max_json_numbers, "positions")
    if here.working.locked():
        message = "The service is working on another list"
        raise Refusal("overloaded", "", message, headers={"Retry-After": "1"})
    async with here.working:
        try:
            found = await asyncio.to_thread(work, model)
        except QueryError as error:
            raise Refusal("unanswerable_query", error.field, error.message) from None
    arrays = {
        field: np.ascontiguousarray(getattr(found, field), dtype)
        for field, dtype in _OF_ANSWERS.items()
    }
    content = wire.encode(media_type, {"scene": name}, arrays)
    return Response(content, media_type=media_type)


def _positions(body: bytes, fields: Collection[str]) -> dict[str, Any]:
    """Arrays of a binary request, by the names of fields, and the head's Young's modulus."""
    try:
        head, arrays = layout.decode(body)
    except PalpateError as error:
        raise Refusal("invalid_value", "body", str(error)) from None
    young, names = head.get("young"), set(fields) - {"young"}
    if not (young is None or type(young) in (int, float)):
        raise Refusal("invalid_value", "young", "Input should be a valid number")
    if strange := sorted(arrays.keys() - names):
        raise Refusal("invalid_value", printable(strange[0]), "Not a field", sorted(fields))
    for name in names:
        if len(arrays.get(name, ())) > schemas.MOST_MANY:
            raise Refusal("invalid_value", name, "Too many", {"max_length": schemas.MOST_MANY})
        if name not in arrays and name != "directions":
            raise Refusal("invalid_value", name, "Missing", sorted(fields))
    return {"young": young} | {name: arrays.get(name) for name in names}


queries = APIRouter(prefix="/scenes", tags=["scenes"], route_class=QueryRoute)
lists = APIRouter(prefix="/scenes", tags=["scenes"], route_class=ManyRoute)
scenes = APIRouter(prefix="/scenes", tags=["scenes"])
service = APIRouter(tags=["service"])


def _problems(*codes: int) -> dict[int | str, dict[str, Any]]:
    """Describe the refusals of an endpoint: its own `codes` and those of the guard."""
    return {code: {"model": schemas.Problem} for code in sorted({401, 403, 421, 429, 503, *codes})}


def _document(model: type, what: str, *codes: int) -> dict[str, Any]:
    """Describe an answer that comes in three formats, and the refusals of its endpoint."""
    described = {BINARY: layout.__doc__, MSGPACK: "The JSON document, but for arrays."}
    schema = {"type": "string", "format": "binary"}
    formats = {name: {"schema": {**schema, "description": d}} for name, d in described.items()}
    answer = {200: {"model": model, "description": what, "content": formats}}
    return {"response_model": None, "responses": {**answer, **_problems(404, *codes)}}


@queries.post(
    "/{name}/solve", **_document(schemas.Answer, "How the tissue answers", 406, 413, 415, 422)
)
async def solve(request: Request, name: SceneName, load: SolveRequest) -> Response:
    """Press the tissue: force, displacement and stress under a load.

    Every request is answered from rest, independently of those before it. The header
    Server-Timing tells the time taken to decode, solve, recover and encode, in ms.
    """
    return _answer(request, name, load)


@queries.post(
    "/{name}/history",
    **_document(schemas.HistoryAnswer, "How the tissue answers, step by step", 406, 413, 415, 422),
)
async def history(request: Request, name: SceneName, load: HistoryRequest) -> Response:
    """Press visco-elastic tissue over time: force and displacement at every step.

    Every request starts at rest. Elastic scenes know no time and refuse.
    """
    return _answer(request, name, load)


@queries.post(
    "/{name}/check", responses={200: {"model": schemas.Checked}, **_problems(404, 413, 415, 422)}
)
async def check(request: Request, name: SceneName, load: SolveRequest) -> Response:
    """Check a solve request without solving it: what solve would refuse, and the range."""
    limit, outside = checked(request.app.state.service.model(name).model, load)
    return _json({"in_range": not outside, "out_of_range": outside, "pressure_limit": limit})


@lists.post(
    "/{name}/solve-many",
    **_document(schemas.AnswersDocument, "How the tissue answers", 406, 413, 415, 422),
)
async def solve_many(request: Request, name: SceneName, asked: ManyRequest) -> Response:
    """Press the tissue with many loads, each from rest, on all cores.

    The body may be in the binary layout, too: arrays positions (n, 3), pressures (n,) and maybe
    directions (n, 3), and young in its head. What is refused names the row, from 0.
    """
    loads: Any = asked
    return await _listed(
        request, name, len(loads["positions"]), lambda model: model.solve_many(**loads)
    )


@lists.post(
    "/{name}/touch",
    **_document(schemas.AnswersDocument, "How the tissue answers", 404, 406, 413, 415, 422),
)
async def touch(request: Request, name: SceneName, asked: TouchRequest) -> Response:
    """Touch the tissue with the rigid tip at one or many positions, each from rest.

    The body may be in the binary layout, too: an array positions (n, 3) of the tip's centre.
    """
    tips: Any = asked
    if not request.app.state.service.model(name).model.has_tip:
        raise Refusal("no_tip", "name", "This scene was trained without a tip")
    return await _listed(
        request, name, len(tips["positions"]), lambda model: model.touch_many(**tips)
    )


@scenes.get(
    "/{name}/session",
    response_model=None,
    responses={
        101: {"description": frames.document()},
        **_problems(404, 422, 426),
    },
)
async def session(name: SceneName, request: Request) -> Response:
    """Open a session (WebSocket): send positions of the tip, get forces.

    The first message of the service is a greeting in JSON that states the layout of the frames.
    A text message is answered in JSON, a binary one in binary. A request without a handshake is
    told why one would be refused.
    """
    request.app.state.sessions.check(name)
    raise Refusal("upgrade_required", "upgrade", "A session is opened by a WebSocket handshake")


@service.get("/health")
async def health() -> dict[str, str]:
    """Tell that the process lives."""
    return {"status": "ok"}


@service.get("/ready", responses={503: {"model": schemas.Problem}})
async def ready(request: Request) -> dict[str, str]:
    """Tell whether every model is loaded and warm."""
    here: Service = request.app.state.service
    here.require_ready()
    if not here.models:
        raise Refusal("not_ready", "", "No artifact could be loaded; /scenes and the log say why")
    return {"status": "ready"}


@service.get(guard.METRICS, response_class=PlainTextResponse, responses=_problems())
async def metrics(request: Request) -> Response:
    """Tell what was counted and timed, of every worker, in the text format of Prometheus."""
    # in a thread: the system takes a millisecond and more to add up shared memory
    text = await asyncio.to_thread(request.app.state.service.metrics.text)
    return Response(text, media_type=CONTENT_TYPE)


@service.post("/tickets", response_model=schemas.Ticket, responses=_problems())
async def ticket(request: Request) -> Any:
    """Get a ticket to open a session with, for browsers, which send no token in a handshake.

    It is part of the session's address, ``?ticket=...``; a service without a token needs none.
    """
    token = request.app.state.service.settings.token
    issued = tickets.issue(token, time()) if token else None
    return _json({"ticket": issued, "valid_s": tickets.VALID})


@service.post(
    "/recordings",
    response_class=Response,
    responses={
        200: {"description": "The file", "content": {RECORDING: {}}},
        **_problems(413, 415, 422),
    },
)
async def recording(request: Request) -> Response:
    """Make of the frames that a page kept of a session the file that ``palpate replay`` reads.

    The body is in the binary layout: a head with the session's ``greeting`` and ``commands`` (rows
    of the number of replies before it, its number and value), and arrays ``requests`` and
    ``replies``, the bytes of the frames, and ``received``, s.
    """
    body = await _read(request, MOST_RECORDED, BINARY)
    try:
        # in a thread: answers need not wait for it
        file = await asyncio.to_thread(lambda: recorded(*layout.decode(body)))
    except PalpateError as error:
        raise Refusal("invalid_value", "body", str(error)) from None
    return Response(file, media_type=RECORDING)


@scenes.get("", response_model=schemas.SceneList, responses=_problems())
async def served_scenes(request: Request) -> Any:
    """List the scenes that are served, and the files that had to be refused."""
    here: Service = request.app.state.service
    here.require_ready()
    served = [
        {"name": name, "description": served.model.scene.description}
        for name, served in here.models.items()
    ]
    training = [progress._asdict() for progress in here.trainings]
    return _json({"scenes": served, "refused": here.refused, "training": training})


@scenes.get("/{name}", response_model=schemas.SceneSummary, responses=_problems(404, 422))
async def scene(name: SceneName, request: Request) -> Any:
    """Say what may be asked of a scene, and how well it is answered."""
    served: ServedModel = request.app.state.service.model(name)
    model, endoscope = served.model, served.model.scene.endoscope
    depth = [0.0, model.limits[:, TIP_DEPTH].max()]
    return _json(
        {
            "name": model.name,
            "description": model.scene.description,
            "ranges": {
                "pressure": [0.0, model.pressure_max],
                "depth": depth if model.has_tip else None,
                "tilt": [0.0, endoscope.max_tilt],
                "radius": endoscope.radius,
                "reach": endoscope.reach,
            },
            "serves": {"sessions": model.has_tip, "histories": bool(model.scene.tissue.prony)},
            "young": model.scene.tissue.young,
            "tolerance": model.scene.tolerance.model_dump(),
            "size": {
                "nodes": len(model.nodes),
                "dofs": 3 * len(model.nodes),
                "surface_nodes": len(model.surface_nodes),
                "triangles": len(model.surface_triangles),
            },
            "info": {name: own for name, own in model.info.items() if name != "training"},
            "artifact": model.seal,
            "example": {"contacts": [served.example]},
        }
    )


@scenes.get("/{name}/mesh", **_document(schemas.MeshDocument, "The mesh", 406, 422))
async def mesh(name: SceneName, request: Request, region: MeshRegion = "surface") -> Response:
    """Get the undeformed mesh that the fields of a region belong to."""
    model = request.app.state.service.model(name).model
    surface = np.ascontiguousarray(model.surface_nodes, np.int32)
    triangles = np.ascontiguousarray(model.surface_triangles, np.int32)
    chosen: Any = slice(None) if region == "all" else surface
    found = layout.Mesh(
        nodes=model.nodes[chosen].astype(np.float32),
        triangles=surface[triangles] if region == "all" else triangles,
        surface_nodes=surface,
        clamped=model.clamped[chosen].astype(np.uint8),
    )
    return _arrays(request, {"scene": name, "region": region}, found)


@scenes.get(
    "/{name}/accessible",
    **_document(schemas.AccessibleDocument, "The accessible surface", 406, 422),
)
async def accessible(name: SceneName, request: Request) -> Response:
    """Get the undeformed surface that the endoscope can touch, finer than the fields' mesh."""
    model = request.app.state.service.model(name).model
    found = layout.Accessible(
        vertices=model.surface.vertices.astype(np.float32),
        normals=model.surface.normals.astype(np.float32),
        pressure_limit=model.limits[:, 0].astype(np.float32),
        triangles=np.ascontiguousarray(model.surface.triangles, np.int32),
        depth_limit=model.limits[:, TIP_DEPTH].astype(np.float32) if model.has_tip else None,
    )
    return _arrays(request, {"scene": name}, found)


@scenes.get(
    "/{name}/modes", **_document(schemas.CentresDocument, "Where the local models are", 406, 422)
)
async def centres(name: SceneName, request: Request) -> Response:
    """Get where the local models are, so that modes can be fetched before they are needed."""
    model = request.app.state.service.model(name).model
    found = layout.Centres(model.models.centres.astype(np.float32))
    return _arrays(request, {"scene": name, "artifact": model.seal}, found)


@scenes.get(
    "/{name}/modes/{model}",
    **_document(schemas.ModesDocument, "The modes", 406, 422),
)
async def modes(
    name: SceneName,
    model: Annotated[int, Path(description="Number of a local model.", ge=0)],
    request: Request,
    artifact: Annotated[
        str | None, Query(description="The hash that the scene states; with it, kept for ever.")
    ] = None,
) -> Response:
    """Get the modes of a local model at the nodes of the surface's mesh.

    Their sum, each times its coordinate of the ``PARTS`` of a session's frame, is a displacement.
    """
    served = request.app.state.service.model(name).model
    if artifact not in (None, served.seal):
        raise Refusal("unknown_artifact", "artifact", "The scene has been replaced", served.seal)
    if model >= (count := len(served.models.region)):
        raise Refusal("unknown_model", "model", "No such local model", {"lt": count})
    # in a thread: answers need not wait for it
    found = await asyncio.to_thread(_rounded, served, model)
    response = _arrays(request, {"scene": name, "model": model, "artifact": served.seal}, found)
    lasting = "public, max-age=31536000, immutable" if artifact else "no-cache"
    response.headers.update({"Cache-Control": lasting, "Vary": "Accept"})
    return response


def _rounded(model: ReducedModel, number: int) -> layout.Modes:
    """Modes of a local model as whole numbers of steps."""
    modes = model.surface_modes(number)
    steps = np.maximum(np.abs(modes).max(axis=(0, 2)), np.finfo(np.float32).tiny) / layout.MOST
    rounded = np.rint(modes / steps[:, None]).astype(np.int16)
    return layout.Modes(steps.astype(np.float32), rounded)


def _arrays(request: Request, head: layout.Head, arrays: Any) -> Response:
    media_type = _media_type(request)
    present = {name: array for name, array in arrays._asdict().items() if array is not None}
    return Response(wire.encode(media_type, head, present), media_type=media_type)


def _answer(request: Request, name: str, load: SolveRequest | HistoryRequest) -> Response:
    here: Service = request.app.state.service
    model, media_type = here.model(name).model, _media_type(request)
    start, limit = request.scope[DECODING], here.settings.max_json_numbers
    return answer(model, load, media_type, here.metrics, start, limit)


def _media_type(request: Request) -> str:
    return negotiate(",".join(request.headers.getlist("accept")))


async def _read(request: Request, limit: int, *kinds: str) -> bytes:
    """Read the body of a request of a kind, by default JSON, of at most `limit` bytes."""
    content_type, allowed = request.headers.get("content-type", ""), kinds or (JSON,)
    if content_type.split(";", 1)[0].strip().lower() not in allowed:
        message = "The body must be JSON" if not kinds else "The body is none of what is read here"
        raise Refusal("unsupported_media_type", "content-type", message, allowed)
    chunks, length = [], 0
    async for chunk in request.stream():
        chunks.append(chunk)
        length += len(chunk)
        if length > limit:
            raise Refusal("body_too_large", "body", "The body is too large", {"max_bytes": limit})
    return b"".join(chunks)


def _json(document: dict[str, Any]) -> Response:
    return Response(orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY), media_type=JSON)
