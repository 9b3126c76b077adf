"""Coordinates of another program and back."""

import doctest

import numpy as np
import pytest

from palpate.online.client import frame
from palpate.online.client.frame import Frame
from palpate.online.serve.layout import Mesh
from palpate.shared.errors import PalpateError

LEFT = [[1, 0, 0], [0, 0, 1], [0, 1, 0]]  # y up and z away: left-handed, in metres and newtons


@pytest.fixture
def engine():
    return Frame.of(LEFT, origin=(5.0, 20.0, 10.0), unit=1000.0, newton=1000.0)


def test_the_example_is_right():
    assert doctest.testmod(frame).failed == 0


def test_positions_go_there_and_back(engine, rng):
    own = rng.standard_normal((5, 3))
    np.testing.assert_allclose(engine.from_body(engine.to_body(own)), own, atol=1e-12)
    np.testing.assert_array_equal(engine.to_body([0.0, 0.001, 0.0]), [5.0, 20.0, 11.0])


def test_what_goes_with_positions_agrees_with_them(engine, rng):
    x, u, K = rng.standard_normal(3), rng.standard_normal(3), rng.standard_normal((3, 3))
    moved = engine.from_body(x + u) - engine.from_body(x)
    np.testing.assert_allclose(engine.displacements(u), moved, atol=1e-12)
    np.testing.assert_allclose(engine.directions(u) / 1000.0, moved, atol=1e-12)
    np.testing.assert_allclose(engine.tangent(K) @ moved, engine.forces(K @ u), atol=1e-12)
    work = engine.forces(K @ u) @ moved  # in J; of the body in mN mm
    assert work * 1e6 == pytest.approx(u @ K @ u)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"rotation": [[1, 0, 0], [0, 1, 0]]}, "rotation"),
        ({"rotation": 2.0 * np.eye(3)}, "rotation"),
        ({"rotation": np.full((3, 3), np.nan)}, "rotation"),
        ({"origin": (0.0, np.inf, 0.0)}, "origin"),
        ({"unit": 0.0}, "unit"),
        ({"newton": -1.0}, "newton"),
    ],
)
def test_wrong_frames_are_refused(wrong, named):
    with pytest.raises(PalpateError, match=named):
        Frame.of(**wrong)


def test_a_deformed_mesh_has_normals():
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(subdivisions=3)
    nodes = np.vstack([np.array(ball.vertices), [0.0, 0.0, 0.0]])  # one of them inside
    mesh = Mesh(nodes, np.array(ball.faces), np.arange(len(nodes)), np.zeros(len(nodes)))
    np.testing.assert_allclose(mesh.normals()[:-1], nodes[:-1], atol=0.02)
    wide = mesh.normals(nodes * [2.0, 2.0, 0.0])  # three times as wide as high
    outward = nodes / [3.0, 3.0, 1.0]
    outward[:-1] /= np.linalg.norm(outward[:-1], axis=1, keepdims=True)
    np.testing.assert_allclose(wide, outward, atol=0.05)
