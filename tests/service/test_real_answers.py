"""The service over a really trained artifact."""

import json
from dataclasses import replace

import numpy as np
import pytest

from palpate.online.client.http import Client, ServiceError
from palpate.online.loadtest.run import Plan, run
from palpate.shared.model import ReducedModel

pytestmark = pytest.mark.service


@pytest.fixture
def client(server):
    with Client(server.url) as client:
        yield client


@pytest.fixture(scope="module")
def model(artifact):
    return ReducedModel.load(artifact)


@pytest.fixture
def contact(client):
    return client.scene("quick")["example"]["contacts"][0]


@pytest.mark.parametrize("region", ["surface", "all"])
def test_the_wire_adds_and_takes_nothing(client, model, contact, region):
    answer = client.solve("quick", **contact, region=region)
    solution = model.press(**contact)
    np.testing.assert_allclose(answer.force, solution.force, rtol=1e-12)
    displacement = model.displacement(solution, region)
    np.testing.assert_allclose(answer.displacement, displacement, atol=1e-6)
    np.testing.assert_allclose(answer.von_mises, model.von_mises(solution, region), atol=1e-5)
    assert len(client.mesh("quick", region).nodes) == len(displacement)
    assert np.abs(answer.displacement).max() > 0.1


def test_an_answer_does_not_depend_on_those_before(client, contact):
    def answer(**changes):
        return client.solve("quick", **{**contact, **changes}, region="all")

    first = answer()
    answer(pressure=0.01)
    answer(direction=(0.3, 0.2, -1.0))
    again = answer()
    np.testing.assert_array_equal(again.displacement, first.displacement)
    np.testing.assert_array_equal(again.force, first.force)
    assert again.trust == first.trust


@pytest.mark.parametrize(
    ("field", "factor"),
    [("pressure", f) for f in (1, 2, 5, 10)] + [("radius", f) for f in (0.01, 0.5, 1.5, 500)],
)
def test_beyond_the_trained_range_an_answer_is_flagged_or_refused(client, contact, field, factor):
    usual = client.solve("quick", **contact).contact
    value = factor * usual["pressure_limit" if field == "pressure" else "radius"]
    try:
        answer = client.solve("quick", **{**contact, field: value}, region="all")
    except ServiceError as error:
        answer = error
    if isinstance(answer, ServiceError):
        assert (answer.status, factor != 1) == (422, True)
        return
    assert answer.trust["in_range"] == (factor == 1)
    assert (field in answer.trust["out_of_range"]) == (factor != 1)
    assert (answer.trust["error_estimate"]["displacement"] is None) == (factor != 1)
    assert np.isfinite(answer.displacement).all()
    assert np.isfinite(answer.von_mises).all()


def test_the_summary_is_json_without_nan(client):
    json.dumps(client.scene("quick"), allow_nan=False)


def test_the_service_adds_little_to_a_solve(server):
    plan = Plan(server.url, "quick", sessions=0, queries=100.0, duration=5.0, echo=True)
    for region, most in (("none", 1.4), ("all", 2.0)):
        assert run(replace(plan, region=region)).summary["added"]["queries"]["ratio"] <= most
