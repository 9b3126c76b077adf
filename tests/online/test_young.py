"""Another Young's modulus, in all ways to ask."""

import numpy as np
import pytest

from palpate.online.client.http import Client
from palpate.online.client.session import ServiceError, Session
from palpate.online.serve import layout
from palpate.online.serve.layout import BINARY

from .conftest import error_of
from .fake_model import FakeModel

AT, PRESSED = (5.0, 5.0, 5.0), (5.0, 5.0, 6.5)
YOUNG = 2.5 * FakeModel().scene.tissue.young


def test_a_load_on_stiffer_tissue_is_that_of_the_model(url):
    known = FakeModel().press(AT, 10.0, young=YOUNG)
    assert known.in_range  # beyond the limit of the trained tissue
    with Client(url) as client:
        answer = client.solve("toy", AT, 10.0, young=YOUNG)
        many = client.solve_many("toy", [AT, AT], [10.0, 1.0], young=YOUNG)
        touched = client.touch("toy", [PRESSED], young=YOUNG)
        soft = client.touch("toy", [PRESSED])
    np.testing.assert_allclose(answer.force, known.force)
    assert answer.pressure_limit == pytest.approx(2.5 * FakeModel().pressure_max)
    np.testing.assert_allclose(many.force[0], known.force)
    np.testing.assert_allclose(touched.force, 2.5 * soft.force)


def test_a_check_knows_the_stiffness(client):
    load = {"contacts": [{"position": AT, "pressure": 10.0}]}
    said = client.post("/scenes/toy/check", json=load).json()
    assert said["out_of_range"] == ["pressure"]
    assert client.post("/scenes/toy/check", json={**load, "young": YOUNG}).json()["in_range"]


def test_a_session_has_the_stiffness_that_it_was_told_last(url):
    with Session(url, "toy") as session:
        soft = session.step(PRESSED)
        session.young(YOUNG)
        stiff = session.step(PRESSED)
        session.young(FakeModel().scene.tissue.young)
        again = session.step(PRESSED)
    np.testing.assert_allclose(stiff.force, 2.5 * soft.force)
    np.testing.assert_allclose(stiff.tangent, 2.5 * soft.tangent)
    np.testing.assert_array_equal(again.force, soft.force)
    with Session(url, "toy") as session:  # does not pass on to the next
        np.testing.assert_array_equal(session.step(PRESSED).force, soft.force)


@pytest.mark.parametrize("young", [0.0, -1.0, 1e7, "soft", True])
def test_what_is_no_modulus_is_refused(client, url, young):
    load = {"contacts": [{"position": AT, "pressure": 1.0}], "young": young}
    assert error_of(client.post("/scenes/toy/solve", json=load), 422)["field"] == "young"
    body = layout.encode({"young": young}, {"positions": np.array([PRESSED])})
    response = client.post("/scenes/toy/touch", content=body, headers={"content-type": BINARY})
    assert error_of(response, 422)["field"] == "young"
    if isinstance(young, float):
        with Session(url, "toy") as session, pytest.raises(ServiceError, match="young"):
            session.young(young)
