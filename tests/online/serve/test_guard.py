import http.client
import json
from urllib.parse import urlsplit

import pytest

from palpate.online.client.connection import ServiceError
from palpate.online.client.session import Session
from palpate.online.serve import guard
from palpate.online.serve.guard import RateLimit
from palpate.online.serve.settings import Settings, is_loopback
from palpate.shared.errors import PalpateError

from ..fake_model import FakeModel

LOAD = {"contacts": [{"position": [5, 5, 5], "pressure": 4}]}
TOKEN = {"authorization": "Bearer secret"}


@pytest.fixture
def guarded(serve, tmp_path):
    """Return a context manager that serves the toy with some settings."""

    def serving(**settings):
        return serve(Settings(tmp_path, **settings), toy=FakeModel())

    return serving


def refused(response, status):
    assert response.status_code == status
    error = response.json()["error"]
    assert set(error) == {"code", "field", "message", "allowed"}
    return error


@pytest.mark.parametrize(
    "wrong", [None, "", "secret", "Bearer", "Bearer secre", "Bearer secrets", "bearer secret", "é"]
)
def test_without_the_token_nothing_is_told(guarded, wrong):
    headers = {} if wrong is None else {"authorization": wrong.encode()}
    with guarded(token="secret") as client:
        for path in ("/scenes", "/metrics", "/docs", "/openapi.json", "/nowhere"):
            error = refused(client.get(path, headers=headers), 401)
            assert error["field"] == "authorization"
            assert "secret" not in json.dumps(error)
        response = client.post("/scenes/toy/solve", json=LOAD, headers=headers)
        assert refused(response, 401)
        assert response.headers["www-authenticate"] == "Bearer"


def test_with_the_token_all_is_answered_and_probes_need_none(guarded):
    with guarded(token="secret", rate_limit=2) as client:
        assert client.post("/scenes/toy/solve", json=LOAD, headers=TOKEN).status_code == 200
        assert client.get("/metrics", headers=TOKEN).status_code == 200
        for _ in range(3):
            assert client.get("/health").status_code == 200
            assert client.get("/ready").status_code == 200


def test_pages_of_other_sites_are_refused(guarded):
    with guarded() as client:
        for origin in ("https://evil.example", "null", "http://testserver.evil.example"):
            error = refused(client.get("/scenes", headers={"origin": origin}), 403)
            assert error["field"] == "origin"
        assert client.get("/scenes", headers={"origin": "http://testserver"}).status_code == 200
        assert client.get("/scenes").status_code == 200


LOCAL = {"hosts": ("localhost", "Trainer")}
FOREIGN = (
    "evil.example",
    "evil.example:8000",
    "10.0.0.1",
    "localhost.evil.example",
    "",
    "[",
    "[::",
)
OWN = ("localhost", "LOCALHOST:80", "127.0.0.1:8000", "127.9.8.7", "[::1]:8000", "trainer:1")


def test_only_names_of_this_machine_are_served(guarded):
    """A page whose own name leads here is of the same origin, as far as its browser knows."""
    with guarded(**LOCAL) as client:
        for host in OWN:
            headers = {"host": host, "origin": f"http://{host}"}
            assert client.get("/scenes", headers=headers).status_code == 200, host
        for host in FOREIGN:
            headers = {"host": host, "origin": f"http://{host}"}
            error = refused(client.get("/scenes", headers=headers), 421)
            assert (error["code"], error["field"]) == ("foreign_host", "host")
            assert "localhost" in error["allowed"]
            assert refused(client.post("/scenes/toy/solve", json=LOAD, headers=headers), 421)


def test_listed_origins_may_read_answers(guarded):
    page = "https://trainer.example"
    with guarded(origins=(page,), token="secret") as client:
        preflight = client.options(
            "/scenes/toy/solve",
            headers={
                "origin": page,
                "access-control-request-method": "POST",
                "access-control-request-headers": "authorization,content-type",
            },
        )
        assert preflight.status_code == 200
        answer = client.post("/scenes/toy/solve", json=LOAD, headers={**TOKEN, "origin": page})
        assert answer.status_code == 200
        assert answer.headers["access-control-allow-origin"] == page
        # a page must be able to read why it was refused
        unauthorized = client.get("/scenes", headers={"origin": page})
        assert unauthorized.status_code == 401
        assert unauthorized.headers["access-control-allow-origin"] == page
        assert client.get("/scenes", headers={**TOKEN, "origin": "https://x"}).status_code == 403
    with guarded(origins=("*",)) as client:
        assert client.get("/scenes", headers={"origin": "https://x"}).status_code == 200


def test_too_many_requests_are_told_when_to_come_back(guarded):
    with guarded(rate_limit=5) as client:
        responses = [client.get("/scenes") for _ in range(20)]
        late = [r for r in responses if r.status_code != 200]
        assert len(late) >= 10
        for response in late:
            error = refused(response, 429)
            assert error["allowed"] == {"requests_per_second": 5}
            assert int(response.headers["retry-after"]) >= 1


def test_a_bucket_empties_and_fills_at_its_rate():
    bucket = RateLimit(10.0)
    assert [bucket.take("a", 0.0) for _ in range(10)] == [0.0] * 10
    assert bucket.take("a", 0.0) == pytest.approx(0.1)
    assert bucket.take("b", 0.0) == 0.0
    assert bucket.take("a", 0.1) == 0.0
    assert bucket.take("a", 0.15) == pytest.approx(0.05)
    # over a long time the rate is kept exactly, however often one asks
    answered = sum(bucket.take("c", 0.01 * i) == 0.0 for i in range(10_000))
    assert answered == pytest.approx(10 + 10 * 100, abs=1)


def test_a_rate_below_one_a_second_is_kept_too():
    bucket = RateLimit(0.1)
    assert bucket.take("a", 0.0) == 0.0
    assert bucket.take("a", 4.0) == pytest.approx(6.0)
    answered = [t for t in range(5, 101) if bucket.take("a", t) == 0.0]
    assert answered == list(range(10, 101, 10))


def test_a_flood_of_addresses_does_not_fill_the_memory(monkeypatch):
    monkeypatch.setattr(guard, "MOST_CLIENTS", 100)
    bucket = RateLimit(10.0)
    for i in range(1000):
        bucket.take(str(i), 0.0)
        assert len(bucket._full_at) <= 100


class Waiting:
    """An application whose requests all waited `seconds` before their turn."""

    def __init__(self, app, seconds):
        self.app, self.seconds = app, seconds

    async def __call__(self, scope, receive, send):
        scope[guard.RECEIVED] = guard.perf_counter() - self.seconds
        await self.app(scope, receive, send)


@pytest.mark.parametrize(("seconds", "status"), [(0.01, 200), (0.3, 503)])
def test_what_has_waited_too_long_is_refused(guarded, seconds, status):
    with guarded(max_wait=0.2) as client:
        client._transport.app = Waiting(client._transport.app, seconds)
        response = client.get("/scenes")
        assert response.status_code == status
        if status == 503:
            assert refused(response, 503)["code"] == "overloaded"
            assert response.headers["retry-after"] == "1"
        assert client.get("/health").status_code == 200
        assert client.get("/metrics").status_code == 200


def test_loopback_is_told_from_the_rest():
    assert all(map(is_loopback, ("127.0.0.1", "127.8.9.1", "::1", "localhost")))
    assert not any(map(is_loopback, ("0.0.0.0", "::", "10.0.0.1", "")))


def test_a_host_without_address_is_named():
    with pytest.raises(PalpateError, match=r"no-such-host\.invalid"):
        is_loopback("no-such-host.invalid")


def test_sessions_ask_for_the_token_too(serving, tmp_path):
    with serving(Settings(tmp_path, token="secret"), toy=FakeModel()) as url:
        for wrong in (None, "secre"):
            with pytest.raises(ServiceError) as refused:
                Session(url, "toy", token=wrong)
            assert (refused.value.status, refused.value.code) == (401, "unauthorized")
        with Session(url, "toy", token="secret") as session:
            assert session.step((5.0, 5.0, 6.5)).good


def handshake(url, origin, **more):
    """Try to open a session from a page of `origin`; return the status."""
    address = urlsplit(url).netloc
    connection = http.client.HTTPConnection(address, timeout=10)
    headers = {
        "Origin": origin,
        "Connection": "upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
        **more,
    }
    connection.request("GET", "/scenes/toy/session", headers=headers)
    status = connection.getresponse().status
    connection.close()
    return status


def test_pages_of_other_sites_and_other_names_get_no_session(serving, tmp_path):
    page = "https://trainer.example"
    with serving(Settings(tmp_path, origins=(page,), **LOCAL), toy=FakeModel()) as url:
        assert handshake(url, "https://evil.example") == 403
        assert handshake(url, page) == 101
        assert handshake(url, url) == 101
        assert handshake(url, "http://evil.example", Host="evil.example") == 421


def test_opening_sessions_has_a_rate(serving, tmp_path):
    with serving(Settings(tmp_path, rate_limit=3), toy=FakeModel()) as url:
        statuses = [handshake(url, url) for _ in range(10)]
    assert statuses[:3] == [101, 101, 101]
    assert 429 in statuses[3:]
