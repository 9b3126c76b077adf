"""The mesh's part of an error, and meshes graded towards a contact, which it is found with."""

import numpy as np
import pytest

from palpate.offline.fem.graded import Graded, Grading, parameters_of
from palpate.offline.fem.mesh import ticks_of
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.fem.shapes import shape_of
from palpate.offline.scenes import find_scene
from palpate.offline.validate.mesh_part import GIVEN_WAY, LEVELS, fit, mesh_errors

PLACE, DOWN = np.array([5.6, 4.7, 8.0]), np.array([0.0, 0.0, -1.0])
COARSE = Grading(finest=0.5, even=0.5, growth=0.9)


def block(*divisions):
    scene = find_scene("quick")
    geometry = scene.geometry.model_copy(update={"divisions": divisions})
    return scene.model_copy(update={"geometry": geometry})


@pytest.mark.parametrize("name", ["turbinate-fine", "turbinate-paper", "quick"])
def test_nodes_are_where_their_parameters_say(name):
    scene = find_scene(name)
    nodes = FullProblem(scene).mesh.nodes
    at = parameters_of(scene, ticks_of(scene.geometry))
    some = np.arange(0, len(nodes), 97)
    points = [shape_of(scene).grid(*at[i][:, None])[0, 0, 0] for i in some]
    np.testing.assert_allclose(nodes[some], points, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "place"), [("quick", PLACE), ("turbinate-paper", (10.18, 20.0, 11.0))]
)
def test_a_field_of_a_graded_mesh_is_found_at_the_nodes_of_another(name, place):
    scene = find_scene(name)
    fine = Graded(scene, np.array(place), COARSE)
    own = FullProblem(scene).mesh.nodes
    found = fine.at(parameters_of(scene, ticks_of(scene.geometry)), fine.problem.mesh.nodes)
    away = np.linalg.norm(found - own, axis=1)
    # faces of 4 mm cut the round edges of a curved body
    assert away.max() < (1e-9 if name == "quick" else 0.1)
    assert np.median(away) < 5e-3


def test_elements_are_small_at_the_contact_and_grow_away_from_it():
    scene = find_scene("turbinate-fine")
    place = np.array([10.18, 20.0, 11.0])
    fine = Graded(scene, place, Grading(finest=0.25))
    mesh = fine.problem.mesh
    corners = mesh.nodes[mesh.faces[mesh.accessible][:, :4]]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    away = np.linalg.norm(corners.mean(axis=1) - place, axis=1)
    assert edges[np.argmin(away)] < 0.3 * scene.endoscope.radius
    assert edges[away > 8.0].min() > 2 * edges[np.argmin(away)]


def test_errors_fall_with_the_mesh_and_a_finer_reference_says_the_same():
    loads = [Load(PLACE, DOWN, pressure) for pressure in (0.5, 1.5)]
    coarse, fine = (
        np.array(mesh_errors(FullProblem(block(*divisions)), loads))[:, 1:]
        for divisions in ((3, 3, 2), (8, 8, 6))
    )
    assert (fine < 0.5 * coarse).all()


def test_an_estimate_covers_and_leaves_out_what_has_given_way():
    loads = [[Load(PLACE, DOWN, 10.0 * k + level) for level in LEVELS] for k in range(12)]
    rng = np.random.default_rng(3)
    found = [
        [np.array([load.pressure, *(0.02 * np.exp(level + 0.2 * rng.standard_normal(3)))])
         for load, level in zip(own, LEVELS, strict=True)]
        for own in loads
    ]  # fmt: skip
    found[4][1][1:] = 2 * GIVEN_WAY
    coefficients, told = fit(loads, found)
    assert told["given_way"] == 1
    assert told["loads"] == 24
    for own in found[:4] + found[5:]:
        for row, level in zip(own, LEVELS, strict=True):
            assert (row[1:] <= 1.05 * np.exp(coefficients @ [1.0, level])).all()
    assert (np.exp(coefficients @ [1.0, 0.3]) < 2.5 * 0.02 * np.exp(0.3)).all()
