import asyncio
import http.client
import json
from contextlib import closing
from urllib.parse import urlsplit

import pytest

from palpate.online.client.session import ServiceError, Session
from palpate.online.serve import guard
from palpate.online.serve.guard import RateLimit, Turns, machine_name

from ..conftest import error_of

LOAD = {"contacts": [{"position": [5, 5, 5], "pressure": 4}]}
TOKEN = {"authorization": "Bearer secret"}


@pytest.mark.parametrize(
    "wrong", [None, "", "secret", "Bearer", "Bearer secre", "Bearer secrets", "bearer secret", "é"]
)
def test_without_the_token_nothing_is_told(serve, wrong):
    headers = {} if wrong is None else {"authorization": wrong.encode()}
    with serve(token="secret") as client:
        for path in ("/scenes", "/metrics", "/openapi.json", "/nowhere"):
            error = error_of(client.get(path, headers=headers), 401)
            assert error["field"] == "authorization"
            assert "secret" not in json.dumps(error)
        response = client.post("/scenes/toy/solve", json=LOAD, headers=headers)
        assert error_of(response, 401)
        assert response.headers["www-authenticate"] == "Bearer"


def test_with_the_token_all_is_answered_and_probes_need_none(serve):
    with serve(token="secret", rate_limit=2) as client:
        assert client.post("/scenes/toy/solve", json=LOAD, headers=TOKEN).status_code == 200
        assert client.get("/metrics", headers=TOKEN).status_code == 200
        for _ in range(3):
            assert client.get("/health").status_code == 200
            assert client.get("/ready").status_code == 200


def test_pages_of_other_sites_are_refused(serve):
    with serve() as client:
        for origin in ("https://evil.example", "null", "http://testserver.evil.example"):
            error = error_of(client.get("/scenes", headers={"origin": origin}), 403)
            assert error["field"] == "origin"
        assert client.get("/scenes", headers={"origin": "http://testserver"}).status_code == 200
        assert client.get("/scenes").status_code == 200


LOCAL = {"hosts": ("localhost", "Trainer")}
FOREIGN = "evil.example", "evil.example:8000", "10.0.0.1", "localhost.evil.example", "", "[", "[::"
FOREIGN += "localhost#.evil.example", "localhost?x", "localhost/x", "x@localhost", "localhost:80:80"
OWN = "localhost", "LOCALHOST:80", "127.0.0.1:8000", "127.9.8.7", "[::1]:8000", "trainer:1"


def test_only_names_of_this_machine_are_served(serve):
    """A page whose own name leads here is of the same origin, as far as its browser knows."""
    with serve(**LOCAL) as client:
        for host in (*OWN, *FOREIGN):
            response = client.get("/scenes", headers={"host": host, "origin": f"http://{host}"})
            if host in OWN:
                assert response.status_code == 200, host
                continue
            error = error_of(response, 421)
            assert (error["code"], error["field"]) == ("foreign_host", "host")
            assert "localhost" in error["allowed"]


def test_listed_origins_may_read_answers(serve):
    page = "https://trainer.example"
    wanted = {"method": "POST", "headers": "authorization,content-type"}
    asking = {f"access-control-request-{name}": value for name, value in wanted.items()}
    with serve(origins=(page,), token="secret") as client:
        preflight = client.options("/scenes/toy/solve", headers={"origin": page, **asking})
        assert preflight.status_code == 200
        answer = client.post("/scenes/toy/solve", json=LOAD, headers={**TOKEN, "origin": page})
        assert answer.status_code == 200
        assert answer.headers["access-control-allow-origin"] == page
        # a page must be able to read why it was refused
        unauthorized = client.get("/scenes", headers={"origin": page})
        assert unauthorized.status_code == 401
        assert unauthorized.headers["access-control-allow-origin"] == page
        assert client.get("/scenes", headers={**TOKEN, "origin": "https://x"}).status_code == 403
    with serve(origins=("*",)) as client:
        assert client.get("/scenes", headers={"origin": "https://x"}).status_code == 200


def test_too_many_requests_are_told_when_to_come_back(serve):
    with serve(rate_limit=1) as client:
        responses = [client.get("/scenes") for _ in range(20)]
        late = [r for r in responses if r.status_code != 200]
        assert len(late) >= 10
        for response in late:
            assert error_of(response, 429)["allowed"] == {"requests_per_second": 1}
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
    slow = RateLimit(0.1)  # below one a second
    assert slow.take("a", 0.0) == 0.0
    assert slow.take("a", 4.0) == pytest.approx(6.0)
    assert [t for t in range(5, 31) if slow.take("a", t) == 0.0] == [10, 20, 30]


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
def test_what_has_waited_too_long_is_refused(serve, seconds, status):
    with serve(max_wait=0.2) as client:
        client._transport.app = Waiting(client._transport.app, seconds)
        response = client.get("/scenes")
        assert response.status_code == status
        if status == 503:
            assert error_of(response, 503)["code"] == "overloaded"
            assert response.headers["retry-after"] == "1"
        assert client.get("/health").status_code == 200
        assert client.get("/metrics").status_code == 200


def test_loopback_is_told_from_the_rest():
    for host in ("127.0.0.1", "127.8.9.1", "::1", "localhost", "LOCALHOST"):
        assert machine_name(host) == guard.LOCAL
    for host in ("0.0.0.0", "::", "10.0.0.1", "", "no-such-host.invalid"):
        assert machine_name(host) == host


def test_sessions_ask_for_the_token_too(serving):
    with serving(token="secret") as url:
        for wrong in (None, "secre"):
            with pytest.raises(ServiceError) as refused:
                Session(url, "toy", token=wrong)
            assert (refused.value.status, refused.value.code) == (401, "unauthorized")
        with Session(url, "toy", token="secret") as session:
            assert session.step((5.0, 5.0, 6.5)).good


def handshake(url, origin, **more):
    """Try to open a session from a page of `origin`; return the status."""
    headers = {"Origin": origin, "Connection": "upgrade", "Upgrade": "websocket"}
    headers |= {"Sec-WebSocket-Version": "13", "Sec-WebSocket-Key": 22 * "A" + "=="}
    with closing(http.client.HTTPConnection(urlsplit(url).netloc, timeout=10)) as connection:
        connection.request("GET", "/scenes/toy/session", headers=headers | more)
        return connection.getresponse().status


def test_pages_of_other_sites_and_other_names_get_no_session(serving):
    page = "https://trainer.example"
    with serving(origins=(page,), **LOCAL) as url:
        assert handshake(url, "https://evil.example") == 403
        assert handshake(url, page) == 101
        assert handshake(url, url) == 101
        assert handshake(url, "http://evil.example", Host="evil.example") == 421


def test_opening_sessions_has_a_rate(serving):
    with serving(rate_limit=3) as url:
        statuses = [handshake(url, url) for _ in range(10)]
    assert statuses[:3] == [101, 101, 101]
    assert 429 in statuses[3:]


def test_one_request_is_answered_at_a_time_and_the_loop_reads_between_them():
    async def rounds(count):
        """Rounds of the event loop in which requests that came at once had their turns."""
        turns, loop, now, had = Turns(), asyncio.get_running_loop(), [0], []

        def turn_over():
            now[0] += 1
            loop.call_soon(turn_over)

        async def ask():
            await turns.wait()
            had.append(now[0])

        loop.call_soon(turn_over)
        asking = [loop.create_task(ask()) for _ in range(count)]
        await asyncio.sleep(0)
        asking[3].cancel()  # as where a service ends
        await asyncio.wait(asking)
        await ask()  # later ones wait for nobody
        return had

    had = asyncio.run(rounds(10))
    assert len(had) == len(set(had)) == 10  # one of them was cancelled
