import select
import socket

import numpy as np
import pytest

from palpate.online.client.http import Client, ServiceError
from palpate.shared.errors import PalpateError

from ..conftest import place_comes_free
from ..fake_model import FakeModel


def test_it_asks_and_understands(url):
    model = FakeModel()
    with Client(url) as client:
        assert [scene["name"] for scene in client.scenes()["scenes"]] == ["toy"]
        assert client.scene("toy")["ranges"]["reach"] == 3.0
        mesh = client.mesh("toy", region="all")
        answer = client.solve("toy", (5, 5, 5), 4.0, direction=(0, 0, -1), radius=1.5, region="all")
        assert client.solve("toy", (5, 5, 5), 4.0).displacement is None
        assert client.accessible("toy").depth_limit.max() == 1.0
    solution = model.press((5, 5, 5), 4.0, (0, 0, -1), 1.5)
    np.testing.assert_allclose(mesh.nodes, model.nodes, atol=1e-6)
    np.testing.assert_allclose(answer.force, solution.force)
    np.testing.assert_array_equal(answer.displacement, model.displacement(solution, "all"))
    np.testing.assert_array_equal(answer.von_mises, model.von_mises(solution, "all"))
    assert answer.trust["out_of_range"] == ["radius"]


def test_refusals_are_raised(url):
    with Client(url) as client:
        with pytest.raises(ServiceError, match="greater than or equal") as refused:
            client.solve("toy", (5, 5, 5), -4.0)
        assert (refused.value.status, refused.value.field) == (422, "contacts.0.pressure")
        with pytest.raises(ServiceError) as refused:
            client.scene("a/b c")
        assert refused.value.status == 404


def test_other_addresses_are_refused_and_where_no_service_answers_is_said():
    for url in ("toy", "https://127.0.0.1:1", "http://"):
        with pytest.raises(PalpateError, match="not an address"):
            Client(url)
    with socket.create_server(("127.0.0.1", 0)) as bound:
        port = bound.getsockname()[1]
    with pytest.raises(PalpateError, match="no service answers there"):
        Client(f"http://127.0.0.1:{port}").scenes()


def test_a_session_that_cannot_be_recorded_is_closed(serving, tmp_path):
    """There is no such folder: the error is told, and the session's place is free again."""
    with serving(max_sessions=1) as url, Client(url) as client:
        with pytest.raises(FileNotFoundError):
            client.session("toy", record=tmp_path / "missing" / "session.h5")
        place_comes_free(url).close()


def test_poll_does_not_wait(url):
    with Client(url) as client, client.session("toy") as session:
        assert session.poll() is None
        seq = session.send((5.0, 5.0, 6.5))
        select.select([session], [], [])
        while (reply := session.poll()) is None:
            pass
        assert reply.seq == seq
        assert session.poll() is None
