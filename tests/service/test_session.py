"""Sessions of a process of its own, on a trained scene."""

import json
import signal
import socket
import subprocess
import threading
import time
from contextlib import ExitStack
from urllib.parse import urlsplit

import numpy as np
import pytest

from palpate.online.client.http import Client
from palpate.online.client.session import Session, SessionClosed
from palpate.online.session.frames import Output

from ..conftest import PALPATE

pytestmark = pytest.mark.service


def test_a_recorded_session_is_replayed_to_the_bit(serve, server, artifact, tmp_path, rng):
    """In another process; with steps small and large, out of contact and too deep."""
    path = tmp_path / "session.h5"
    # the first server may have compiled kernels itself: their last bits are not those of the cache
    with (
        serve(artifact.parent) as second,
        Client(second.url) as client,
        client.session("quick", record=path) as session,
    ):
        position = np.array(session.greeting["example"]["position"])
        for i in range(300):
            if i % 20 == 0:
                at = position + rng.uniform([-3, -3, -1.5], [3, 3, 1])
            at = at + rng.normal(0.0, 0.03, 3)
            session.step(at, outputs=Output.STRESS if i % 50 == 0 else 0)
    command = [*PALPATE, "replay", str(path), str(artifact), "--json"]
    replayed = subprocess.run(command, capture_output=True, text=True)
    assert json.loads(replayed.stdout) == {
        "replies": 300,
        "different": 0,
        "first_different": None,
        "force_difference": 0.0,
    }


def test_stopping_under_load_tells_the_sessions(serve, artifact):
    """SIGTERM: every frame that came is answered, every session hears why it ends, exit code 0."""
    heard, started = [], threading.Barrier(4)

    def step():
        with Session(server.url, "quick") as session:
            position = session.greeting["example"]["position"]
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


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_session_outlives_its_service(serve, artifact, number):
    """The service is killed or stopped, and started again while the next step is waiting."""
    with serve(artifact.parent) as first, ExitStack() as stack:
        session = stack.enter_context(Session(first.url, "quick", reconnect=60.0))
        position = session.greeting["example"]["position"]
        before = session.step(position)
        first.stop(number)
        replies = []
        step = threading.Thread(target=lambda: replies.append(session.step(position)))
        step.start()
        time.sleep(0.5)
        assert not replies
        stack.enter_context(serve(artifact.parent, "--port", str(urlsplit(first.url).port)))
        step.join()
        (after,) = replies
        assert (before.first, after.first, after.good) == (True, True, True)
        assert session.reconnections == 1
        np.testing.assert_allclose(after.force, before.force, rtol=1e-6)
        assert not session.step(position).first


def test_stopping_does_not_wait_for_a_client_that_does_not_read(serve, artifact):
    with serve(artifact.parent) as server, Session(server.url, "quick") as session:
        session._connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        position = session.greeting["example"]["position"]
        for _ in range(600):  # more replies with fields than fit into the buffers on the way
            session.send(position, outputs=Output.DISPLACEMENT | Output.VON_MISES)
            time.sleep(0.001)
        assert server.stop() == 0
    assert "Traceback" not in server.log
