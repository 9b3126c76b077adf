"""Modes of local models, of which a page makes the displacement."""

import numpy as np
import pytest

from palpate.online.serve import layout
from palpate.online.serve.layout import BINARY

from ..conftest import error_of
from ..fake_model import FakeModel

ACCEPT = {"accept": BINARY}


def test_modes_come_as_whole_steps(client):
    response = client.get("/scenes/toy/modes/3", headers=ACCEPT)
    head, arrays = layout.decode(response.content)
    assert head == {"scene": "toy", "model": 3, "artifact": FakeModel.seal}
    exact = FakeModel().surface_modes(3)
    assert arrays["modes"].shape == exact.shape
    assert arrays["modes"].dtype == np.int16
    rounded = arrays["modes"] * arrays["steps"][:, None]
    assert np.abs(rounded - exact).max() <= 0.51 * arrays["steps"].max()
    assert np.abs(arrays["modes"]).max() == layout.MOST
    assert client.get("/scenes/toy/modes/3").json()["fields"]["modes"][0][0] == [0, 0, 0]


def test_they_are_kept_for_ever_by_the_artifact(client):
    path = "/scenes/toy/modes/0"
    assert client.get(path).headers["cache-control"] == "no-cache"
    kept = client.get(path, params={"artifact": FakeModel.seal})
    assert "immutable" in kept.headers["cache-control"]
    assert client.get("/scenes/toy").json()["artifact"] == FakeModel.seal
    error = error_of(client.get(path, params={"artifact": "other"}), 404)
    assert (error["code"], error["allowed"]) == ("unknown_artifact", FakeModel.seal)


@pytest.mark.parametrize("number", [4, 10**9])
def test_an_unknown_local_model_is_refused(client, number):
    error = error_of(client.get(f"/scenes/toy/modes/{number}"), 404)
    assert (error["code"], error["allowed"]) == ("unknown_model", {"lt": 4})


def test_where_the_local_models_are(client):
    _, arrays = layout.decode(client.get("/scenes/toy/modes", headers=ACCEPT).content)
    assert arrays["centres"].shape == (4, 3)
