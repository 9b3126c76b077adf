"""Quadratic tetrahedra: bounds of determinants, volumes, measures of shape."""

import numpy as np
import pytest

from palpate.offline.bodies.tetrahedra import (
    EDGES,
    boundary,
    determinants,
    dihedral_angles,
    half_thickness,
    lattice,
    least_determinants,
    quality,
    raised,
    scaled_jacobians,
    shape,
    volume,
)

REGULAR = np.array([[0.0, 0, 0], [1, 0, 1], [1, 1, 0], [0, 1, 1]])
RIGHT = np.vstack([np.zeros(3), np.eye(3)])


def bent(seed, by):
    nodes, elements = raised(RIGHT, np.array([[0, 1, 2, 3]]))
    nodes[4:] += by * np.random.default_rng(seed).standard_normal((6, 3))
    return nodes, elements


def test_shape_functions_are_one_at_their_node():
    at = np.vstack([np.eye(4), np.eye(4)[EDGES].mean(axis=1)])
    np.testing.assert_allclose(shape(at), np.eye(10), atol=1e-15)


def test_a_regular_tetrahedron_is_perfect_and_a_flat_one_is_nothing():
    assert scaled_jacobians(REGULAR[None]) == pytest.approx(1.0)
    assert dihedral_angles(REGULAR[None]) == pytest.approx(np.degrees(np.arccos(1 / 3)))
    flat = REGULAR * [1, 1, 1e-6]
    assert dihedral_angles(flat[None]).min() < 1e-3
    assert quality(*raised(RIGHT, np.array([[0, 1, 2, 3]])))["dihedral_max"] == pytest.approx(90)


@pytest.mark.parametrize("by", [0.0, 0.05, 0.2])
def test_determinants_are_nowhere_less_than_their_bound(by):
    for seed in range(20):
        nodes, elements = bent(seed, by)
        found = determinants(nodes, elements, order=12)
        bound = least_determinants(nodes, elements)
        assert (bound <= found.min(axis=1) + 1e-12).all()
        assert (bound >= found.min(axis=1) - 20 * by - 1e-12).all()


def test_half_the_thickness_is_a_third_of_the_radius_of_the_ball_inside_a_regular_one():
    found = half_thickness(*raised(REGULAR, np.array([[0, 1, 2, 3]])))
    assert found == pytest.approx(np.sqrt(2) / np.sqrt(24) / 3)


def test_volumes_are_those_of_the_curved_elements():
    nodes, elements = bent(3, 0.1)
    at = lattice(40)
    inside = at.min(axis=1) > 0
    mean = determinants(nodes, elements, order=40)[:, inside].mean()
    assert volume(nodes, elements) == pytest.approx(mean / 6, rel=5e-3)


def test_faces_of_the_boundary_point_outward():
    nodes, elements = raised(RIGHT, np.array([[0, 1, 2, 3]]))
    faces, owner, opposite = boundary(elements)
    assert owner.tolist() == [0] * 4
    for face, corner in zip(faces, opposite, strict=True):
        a, b, c = nodes[face[:3]]
        assert np.cross(b - a, c - a) @ (nodes[corner] - a) < 0
        np.testing.assert_allclose(nodes[face[3:]], [(a + b) / 2, (b + c) / 2, (c + a) / 2])
