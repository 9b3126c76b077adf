"""Stress under a contact on a coarse mesh, with the near field, beside a fine one."""

import numpy as np
import pytest

from palpate.offline.fem.body_mesh import own_mesh
from palpate.offline.fem.graded import Graded, Grading
from palpate.offline.fem.problem import FullProblem, Load, TipPosition
from palpate.offline.scenes import find_scene
from palpate.offline.validate.mesh_part import Pressed
from palpate.shared.near_field import NearFields

PLACE, UP = np.array([5.6, 4.7, 8.0]), np.array([0.0, 0.0, 1.0])
DOWN, TILTED = [0.0, 0.0, -1.0], [0.48, 0.0, -0.877268]


def block(*divisions):
    scene = find_scene("quick")
    geometry = scene.geometry.model_copy(update={"divisions": divisions})
    return FullProblem(scene.model_copy(update={"geometry": geometry}))


@pytest.fixture(scope="module")
def coarse():
    return block(4, 4, 3)


@pytest.fixture(scope="module")
def fine():
    return block(16, 16, 12)


@pytest.mark.parametrize("direction", [DOWN, TILTED], ids=["pressed", "tilted"])
def test_it_brings_a_coarse_mesh_nearer_to_a_fine_one(coarse, fine, direction):
    load = Load(PLACE, np.array(direction), 1.5)
    exact = fine.von_mises(fine.solve(load).displacement, contact=fine.footprint(load))
    u = coarse.solve(load).displacement
    at = np.linalg.norm(coarse.mesh.nodes - PLACE, axis=1) < 4.0
    same = [
        np.argmin(np.linalg.norm(fine.mesh.nodes - node, axis=1)) for node in coarse.mesh.nodes[at]
    ]

    def error(contact):
        off = coarse.von_mises(u, contact=contact)[at] - exact[same]
        return np.linalg.norm(off) / np.linalg.norm(exact[same])

    assert error(coarse.footprint(load)) < 0.6 * error(None)
    assert error(coarse.footprint(load)) < 0.3


def test_a_fine_mesh_hardly_needs_it(fine):
    load = Load(PLACE, np.array(DOWN), 1.5)
    u = fine.solve(load).displacement
    own, whole = fine.von_mises(u), fine.von_mises(u, contact=fine.footprint(load))
    assert np.linalg.norm(own - whole) < 0.07 * np.linalg.norm(whole)


def test_it_ends_at_its_reach_and_is_the_gradient_of_its_displacement(coarse):
    contact = coarse.footprint(Load(PLACE, np.array(TILTED), 1.5))
    contact = contact._replace(curvature=np.array([0.1, -0.05, 0.0, 0.02, 0.0, 0.0]))
    points = PLACE + np.array([[0.7, 0.4, -0.6], [-1.5, 1.0, -1.5], [0.0, 0.0, -3.0]])
    step, shifted = 0.05, [points]
    for away in step * np.eye(3):
        shifted += [points + away, points - away]
    points = np.vstack([*shifted, [[5.6, 4.7, 1.0], [0.0, 0.0, 8.0]]])
    found = NearFields(coarse.body).at(points, contact)
    assert list(found.points) == list(range(21))
    u = found.displacement.reshape(7, 3, 3)
    numeric = np.stack([u[1] - u[2], u[3] - u[4], u[5] - u[6]], axis=2) / (2 * step)
    scale = np.abs(found.gradient[:3]).max()
    np.testing.assert_allclose(found.gradient[:3], numeric, atol=0.02 * scale)


def test_under_a_tip_it_is_that_of_its_force(coarse):
    step = TipPosition(PLACE + 1.7 * UP)
    found = coarse.solve(step)
    contact = coarse.footprint(step, found)
    nodal = coarse.unit_load_at(contact.place, contact.normal)
    np.testing.assert_allclose(contact.traction * nodal.sum(), -found.force, rtol=1e-12)
    assert coarse.footprint(TipPosition(PLACE + 2.1 * UP)) is None


@pytest.mark.parametrize("depth", [0.2, 0.5])
def test_under_a_tip_most_of_what_fields_lack_of_the_sphere_comes_back(depth):
    problem, step = block(8, 8, 6), TipPosition(PLACE + (2.0 - depth) * UP)
    graded = Graded(problem.scene, PLACE, Grading(finest=0.15, even=0.3, growth=0.9))
    sphere = Pressed(graded.problem, integrated=True).harder(depth, step)
    at = own_mesh(problem.scene).sites
    found = problem.solve(step)
    contact = problem.footprint(step, found)
    u, plain = problem.displaced(found, contact), found.displacement
    stress = problem.von_mises(u, contact=contact)
    without = problem.von_mises(plain, contact=contact._replace(tip=False))
    for own, dented, exact, share in (
        (plain, u, sphere.displacement, 0.4), (without, stress, sphere.von_mises, 0.65)
    ):  # fmt: skip
        exact = graded.at(at, exact)
        assert np.linalg.norm(dented - exact) < share * np.linalg.norm(own - exact)
    peak, high = problem.stress_field.peaks(u, None, contact)
    assert high == pytest.approx(sphere.peaks[1], rel=0.08)
    assert peak == pytest.approx(sphere.peaks[0], rel=0.25)


def test_peaks_are_nearer_to_those_of_a_fine_mesh_than_the_nodes_are(coarse, fine):
    load = Load(PLACE, np.array(DOWN), 1.5)
    found = [problem.solve(load).displacement for problem in (coarse, fine)]
    (largest, high), (exact, exact_high) = (
        problem.stress_field.peaks(u, None, problem.footprint(load))
        for problem, u in zip((coarse, fine), found, strict=True)
    )
    assert largest == pytest.approx(exact, rel=0.1)
    assert high == pytest.approx(exact_high, rel=0.1)
    assert abs(coarse.von_mises(found[0]).max() - exact) > 0.15 * exact


def test_the_99th_percentile_is_that_of_volume_outside_the_clamped_layer(coarse):
    F = np.diag([0.05, 0.0, -0.1])
    peaks = coarse.stress_field.peaks(coarse.mesh.nodes @ F, None, None)
    np.testing.assert_allclose(peaks, coarse.von_mises(coarse.mesh.nodes @ F)[0], rtol=1e-10)
    # a stress that grows with the height: the uppermost hundredth of what counts
    z = coarse.mesh.nodes[:, 2]
    u = np.column_stack([0.0 * z, 0.0 * z, -1e-6 * z**2])
    largest, high = coarse.stress_field.peaks(u, None, None)
    assert 0.85 * largest < high <= largest
    np.testing.assert_array_equal(coarse.beyond_clamped_layer, z > 1.5)
