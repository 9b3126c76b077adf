import select
import shutil
import socket
import ssl
import subprocess
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import urlsplit

import numpy as np
import pytest

from palpate.online.client.http import Client
from palpate.online.client.session import ServiceError, Session, secure
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
    assert answer.out_of_range == ("radius",)


def test_an_answer_has_the_names_and_values_that_it_has_in_process(url):
    """Also beyond the range, where errors are infinite, and the fields of the next in one go."""
    own = FakeModel()
    with Client(url) as client:
        for pressure in (4.0, 9.0):
            expected = own.press((5, 5, 6), pressure, (0.1, 0, -1))
            answer = client.solve("toy", (5, 5, 6), pressure, direction=(0.1, 0, -1))
            for name in set(answer._fields) & set(expected._fields):
                one, other = getattr(answer, name), getattr(expected, name)
                if name == "out_of_range":
                    assert one == other
                else:
                    np.testing.assert_allclose(one, other, err_msg=name)


def test_the_largest_values_come_when_asked_for(url):
    own = FakeModel()
    found = own.press((5, 5, 5), 4.0)
    with Client(url) as client:
        assert client.solve("toy", (5, 5, 5), 4.0).peak is None
        answer = client.solve("toy", (5, 5, 5), 4.0, outputs=["peak"])
    assert answer.peak["von_mises"] == own.peaks(found, own.displacement(found))[0]
    assert answer.displacement is None


def test_a_history_is_answered_step_by_step(serving, visco_atlas):
    at = visco_atlas.models.centres[0].tolist()
    steps = [(0.1, at, 0.5), (0.5, at, 1.0), (1.0, None, 0.0)]
    with serving(visco_atlas) as url, Client(url) as client:
        answers = client.history(visco_atlas.name, steps, region="surface")
    assert [answer.time for answer in answers] == [0.1, 0.5, 1.0]
    assert answers[0].displacement is None
    assert answers[2].displacement.shape == (len(visco_atlas.surface_nodes), 3)
    assert answers[1].force[2] != 0.0
    assert not answers[2].force.any()


def test_lists_are_answered_as_one_by_one(url):
    own, x = FakeModel(), [[5, 5, 6.5], [2, 3, 6.2], [5, 5, 9.0]]
    with Client(url) as client:
        found = client.solve_many("toy", [[5, 5, 5], [2, 3, 5.5]], [4.0, 9.0], [[0, 0, -1]] * 2)
        touched = client.touch("toy", x)
    expected = [own.press((5, 5, 5), 4.0, (0, 0, -1)), own.press((2, 3, 5.5), 9.0, (0, 0, -1))]
    for answers, others in ((found, expected), (touched, [own.touch(at) for at in x])):
        for name in set(answers._fields) - {"limit"}:
            other = [getattr(answer, name) for answer in others]
            np.testing.assert_array_equal(getattr(answers, name), other, err_msg=name)
    assert found.in_range.tolist() == [1, 0]


def forwarded(listener, url):
    """Pass on what one client sends by TLS, and the answers."""
    client, _ = listener.accept()
    parts = urlsplit(url)
    with client, socket.create_connection((parts.hostname, parts.port)) as service:
        while True:
            ready = [client] if client.pending() else select.select([client, service], [], [])[0]
            for source, drain in ((client, service), (service, client)):
                if source in ready:
                    data = source.recv(65536)
                    if not data:
                        return
                    drain.sendall(data)


@pytest.mark.skipif(shutil.which("openssl") is None, reason="makes the certificate")
def test_it_speaks_tls_and_believes_only_whom_it_should(url, tmp_path, monkeypatch):
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    command = f"openssl req -x509 -newkey rsa:2048 -nodes -keyout {key} -out {certificate} -days 1"
    named = ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"]
    subprocess.run([*command.split(), *named], check=True, capture_output=True)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    with (
        socket.create_server(("127.0.0.1", 0)) as bound,
        context.wrap_socket(bound, server_side=True) as listener,
        ThreadPoolExecutor(2) as executor,
    ):
        safe = f"https://localhost:{listener.getsockname()[1]}"
        secure.cache_clear()
        refused = executor.submit(listener.accept)
        with Client(safe) as client, pytest.raises(PalpateError, match="CERTIFICATE_VERIFY"):
            client.scenes()
        assert refused.exception()
        monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
        secure.cache_clear()
        served = [executor.submit(forwarded, listener, url)]
        with Client(safe) as client:
            assert client.solve("toy", (5, 5, 5), 4.0).converged
        served.append(executor.submit(forwarded, listener, url))
        with Session(safe, "toy") as session:
            assert session.step((5.0, 5.0, 6.5)).good
            session.send((5.0, 5.0, 6.5))
            while session.poll() is None:
                pass
        for one in served:
            one.result()
    secure.cache_clear()


def test_refusals_are_raised(url):
    with Client(url) as client:
        with pytest.raises(ServiceError, match="greater than or equal") as refused:
            client.solve("toy", (5, 5, 5), -4.0)
        assert (refused.value.status, refused.value.field) == (422, "contacts.0.pressure")
        with pytest.raises(ServiceError) as refused:
            client.scene("a/b c")
        assert refused.value.status == 404


def test_other_addresses_are_refused_and_where_no_service_answers_is_said():
    strange = "toy", "ftp://127.0.0.1:1", "http://", "http://localhost:abc"
    for url in (*strange, "http://127.0.0.1:99999", "https://127.0.0.1:0"):
        with pytest.raises(PalpateError, match="not an address"):
            Client(url)
    with socket.create_server(("127.0.0.1", 0)) as bound:
        port = bound.getsockname()[1]
    with pytest.raises(PalpateError, match="no service answers there"):
        Client(f"http://127.0.0.1:{port}").scenes()
    with pytest.raises(PalpateError, match="no service answers there"):
        Session(f"http://127.0.0.1:{port}", "toy")
    with pytest.raises(PalpateError, match="no-such-machine"):
        Client("http://no-such-machine.invalid").scenes()


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
