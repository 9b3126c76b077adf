"""Edges of a boundary and how sharp they are."""

import numpy as np
import pytest

from palpate.shared.geometry.edges import AT_THE_RIM, BLUNTER, shared_edges, sharp_points


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


def sharp(at, faces, clamped=None, accessible=None):
    """Of edges without clamped nodes between accessible faces, unless told."""
    clamped = np.zeros(len(at), bool) if clamped is None else clamped
    accessible = np.ones(len(faces), bool) if accessible is None else accessible
    return sharp_points(at, faces, clamped, accessible)


@pytest.mark.parametrize("nodes", [4, 8, 6])
@pytest.mark.parametrize("degrees", [0.0, 10.0, 40.0, 90.0])
def test_an_edge_turns_by_the_angle_of_its_faces(degrees, nodes):
    at, faces = roof(degrees, nodes)
    edges = shared_edges(at, faces)
    inner = {(1, 2): np.radians(degrees), **({(0, 2): 0.0, (2, 4): 0.0} if nodes == 6 else {})}
    found = [tuple(sorted(ends[:2])) for ends in edges.nodes]
    assert sorted(found) == sorted(inner)
    np.testing.assert_allclose(edges.turn, [inner[ends] for ends in found], atol=1e-6)
    for both, ends in zip(edges.faces, edges.nodes, strict=True):
        assert (np.isin(faces[both], ends).sum(axis=1) == len(ends)).all()
    left = at[faces, 0].mean(axis=1) < 0.0
    for accessible, part in ((np.ones(len(faces), bool), 1.0), (left, AT_THE_RIM)):
        points, sharpness = sharp(at, faces, accessible=accessible)
        assert len(points) == (0 if degrees < 15.0 else 9)
        if len(points):
            np.testing.assert_allclose(points[:, [0, 2]], 0.0, atol=1e-12)
            np.testing.assert_allclose(np.sort(points[:, 1]), np.linspace(-1.0, 1.0, 9), atol=1e-12)
            blunt = BLUNTER * part * np.radians(degrees)
            np.testing.assert_allclose(sharpness, min(max((degrees / 90.0) ** 2, blunt), 1.0))


def test_a_clamped_edge_is_none():
    at, faces = roof(90.0, 8)
    assert len(sharp(at, faces, clamped=at[:, 1] < 0.0)[0]) == 0


@pytest.mark.parametrize("nodes", [4, 8, 6])
def test_a_valley_turns_the_other_way_and_is_no_edge(nodes):
    at, faces = roof(-40.0, nodes)
    assert shared_edges(at, faces).turn.min() == pytest.approx(np.radians(-40.0), abs=1e-6)
    assert len(sharp(at, faces)[0]) == 0


def test_the_sharper_end_of_an_edge_tells_whether_it_is_a_valley():
    """A ridge of 20 degrees at one end and a valley of 40 at the other."""
    at = np.array([[-1, 0, 0], [0, 0, 0], [0, 1, 0], [-1, 1, 0], [1, 0, 0], [1, 1, 0]], float)
    at[4:, 2] = np.tan(np.radians([-20.0, 40.0]))
    faces = np.array([[0, 1, 2, 3], [1, 4, 5, 2]], np.int32)
    assert shared_edges(at, faces).turn == pytest.approx([-np.radians(40.0)], abs=0.05)
