import numpy as np
import pytest

from palpate.online.loadtest.paths import LIFTED, SPEED, tool_path
from palpate.online.serve.schemas import Accessible

from ..fake_model import FakeModel

RADIUS, DEPTH = TIP = 2.0, 0.8


@pytest.fixture(scope="module")
def surface():
    surface = FakeModel().surface
    return Accessible(surface.vertices, surface.normals, None, surface.triangles)


@pytest.fixture
def path(surface, rng):
    return tool_path(surface, *TIP, np.arange(0.0, 20.0, 1e-3), rng)


def test_it_moves_as_a_hand_does(path):
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1) / 1e-3
    assert speed.max() <= SPEED * (1 + 1e-9)
    assert speed.max() > 0.9 * SPEED
    assert speed[-1000:].max() > 0.1 * SPEED  # to the end


def test_it_goes_in_and_out_of_contact(path):
    depth = RADIUS - (path[:, 2] - 5.0)  # the block's top is at z = 5
    assert depth.max() == pytest.approx(DEPTH, abs=0.01)
    assert depth.min() == pytest.approx(-LIFTED, abs=0.01)
    assert np.count_nonzero(np.diff(np.sign(depth))) > 20


def test_it_covers_the_surface(surface, path):
    pressed = path[path[:, 2] < 5.0 + RADIUS, :2]
    distance = [np.linalg.norm(pressed - v, axis=1).min() for v in surface.vertices[:, :2]]
    assert max(distance) < 2.0


def test_neither_the_rate_nor_chance_changes_the_path(surface):
    one, same, two = (
        tool_path(surface, *TIP, np.linspace(0.0, 2.0, count), np.random.default_rng(3))
        for count in (51, 51, 501)
    )
    np.testing.assert_array_equal(one, same)
    np.testing.assert_allclose(one, two[::10], atol=1e-9)
