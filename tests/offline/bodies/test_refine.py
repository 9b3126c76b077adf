"""Refinement of a base mesh: nested to the bit, conforming, of the same body, of even quality."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from palpate.offline.bodies.base import Base
from palpate.offline.bodies.mesh_file import HEXAHEDRON, _split
from palpate.offline.bodies.refine import growing, placed, refined, spread_over
from palpate.offline.bodies.tetrahedra import (
    boundary,
    curved,
    dihedral_angles,
    manifold,
    quality,
    raised,
    shape,
    volumes,
)

from .conftest import bricks


@pytest.fixture(scope="module")
def base():
    """A box of bricks cut into tetrahedra whose middles of edges are moved about."""
    points, cells = bricks()
    corners, _ = _split(cells, HEXAHEDRON[0])
    rng = np.random.default_rng(0)
    points = points + rng.uniform(-0.6, 0.6, points.shape)
    assert volumes(points[corners]).min() > 0
    nodes, elements = raised(points, corners)
    middles = np.unique(elements[:, 4:])
    nodes[middles] += rng.uniform(-0.15, 0.15, (len(middles), 3))
    return Base(nodes, elements)


def nodes_of(mesh):
    return {node.tobytes() for node in mesh.nodes}


def everywhere(edge):
    return lambda points: np.full(len(points), edge)


def test_a_mesh_that_is_asked_nothing_is_the_base_mesh(base):
    mesh = refined(base, everywhere(np.inf))
    np.testing.assert_array_equal(mesh.nodes[mesh.elements], base.nodes[base.elements])
    np.testing.assert_array_equal(mesh.face_of, np.arange(len(mesh.faces)))


def test_every_node_of_a_mesh_is_a_node_of_a_finer_one(base):
    at = np.array([[12.0, 4.0, 4.0]])
    coarse = refined(base, everywhere(np.inf))
    middle, fine = refined(base, growing(at, 1.0, 1.0, 9.0)), refined(base, everywhere(1.0))
    assert len(coarse.nodes) < len(middle.nodes) < len(fine.nodes)
    assert nodes_of(coarse) < nodes_of(middle) < nodes_of(fine)


@pytest.mark.parametrize("edge", [4.0, 2.0])
def test_finer_meshes_fit_together_and_are_of_the_same_body(base, edge):
    own, mesh = quality(base.nodes, base.elements), refined(base, everywhere(edge))
    ends = mesh.nodes[mesh.elements[:, [0, 1, 2, 0, 1, 2]]] - mesh.nodes[
        mesh.elements[:, [1, 2, 0, 3, 3, 3]]]  # fmt: skip
    assert np.linalg.norm(ends, axis=2).max() <= edge
    assert manifold(mesh.faces)
    found = quality(mesh.nodes, mesh.elements)
    assert found["inverted"] == 0
    assert found["volume_mm3"] == pytest.approx(own["volume_mm3"], rel=1e-12)
    assert found["dihedral_1_percent"] > 0.5 * own["dihedral_1_percent"]


def test_refinement_goes_where_it_is_asked_and_grows_from_there(base):
    at = np.array([[0.0, 0.0, 0.0]])
    mesh = refined(base, growing(at, 0.4, 1.0, 9.0))
    centres = mesh.nodes[mesh.elements[:, :4]].mean(axis=1)
    size = np.cbrt(volumes(mesh.nodes[mesh.elements[:, :4]]))
    away = np.linalg.norm(centres - at, axis=1)
    assert size[away < 1].max() < 0.5
    assert size[away > 8].min() > 0.8
    assert np.percentile(dihedral_angles(mesh.nodes[mesh.elements[:, :4]]), 1) > 10


def test_faces_and_elements_know_those_of_the_base_mesh_that_they_are_part_of(base):
    mesh = refined(base, everywhere(2.0))
    faces, _, _ = boundary(base.elements)
    for number in (0, len(faces) // 2, len(faces) - 1):
        parts = mesh.faces[mesh.face_of == number]
        assert area(base.nodes, faces[[number]]) == pytest.approx(area(mesh.nodes, parts), rel=2e-3)
        outer = np.linalg.norm(np.ptp(base.nodes[faces[number]], axis=0))
        gap = mesh.nodes[parts].reshape(-1, 3) - base.nodes[faces[number]].mean(axis=0)
        assert np.linalg.norm(gap, axis=1).max() < outer
    whole = np.zeros(len(base.elements))
    np.add.at(whole, mesh.element_of, volumes(mesh.nodes[mesh.elements[:, :4]]))
    np.testing.assert_allclose(whole, volumes(base.nodes[base.elements[:, :4]]), rtol=0.3)


def area(nodes, faces):
    points, triangles = curved(faces, nodes, squares=8)
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


def test_fields_of_the_base_mesh_are_found_at_the_nodes_of_a_finer_one(base):
    mesh = refined(base, everywhere(2.0))
    within, at = mesh.sites[:, 0].astype(int), mesh.sites[:, 1:]
    np.testing.assert_array_equal(placed(base, within, at), mesh.nodes)
    field = np.random.default_rng(1).standard_normal(len(base.nodes))
    fine = np.einsum("ka,ka->k", shape(at), field[base.elements[within]])
    # at centres of fine elements the fine mesh says what the base mesh does
    N = shape(np.full((1, 4), 0.25))[0]
    inside = np.flatnonzero((within[mesh.elements] == mesh.element_of[:, None]).all(axis=1))
    where = at[mesh.elements[inside, :4]].mean(axis=1)
    own = np.einsum("ka,ka->k", shape(where), field[base.elements[mesh.element_of[inside]]])
    np.testing.assert_allclose(fine[mesh.elements[inside]] @ N, own, atol=1e-12)


def test_points_are_spread_over_chosen_faces(base):
    faces, _, _ = boundary(base.elements)
    chosen = base.nodes[faces[:, :3], 2].mean(axis=1) > 7
    points = spread_over(base, chosen, 0.5)
    assert points[:, 2].min() > 3.5  # a face of a side reaches down to the next row
    gap = cKDTree(points).query(points, k=2)[0][:, 1]
    assert 0 < gap.max() < 0.6


def test_a_field_of_one_mesh_is_found_at_the_nodes_of_another_one(base):
    one = refined(base, growing(np.array([[0.0, 0.0, 9.0]]), 0.8, 0.6, 9.0))
    two = refined(base, growing(np.array([[0.0, 9.0, 0.0]]), 1.0, 0.6, 9.0))
    for mesh, other in ((one, two), (two, one), (one, one)):
        np.testing.assert_allclose(mesh.at(other.sites, mesh.nodes), other.nodes, atol=1e-12)
    # a field of the base mesh is one of all that divide it
    field = np.random.default_rng(2).standard_normal(len(base.nodes))
    as_stored = refined(base, everywhere(1e9))
    whole = as_stored.at(one.sites, as_stored.at(as_stored.sites, field))
    np.testing.assert_allclose(two.at(one.sites, as_stored.at(two.sites, field)), whole, atol=1e-12)
