"""Who may ask, how often, and when the service is too busy: decided before anything is read.

Pure ASGI, for HTTP requests and the opening of sessions alike; Starlette's BaseHTTPMiddleware
would cost a query more than its solve.
"""

import hmac
import ipaddress
import math
from collections.abc import Mapping
from functools import lru_cache
from time import perf_counter
from urllib.parse import urlsplit

from fastapi import FastAPI
from starlette.middleware.cors import CORSMiddleware
from starlette.types import ASGIApp, Receive, Scope, Send

from palpate.online.serve.errors import Refusal
from palpate.online.serve.metrics import Metrics
from palpate.online.serve.settings import Settings

RECEIVED = "palpate.received"
"""Key in the ASGI scope of when the request was read, s of `time.perf_counter`."""

PROBES = frozenset({"/health", "/ready"})
"""Open to all and always answered: they tell nothing but whether to wait."""

METRICS = "/metrics"
"""Answered also while the service sheds load: it shows that it does."""

BURST = 1.0
"""Seconds of the rate limit that may come at once, but always one request."""

MOST_CLIENTS = 10_000
"""Clients whose rates are remembered; beyond it all are forgiven, so that memory stays bounded."""


def install(app: FastAPI, settings: Settings, metrics: Metrics) -> None:
    """Put `app` behind the guard; browsers learn which origins are allowed, if there are any."""
    app.add_middleware(Guard, settings=settings, metrics=metrics)
    if settings.origins:
        # outermost: preflights carry no token, and refusals must be readable by the page too
        app.add_middleware(
            CORSMiddleware,
            allow_origins=settings.origins,
            allow_methods=["GET", "POST"],
            allow_headers=["Authorization", "Content-Type"],
            expose_headers=["Server-Timing", "Retry-After"],
        )


class Guard:
    """Passes on what may pass and refuses the rest."""

    def __init__(self, app: ASGIApp, settings: Settings, metrics: Metrics) -> None:
        self._app, self._metrics = app, metrics
        self._origins = frozenset(origin.encode() for origin in settings.origins)
        self._hosts = frozenset(host.lower() for host in settings.hosts)
        self._secret = f"Bearer {settings.token}".encode() if settings.token else None
        self._rates = RateLimit(settings.rate_limit) if settings.rate_limit else None
        self._max_wait = settings.max_wait

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer or refuse, as ASGI asks."""
        if scope["type"] != "lifespan" and scope["path"] not in PROBES:
            try:
                self._admit(scope)
            except Refusal as refusal:
                self._metrics.count_refusal(refusal.code)
                await refusal.response()(scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _admit(self, scope: Scope) -> None:
        headers = dict(scope["headers"])
        self._check_host(headers)
        self._check_origin(headers)
        self._check_token(headers)
        if scope["path"] != METRICS:
            now = perf_counter()
            self._check_wait(now - scope.get(RECEIVED, now), scope["type"])
            self._check_rate(scope, now)

    def _check_host(self, headers: Mapping[bytes, bytes]) -> None:
        """Refuse calls by other names than this machine's (DNS rebinding).

        A page of another site may have its own name lead here; its origin is then the service's.
        """
        host = _host(headers.get(b"host", b""))
        if self._hosts and host not in self._hosts and not _is_loopback_address(host):
            allowed = sorted({*self._hosts, "127.0.0.1"})
            raise Refusal("foreign_host", "host", "The service does not go by this name", allowed)

    def _check_origin(self, headers: Mapping[bytes, bytes]) -> None:
        """Refuse other sites' pages: a browser would lend them the user's place in the network."""
        origin = headers.get(b"origin")
        if origin is None or origin in self._origins or b"*" in self._origins:
            return
        if origin.partition(b"://")[2] != headers.get(b"host"):
            message = "Pages of this origin may not use the service"
            raise Refusal("foreign_origin", "origin", message)

    def _check_token(self, headers: Mapping[bytes, bytes]) -> None:
        given = headers.get(b"authorization", b"")
        # takes as long for a token that is nearly right as for any other
        if self._secret is not None and not hmac.compare_digest(given, self._secret):
            raise Refusal(
                "unauthorized",
                "authorization",
                "This service asks for a token: Authorization: Bearer TOKEN",
                headers={"WWW-Authenticate": "Bearer"},
            )

    def _check_wait(self, waited: float, kind: str) -> None:
        if kind == "http":  # the opening of a session is no query
            self._metrics.count_wait(waited)
        if waited > self._max_wait:
            raise Refusal(
                "overloaded",
                "",
                f"The service is too busy: this request waited {waited:.3f} s for its turn",
                {"max_wait_s": self._max_wait},
                {"Retry-After": "1"},
            )

    def _check_rate(self, scope: Scope, now: float) -> None:
        client = scope.get("client")
        if self._rates and (wait := self._rates.take(client[0] if client else "", now)) > 0.0:
            raise Refusal(
                "too_many_requests",
                "",
                "More requests from this address than the service answers",
                {"requests_per_second": self._rates.rate},
                {"Retry-After": str(math.ceil(wait))},
            )


@lru_cache(64)
def _host(header: bytes) -> str:
    """Read the name or address in a Host header; empty if there is none."""
    try:
        return urlsplit(f"//{header.decode('latin-1')}").hostname or ""
    except ValueError:
        return ""


@lru_cache(64)
def _is_loopback_address(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class RateLimit:
    """A bucket of tokens per client that fills at `rate` (1/s) and holds `BURST` seconds' worth.

    Kept as the one moment at which the bucket will be full again (the generic cell rate algorithm
    of ATM networks), so that an idle client costs nothing.
    """

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
            self._full_at = {name: at for name, at in self._full_at.items() if at > now}
        if len(self._full_at) > MOST_CLIENTS:
            self._full_at.clear()
        return 0.0
