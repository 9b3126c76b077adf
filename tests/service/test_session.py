"""Sessions of a process of its own, on a trained scene."""

import threading

import numpy as np
import pytest

from online.client import Client
from online.session_client import Session, SessionClosed

pytestmark = pytest.mark.service


def test_a_session_feels_the_tissue(server):
    with Session(server.url, "quick") as session:
        start = np.array(session.hello["example"]["position"])
        for depth in np.linspace(0.0, 0.3, 10):
            reply = session.step(start - [0, 0, depth])
            assert reply.good
            assert reply.contact
            assert reply.force[2] > 0


def test_stopping_under_load_tells_the_sessions(serve, artifact):
    """SIGTERM: every frame that came is answered, every session hears why it ends, exit code 0."""
    heard, started = [], threading.Barrier(4)

    def step():
        with Session(server.url, "quick") as session:
            position = session.hello["example"]["position"]
            session.step(position)
            started.wait()
            try:
                while True:
                    session.step(position)
            except SessionClosed as closed:
                heard.append((closed.code, closed.reason))

    with serve(artifact.parent) as server, Client(server.url) as client:
        threads = [threading.Thread(target=step) for _ in range(3)]
        for thread in threads:
            thread.start()
        started.wait()
        client.scene("quick")
        assert server.stop() == 0
        for thread in threads:
            thread.join()
    assert heard == [(1001, "the service is stopping")] * 3
    assert "Traceback" not in server.log


def test_stopping_does_not_wait_for_a_client_that_does_not_read(serve, artifact):
    with serve(artifact.parent) as server, Session(server.url, "quick") as session:
        session._socket.settimeout(0.5)
        position = session.hello["example"]["position"]
        with pytest.raises(TimeoutError):
            pour(session, position)
        assert server.stop() == 0
    assert "Traceback" not in server.log


def pour(session, position):
    """Ask for fields and read nothing, until the socket is full."""
    while True:
        session.send(position, outputs=6)
