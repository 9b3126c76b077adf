import threading

import pytest
from starlette.testclient import TestClient

from palpate.online.serve import schemas
from palpate.online.serve.app import create_app
from palpate.online.serve.service import Service
from palpate.online.serve.wire import BINARY, JSON, MSGPACK
from palpate.online.settings import Settings
from palpate.shared.errors import PalpateError
from palpate.shared.model import ReducedModel

from ..conftest import error_of
from ..fake_model import FakeModel


@pytest.fixture
def slow(tmp_path, monkeypatch):
    """Return a service that is loading until the returned event is set."""
    (tmp_path / "toy.h5").touch()
    loaded = threading.Event()

    def load(path):
        loaded.wait()
        return FakeModel()

    monkeypatch.setattr(ReducedModel, "load", load)
    return Service(Settings(tmp_path)), loaded


def test_it_lives_at_once_and_is_ready_when_warm(slow):
    service, loaded = slow
    ready = threading.Event()
    app = create_app(service, ready.set)
    with TestClient(app) as client:
        assert client.get("/health").json() == {"status": "ok"}
        for path in ("/ready", "/scenes", "/scenes/toy", "/scenes/toy/mesh"):
            assert error_of(client.get(path), 503)["code"] == "not_ready"
        loaded.set()
        assert ready.wait(5.0)
        assert client.get("/ready").json() == {"status": "ready"}


def test_a_service_that_is_told_to_stop_does_not_wait_for_its_models(slow):
    service, loaded = slow
    with TestClient(create_app(service)) as client:
        assert client.get("/ready").status_code == 503
    assert not service.ready.is_set()
    assert not loaded.is_set()
    loaded.set()


def test_a_service_without_any_model_is_not_ready(serve):
    with serve(PalpateError("broken.h5: truncated")) as client:
        assert "/scenes" in error_of(client.get("/ready"), 503)["message"]
        assert client.get("/scenes").json()["refused"][0]["reason"] == "broken.h5: truncated"


def test_openapi_tells_units_ranges_and_examples(client):
    document = client.get("/openapi.json").json()
    described = document["components"]["schemas"]
    contact = described["Contact"]["properties"]
    assert "mm" in contact["position"]["description"]
    assert "kPa" in contact["pressure"]["description"]
    assert contact["pressure"]["minimum"] == 0
    assert contact["position"]["maxItems"] == 3
    example = described["SolveRequest"]["examples"][0]
    assert client.post("/scenes/toy/check", json=example).json()["in_range"]
    assert described["SolveRequest"]["properties"]["contacts"]["maxItems"] == 1
    solve = document["paths"]["/scenes/{name}/solve"]["post"]
    reference = solve["requestBody"]["content"]["application/json"]["schema"]["$ref"]
    assert reference == "#/components/schemas/SolveRequest"
    assert set(solve["responses"]["200"]["content"]) == {JSON, BINARY, MSGPACK}


def test_answers_are_as_documented(client):
    """Hot answers bypass their models at run time, so hold them against the models here."""
    example = client.get("/scenes/toy").json()["example"]
    answer = client.post("/scenes/toy/solve", json={**example, "region": "surface"}).text
    documents = {
        schemas.Answer: answer,
        schemas.AccessibleDocument: client.get("/scenes/toy/accessible").text,
        schemas.MeshDocument: client.get("/scenes/toy/mesh").text,
        schemas.SceneList: client.get("/scenes").text,
        schemas.SceneSummary: client.get("/scenes/toy").text,
    }
    for model, text in documents.items():
        model.model_validate_json(text, strict=True, extra="forbid")
