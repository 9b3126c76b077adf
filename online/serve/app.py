"""The service as an ASGI application."""

import asyncio
import gc
import logging
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from importlib.metadata import version
from typing import Any

import orjson
from fastapi import FastAPI
from pydantic.json_schema import models_json_schema

from palpate.online.serve import errors, guard
from palpate.online.serve.answer import answer
from palpate.online.serve.metrics import Metrics
from palpate.online.serve.routes import Service, add_routes
from palpate.online.serve.schemas import CONVENTIONS, HistoryRequest, SolveRequest
from palpate.online.serve.settings import Settings
from palpate.online.serve.store import ServedModel, Store
from palpate.online.serve.wire import JSON, OFFERED
from palpate.online.session.session import Sessions

logger = logging.getLogger(__name__)


def create_app(
    settings: Settings,
    store: Store | None = None,
    on_ready: Callable[[Store], None] = lambda store: None,
    metrics: Metrics | None = None,
) -> FastAPI:
    """Make the service.

    It answers at once; the models are loaded and warmed meanwhile, and ``/ready`` says when that
    is done; `on_ready` is then called on the thread that answers. One of several workers leaves
    all clients to the others until it is ready.
    """
    models, counts = store or Store(settings.artifacts), metrics or Metrics()
    sessions = Sessions(models, settings, counts)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        prepared = _prepare(models, sessions, on_ready)
        if settings.workers > 1:
            await prepared.wait()
        yield

    app = FastAPI(
        title="Palpate",
        version=version("palpate"),
        summary="Press soft tissue and get its answer in real time",
        description=CONVENTIONS,
        lifespan=lifespan,
        redirect_slashes=False,
        redoc_url=None,
        # Even unused it looks for a tracer in every request; the service times itself.
        telemetry={"tracing": False, "metrics": False, "logs": False},
    )
    app.state.service = Service(models, settings, counts)
    errors.install(app)
    guard.install(app, settings, counts)
    add_routes(app, sessions, settings.echo)
    _describe_requests(app)
    return app


def _prepare(store: Store, sessions: Sessions, on_ready: Callable[[Store], None]) -> asyncio.Event:
    """Load and warm the models in a thread; return what is set when that is over."""
    loop, prepared = asyncio.get_running_loop(), asyncio.Event()

    def finish() -> None:
        gc.collect()
        gc.freeze()  # the collector need not look at the models again
        store.ready = True
        on_ready(store)
        prepared.set()

    def load() -> None:
        over = finish
        try:
            store.open(lambda served: _warm(sessions, served))
        except Exception:
            logger.exception("the models could not be loaded")
            over = prepared.set
        with suppress(RuntimeError):  # the service has ended meanwhile
            loop.call_soon_threadsafe(over)

    logger.info("loading models; where kernels are compiled for the first time, it takes minutes")
    # a daemon: a service that has to stop does not wait for it
    threading.Thread(target=load, name="loading", daemon=True).start()
    return prepared


def _warm(sessions: Sessions, served: ServedModel) -> None:
    """Call every kernel and encoder once, so that no client pays for a first time."""
    uncounted = Metrics()
    for region in ("none", "surface", "all"):
        body = orjson.dumps({"contacts": [served.example], "region": region})
        for media_type in OFFERED:
            answer(served, SolveRequest, body, media_type, 10**9, uncounted)
    models, radius = served.model.models, served.model.scene.endoscope.radius
    tour: list[int] = []
    if models.viscous is not None:  # a history goes from one local model to the next and back
        here, there = models.viscous.pairs[0]
        tour = [here, there, here]
        steps = [
            {"time": 0.1 * number, "contact": {"position": position, "pressure": 0.1}}
            for number, position in enumerate(models.centres[tour].tolist())
        ]
        body = orjson.dumps({"steps": steps, "region": "all"})
        answer(served, HistoryRequest, body, JSON, 10**9, uncounted)
    if served.model.has_tip:
        above = [models.centres[k] + 0.9 * radius * models.frames[k, 0] for k in tour]
        sessions.prepare(served, [position.tolist() for position in above])


def _describe_requests(app: FastAPI) -> None:
    """Add the schemas of the request bodies, which are read by hand, to the OpenAPI document."""
    generate = app.openapi

    def openapi() -> dict[str, Any]:
        document = generate()
        _, definitions = models_json_schema(
            [(SolveRequest, "validation"), (HistoryRequest, "validation")],
            ref_template="#/components/schemas/{model}",
        )
        document["components"]["schemas"].update(definitions["$defs"])
        return document

    app.openapi = openapi  # type: ignore[method-assign]
