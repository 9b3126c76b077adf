"""The mesh's part of an error, and meshes graded towards a contact, which it is found with."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from palpate.offline.bodies.tetrahedra import edge_lengths
from palpate.offline.fem.body_mesh import own_mesh
from palpate.offline.fem.graded import Graded, Grading
from palpate.offline.fem.mesh import ticks_of
from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.problem import FullProblem, Load, TipPosition
from palpate.offline.fem.shapes import shape_of
from palpate.offline.scenes import find_scene
from palpate.offline.validate import mesh_part
from palpate.offline.validate.mesh_part import (
    DEPTHS,
    GIVEN_WAY,
    LESS,
    LEVELS,
    MOST,
    Pressed,
    borne,
    fit,
    mesh_errors,
)
from palpate.shared.mechanics.footprint import TIP_DEPTH

PLACE, DOWN = np.array([5.6, 4.7, 8.0]), np.array([0.0, 0.0, -1.0])
COARSE = Grading(finest=0.5, even=0.5, growth=0.9)


def block(*divisions):
    scene = find_scene("quick")
    geometry = scene.geometry.model_copy(update={"divisions": divisions})
    return scene.model_copy(update={"geometry": geometry})


@pytest.mark.parametrize("name", ["turbinate", "turbinate-paper", "quick"])
def test_nodes_are_where_their_parameters_say(name):
    scene = find_scene(name)
    nodes = FullProblem(scene).mesh.nodes
    at = own_mesh(scene).sites
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
    found = fine.at(own_mesh(scene).sites, fine.problem.mesh.nodes)
    away = np.linalg.norm(found - own, axis=1)
    # faces of 4 mm cut the round edges of a curved body
    assert away.max() < (1e-9 if name == "quick" else 0.1)
    assert np.median(away) < 5e-3


def test_a_field_of_a_mesh_with_a_refined_lip_is_found_at_the_nodes_of_a_graded_one():
    scene = find_scene("turbinate")
    assert ticks_of(scene.geometry)[2].ndim == 2
    own, wanted = own_mesh(scene), Graded(scene, np.array([10.1, 22.0, 8.0]), COARSE).sites
    found = own.at(wanted, own.sites)
    np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_elements_are_small_at_the_contact_and_grow_away_from_it():
    scene = find_scene("turbinate")
    place = np.array([10.18, 20.0, 11.0])
    fine = Graded(scene, place, Grading(finest=0.25))
    mesh = fine.problem.mesh
    corners = mesh.nodes[mesh.faces[mesh.accessible][:, :4]]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    away = np.linalg.norm(corners.mean(axis=1) - place, axis=1)
    assert edges[np.argmin(away)] < 0.3 * scene.endoscope.radius
    assert edges[away > 8.0].min() > 2 * edges[np.argmin(away)]


def test_under_a_tip_whose_centre_is_outside_they_are_as_small_on_a_body_from_a_file():
    scene = find_scene("turbinate-mri")
    place, normal, _ = FullProblem(scene).surface.project(np.array([16.0, 14.5, 10.0]))
    radius = scene.endoscope.radius
    at_surface, at_centre = (
        Graded(scene, x, mesh_part.TIP_GRADING).problem.mesh
        for x in (place, place + radius * normal)
    )
    corners = at_centre.nodes[at_centre.elements[:, :4]]
    edges = edge_lengths(at_centre.nodes, at_centre.elements[:, :4]).max(axis=1)
    away = np.linalg.norm(corners.mean(axis=1) - place, axis=1)
    assert edges[np.argmin(away)] < 0.2 * radius
    assert at_centre.nodes.size == pytest.approx(at_surface.nodes.size, rel=0.02)


@pytest.mark.parametrize(("name", "thick"), [("liver", True), ("turbinate-mri", False)])
def test_far_from_the_contact_edges_are_longer_in_a_body_many_radii_thick(name, thick):
    scene = find_scene(name)
    place = FullProblem(scene).surface.vertices[0]
    how = Grading(finest=1.0, even=0.5, coarsest=1.4, held=2.0)
    mesh = Graded(scene, place, how).problem.mesh
    edges = edge_lengths(mesh.nodes, mesh.elements[:, :4]).max() / scene.endoscope.radius
    assert (edges > how.coarsest) == thick


def test_errors_fall_with_the_mesh_and_a_finer_reference_says_the_same():
    levels = [(share, Load(PLACE, DOWN, 1.5 * share), None) for share in (0.3, 1.0)]
    coarse, fine = (
        np.array(mesh_errors(FullProblem(block(*divisions)), levels))
        for divisions in ((3, 3, 2), (8, 8, 6))
    )
    assert fine[:, 0].tolist() == [0.3, 1.0]
    assert (fine[:, 1:4] < 0.5 * coarse[:, 1:4]).all()
    # largest stress and 99th percentile, whose errors change sign on the way
    assert (fine[:, 4:6] < 0.1).all()
    assert (fine[:, 5] < 0.6 * coarse[:, 5]).all()


def test_where_the_finer_mesh_gives_way_less_is_pressed(monkeypatch):
    monkeypatch.setattr(mesh_part, "GRADING", COARSE)
    problem = FullProblem(block(3, 3, 2))
    limit = Load(PLACE, DOWN, 8.0)
    assert problem.solve(limit).load_steps == 1  # the scene's own mesh bears it
    levels = [
        (share, replace(limit, pressure=share * limit.pressure), None) for share in (*LEVELS, *LESS)
    ]
    rows = mesh_errors(problem, levels)
    share = rows[1][0]
    assert [row[0] for row in rows] == [0.3, share]
    assert 0.5 < share < 1.0
    fine = Pressed(Graded(block(3, 3, 2), PLACE, COARSE).problem)
    fine.harder(0.3, levels[0][1])
    with pytest.raises(NoEquilibrium):
        fine.harder(1.0, limit)
    # there and no further, as far as the place is the nearest
    elsewhere = [(0.3, replace(limit, position=np.array([1.0, 9.0, 8.0])), None)]
    bears = [np.array([level, *[0.02] * 5, 0.0]) for level in LEVELS]
    shares = borne([levels, elsewhere], [rows, bears], problem.surface)
    nearest = cKDTree([PLACE, elsewhere[0][1].position]).query(problem.surface.vertices)[1]
    np.testing.assert_array_equal(shares, np.where(nearest == 0, share, 1.0))
    assert [row[0] for row in rows] == [0.3 / share, 1.0]
    # a mesh that is off by as much under any load is too coarse to tell
    off = [np.array([level, *[2 * GIVEN_WAY] * 5, 0.0]) for level in LEVELS]
    assert (borne([levels], [off], problem.surface) == 1.0).all()


def test_under_the_tip_errors_are_those_beside_a_sphere(monkeypatch):
    monkeypatch.setattr(mesh_part, "TIP_GRADING", Grading(finest=0.25, even=0.3, growth=0.9))
    problem = FullProblem(block(8, 8, 6))
    levels = [(depth, TipPosition(PLACE - (2.0 - depth) * DOWN), None) for depth in (0.2, 0.4)]
    rows = np.array(mesh_errors(problem, levels))
    pushed = np.linalg.norm(problem.solve(levels[1][1]).force)
    footprint = [(1.0, Load(PLACE, DOWN, pushed / problem.unit_load(PLACE)[0].sum()), None)]
    (load,) = mesh_errors(problem, footprint)
    # a dent is harder to follow than a footprint
    assert (rows[:, 2] > 1.5 * load[2]).all()
    assert (rows[:, [1, 3]] < 0.1).all()
    assert (rows[:, 3] > 0.002).all()


def test_tips_are_pressed_no_less_deep_than_finer_meshes_tell_of(atlas, monkeypatch):
    def pressed():
        found = mesh_part.places(atlas, np.random.default_rng(5), tip=True)
        return [[level for level, *_ in levels] for levels in found]

    assert pressed() == [list(DEPTHS)] * MOST
    deepest = atlas.limits[:, TIP_DEPTH].max() / atlas.scene.endoscope.radius
    monkeypatch.setattr(mesh_part, "SHALLOW", DEPTHS[0] * deepest * 1.01)
    assert pressed() == [[DEPTHS[1]]] * MOST
    monkeypatch.setattr(mesh_part, "SHALLOW", deepest)
    assert pressed() == []


def test_a_sphere_pressed_deeper_and_deeper_is_where_one_pressed_at_once_is():
    """From the last state, grown, it is found to the tolerance."""
    problem = FullProblem(find_scene("quick"))
    pressed = Pressed(problem, integrated=True)
    for depth in (0.2, 0.4):
        step = TipPosition(PLACE - (2.0 - depth) * DOWN)
        found = pressed.harder(depth, step)
    exact = problem.model.solve(problem.sphere_at(step.position))
    np.testing.assert_allclose(found.felt, exact.force, atol=1e-3 * exact.force[2])
    np.testing.assert_allclose(found.displacement, exact.displacement, atol=2e-4)


def test_an_estimate_covers_and_leaves_out_what_has_given_way():
    rng = np.random.default_rng(3)
    found = [
        [np.array([level, *(0.02 * np.exp(level + 0.2 * rng.standard_normal(5))), 0.0])
         for level in LEVELS]
        for _ in range(12)
    ]  # fmt: skip
    found[4][1][1:6] = 2 * GIVEN_WAY
    coefficients, told = fit(found)
    assert told["given_way"] == 1
    assert told["answers"] == 24
    assert told["p99"]["max"] == max(row[5] for own in found for row in own if row[5] < GIVEN_WAY)
    for own in found[:4] + found[5:]:
        for row in own:
            assert (row[1:4] <= 1.05 * np.exp(coefficients @ [1.0, row[0], 0.0])).all()
    assert (np.exp(coefficients @ [1.0, 0.3, 0.0]) < 2.5 * 0.02 * np.exp(0.3)).all()


def test_under_the_tip_force_and_what_displacement_is_more_off_deeper_tell_what_has_given_way():
    lacks_dent = [np.array([level, 0.5, 0.6, 0.01, 0.1, 0.1, 0.0]) for level in (0.15, 0.8)]
    slipped = [np.array([level, 0.5, 0.6, 2 * GIVEN_WAY, 0.1, 0.1, 0.0]) for level in (0.15, 0.8)]
    bent = [lacks_dent[0], np.array([0.8, 0.5 + 2 * GIVEN_WAY, 0.6, 0.01, 0.1, 0.1, 0.0])]
    coefficients, told = fit([lacks_dent] * 5 + [slipped, bent], tip=True)
    assert told["given_way"] == 3
    np.testing.assert_allclose(np.exp(coefficients[:, 0]), [0.5, 0.6, 0.01], rtol=1e-6)


def test_near_the_rim_errors_are_covered_by_themselves():
    at_rim = [np.array([level, 0.1, 0.4, 0.2, 0.1, 0.1, 1.0]) for level in LEVELS]
    inside = [np.array([level, 0.02, 0.1, 0.03, 0.1, 0.1, 0.0]) for level in LEVELS]
    coefficients, _ = fit([inside] * 4 + [at_rim] * 2)
    for rim, errors in ((0.0, [0.02, 0.1, 0.03]), (1.0, [0.1, 0.4, 0.2])):
        told = np.exp(coefficients @ [1.0, 0.5, rim])
        assert (told >= 0.999 * np.array(errors)).all()
        assert (told < 2.0 * np.array(errors)).all()
