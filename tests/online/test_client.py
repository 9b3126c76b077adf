import numpy as np
import pytest

from online.client import Client, ServiceError
from shared.errors import PalpateError

from .fake_atlas import FakeAtlas


def test_it_asks_and_understands(url):
    atlas = FakeAtlas()
    with Client(url) as client:
        assert [scene["name"] for scene in client.scenes()["scenes"]] == ["toy"]
        assert client.scene("toy")["ranges"]["reach"] == 3.0
        mesh = client.mesh("toy", region="all")
        answer = client.solve("toy", (5, 5, 5), 4.0, direction=(0, 0, -1), radius=1.5, region="all")
    solution = atlas.solve((5, 5, 5), 4.0, (0, 0, -1), 1.5)
    np.testing.assert_allclose(mesh.nodes, atlas.nodes, atol=1e-6)
    np.testing.assert_allclose(answer.force, solution.force)
    np.testing.assert_array_equal(answer.displacement, atlas.displacement(solution, "all"))
    np.testing.assert_array_equal(answer.von_mises, atlas.von_mises(solution, "all"))
    assert answer.trust["out_of_range"] == ["radius"]


def test_fields_not_asked_for_are_none(url):
    with Client(url) as client:
        answer = client.solve("toy", (5, 5, 5), 4.0)
    assert answer.displacement is None
    assert answer.von_mises is None


def test_refusals_are_raised(url):
    with Client(url) as client:
        with pytest.raises(ServiceError, match="greater than or equal") as refused:
            client.solve("toy", (5, 5, 5), -4.0)
        assert (refused.value.status, refused.value.field) == (422, "contacts.0.pressure")
        with pytest.raises(ServiceError) as refused:
            client.scene("a/b c")
        assert refused.value.status == 404


@pytest.mark.parametrize("url", ["toy", "https://127.0.0.1:1", "http://"])
def test_other_addresses_are_refused(url):
    with pytest.raises(PalpateError, match="not an address"):
        Client(url)
