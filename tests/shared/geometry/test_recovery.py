"""Values at the points of a lattice of hexahedra, carried to its nodes."""

import numpy as np
import pytest

from palpate.offline.fem.mesh import build_mesh
from palpate.shared.geometry.elements import gauss, hexahedron, shape
from palpate.shared.geometry.recovery import neighbours, patches
from palpate.shared.scene import parse_scene

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


@pytest.fixture(params=["hex8", "hex20"])
def mesh(request):
    """Three by two by four elements whose sizes grow along every axis."""
    scene = parse_scene(BLOCK.format(element=request.param, divisions=[3, 2, 4]))
    grown = tuple(np.linspace(0, 1, n + 1) ** 1.5 for n in (3, 2, 4))
    found = build_mesh(scene, grown)
    return found.nodes, found.elements


def carried(nodes, elements, values):
    """Values (n,) at the nodes, of those at the points (e, 8)."""
    how, out = patches(nodes, elements), np.zeros(len(nodes))
    out[how.corners] = np.einsum("kaq,kaq->k", how.weights, values[how.elements])
    out[how.midsides] = np.sum(how.shares * out[how.lines], axis=1)
    return out


def at_points(nodes, elements):
    N, _ = shape(hexahedron(elements.shape[1]), gauss(2, 3)[0])
    return np.einsum("qa,eai->eqi", N, nodes[elements])


def test_quadratic_fields_are_carried_exactly_even_to_the_boundary(mesh, rng):
    nodes, elements = mesh
    coefficients = rng.standard_normal((3, 3, 3))

    def field(x):
        powers = np.moveaxis(x, -1, 0)[:, None] ** np.arange(3).reshape(1, 3, *[1] * (x.ndim - 1))
        return np.einsum("ijk,i...,j...,k...->...", coefficients, *powers)

    found = carried(nodes, elements, field(at_points(nodes, elements)))
    np.testing.assert_allclose(found, field(nodes), rtol=1e-10, atol=1e-9)


def test_errors_of_smooth_fields_fall_with_the_third_power_of_the_size(rng):
    errors = []
    for n in (4, 8):
        scene = parse_scene(BLOCK.format(element="hex20", divisions=[n, n, n]))
        found = build_mesh(scene)

        def field(x):
            return np.sin(1.1 * x[..., 0] + 0.7 * x[..., 1] - 0.5 * x[..., 2])

        values = field(at_points(found.nodes, found.elements))
        off = carried(found.nodes, found.elements, values) - field(found.nodes)
        errors.append(np.abs(off).max())
    assert errors[0] / errors[1] > 6.5
    assert errors[1] < 2e-2


def test_a_layer_of_one_element_is_linear_across():
    scene = parse_scene(BLOCK.format(element="hex20", divisions=[3, 3, 1]))
    found = build_mesh(scene)
    across = carried(found.nodes, found.elements, at_points(found.nodes, found.elements)[..., 2])
    np.testing.assert_allclose(across, found.nodes[:, 2], atol=1e-12)


def test_neighbours_lie_beyond_the_sides_of_an_element():
    scene = parse_scene(BLOCK.format(element="hex8", divisions=[3, 2, 4]))
    elements = build_mesh(scene).elements
    found = neighbours(elements)
    assert found[0].tolist() == [[-1, 8], [-1, 4], [-1, 1]]
    assert found[-1].tolist() == [[15, -1], [19, -1], [22, -1]]
