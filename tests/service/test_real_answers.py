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


def test_no_pressure_moves_nothing(client, contact):
    answer = client.solve("quick", **{**contact, "pressure": 0.0}, region="all")
    np.testing.assert_allclose(answer.displacement, 0.0, atol=1e-6)
    np.testing.assert_allclose(answer.von_mises, 0.0, atol=1e-6)
    np.testing.assert_allclose(answer.force, 0.0, atol=1e-9)


def test_a_position_within_reach_is_projected(client, model, contact):
    x, y, z = contact["position"]
    reach = model.scene.endoscope.reach
    answer = client.solve("quick", (x, y, z + 0.5 * reach), contact["pressure"])
    assert answer.contact["distance"] == pytest.approx(0.5 * reach, rel=1e-6)
    np.testing.assert_allclose(answer.contact["position"], contact["position"], atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"position": (1e4, -1e4, 1e4)}, "position"),
        ({"pressure": 1e3}, "pressure"),
        ({"direction": (1.0, 0.0, 0.0)}, "direction"),
    ],
)
def test_unanswerable_queries_are_refused(client, contact, changes, field):
    with pytest.raises(ServiceError) as refused:
        client.solve("quick", **{**contact, **changes})
    assert (refused.value.status, refused.value.field) == (422, f"contacts.0.{field}")


def solve_or_refusal(client, **contact):
    try:
        return client.solve("quick", **contact, region="all")
    except ServiceError as error:
        return error


@pytest.mark.parametrize("factor", [1.0, 2.0, 5.0, 10.0])
def test_beyond_the_trained_range_an_answer_is_flagged_or_refused(client, contact, factor):
    limit = client.solve("quick", **contact).contact["pressure_limit"]
    answer = solve_or_refusal(client, **{**contact, "pressure": factor * limit})
    if isinstance(answer, ServiceError):
        assert factor > 1.0
        assert answer.code == "no_equilibrium"
    else:
        assert answer.trust["in_range"] == (factor == 1.0)
        assert ("pressure" in answer.trust["out_of_range"]) == (factor > 1.0)
        assert np.isfinite(answer.displacement).all()
        assert np.isfinite(answer.von_mises).all()


@pytest.mark.parametrize("radius", [0.01, 0.5, 1.5, 1000.0])
def test_odd_radii_are_flagged_or_refused(client, contact, radius):
    answer = solve_or_refusal(client, **contact, radius=radius)
    if isinstance(answer, ServiceError):
        assert answer.status == 422
    else:
        assert "radius" in answer.trust["out_of_range"]
        assert answer.trust["error_estimate"] == {"displacement": None, "von_mises": None}
        assert np.isfinite(answer.displacement).all()


def test_the_summary_is_json_without_nan(client):
    json.dumps(client.scene("quick"), allow_nan=False)


def test_the_service_adds_little_to_a_solve(server):
    plan = Plan(server.url, "quick", sessions=0, queries=100.0, duration=5.0, echo=True)
    for region, most in (("none", 1.4), ("all", 2.0)):
        assert run(replace(plan, region=region)).summary["added"]["queries"]["ratio"] <= most
