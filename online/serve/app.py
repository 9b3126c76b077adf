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
from palpate.online.serve.history import answer_history
from palpate.online.serve.metrics import Metrics
from palpate.online.serve.negotiation import JSON, OFFERED
from palpate.online.serve.routes import add_routes
from palpate.online.serve.schemas import HistoryRequest, SolveRequest
from palpate.online.serve.settings import Settings
from palpate.online.serve.store import Model, Store
from palpate.online.session import session

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

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        preparing = asyncio.create_task(_prepare(models, on_ready))
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
        description="Units are mm, mN, kPa and s throughout.",
        lifespan=lifespan,
        redirect_slashes=False,
        redoc_url=None,
        # Even unused it looks for a tracer in every request; the service times itself.
        telemetry={"tracing": False, "metrics": False, "logs": False},
    )
    app.state.metrics = counts
    errors.install(app)
    guard.install(app, settings, counts)
    add_routes(app, models, settings, counts)
    _describe_request(app)
    return app


async def _prepare(store: Store, on_ready: Callable[[Store], None] | None) -> None:
    """Load and warm the models in a thread, then keep the collector away from them."""
    loop = asyncio.get_running_loop()
    opened: asyncio.Future[bool] = loop.create_future()

    def tell(whether: bool) -> None:
        if not opened.done():
            opened.set_result(whether)

    def load() -> None:
        done = False
        try:
            store.open(_warm)
            done = True
        except Exception:
            logger.exception("the models could not be loaded")
        with suppress(RuntimeError):  # the service has ended meanwhile
            loop.call_soon_threadsafe(tell, done)

    logger.info("loading models; where kernels are compiled for the first time, it takes minutes")
    # a daemon: a service that is told to stop does not wait for it
    threading.Thread(target=load, name="loading", daemon=True).start()
    if not await opened:
        return
    gc.collect()
    gc.freeze()
    store.ready = True
    if on_ready is not None:
        on_ready(store)


def _warm(model: Model) -> None:
    """Call every kernel and encoder once, so that no client pays for a first time."""
    uncounted = Metrics()
    for region in ("none", "surface", "all"):
        body = orjson.dumps({"contacts": [model.example], "region": region})
        for media_type in OFFERED:
            answer(model, body, media_type, 10**9, uncounted)
    _warm_history(model, uncounted)
    session.warm(model, uncounted)


def _warm_history(model: Model, metrics: Metrics) -> None:
    """From one local model to the next and back: everything that a history may need."""
    models = model.atlas.models
    if models.viscous is None:
        return
    here, there = models.centres[models.viscous.pairs[0]].tolist()
    steps = [
        {"time": 0.1 * number, "contact": {"position": position, "pressure": 0.1}}
        for number, position in enumerate((here, there, here))
    ]
    body = orjson.dumps({"steps": steps, "region": "all"})
    answer_history(model, body, JSON, 10**9, metrics)


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
