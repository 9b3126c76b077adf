"""Shape functions and quadrature of hexahedra and their faces."""

import itertools

import numpy as np
import pytest

from palpate.shared.geometry.elements import (
    HEX20_NODES,
    HEX_CORNERS,
    HEX_EDGES,
    QUAD8_NODES,
    QUAD_CORNERS,
    gauss,
    shape,
)

ELEMENTS = {"hex8": HEX_CORNERS, "hex20": HEX20_NODES, "quad4": QUAD_CORNERS, "quad8": QUAD8_NODES}


@pytest.fixture(params=ELEMENTS.values(), ids=ELEMENTS)
def nodes(request):
    return request.param


@pytest.fixture
def points(nodes, rng):
    return rng.uniform(-1, 1, (20, nodes.shape[1]))


def test_each_function_is_one_at_its_node_and_zero_at_the_others(nodes):
    np.testing.assert_allclose(shape(nodes, nodes)[0], np.eye(len(nodes)), atol=1e-15)


def test_constant_and_linear_fields_are_exact(nodes, points):
    N, dN = shape(nodes, points)
    np.testing.assert_allclose(N.sum(axis=1), 1, rtol=1e-13)
    np.testing.assert_allclose(dN.sum(axis=1), 0, atol=1e-13)
    np.testing.assert_allclose(N @ nodes, points, atol=1e-14)
    slopes = np.einsum("ai,qaj->qij", nodes, dN)
    np.testing.assert_allclose(slopes, np.tile(np.eye(nodes.shape[1]), (20, 1, 1)), atol=1e-13)


@pytest.mark.parametrize("nodes", [HEX20_NODES, QUAD8_NODES], ids=["hex20", "quad8"])
def test_quadratic_fields_are_exact_with_midside_nodes(nodes, points):
    N, _ = shape(nodes, points)
    dimension = nodes.shape[1]
    for i, j in itertools.combinations_with_replacement(range(dimension), 2):
        field = nodes[:, i] * nodes[:, j]
        np.testing.assert_allclose(N @ field, points[:, i] * points[:, j], atol=1e-14)


def test_derivatives_are_those_of_the_functions(nodes, points):
    _, dN = shape(nodes, points)
    h = 1e-3
    for i, axis in enumerate(np.eye(nodes.shape[1])):
        difference = shape(nodes, points + h * axis)[0] - shape(nodes, points - h * axis)[0]
        # The functions are at most quadratic in each coordinate: central differences are exact.
        np.testing.assert_allclose(dN[:, :, i], difference / (2 * h), atol=1e-11)


def test_edges_and_midside_nodes_belong_together():
    assert HEX20_NODES.shape == (20, 3)
    for middle, (start, end) in zip(HEX20_NODES[8:], HEX_EDGES, strict=True):
        assert np.abs(HEX_CORNERS[start] - HEX_CORNERS[end]).sum() == 2
        np.testing.assert_array_equal(middle, (HEX_CORNERS[start] + HEX_CORNERS[end]) / 2)


@pytest.mark.parametrize("points", [1, 2, 3, 8])
@pytest.mark.parametrize("dimension", [2, 3])
def test_quadrature_is_exact_to_its_degree(points, dimension):
    at, weights = gauss(points, dimension)
    assert at.shape == (points**dimension, dimension)
    assert (weights > 0).all()
    degree = 2 * points - 1
    for powers in itertools.product({0, 1, degree - 1, degree}, repeat=dimension):
        exact = np.prod([0.0 if k % 2 else 2 / (k + 1) for k in powers])
        assert weights @ np.prod(at ** np.array(powers), axis=1) == pytest.approx(exact, abs=1e-13)
