"""The service as an ASGI application."""

import asyncio
import gc
import logging
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from functools import partial
from importlib.metadata import version
from typing import Any

import orjson
from fastapi import FastAPI
from pydantic.json_schema import models_json_schema

from palpate.online.serve import errors, guard
from palpate.online.serve.answer import answer
from palpate.online.serve.metrics import Metrics
from palpate.online.serve.negotiation import JSON, OFFERED
from palpate.online.serve.routes import Service, add_routes
from palpate.online.serve.schemas import CONVENTIONS, HistoryRequest, SolveRequest
from palpate.online.serve.settings import Settings
from palpate.online.serve.store import ServedModel, Store
from palpate.online.session.session import Sessions

logger = logging.getLogger(__name__)


def create_app(
    settings: Settings,
    store: Store | None = None,
    on_ready: Callable[[Store], None] | None = None,
    metrics: Metrics | None = None,
) -> FastAPI:
    """Make the service.

    It answers at once; the models are loaded and warmed meanwhile, and ``/ready`` says when that
    is done. One of several workers leaves all clients to the others until it is ready.

    Parameters
    ----------
    settings : Settings
    store : Store, optional
        Where models come from; by default the artifacts of `settings`.
    on_ready : callable, optional
        Called once, on the thread that answers, when every model is warm.
    metrics : Metrics, optional
        Where to count; by default in a table of its own.
    """
    models = Store(settings.artifacts) if store is None else store
    counts = Metrics() if metrics is None else metrics
    sessions = Sessions(models, settings, counts)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        preparing = asyncio.create_task(_prepare(models, sessions, on_ready))
        if settings.workers > 1:
            await preparing
        yield
        preparing.cancel()
        with suppress(asyncio.CancelledError):
            await preparing

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
    _describe_request(app)
    return app


async def _prepare(
    store: Store, sessions: Sessions, on_ready: Callable[[Store], None] | None
) -> None:
    """Load and warm the models in a thread, then keep the collector away from them."""
    loop = asyncio.get_running_loop()
    opened: asyncio.Future[bool] = loop.create_future()

    def tell(whether: bool) -> None:
        if not opened.done():
            opened.set_result(whether)

    def load() -> None:
        done = False
        try:
            store.open(partial(_warm, sessions))
            done = True
        except Exception:
            logger.exception("the models could not be loaded")
        with suppress(RuntimeError):  # the service has ended meanwhile
            loop.call_soon_threadsafe(tell, done)

    logger.info("loading models; where kernels are compiled for the first time, it takes minutes")
    # a daemon: a service that has to stop does not wait for it
    threading.Thread(target=load, name="loading", daemon=True).start()
    if not await opened:
        return
    gc.collect()
    gc.freeze()
    store.ready = True
    if on_ready is not None:
        on_ready(store)


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


def _describe_request(app: FastAPI) -> None:
    """Add the schema of the hand-read request body to the application's OpenAPI document."""
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
