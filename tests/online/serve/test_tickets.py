import re
from time import time

import pytest

from palpate.online.client.session import Connection, ServiceError
from palpate.online.serve.tickets import VALID, is_valid, issue

from ..conftest import error_of

TOKEN = {"authorization": "Bearer secret"}


def test_a_ticket_is_valid_for_a_while_with_its_token():
    ticket = issue("secret", 1000.0)
    assert is_valid(ticket, "secret", 1000.0 + VALID)
    assert not is_valid(ticket, "secret", 1001.0 + VALID)
    assert not is_valid(ticket, "other", 1000.0)
    later = re.sub(r"^\d+", lambda time: str(int(time[0]) + 100), ticket)
    for wrong in ("", ".", "..", "9999.x.y", ticket[:-1], ticket + "0", later, "é"):
        assert not is_valid(wrong, "secret", 1000.0)


def test_two_tickets_differ():
    assert issue("secret", 1000.0) != issue("secret", 1000.0)


def test_who_has_the_token_gets_a_ticket(serve):
    with serve(token="secret") as client:
        assert error_of(client.post("/tickets"), 401)
        told = client.post("/tickets", headers=TOKEN).json()
        assert told["valid_s"] == VALID
        # it opens sessions and nothing else
        assert error_of(client.get("/scenes", params={"ticket": told["ticket"]}), 401)
    with serve() as client:
        assert client.post("/tickets").json()["ticket"] is None


def test_a_session_opens_with_a_ticket(serving):
    with serving(token="secret") as url:

        def opened(ticket):
            Connection(url, f"/scenes/toy/session?ticket={ticket}", None, 10.0).close()

        opened(issue("secret", time()))
        for wrong in ("", "x", issue("other", time()), issue("secret", time() - 2 * VALID)):
            with pytest.raises(ServiceError) as refused:
                opened(wrong)
            assert refused.value.status == 401
