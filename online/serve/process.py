"""From settings to a running service: one process, or several under a supervisor.

The supervisor is uvicorn's. It binds the socket, starts the workers, starts a new one for each that
dies, and passes on the signal to end. All workers accept from the one socket, so a session belongs
to the worker that accepted it and is none of the others' business. The supervisor loads the models
and the workers are forked from it, so that all have them in the same memory and a new one is ready
at once.
"""

import asyncio
import ctypes
import gc
import json
import logging
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from socket import socket
from time import perf_counter
from types import FrameType
from typing import TYPE_CHECKING, Any, ClassVar

import click
import uvicorn
from fastapi import FastAPI
from uvicorn._subprocess import subprocess_started
from uvicorn.protocols.http.httptools_impl import (
    STATUS_LINE,
    HttpToolsProtocol,
    RequestResponseCycle,
)
from uvicorn.supervisors import multiprocess
from uvicorn.supervisors.multiprocess import Multiprocess

from palpate.online.serve.errors import Refusal
from palpate.online.serve.guard import LOCAL, RECEIVED, machine_name
from palpate.online.serve.metrics import Metrics, make_table
from palpate.online.session.websocket import OPTIONS
from palpate.online.settings import Settings
from palpate.shared.errors import PalpateError
from palpate.shared.files import printable

if TYPE_CHECKING:
    from palpate.online.serve.service import Service

logger = logging.getLogger(__name__)

MOST_CONNECTIONS = 900
"""Of one worker; systems commonly allow a process 1024 files."""

PATIENCE = 10.0
"""Seconds that a client gets to send a request, or to begin its first one."""

MOST_HEAD = 16 * 1024
"""Bytes of a request up to its body, about: they are read before anybody knows who asks."""

MOST_PIPELINED = 16
"""Requests of a connection that wait for the answer to the one before."""

MOST_UNREAD = 64 * 1024**2
"""Bytes of answers that clients have not read yet, of one worker."""

UNREAD = 5.0
"""Seconds that a client gets to read more of an answer."""

LINGER = 1.0
"""Seconds in which nothing more is read of a client that sent too much, before it is cut off.

Cut off at once it would not get to read why, and would be back with the next at once.
"""

_OF_BODIES = b"content-length", b"transfer-encoding"

LAST_WAIT = 4.0
"""Seconds that workers get to end."""

PRIORITY = 10
"""Of a service in real time: above all ordinary work, below the kernel's own threads (50)."""

_MCL_CURRENT, _MCL_ONFAULT = 1, 4  # Linux: what is in memory, not all that could be


class HttpProtocol(HttpToolsProtocol):
    """Uvicorn's HTTP, which notes when it read a request, and bounds what connections cost.

    One beyond `MOST_CONNECTIONS` is refused, as is a request with more than `MOST_HEAD` before its
    body; one whose request takes longer than `PATIENCE`, that asks on and on without waiting for
    answers, or that does not read them, is closed.
    """

    unread: ClassVar[dict["HttpProtocol", int]] = {}  # bytes, of connections that do not read

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take over a connection."""
        super().connection_made(transport)
        self.patience = self.reading = self.loop.call_later(PATIENCE, transport.abort)
        self.head: int | None = 0  # bytes of it read, or of what follows a body; None within one
        self.with_body = False
        self.url = b""
        self.refused = False
        self.asked: list[RequestResponseCycle] = []  # not answered yet
        if len(self.connections) > MOST_CONNECTIONS:
            allowed = {"max_connections": MOST_CONNECTIONS}
            message = "The service has no place for another connection"
            self.refuse(Refusal("overloaded", "", message, allowed, {"Retry-After": "1"}))

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget a connection."""
        self.give_up()
        self.resume_writing()
        super().connection_lost(exc)

    def give_up(self) -> None:
        """Leave unanswered what has been asked; uvicorn does so with the last request only."""
        self.patience.cancel()
        for cycle in self.asked:
            cycle.disconnected = True
            cycle.message_event.set()

    def data_received(self, data: bytes) -> None:
        """Read on, little by little so that heads of requests can be counted."""
        for start in range(0, len(data), MOST_HEAD):
            if self.refused:
                return
            part = data[start : start + MOST_HEAD]
            super().data_received(part)
            if self.transport.is_closing() or self.transport.get_protocol() is not self:
                return
            if self.head is not None:
                self.head += len(part)
                if self.head > MOST_HEAD:
                    self.refuse_head()

    def refuse_head(self) -> None:
        """Refuse a request whose head is too long, and read no more of it until it is cut off."""
        allowed = {"max_bytes": MOST_HEAD}
        if len(self.url) > MOST_HEAD // 2:
            self.tell(Refusal("url_too_long", "url", "The address is too long", allowed))
        else:
            message = "The headers are too long"
            self.tell(Refusal("headers_too_large", "headers", message, allowed))
        self.transport.pause_reading()
        self.give_up()
        self.refused = True
        self.loop.call_later(LINGER, self.transport.abort)

    def refuse(self, refusal: Refusal) -> None:
        """Answer to nothing that could be read, and close."""
        self.tell(refusal)
        self.transport.close()

    def tell(self, refusal: Refusal) -> None:
        """Write a refusal of what is not read on."""
        response = refusal.response()
        head = b"".join(name + b": " + value + b"\r\n" for name, value in response.raw_headers)
        line = STATUS_LINE[response.status_code]
        close = b"connection: close\r\n\r\n"
        self.transport.write(line + head + close + bytes(response.body))

    def pause_writing(self) -> None:
        """Wait for a client that does not read, but not for ever, and not for too many."""
        super().pause_writing()
        self.reading = self.loop.call_later(UNREAD, self.transport.abort)
        self.unread[self] = self.transport.get_write_buffer_size()
        if sum(self.unread.values()) > MOST_UNREAD:
            self.transport.abort()

    def resume_writing(self) -> None:
        """Go on with a client that reads."""
        self.reading.cancel()
        self.unread.pop(self, None)
        super().resume_writing()

    def on_message_begin(self) -> None:
        """Begin a request."""
        super().on_message_begin()
        self.patience.cancel()
        self.patience = self.loop.call_later(PATIENCE, self.transport.abort)
        self.scope[RECEIVED] = perf_counter()  # type: ignore[literal-required]
        self.head, self.with_body = 0, False

    def on_header(self, name: bytes, value: bytes) -> None:
        """Take a header, but none that comes after a body."""
        if not self.with_body:
            super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """Know what is asked."""
        last = self.cycle
        super().on_headers_complete()
        self.head, self.with_body = None, True
        if self.cycle is not last:
            self.asked.append(self.cycle)
        elif any(name in _OF_BODIES for name, _ in self.headers):
            self.refuse(Refusal("invalid_value", "headers", "A handshake has no body"))
        if len(self.pipeline) > MOST_PIPELINED:
            self.transport.abort()

    def on_chunk_header(self) -> None:
        """Begin a piece of a body; the last is none, and headers may follow it."""
        self.head = 0

    def on_body(self, body: bytes) -> None:
        """Take a part of a body."""
        self.head = None
        super().on_body(body)

    def on_response_complete(self) -> None:
        """Go on to the next request."""
        del self.asked[0]
        super().on_response_complete()

    def on_message_complete(self) -> None:
        """End a request; a handshake also ends here."""
        super().on_message_complete()
        self.patience.cancel()
        self.head = 0


class Server(uvicorn.Server):
    """Uvicorn's, which ends in the same good order if it is told twice."""

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begin to end, which takes no longer than ``LAST_WAIT``."""
        if not self.should_exit:
            super().handle_exit(sig, frame)


class Supervisor(Multiprocess):
    """Uvicorn's, but its workers are forked, and it does not wait for ever for one to end."""

    def init_processes(self) -> None:
        """Start the workers."""
        multiprocess.get_subprocess = _forked  # uvicorn would start them without the models
        super().init_processes()

    def join_all(self) -> None:
        """Wait for the workers; kill those that are still loading their models."""
        end = perf_counter() + LAST_WAIT
        for worker in self.processes:
            worker.process.join(max(0.0, end - perf_counter()))
            if worker.process.is_alive():
                worker.process.kill()
        super().join_all()


def _forked(config: uvicorn.Config, target: Callable[..., None], sockets: list[socket]) -> Any:
    """Make a worker that begins with all that this process has in memory."""
    inherited = {"config": config, "target": target, "sockets": sockets, "stdin_fileno": None}
    return get_context("fork").Process(target=subprocess_started, kwargs=inherited)


def serve(
    settings: Settings,
    opened: Callable[[str], None] = lambda url: None,
    ended: Callable[[], None] = lambda: None,
) -> None:
    """Serve until a signal says to end; tell when the page can be opened, and the end.

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
        forwarded_allow_ips=settings.proxy,
        **OPTIONS | {"proxy_headers": settings.proxy is not None},
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
            config.app = partial(_work, settings, url, table, None, opened)
            if settings.workers > 1:
                config.app = partial(_work, settings, url, table, _loaded(settings), opened)
                Supervisor(config, [bound]).run()
            else:
                Server(config).run([bound])
    finally:
        ended()
        if any(thread.daemon for thread in threading.enumerate()):
            # Models are being loaded. The interpreter's own end would wait for ever for locks of
            # the compiler, which the thread that loads holds while it is halted.
            logging.shutdown()
            sys.stdout.flush()
            os._exit(0)


def _loaded(settings: Settings) -> "Service":
    """Load and warm the models for workers to share."""
    from palpate.online.serve.app import warm
    from palpate.online.serve.first_start import compile_kernels
    from palpate.online.serve.service import Service
    from palpate.online.session.session import Sessions

    compile_kernels(settings.artifacts)
    service = Service(settings)
    sessions = Sessions(service)
    service.open(lambda served: warm(sessions, served))
    gc.collect()
    gc.freeze()  # its marks would be written into memory that is shared
    return service


def _work(
    settings: Settings,
    url: str,
    table: Path,
    shared: "Service | None",
    opened: Callable[[str], None],
) -> FastAPI:
    """Make the application of one worker, in its own process."""
    # Not before: a supervisor that starts no workers has no use for the models' code.
    from palpate.online.serve.app import create_app
    from palpate.online.serve.service import Service

    set_up_log(settings)
    # Uvicorn tells of every session that opens; that it starts and ends, the supervisor tells.
    logging.getLogger("uvicorn.error").setLevel(logging.WARNING)
    # On systems without file locks there is one worker, which has no use for a table.
    metrics = Metrics(table if settings.workers > 1 else None)
    service = Service(settings, metrics, shared)

    def greet() -> None:
        if settings.realtime:
            logger.info(run_in_real_time())
        logger.info("worker %d is ready", metrics.worker)
        if metrics.worker or metrics.restarted:
            return  # the first worker says it once
        click.echo(f"Open {url}/ in a browser (API: {url}/docs)")
        opened(f"{url}/")
        for refused in service.refused:
            click.echo(f"Refused {refused['reason']}")
        click.echo(f"Serving {', '.join(service.models) or 'nothing'}")
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


class TextFormatter(logging.Formatter):
    """Writes a record of the log as text, its message on one line."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        """Return the line, without what would begin another or move a terminal's cursor."""
        record.message = printable(record.message)
        return super().formatMessage(record)


def set_up_log(settings: Settings) -> None:
    """Send every record of at least the level of `settings` to stderr, in their format."""
    text = TextFormatter("%(levelname)s: %(message)s")
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
