"""From settings to a running service: one process, or several under a supervisor.

The supervisor is uvicorn's. It binds the socket, starts the workers, starts a new one for each that
dies, and passes on the signal to end. All workers accept from the one socket, so a session belongs
to the worker that accepted it and is none of the others' business.
"""

import asyncio
import ctypes
import json
import logging
import os
import signal
import sys
import tempfile
import threading
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from time import perf_counter

import click
import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol
from uvicorn.supervisors.multiprocess import Multiprocess

from palpate.online.serve.errors import Refusal
from palpate.online.serve.guard import LOCAL, RECEIVED, machine_name
from palpate.online.serve.metrics import Metrics, make_table
from palpate.online.session.websocket import OPTIONS
from palpate.online.settings import Settings
from palpate.shared.errors import PalpateError

logger = logging.getLogger(__name__)

MOST_CONNECTIONS = 900
"""Of one worker; systems commonly allow a process 1024 files."""

PATIENCE = 10.0
"""Seconds that a client gets to send a request, or to begin its first one."""

LAST_WAIT = 4.0
"""Seconds that workers get to end."""

PRIORITY = 10
"""Of a service in real time: above all ordinary work, below the kernel's own threads (50)."""

_MCL_CURRENT, _MCL_ONFAULT = 1, 4  # Linux: what is in memory, not all that could be


def _full() -> bytes:
    """Write the response to a client for whom there is no place, as it goes over the wire."""
    message, allowed = "The service has no place for another connection", MOST_CONNECTIONS
    later = {"Retry-After": "1", "Connection": "close"}
    full = Refusal("overloaded", "", message, {"max_connections": allowed}, later).response()
    head = b"".join(name + b": " + value + b"\r\n" for name, value in full.raw_headers)
    return STATUS_LINE[full.status_code] + head + b"\r\n" + bytes(full.body)


class HttpProtocol(HttpToolsProtocol):
    """Uvicorn's HTTP, which notes when it read a request, and bounds what connections cost.

    One beyond `MOST_CONNECTIONS` is refused, one whose request takes longer than `PATIENCE` closed.
    """

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take over a connection."""
        super().connection_made(transport)
        self.patience = self.loop.call_later(PATIENCE, transport.abort)
        if len(self.connections) > MOST_CONNECTIONS:
            transport.write(_full())
            transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget a connection."""
        self.patience.cancel()
        super().connection_lost(exc)

    def on_message_begin(self) -> None:
        """Begin a request."""
        super().on_message_begin()
        self.patience.cancel()
        self.patience = self.loop.call_later(PATIENCE, self.transport.abort)
        self.scope[RECEIVED] = perf_counter()  # type: ignore[literal-required]

    def on_message_complete(self) -> None:
        """End a request; a handshake also ends here."""
        super().on_message_complete()
        self.patience.cancel()


class Supervisor(Multiprocess):
    """Uvicorn's, but it does not wait for ever for a worker to end."""

    def join_all(self) -> None:
        """Wait for the workers; kill those that are still loading their models."""
        end = perf_counter() + LAST_WAIT
        for worker in self.processes:
            worker.process.join(max(0.0, end - perf_counter()))
            if worker.process.is_alive():
                worker.process.kill()
        super().join_all()


def serve(settings: Settings) -> None:
    """Serve until a signal says to end.

    Raises `PalpateError` if there is nothing to serve, or no token for other machines.
    """
    if not any(settings.artifacts.glob("*.h5")):
        raise PalpateError(
            f"no artifacts (*.h5) in {settings.artifacts}; make one with: "
            f"palpate train turbinate --out {settings.artifacts / 'turbinate.h5'}"
        )
    host = settings.host
    if not settings.token and not settings.public:
        if machine_name(host) != LOCAL:
            raise PalpateError(
                f"--host {host or '(any)'} lets other machines in: set PALPATE_TOKEN, or say "
                "--public to serve anybody"
            )
        settings = replace(settings, hosts=(LOCAL, host))
    set_up_log(settings)
    config = uvicorn.Config(
        "",  # known once the socket is bound
        factory=True,
        host=host,
        port=settings.port,
        workers=settings.workers,
        http=HttpProtocol,
        log_config=None,
        access_log=settings.access_log,
        **OPTIONS,
    )
    try:
        bound = config.bind_socket()
    except SystemExit:  # it has said why
        raise PalpateError(f"cannot listen on {host}:{settings.port}; try another --port") from None
    # From here on clients wait for a worker that is ready rather than being turned away.
    bound.listen(config.backlog)
    url = f"http://{f'[{host}]' if ':' in host else host}:{bound.getsockname()[1]}"
    # A server shuts down on a signal and then raises it again, for us to end cleanly.
    for stop in (signal.SIGTERM, signal.SIGINT):
        signal.signal(stop, lambda *_: sys.exit(0))
    try:
        with tempfile.TemporaryDirectory(prefix="palpate-") as directory:
            table = Path(directory) / "metrics"
            make_table(table, settings.workers)
            config.app = partial(_work, settings, url, table)
            if settings.workers > 1:
                Supervisor(config, [bound]).run()
            else:
                uvicorn.Server(config).run([bound])
    finally:
        if any(thread.daemon for thread in threading.enumerate()):
            # Models are being loaded. The interpreter's own end would wait for ever for locks of
            # the compiler, which the thread that loads holds while it is halted.
            logging.shutdown()
            sys.stdout.flush()
            os._exit(0)


def _work(settings: Settings, url: str, table: Path) -> FastAPI:
    """Make the application of one worker, in its own process."""
    # Not before: the supervisor has no use for the models' code.
    from palpate.online.serve.app import create_app
    from palpate.online.serve.service import Service

    set_up_log(settings)
    # Uvicorn tells of every session that opens; that it starts and ends, the supervisor tells.
    logging.getLogger("uvicorn.error").setLevel(logging.WARNING)
    # On systems without file locks there is one worker, which has no use for a table.
    metrics = Metrics(table if settings.workers > 1 else None)
    service = Service(settings, metrics)

    def greet() -> None:
        if settings.realtime:
            logger.info(run_in_real_time())
        logger.info("worker %d is ready", metrics.worker)
        if metrics.worker or metrics.restarted:
            return  # the first worker says it once
        for refused in service.refused:
            click.echo(f"Refused {refused['reason']}")
        click.echo(f"Serving {', '.join(service.models) or 'nothing'} on {url} (API: {url}/docs)")
        for name, model in list(service.models.items())[:1]:
            click.echo(
                f"Try: curl {url}/scenes/{name}/solve -H 'Content-Type: application/json' "
                f"-d '{json.dumps({'contacts': [model.example]})}'"
            )

    return create_app(service, on_ready=greet)


class JsonFormatter(logging.Formatter):
    """Writes a record of the log as a JSON object on one line."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line: time (UTC), level, logger, process, message and any exception."""
        document = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "process": os.getpid(),
            "message": record.getMessage(),
        }
        if record.exc_info:
            document["exception"] = self.formatException(record.exc_info)
        return json.dumps(document, default=str)


def set_up_log(settings: Settings) -> None:
    """Send every record of at least the level of `settings` to stderr, in their format."""
    text = logging.Formatter("%(levelname)s: %(message)s")
    handler = logging.StreamHandler()
    handler.setFormatter(JsonFormatter() if settings.log_format == "json" else text)
    logging.basicConfig(level=settings.log_level.upper(), handlers=[handler], force=True)


def run_in_real_time() -> str:
    """Let this thread run before all other work, and its memory stay; return what was granted.

    On a busy machine the scheduler lets a ready worker wait for milliseconds; with a
    first-in-first-out priority it runs at once.
    """
    said = []
    for what, ask, needs in (
        ("real-time scheduling", _schedule, f"CAP_SYS_NICE or an rtprio limit of {PRIORITY}"),
        ("memory lock", _lock_memory, "CAP_IPC_LOCK or a higher memlock limit"),
    ):
        try:
            ask()
            said.append(f"{what}: on")
        except OSError as error:
            said.append(f"{what}: refused ({error.strerror}); it takes root, {needs}")
        except (AttributeError, TypeError):
            said.append(f"{what}: not known to this system")
    return "; ".join(said)


def _schedule() -> None:
    policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    os.sched_setscheduler(0, policy, os.sched_param(PRIORITY))


def _lock_memory() -> None:
    if ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT | _MCL_ONFAULT) != 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
