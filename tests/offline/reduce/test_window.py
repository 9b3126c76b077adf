"""The window of a region: what it and a few modes of the body say is what the whole body says."""

from dataclasses import replace

import numpy as np
import pytest

from palpate.offline.fem.mesh import build_mesh
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.reduce.cubature import residuals_left
from palpate.offline.reduce.join import bases_of
from palpate.offline.reduce.ritz import Footprint, region, ritz_vectors
from palpate.offline.reduce.window import SPACING, WindowProblem, body_modes, window_elements
from palpate.shared.fields import FieldRecovery
from palpate.shared.local_models import LocalModels
from palpate.shared.scene import parse_scene

from ..fem.bodies import in_tetrahedra

STRIP = """
name = "strip"
geometry.kind = "block"
geometry.size = [60.0, 8.0, 6.0]
geometry.element = "{element}"
geometry.divisions = {divisions}
tissue.law = "neo-hookean"
tissue.young = 15.0
tissue.poisson = 0.45
{past}
support.side = "bottom"
surface.side = "top"
endoscope.radius = 1.5
endoscope.max_tilt = 30.0
load.max_indentation = 0.1
"""


PAST = "tissue.prony = [[0.25, 0.1]]"


@pytest.fixture(scope="module", params=["hexahedra", "hexahedra with a past", "tetrahedra"])
def whole(request):
    past = PAST if "past" in request.param else ""
    if request.param != "tetrahedra":
        scene = parse_scene(STRIP.format(past=past, element="hex20", divisions=[24, 4, 3]))
        return FullProblem(scene)
    scene = parse_scene(STRIP.format(past=past, element="hex8", divisions=[24, 3, 3]))
    return FullProblem(scene, in_tetrahedra(build_mesh(scene)))


@pytest.fixture(scope="module")
def pressed(whole):
    """Return two footprints near the middle of the strip."""
    points = np.array([[29.0, 4.0, 6.0], [31.5, 5.5, 6.0]])
    return [Footprint(x, np.array([0.0, 0.0, 1.0]), 1.5) for x in points]


@pytest.fixture(scope="module")
def body(whole):
    """Return modes as training makes them, of footprints as far apart."""
    x, y = np.meshgrid(np.arange(1.5, 60.0, SPACING * 1.5), [1.0, 4.0, 7.0])
    return body_modes(whole, np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 6.0)]))


@pytest.fixture(scope="module")
def part(whole, pressed, body):
    """Return the window of the footprints."""
    part = WindowProblem(whole, window_elements(whole, pressed), body)
    assert len(part.elements) < 0.6 * len(whole.elements)
    return part


def everywhere(whole, part, body, states):
    """Displacements (free dofs, k) of the whole body of states of a window."""
    n = len(part.model.free)
    u = (body.values * body.steps[:, None]).T @ states[n:]
    own = (3 * part.nodes[:, None] + np.arange(3)).ravel()
    u[own[part.model.free]] = states[:n]
    return u[whole.model.free]


def vectors(problem, model, footprint):
    nodal, _ = problem.unit_load(footprint.point)
    loads = (nodal[:, None, None] * footprint.loads.T).reshape(-1, 3)
    return ritz_vectors(model, loads[model.free])


def test_ritz_vectors_of_a_window_are_those_of_the_body(whole, part, body, pressed):
    for found, exact in ((part.model, whole.model), (part.model.relaxed, whole.model.relaxed)):
        known = vectors(whole, exact, pressed[0])
        u = everywhere(whole, part, body, vectors(part, found, pressed[0]))
        largest = np.linalg.norm(known[:, :3], axis=0).max()
        # of an error of 1 % that an answer may have, less than half
        assert np.linalg.norm(u - known, axis=0).max() <= 4e-3 * largest


def test_energy_and_products_of_states_are_those_of_the_body(whole, part, body, pressed, rng):
    states = vectors(part, part.model, pressed[1]) @ rng.standard_normal((19, 4))
    u = everywhere(whole, part, body, states)
    np.testing.assert_allclose(
        states.T @ (part.model.rest_stiffness @ states),
        u.T @ (whole.model.rest_stiffness @ u),
        rtol=1e-9, atol=1e-9 * np.abs(u.T @ (whole.model.rest_stiffness @ u)).max(),
    )  # fmt: skip


def test_paired_forces_are_internal_forces_two_by_two(part, pressed, rng):
    for model in (part.model, part.model.relaxed):
        states = vectors(part, model, pressed[0])[:, :4].T
        one, other = 0.1 * rng.standard_normal((2, 3, 4))
        for sign in (1.0, -1.0):
            found = model.paired_forces(states, one, other, sign)
            exact = [
                model.internal_free(a @ states) + sign * model.internal_free(b @ states)
                for a, b in zip(one, other, strict=True)
            ]
            np.testing.assert_allclose(found, exact, atol=1e-12 * np.abs(exact).max())


def test_residuals_are_those_of_the_body(whole, part, body, pressed):
    load = Load(pressed[0].point, np.array([0.0, 0.0, -1.0]), 1.5)
    states = vectors(part, part.model, pressed[0])[:, :1] * [0.8, 1.2]
    found = residuals_left(part, states, [load, load])
    exact = residuals_left(whole, everywhere(whole, part, body, states), [load, load])
    np.testing.assert_allclose(found, exact, rtol=0.02)


def test_a_stored_basis_is_that_of_the_states(whole, part, body, pressed, atlas):
    own = region(part, pressed, 30)
    states = own.states(part.model)
    exact = everywhere(whole, part, body, states)
    models = replace(atlas.models, **bases_of([own], body.values, body.steps))
    assert isinstance(models, LocalModels)
    fields = FieldRecovery(whole.body, models, lambda: None)
    found = np.transpose([fields._field({0: column}) for column in np.eye(30, dtype=np.float32)])
    found = found.transpose(1, 0, 2).reshape(-1, 30)[whole.model.free]
    np.testing.assert_allclose(found, exact, atol=1e-5 * np.abs(exact).max())
    orthonormal = states @ own.orthonormal
    products = orthonormal.T @ (part.model.rest_stiffness @ orthonormal)
    np.testing.assert_allclose(products, np.eye(30), atol=1e-4)
