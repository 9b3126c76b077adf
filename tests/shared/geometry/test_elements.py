"""Shape functions, quadrature and parts of every kind of element and face."""

import itertools
from math import factorial, prod

import numpy as np
import pytest

from palpate.shared.geometry.elements import (
    ELEMENTS,
    FACES,
    HEX20,
    TET10,
    Box,
    collapsed_gauss,
    gauss,
)
from palpate.shared.mechanics.tissue import BULK, COMPRESSIBLE, WHOLE

KINDS = {
    **{f"element of {n}": kind for n, kind in ELEMENTS.items()},
    **{f"face of {n}": kind for n, kind in FACES.items()},
    "straight tetrahedron": TET10.straight,
}
QUADRATIC = {name: kind for name, kind in KINDS.items() if kind.quadratic}


@pytest.fixture(params=KINDS.values(), ids=KINDS)
def kind(request):
    return request.param


@pytest.fixture(params=FACES.values(), ids=FACES)
def face(request):
    return request.param


def inside(kind, rng, count=20):
    """Random points of the reference element."""
    d = kind.nodes.shape[1]
    if isinstance(kind, Box):
        return rng.uniform(-1, 1, (count, d))
    return rng.dirichlet(np.ones(d + 1), count)[:, 1:]


def exact(kind, powers):
    """Integral of a product of powers of the coordinates."""
    if isinstance(kind, Box):
        return prod(0.0 if k % 2 else 2 / (k + 1) for k in powers)
    return prod(map(factorial, powers)) / factorial(sum(powers) + len(powers))


def test_each_function_is_one_at_its_node_and_zero_at_the_others(kind):
    np.testing.assert_allclose(kind.shape(kind.nodes)[0], np.eye(len(kind.nodes)), atol=1e-15)


def test_constant_and_linear_fields_are_exact(kind, rng):
    nodes, points = kind.nodes, inside(kind, rng)
    N, dN = kind.shape(points)
    np.testing.assert_allclose(N.sum(axis=1), 1, rtol=1e-13)
    np.testing.assert_allclose(dN.sum(axis=1), 0, atol=1e-13)
    np.testing.assert_allclose(N @ nodes, points, atol=1e-14)
    slopes = np.einsum("ai,qaj->qij", nodes, dN)
    np.testing.assert_allclose(slopes, np.tile(np.eye(nodes.shape[1]), (20, 1, 1)), atol=1e-13)


@pytest.mark.parametrize("kind", QUADRATIC.values(), ids=QUADRATIC)
def test_quadratic_fields_are_exact_with_midside_nodes(kind, rng):
    nodes, points = kind.nodes, inside(kind, rng)
    N, _ = kind.shape(points)
    for i, j in itertools.combinations_with_replacement(range(nodes.shape[1]), 2):
        field = nodes[:, i] * nodes[:, j]
        np.testing.assert_allclose(N @ field, points[:, i] * points[:, j], atol=1e-14)


def test_derivatives_are_those_of_the_functions(kind, rng):
    points = inside(kind, rng)
    _, dN = kind.shape(points)
    h = 1e-3
    for i, axis in enumerate(np.eye(kind.nodes.shape[1])):
        difference = kind.shape(points + h * axis)[0] - kind.shape(points - h * axis)[0]
        # The functions are at most quadratic in each coordinate: central differences are exact.
        np.testing.assert_allclose(dN[:, :, i], difference / (2 * h), atol=1e-11)


def test_edges_and_midside_nodes_belong_together(kind):
    for middle, (a, b) in zip(kind.nodes[kind.corners :], kind.edges, strict=False):
        np.testing.assert_array_equal(middle, kind.nodes[[a, b]].mean(axis=0))
    assert len(kind.nodes) in (kind.corners, kind.corners + len(kind.edges))
    counts = np.bincount(np.ravel(kind.edges))
    np.testing.assert_array_equal(counts, kind.nodes.shape[1])


@pytest.mark.parametrize("kind", [HEX20, TET10], ids=["hex20", "tet10"])
def test_faces_close_an_element_and_look_outward(kind):
    """What flows out through all faces of a linear flow is what the volume gives off."""
    flow = np.array([[1.0, 0.2, 0.0], [0.0, 2.0, 0.3], [0.1, 0.0, 4.0]])
    volume = kind.rule(1)[1].sum()
    for of, face in ((kind, kind.faces), (kind.straight, kind.faces)):
        out = 0.0
        for corners in face:
            nodes = of.nodes[of.on_face(corners)]
            own = FACES[len(nodes)] if len(nodes) in FACES else FACES[6].straight
            at, weights = own.rule(2)
            N, dN = own.shape(at)
            t = np.einsum("ai,qaj->qij", nodes, dN)
            normals = np.cross(t[..., 0], t[..., 1])
            out += np.einsum("q,qi,qi->", weights, normals, N @ nodes @ flow.T)
        assert out == pytest.approx(7.0 * volume, rel=1e-13)


@pytest.mark.parametrize("points", [1, 2, 3, 8])
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("rule", [gauss, collapsed_gauss])
def test_quadrature_is_exact_to_its_degree(rule, points, dimension):
    at, weights = rule(points, dimension)
    assert at.shape == (points**dimension, dimension)
    assert (weights > 0).all()
    degree = 2 * points - 1
    kind = FACES[4 if rule is gauss else 6]
    for powers in itertools.product({0, 1, degree - 1, degree}, repeat=dimension):
        if rule is collapsed_gauss and sum(powers) > degree:
            continue
        found = weights @ np.prod(at ** np.array(powers), axis=1)
        assert found == pytest.approx(exact(kind, powers), abs=1e-13)


def test_the_rule_of_an_element_is_exact_for_quadratic_functions(kind):
    at, weights = kind.rule(2)
    assert (weights > 0).all()
    for powers in itertools.product(range(3), repeat=kind.nodes.shape[1]):
        if sum(powers) <= 2:
            found = weights @ np.prod(at ** np.array(powers), axis=1)
            assert found == pytest.approx(exact(kind, powers), abs=1e-14)


@pytest.mark.parametrize("kind", ELEMENTS.values(), ids=ELEMENTS)
def test_every_part_of_a_law_is_integrated_over_the_whole_volume(kind):
    at, weights, parts = kind.integration
    volume = kind.rule(1)[1].sum()
    np.testing.assert_array_equal(at[: kind.points], kind.rule(2)[0])
    for both in ((WHOLE, COMPRESSIBLE), (WHOLE, BULK)):
        assert weights[np.isin(parts, both)].sum() == pytest.approx(volume, rel=1e-14)


def test_cells_fill_a_face_and_look_its_way(face):
    counts = (3, 5)[: face.axes]
    at, cells = face.cells(*counts)
    assert len(cells) == np.prod(counts) ** (3 - face.axes)
    own, weights = face.straight.rule(1)
    corners = at[cells]
    _, dN = face.straight.shape(own)
    sizes = np.linalg.det(np.einsum("cai,qaj->cqij", corners, dN))[:, 0]
    np.testing.assert_allclose(sizes, sizes.mean(), rtol=1e-12)
    assert sizes.sum() * weights.sum() == pytest.approx(weights.sum(), rel=1e-12)
    assert len(np.unique(at.round(9), axis=0)) == len(at) == cells.max() + 1


def test_spread_points_weigh_a_face_and_lie_even(face):
    at, weights = face.spread(*(4, 6)[: face.axes])
    assert weights.sum() == pytest.approx(face.rule(1)[1].sum(), rel=1e-13)
    for powers in ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2)):
        found = weights @ np.prod(at ** np.array(powers), axis=1)
        assert found == pytest.approx(exact(face, powers), abs=1e-13)


def test_drawn_triangles_fill_a_face_and_look_its_way(face):
    corners = face.nodes[np.array(face.triangles)]
    turned = np.linalg.det(corners[:, 1:] - corners[:, :1])
    assert (turned > 0).all()
    assert turned.sum() / 2 == pytest.approx(face.rule(1)[1].sum())
