import numpy as np
import pytest

from palpate.online.serve import layout
from palpate.online.serve.wire import BINARY

from .fake_model import FakeModel


def test_served_and_refused_are_listed(client):
    listed = client.get("/scenes").json()
    assert [scene["name"] for scene in listed["scenes"]] == ["toy"]
    assert listed["refused"] == [{"file": "broken.h5", "reason": "broken.h5: truncated"}]


def test_a_scene_tells_what_may_be_asked_with_an_example(client):
    scene = client.get("/scenes/toy").json()
    assert client.post("/scenes/toy/solve", json=scene["example"]).status_code == 200
    assert scene["ranges"] == {
        "pressure": [0.0, 8.0],
        "depth": [0.0, 1.0],
        "tilt": [0.0, 30.0],
        "radius": 2.0,
        "reach": 3.0,
    }
    assert scene["size"] == {"nodes": 1331, "dofs": 3993, "surface_nodes": 121, "triangles": 200}
    assert scene["young"] == FakeModel().scene.tissue.young
    assert scene["tolerance"] == {
        "displacement": 0.03,
        "von_mises": 0.12,
        "force": 0.05,
        "tip_displacement": 0.06,
        "tip_von_mises": 0.36,
    }
    assert scene["info"] == {"modes": 1, "validation": {"queries": 0}}
    assert scene["serves"] == {"sessions": True, "histories": False}


def test_the_accessible_surface_has_its_limits(serve):
    with serve(FakeModel(), FakeModel("other", has_tip=False)) as client:
        response = client.get("/scenes/toy/accessible", headers={"accept": BINARY})
        _, arrays = layout.decode(response.content)
        other = client.get("/scenes/other/accessible").json()["fields"]
        assert client.get("/scenes/other").json()["ranges"]["depth"] is None
    limits = [set(arrays[name].ravel()) for name in ("pressure_limit", "depth_limit")]
    assert limits == [{8.0}, {1.0}]
    assert arrays["vertices"].shape == arrays["normals"].shape == (121, 3)
    assert len(other["pressure_limit"]) == 121
    assert "depth_limit" not in other


@pytest.mark.parametrize("region", ["surface", "all"])
def test_the_mesh_of_a_region(client, region):
    path = f"/scenes/toy/mesh?region={region}"
    _, arrays = layout.decode(client.get(path, headers={"accept": BINARY}).content)
    model = FakeModel()
    ids = model.surface_nodes if region == "surface" else np.arange(len(model.nodes))
    np.testing.assert_allclose(arrays["nodes"], model.nodes[ids], atol=1e-6)
    np.testing.assert_array_equal(arrays["clamped"], model.clamped[ids])
    np.testing.assert_array_equal(
        ids[arrays["triangles"]], model.surface_nodes[model.surface_triangles]
    )
    np.testing.assert_array_equal(arrays["surface_nodes"], model.surface_nodes)
    document = client.get(path).json()
    assert document["region"] == region
    for name, array in arrays.items():
        np.testing.assert_allclose(document["fields"][name], array, rtol=1e-6)
