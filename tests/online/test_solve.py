import re

import msgpack
import numpy as np
import pytest
from starlette.testclient import TestClient

from palpate.online.serve import layout
from palpate.online.serve.wire import BINARY, MSGPACK

from .conftest import error_of
from .fake_model import FakeModel

QUERY = {
    "contacts": [{"position": [4.0, 5.0, 6.0], "pressure": 4.0, "direction": [0.0, 1.0, -2.0]}]
}


def solve(client, accept="application/json", **changes):
    response = client.post(
        "/scenes/toy/solve", json={**QUERY, **changes}, headers={"accept": accept}
    )
    assert response.status_code == 200, response.text
    assert response.headers["content-type"] == accept
    return response


def test_the_answer_tells_contact_force_and_trust_and_where_the_time_went(client):
    response = solve(client)
    phases = [f"{phase};dur=[\\d.]+" for phase in ("decode", "solve", "recover", "encode")]
    assert re.fullmatch(", ".join(phases), response.headers["server-timing"])
    answer = response.json()
    direction = np.array([0.0, 1.0, -2.0]) / np.sqrt(5.0)
    timing = answer.pop("timing")
    assert set(timing) == {"solve_us", "recover_us"}
    assert min(timing.values()) >= 0
    assert answer == {
        "scene": "toy",
        "contact": {
            "position": [4.0, 5.0, 5.0],
            "normal": [0.0, 0.0, 1.0],
            "distance": 1.0,
            "direction": pytest.approx(direction),
            "pressure": 4.0,
            "radius": 2.0,
            "pressure_limit": 8.0,
            "depth_limit": None,
        },
        "force": pytest.approx(-16.0 * direction),  # on the tool
        "contact_displacement": pytest.approx(0.4 * direction),
        "trust": {
            "converged": True,
            "iterations": 1,
            "in_range": True,
            "out_of_range": [],
            "error_estimate": {"displacement": 0.001, "von_mises": 0.002},
            "min_jacobian": 0.96,
        },
        "fields": {},
    }


@pytest.mark.parametrize("region", ["surface", "all"])
def test_all_formats_hold_the_same_fields_in_the_order_of_the_mesh(client, region):
    from_json = solve(client, region=region).json()["fields"]
    _, from_binary = layout.decode(solve(client, BINARY, region=region).content)
    packed = msgpack.unpackb(solve(client, MSGPACK, region=region).content)["fields"]
    assert {entry["dtype"] for entry in packed.values()} == {"float32"}
    from_msgpack = {
        name: np.frombuffer(entry["data"], "<f4").reshape(entry["shape"])
        for name, entry in packed.items()
    }
    mesh = client.get(f"/scenes/toy/mesh?region={region}").json()["fields"]
    model = FakeModel()
    expected = model.displacement(model.press(**QUERY["contacts"][0]), region)
    assert len(mesh["nodes"]) == len(expected)
    for fields in (from_json, from_binary, from_msgpack):
        assert list(fields) == ["displacement", "von_mises"]
        for name, values in fields.items():
            np.testing.assert_array_equal(np.array(values, np.float32), from_binary[name])
    np.testing.assert_array_equal(from_binary["displacement"], expected)
    named = solve(client, outputs=["von_mises"]).json()["fields"]  # and no region
    assert named == solve(client, outputs=["von_mises"], region="surface").json()["fields"]
    for outputs in ([], ["displacement"], ["von_mises"]):
        assert list(solve(client, outputs=outputs, region=region).json()["fields"]) == outputs


def test_the_largest_values_are_told_to_who_asks_for_them(client):
    """Whatever the region; of the fields that are named with them those of the surface."""
    model = FakeModel()
    found = model.press(**QUERY["contacts"][0])
    moved = model.displacement(found)
    largest, percentile = model.peaks(found, moved)
    expected = {"displacement": np.linalg.norm(moved, axis=1).max(), "von_mises": largest}
    expected["von_mises_p99"] = percentile
    answer = solve(client, outputs=["peak"]).json()
    assert answer["peak"] == pytest.approx(expected)
    assert answer["fields"] == {}
    answer = solve(client, outputs=["peak", "von_mises"]).json()
    assert answer["peak"] == pytest.approx(expected)
    assert len(answer["fields"]["von_mises"]) == len(model.surface_nodes)
    head, _ = layout.decode(solve(client, BINARY, outputs=["peak"]).content)
    assert head["peak"] == pytest.approx(expected)


def test_a_load_beyond_training_is_answered_with_a_flag(client):
    answer = solve(client, contacts=[{"position": [5, 5, 5], "pressure": 12}]).json()
    assert answer["trust"]["in_range"] is False
    assert answer["trust"]["out_of_range"] == ["pressure"]
    assert answer["trust"]["error_estimate"] == {"displacement": None, "von_mises": None}


def test_a_load_without_equilibrium_is_refused(serve):
    with serve(FakeModel(collapse=5.0)) as client:
        load = {"contacts": [{"position": [5, 5, 5], "pressure": 6}]}
        response = client.post("/scenes/toy/solve", json=load)
    assert error_of(response, 422) == {
        "code": "no_equilibrium",
        "field": "contacts.0.pressure",
        "message": "There is no equilibrium under this load; the model was trained for up to "
        "8 kPa there",
        "allowed": {"le": 8.0},
    }


@pytest.mark.parametrize("accept", ["application/json", BINARY, MSGPACK])
@pytest.mark.parametrize("region", ["none", "surface", "all"])
def test_nan_never_leaves(serve, accept, region):
    model = FakeModel()
    with serve(model) as client:
        model.poison = True
        response = client.post(
            "/scenes/toy/solve", json={**QUERY, "region": region}, headers={"accept": accept}
        )
    assert error_of(response, 422)["code"] == "no_equilibrium"


def test_fields_too_large_for_json_are_refused_in_json_only(serve):
    with serve(max_json_numbers=1000) as client:
        solve(client, region="surface")
        solve(client, BINARY, region="all")
        response = client.post("/scenes/toy/solve", json={**QUERY, "region": "all"})
    error = error_of(response, 422)
    assert (error["field"], error["allowed"]) == ("region", {"max_numbers": 1000})


def test_a_bug_is_answered_without_details_and_raised_on(serve):
    model = FakeModel()
    with serve(model) as client:
        model.press = None
        response = client.post("/scenes/toy/solve", json=QUERY)
        with pytest.raises(TypeError):
            TestClient(client.app).post("/scenes/toy/solve", json=QUERY)
    assert error_of(response, 500)["code"] == "internal"
    assert "NoneType" not in response.text
