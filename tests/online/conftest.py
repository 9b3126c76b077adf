import socket
import threading
import time
from contextlib import contextmanager

import pytest
import uvicorn
from starlette.testclient import TestClient

from palpate.online.client.session import ServiceError, Session
from palpate.online.serve.app import create_app
from palpate.online.serve.process import HttpProtocol
from palpate.online.serve.service import Service
from palpate.online.session.websocket import OPTIONS
from palpate.online.settings import Settings
from palpate.shared.errors import PalpateError
from palpate.shared.model import ReducedModel

from .fake_model import FakeModel


@pytest.fixture
def fake_service(tmp_path, monkeypatch):
    """Return a function that makes a service of fake models, one per name.

    An exception in place of a model is raised when that file is loaded.
    """

    def make(settings=(), /, **models):
        for name in models:
            (tmp_path / f"{name}.h5").touch()

        def load(path):
            model = models[path.stem]
            if isinstance(model, Exception):
                raise model
            return model

        monkeypatch.setattr(ReducedModel, "load", load)
        service = Service(Settings(tmp_path, **dict(settings)))
        service.loads = models  # may be changed, as files are
        return service

    return make


@pytest.fixture
def make_app(fake_service):
    """Return a function that makes a service of models (by default the toy) and its application."""

    def make(models, settings):
        models = models or [FakeModel()]
        named = {getattr(model, "name", "broken"): model for model in models}
        service = fake_service(settings, **named)
        return service, create_app(service)

    return make


@pytest.fixture
def serve(make_app):
    """Return a context manager that serves models to an in-process client, once warm."""

    @contextmanager
    def serving(*models, **settings):
        service, app = make_app(models, settings)
        with TestClient(app, raise_server_exceptions=False) as client:
            _wait_for(service)
            yield client

    return serving


@pytest.fixture
def client(serve):
    """Return an in-process client of a service with one toy scene and one refused file."""
    with serve(FakeModel(), PalpateError("broken.h5: truncated")) as client:
        yield client


@pytest.fixture
def serving(make_app):
    """Return a context manager that serves models on a real socket and gives the address."""

    @contextmanager
    def serving(*models, **settings):
        service, app = make_app(models, settings)
        config = uvicorn.Config(
            app, http=HttpProtocol, access_log=False, log_level="warning", **OPTIONS
        )
        server = uvicorn.Server(config)
        with socket.create_server(("127.0.0.1", 0)) as bound:
            thread = threading.Thread(target=server.run, args=([bound],))
            thread.start()
            _wait_for(service)
            try:
                yield f"http://127.0.0.1:{bound.getsockname()[1]}"
            finally:
                server.should_exit = True
                thread.join()

    return serving


@pytest.fixture
def opening(serving):
    """Return a context manager that opens a session of the toy, served like this."""

    @contextmanager
    def opening(*models, record=None, **settings):
        with serving(*models, **settings) as url, Session(url, "toy", record=record) as session:
            yield session

    return opening


@pytest.fixture
def url(serving):
    """Return the address of a toy service on a real socket."""
    with serving() as url:
        yield url


def place_comes_free(url):
    """Open a session as soon as there is a place."""
    for _ in range(500):
        try:
            return Session(url, "toy")
        except ServiceError:
            time.sleep(0.01)
    raise AssertionError("no place came free")


def error_of(response, status):
    """Return the error of a refusal, which has the form of all refusals."""
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/json"
    assert "NaN" not in response.text
    assert "Traceback" not in response.text
    error = response.json()["error"]
    assert set(error) == {"code", "field", "message", "allowed"}
    assert error["message"]
    return error


def _wait_for(service):
    while not service.ready.is_set():
        time.sleep(0.005)
