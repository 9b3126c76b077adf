"""Values at the points of a lattice of hexahedra, carried to its nodes."""

import numpy as np
import pytest

from palpate.offline.fem.mesh import build_mesh
from palpate.shared.geometry.elements import POINTS, kind_of
from palpate.shared.geometry.recovery import by_region, neighbours, patches
from palpate.shared.scene import parse_scene

from ...offline.fem.bodies import in_tetrahedra

BLOCK = """
name = "block"
geometry.kind = "block"
geometry.size = [2.0, 3.0, 4.0]
geometry.element = "{element}"
geometry.divisions = {divisions}
tissue.law = "neo-hookean"
tissue.young = 15.0
tissue.poisson = 0.45
support.side = "bottom"
surface.side = "top"
endoscope.radius = 2.0
endoscope.max_tilt = 20.0
load.max_indentation = 0.2
"""


def block(element, *divisions, ticks=None):
    """Nodes and elements; six tet10 for a brick."""
    hexahedra = "hex8" if element == "tet10" else element
    scene = parse_scene(BLOCK.format(element=hexahedra, divisions=list(divisions)))
    found = build_mesh(scene, ticks)
    if element == "tet10":
        found = in_tetrahedra(found)
    return found.nodes, found.elements


@pytest.fixture(params=["hex8", "hex20", "tet10", "hex20 in disorder"])
def mesh(request, rng):
    """Three by two by four elements, or bricks, whose sizes grow along every axis."""
    grown = tuple(np.linspace(0, 1, n + 1) ** 1.5 for n in (3, 2, 4))
    nodes, elements = block(request.param.split()[0], 3, 2, 4, ticks=grown)
    if "disorder" in request.param:  # some elements begin at another corner
        turned = np.roll(np.arange(20).reshape(5, 4), 1, axis=1).ravel()
        elements[::3] = elements[::3, turned]
    return nodes, elements


def carried(nodes, elements, values):
    """Values (n,) at the nodes, of those at the points (e, 8)."""
    how, out = patches(nodes, elements), np.zeros(len(nodes))
    out[how.corners] = np.einsum("kaq,kaq->k", how.weights, values[how.elements])
    out[how.midsides] = np.sum(how.shares * out[how.lines], axis=1)
    return out


def at_points(nodes, elements):
    kind = kind_of(elements)
    N, _ = kind.shape(kind.rule(POINTS)[0])
    return np.einsum("qa,eai->eqi", N, nodes[elements])


def test_quadratic_fields_are_carried_exactly_even_to_the_boundary(mesh, rng):
    nodes, elements = mesh
    coefficients = rng.standard_normal((3, 3, 3))
    if patches(nodes, elements).weights.shape[1] != 8:  # no lattice: the sum of powers counts
        coefficients[np.indices((3, 3, 3)).sum(axis=0) > 2] = 0.0

    def field(x):
        powers = np.moveaxis(x, -1, 0)[:, None] ** np.arange(3).reshape(1, 3, *[1] * (x.ndim - 1))
        return np.einsum("ijk,i...,j...,k...->...", coefficients, *powers)

    found = carried(nodes, elements, field(at_points(nodes, elements)))
    np.testing.assert_allclose(found, field(nodes), rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize("element", ["hex20", "tet10"])
def test_errors_of_smooth_fields_fall_with_the_third_power_of_the_size(element):
    errors = []
    for n in (4, 8):
        nodes, elements = block(element, n, n, n)

        def field(x):
            return np.sin(1.1 * x[..., 0] + 0.7 * x[..., 1] - 0.5 * x[..., 2])

        off = carried(nodes, elements, field(at_points(nodes, elements))) - field(nodes)
        errors.append(np.abs(off).max())
    assert errors[0] / errors[1] > 6.5
    assert errors[1] < 2e-2


@pytest.mark.parametrize("element", ["hex20", "tet10"])
def test_linear_fields_are_carried_exactly_across_a_layer_of_one_element(element):
    nodes, elements = block(element, 3, 3, 1)
    across = carried(nodes, elements, at_points(nodes, elements)[..., 2])
    np.testing.assert_allclose(across, nodes[:, 2], atol=1e-10)


def test_what_does_not_meet_is_carried_by_itself():
    """Two blocks that lie upon one another, and one element beside them, share no node."""
    nodes, elements = block("tet10", 2, 2, 2)
    alone = nodes[elements[0]] + [9.0, 0.0, 0.0]
    both = np.vstack([nodes, nodes, alone])
    n = len(nodes)
    parts = [elements, n + elements, 2 * n + np.arange(10, dtype=np.int32)[None]]
    values = np.concatenate([np.full((len(part), 4), k) for k, part in enumerate(parts)])
    found = carried(both, np.concatenate(parts), values)
    np.testing.assert_allclose(found, np.repeat([0.0, 1.0, 2.0], [n, n, 10]), atol=1e-12)


def test_neighbours_lie_beyond_the_sides_of_an_element():
    scene = parse_scene(BLOCK.format(element="hex8", divisions=[3, 2, 4]))
    elements = build_mesh(scene).elements
    found = neighbours(elements)
    assert found[0].tolist() == [[-1, 8], [-1, 4], [-1, 1]]
    assert found[-1].tolist() == [[15, -1], [19, -1], [22, -1]]


@pytest.mark.parametrize("element", ["hex8", "hex20", "tet10"])
def test_regions_carry_fields_of_their_own_exactly(element, rng):
    """A corner, an edge and a plate of a block, and what is left: no lattice in a box."""
    nodes, elements = block(element, 5, 5, 4)
    centres = nodes[elements].mean(axis=1) / np.ptp(nodes, axis=0)
    region = np.zeros(len(elements), np.int32)
    region[(centres > 0.6).all(axis=1)] = 1
    region[(centres[:, :2] < 0.4).all(axis=1)] = 2
    region[centres[:, 2] < 0.25] = 3
    slopes = rng.standard_normal((4, 3))
    how, of = by_region(nodes, elements, region)
    values = np.einsum("eqi,ei->eq", at_points(nodes, elements), slopes[region])
    found = np.full(len(of), np.nan)
    found[how.corners] = np.einsum("kaq,kaq->k", how.weights, values[how.elements])
    found[how.midsides] = np.sum(how.shares * found[how.lines], axis=1)
    lowest = np.full(len(nodes), 4)
    np.minimum.at(lowest, elements, region[:, None])
    used = lowest < 4
    np.testing.assert_array_equal(region[of[: len(nodes)]][used], lowest[used])
    exact = np.einsum("ni,ni->n", nodes, slopes[np.minimum(lowest, 3)])
    np.testing.assert_allclose(found[: len(nodes)][used], exact[used], atol=1e-11)


def test_a_body_of_one_region_is_carried_as_ever(mesh):
    nodes, elements = mesh
    one, other = by_region(nodes, elements, np.full(len(elements), 2))[0], patches(nodes, elements)
    for own, same in zip(one, other, strict=True):
        np.testing.assert_array_equal(own, same)
