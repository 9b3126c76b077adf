"""Edges of a boundary and how sharp they are."""

import numpy as np
import pytest

from palpate.shared.geometry.edges import shared_edges, sharp_points


def roof(degrees, nodes):
    """Two squares, 2 mm wide, that meet along y at an angle of their normals.

    They are faces of so many nodes; each two, of six.
    """
    turn = np.radians(degrees)
    flat = [[-2, -1], [0, -1], [0, 1], [-2, 1], [2, -1], [2, 1]]
    faces = [[0, 1, 2, 3], [1, 4, 5, 2]]
    if nodes == 8:
        flat += [[-1, -1], [0, 0], [-1, 1], [-2, 0], [1, -1], [2, 0], [1, 1]]
        faces = [[*faces[0], 6, 7, 8, 9], [*faces[1], 10, 11, 12, 7]]
    if nodes == 6:
        flat += [[-1, -1], [0, 0], [-1, 0], [-1, 1], [-2, 0], [1, -1], [1, 0], [2, 0], [1, 1]]
        faces = [[0, 1, 2, 6, 7, 8], [0, 2, 3, 8, 9, 10]]
        faces += [[1, 4, 2, 11, 12, 7], [4, 5, 2, 13, 14, 12]]
    x, y = np.array(flat, float).T
    down = np.where(x > 0.0, x, 0.0)
    at = np.column_stack([np.where(x > 0.0, x * np.cos(turn), x), y, -down * np.sin(turn)])
    return at, np.array(faces, np.int32)


def sharp(at, faces, clamped=None):
    """Of edges without clamped nodes, unless told."""
    return sharp_points(at, faces, np.zeros(len(at), bool) if clamped is None else clamped)


@pytest.mark.parametrize("nodes", [4, 8, 6])
@pytest.mark.parametrize("degrees", [0.0, 40.0, 60.0, 90.0])
def test_an_edge_turns_by_the_angle_of_its_faces(degrees, nodes):
    at, faces = roof(degrees, nodes)
    edges = shared_edges(at, faces)
    inner = {(1, 2): np.radians(degrees), **({(0, 2): 0.0, (2, 4): 0.0} if nodes == 6 else {})}
    found = [tuple(sorted(ends[:2])) for ends in edges.nodes]
    assert sorted(found) == sorted(inner)
    np.testing.assert_allclose(edges.turn, [inner[ends] for ends in found], atol=1e-6)
    for both, ends in zip(edges.faces, edges.nodes, strict=True):
        assert (np.isin(faces[both], ends).sum(axis=1) == len(ends)).all()
    points, sharpness = sharp(at, faces)
    assert len(points) == (0 if degrees < 45.0 else 9)
    if len(points):
        np.testing.assert_allclose(points[:, [0, 2]], 0.0, atol=1e-12)
        np.testing.assert_allclose(np.sort(points[:, 1]), np.linspace(-1.0, 1.0, 9), atol=1e-12)
        np.testing.assert_allclose(sharpness, (degrees / 90.0) ** 2)


def test_a_clamped_edge_is_none():
    at, faces = roof(90.0, 8)
    assert len(sharp(at, faces, clamped=at[:, 1] < 0.0)[0]) == 0


@pytest.mark.parametrize("nodes", [4, 8, 6])
def test_a_valley_turns_the_other_way_and_is_no_edge(nodes):
    at, faces = roof(-60.0, nodes)
    assert shared_edges(at, faces).turn.min() == pytest.approx(np.radians(-60.0), abs=1e-6)
    assert len(sharp(at, faces)[0]) == 0


def test_the_sharper_end_of_an_edge_tells_whether_it_is_a_valley():
    """A ridge of 20 degrees at one end and a valley of 40 at the other."""
    at = np.array([[-1, 0, 0], [0, 0, 0], [0, 1, 0], [-1, 1, 0], [1, 0, 0], [1, 1, 0]], float)
    at[4:, 2] = np.tan(np.radians([-20.0, 40.0]))
    faces = np.array([[0, 1, 2, 3], [1, 4, 5, 2]], np.int32)
    assert shared_edges(at, faces).turn == pytest.approx([-np.radians(40.0)], abs=0.05)
