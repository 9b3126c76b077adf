"""Who may ask, how often, and when the service is too busy: decided before anything is read.

Pure ASGI: Starlette's BaseHTTPMiddleware would cost a query more than its solve.
"""

import asyncio
import hmac
import ipaddress
import math
import re
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from functools import lru_cache
from time import perf_counter, time
from urllib.parse import parse_qs

from starlette.types import ASGIApp, Receive, Scope, Send

from palpate.online.serve import page, tickets
from palpate.online.serve.errors import Refusal
from palpate.online.serve.metrics import Metrics
from palpate.online.settings import Settings

RECEIVED = "palpate.received"
"""Key in the ASGI scope of when the request was read, s of `time.perf_counter`."""

PROBES = frozenset({"/health", "/ready"})
"""Open to all and always answered: they tell nothing but whether to wait."""

METRICS = "/metrics"
"""Answered also while the service sheds load: it shows that it does."""

LOCAL = "localhost"
"""Name of this machine for itself."""

_HOST = re.compile(rb"(?:\[([0-9A-Fa-f:.]+)\]|([A-Za-z0-9._-]+))(?::[0-9]*)?")
"""A Host header: an address in brackets or a name, and maybe a port (RFC 9110, 7.2)."""

BURST = 1.0
"""Seconds of the rate limit that may come at once, but always one request."""

MOST_CLIENTS = 10_000
"""Clients whose rates are remembered; beyond it all are forgiven, so that memory stays bounded."""


class Guard:
    """Passes on what may pass and refuses the rest."""

    def __init__(self, app: ASGIApp, settings: Settings, metrics: Metrics) -> None:
        self._app, self._metrics = app, metrics
        self._origins = frozenset(origin.encode() for origin in settings.origins)
        self._hosts = {machine_name(host) for host in settings.hosts}
        self._token = settings.token
        self._secret = f"Bearer {settings.token}".encode() if settings.token else None
        self._rates = RateLimit(settings.rate_limit) if settings.rate_limit else None
        self._max_wait = settings.max_wait
        self._turns = Turns()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer or refuse, as ASGI asks."""
        if scope["type"] != "lifespan" and scope["path"] not in PROBES:
            try:
                headers = dict(scope["headers"])
                self._check_names(headers)
                self._check_token(scope, headers)
                if scope["type"] == "http":
                    await self._turns.wait()
                if scope["path"] != METRICS:
                    self._check_load(scope, perf_counter())
            except Refusal as refusal:
                self._metrics.count("refusals_total", refusal.code)
                await refusal.response()(scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _check_names(self, headers: Mapping[bytes, bytes]) -> None:
        """Refuse pages of other sites, and calls by other names than this machine's.

        By DNS rebinding a page of another site may have the service's origin.
        """
        host, origin = headers.get(b"host", b""), headers.get(b"origin")
        if self._hosts and _host(host) not in self._hosts:
            allowed = sorted({*self._hosts, "127.0.0.1"})
            raise Refusal("foreign_host", "host", "The service does not go by this name", allowed)
        if origin is None or origin in self._origins or b"*" in self._origins:
            return
        if origin.partition(b"://")[2] != host:
            message = "Pages of this origin may not use the service"
            raise Refusal("foreign_origin", "origin", message)

    def _check_token(self, scope: Scope, headers: Mapping[bytes, bytes]) -> None:
        """Refuse who presents no token, but for the page, which asks for it."""
        path, given = scope["path"], headers.get(b"authorization", b"")
        if self._secret is None or path in page.OPEN or path.startswith(page.PREFIX):
            return
        if scope["type"] == "websocket" and self._has_ticket(scope):
            return
        # takes as long for a token that is nearly right as for any other
        if not hmac.compare_digest(given, self._secret):
            message = "This service asks for a token: Authorization: Bearer TOKEN"
            said = {"WWW-Authenticate": "Bearer"}
            raise Refusal("unauthorized", "authorization", message, headers=said)

    def _has_ticket(self, scope: Scope) -> bool:
        """Whether a handshake has a valid ticket in its address."""
        (ticket, *_) = parse_qs(scope["query_string"].decode("latin-1")).get("ticket", [""])
        return tickets.is_valid(ticket, self._token or "", time())

    def _check_load(self, scope: Scope, now: float) -> None:
        """Refuse what has waited too long, and clients that ask too often."""
        waited = now - scope.get(RECEIVED, now)
        if scope["type"] == "http":  # the opening of a session is no query
            self._metrics.count_wait(waited)
        if waited > self._max_wait:
            message = f"The service is too busy: this request waited {waited:.3f} s for its turn"
            allowed = {"max_wait_s": self._max_wait}
            raise Refusal("overloaded", "", message, allowed, {"Retry-After": "1"})
        client = scope.get("client")
        if self._rates and (wait := self._rates.take(client[0] if client else "", now)) > 0.0:
            message = "More requests from this address than the service answers"
            headers = {"Retry-After": str(math.ceil(wait))}
            allowed = {"requests_per_second": self._rates.rate}
            raise Refusal("too_many_requests", "", message, allowed, headers)


def machine_name(name: str) -> str:
    """Return a name or an address as it is compared; addresses of loopback are `LOCAL`."""
    with suppress(ValueError):
        return LOCAL if ipaddress.ip_address(name).is_loopback else name
    return name.lower()


@lru_cache(64)
def _host(header: bytes) -> str:
    """Read the name or address in a Host header."""
    read = _HOST.fullmatch(header)
    return machine_name((read[1] or read[2]).decode()) if read else ""


class Turns:
    """Lets one request be answered after the other, and the frames of sessions between them.

    An answer is made in one go. Without turns the event loop would make those to all requests that
    it has read before it reads the next frame.
    """

    def __init__(self) -> None:
        self._waiting: deque[asyncio.Future[None]] = deque()
        self._taken = False

    async def wait(self) -> None:
        """Wait for a turn, which ends when the event loop has read what came meanwhile."""
        loop = asyncio.get_running_loop()
        if self._taken:
            self._waiting.append(turn := loop.create_future())
            await turn
        else:
            self._taken = True
            loop.call_soon(self._pass_on, loop)

    def _pass_on(self, loop: asyncio.AbstractEventLoop) -> None:
        while self._waiting:
            if not (turn := self._waiting.popleft()).cancelled():
                turn.set_result(None)  # the one who waits goes on before the call below
                loop.call_soon(self._pass_on, loop)
                return
        self._taken = False


class RateLimit:
    """A bucket per client that fills at `rate` (1/s) and holds `BURST` s (generic cell rate)."""

    def __init__(self, rate: float) -> None:
        self.rate = rate
        self._burst = max(BURST, 1.0 / rate)
        self._full_at: dict[str, float] = {}

    def take(self, client: str, now: float) -> float:
        """Take a token of `client` at `now` (s); if there is none, return the seconds to wait."""
        full_at = max(self._full_at.get(client, now), now)
        wait = full_at + 1.0 / self.rate - now - self._burst
        if wait > 1e-9:
            return wait
        self._full_at[client] = full_at + 1.0 / self.rate
        if len(self._full_at) > MOST_CLIENTS:
            busy = {name: at for name, at in self._full_at.items() if at > now}
            self._full_at = busy if len(busy) <= MOST_CLIENTS else {}
        return 0.0
