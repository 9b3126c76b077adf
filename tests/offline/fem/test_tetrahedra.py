"""Bodies of tetrahedra: their surface, what presses them, and hexahedra beside them."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.spatial import ConvexHull, cKDTree

from palpate.offline.fem.mesh import (
    accessible_surface,
    build_mesh,
    least_volume_ratio,
    local_thickness,
    mesh_quality,
)
from palpate.offline.fem.model import FullModel
from palpate.offline.fem.norms import relative
from palpate.offline.fem.problem import FullProblem, Load, TipPosition
from palpate.offline.fem.terms import advanced
from palpate.offline.scenes import find_scene
from palpate.shared.geometry.elements import TET10
from palpate.shared.geometry.quadrature import surface_quadrature
from palpate.shared.geometry.surface import boundary_triangles
from palpate.shared.local_models import Mesh
from palpate.shared.mechanics.footprint import footprint
from palpate.shared.mechanics.viscosity import step_weights

from ...shared.mechanics.material_point import rotation
from .bodies import in_tetrahedra, tissue_of, with_middles

UP = np.array([0.0, 0.0, 1.0])
PLACE, TILTED = np.array([5.6, 4.7, 8.0]), np.array([0.48, 0.0, -0.877268])


def scene_of(divisions, element="hex20"):
    """Scene of the block of 10 x 10 x 8 mm."""
    scene = find_scene("quick")
    geometry = scene.geometry.model_copy(update={"element": element, "divisions": divisions})
    return scene.model_copy(update={"geometry": geometry})


@lru_cache
def problem_of(element, *divisions):
    """The block, of hexahedra or of six tet10 for each."""
    if element == "hex20":
        return FullProblem(scene_of(divisions))
    return FullProblem(scene_of(divisions), in_tetrahedra(build_mesh(scene_of(divisions, "hex8"))))


@lru_cache
def ball():
    """A ball of radius 1 mm: curved tetrahedra from its middle to 80 faces; clamped below."""
    golden = (1 + np.sqrt(5)) / 2
    corners = np.array([[0, a, b * golden] for a in (-1, 1) for b in (-1, 1)])
    corners = np.vstack([np.roll(corners, k, axis=1) for k in range(3)]) / np.sqrt(1 + golden**2)
    hull = ConvexHull(corners).simplices
    edges = np.unique(np.sort(np.vstack([hull[:, [i, (i + 1) % 3]] for i in range(3)])), axis=0)
    middles = corners[edges].sum(axis=1)
    corners = np.vstack([corners, middles / np.linalg.norm(middles, axis=1, keepdims=True)])
    hull = ConvexHull(corners).simplices
    inward = np.linalg.det(corners[hull]) < 0
    hull[inward] = hull[inward, ::-1]
    elements = np.column_stack([np.full(len(hull), len(corners)), hull])
    nodes, elements, edges = with_middles(np.vstack([corners, np.zeros(3)]), elements)
    outer = len(corners) + 1 + np.flatnonzero((edges < len(corners)).all(axis=1))
    nodes[outer] /= np.linalg.norm(nodes[outer], axis=1, keepdims=True)
    faces = elements[:, TET10.on_face((1, 2, 3))]
    low = (nodes[:, 2] < -0.3) & (np.linalg.norm(nodes, axis=1) > 0.9)
    return Mesh(nodes, elements, faces, low, ~low[faces].any(axis=1))


def regular():
    """One tetrahedron with edges of 1 mm."""
    corners = np.array([[1, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]]) / np.sqrt(8)
    nodes, elements, _ = with_middles(corners, np.array([[0, 1, 2, 3]]))
    none = np.zeros((0, 6), np.int32)
    return Mesh(nodes, elements, none, np.zeros(10, bool), np.zeros(0, bool))


# --- the mesh ------------------------------------------------------------------------------------


def test_quality_is_1_of_the_regular_element_and_less_of_others():
    perfect = {"scaled_jacobian_min": 1.0, "scaled_jacobian_median": 1.0, "jacobian_ratio_min": 1.0}
    expected = {**perfect, "aspect_ratio_max": 1.0, "volume_mm3": 1 / np.sqrt(72)}
    assert mesh_quality(regular()) == pytest.approx(expected)
    # six to a cube: paths of an edge, a diagonal of a face, the diagonal of the cube
    found = mesh_quality(in_tetrahedra(build_mesh(scene_of((5, 5, 4), "hex8"))))
    assert found["volume_mm3"] == pytest.approx(800.0)
    assert found["aspect_ratio_max"] == pytest.approx(np.sqrt(3))
    assert found["scaled_jacobian_min"] == pytest.approx(np.sqrt(2) / np.sqrt(6))


def test_a_ball_has_its_volume_its_surface_and_its_diameter():
    mesh = ball()
    quality = mesh_quality(mesh)
    assert quality["volume_mm3"] == pytest.approx(4 / 3 * np.pi, rel=4e-3)
    assert quality["jacobian_ratio_min"] > 0.0
    whole = surface_quadrature(mesh.nodes, mesh.faces)
    assert whole.areas.sum() == pytest.approx(4 * np.pi, rel=4e-3)
    assert np.abs(whole.areas @ whole.normals).max() < 1e-3
    assert np.sum(whole.points * whole.normals, axis=1).min() > 0.97
    top = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]])
    assert local_thickness(mesh, top, top) == pytest.approx(2.0, abs=0.02)
    assert least_volume_ratio(mesh, 0.1 * mesh.nodes) == pytest.approx(1.331)


def test_the_surface_of_a_ball_is_round():
    surface = accessible_surface(ball())
    np.testing.assert_allclose(np.linalg.norm(surface.vertices, axis=1), 1.0, atol=4e-3)
    assert np.sum(surface.vertices * surface.normals, axis=1).min() > 0.998
    for p in ([0.3, 0.2, 1.4], [0.0, -0.5, 0.7]):
        x, normal, _ = surface.project(np.array(p))
        np.testing.assert_allclose(x, p / np.linalg.norm(p), atol=0.02)
        np.testing.assert_allclose(normal, p / np.linalg.norm(p), atol=0.04)


def test_the_surface_of_a_block_is_flat_and_whole():
    surface = problem_of("tet10", 4, 4, 3).surface
    np.testing.assert_allclose(surface.normals, np.tile(UP, (len(surface.normals), 1)), atol=1e-12)
    a, b, c = np.moveaxis(surface.vertices[surface.triangles], 1, 0)
    turned = np.cross(b - a, c - a)[:, 2]
    assert (turned > 0).all()
    assert turned.sum() / 2 == pytest.approx(100.0)
    assert len(surface.triangles) == 4 * 32


def test_the_drawn_boundary_is_closed():
    nodes, triangles = boundary_triangles(problem_of("tet10", 2, 2, 2).mesh.faces)
    edges = np.sort(np.vstack([triangles[:, [i, (i + 1) % 3]] for i in range(3)]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    assert len(nodes) == triangles.max() + 1


# --- loads ---------------------------------------------------------------------------------------


def test_the_load_on_a_flat_face_has_the_force_and_the_moment_of_the_disc():
    mesh = problem_of("tet10", 4, 4, 3).mesh
    nodal = np.empty(len(mesh.nodes))
    for aside in ([0.0, 0.0, 0.0], [0.31, -0.17, 0.0], [-0.9, 0.4, 0.0]):
        x = np.array([5.0, 5.0, 8.0]) + aside
        area = footprint(surface_quadrature(mesh.nodes, mesh.faces), x, UP, 2.0, nodal)
        assert area == pytest.approx(nodal.sum())
        assert area == pytest.approx(8 / 15 * np.pi * 4.0, rel=4e-3)
        np.testing.assert_allclose(nodal @ mesh.nodes / area, x, atol=4e-3 * 2.0)


def test_the_load_does_not_jump_as_it_moves():
    mesh = problem_of("tet10", 4, 4, 3).mesh
    way = PLACE + 0.05 * np.arange(60)[:, None] * np.array([-0.8, 0.6, 0.0])
    for spacing, most in ((0.4, 0.01), (0.2, 0.002)):
        nodal, fine = np.empty((2, len(way), len(mesh.nodes)))
        for rows, step in ((nodal, spacing), (fine, 0.08)):
            points = surface_quadrature(mesh.nodes, mesh.faces, step)
            for row, x in zip(rows, way, strict=True):
                footprint(points, x, UP, 2.0, row)
        error = np.linalg.norm(nodal - fine, axis=1) / np.linalg.norm(fine, axis=1)
        assert error.max() < most
        steps, bends = (np.linalg.norm(np.diff(nodal, n, axis=0), axis=1).max() for n in (1, 2))
        assert bends < 0.2 * steps


# --- the model -----------------------------------------------------------------------------------


def test_a_curved_body_that_turns_has_no_force(rng):
    mesh = ball()
    model = FullModel(replace(mesh, clamped=np.zeros_like(mesh.clamped)), tissue_of())
    force = np.empty(mesh.nodes.size)
    energy, _ = model.internal((mesh.nodes @ (rotation(rng) - np.eye(3)).T).ravel(), force)
    assert abs(energy) < 1e-12
    assert np.abs(force).max() < 1e-12
    values = np.linalg.eigvalsh(model.rest_stiffness.toarray())
    assert np.abs(values[:6]).max() < 1e-11 * values[-1]
    assert values[6] > 1e-4 * values[-1]


def test_the_tangent_of_a_curved_body_is_the_derivative_of_its_force(rng):
    mesh = ball()
    model = FullModel(mesh, tissue_of())
    u, v = 0.02 * rng.standard_normal((2, len(model.free)))
    h = 1e-4
    slope = (model.internal_free(u + h * v) - model.internal_free(u - h * v)) / (2 * h)
    found = model.stiffness(model.filled(u)) @ v
    assert np.abs(found - slope).max() < 1e-6 * np.abs(slope).max()


def answer(element, divisions, step, tip_as_sphere=False):
    """Mean displacement under the footprint, force on the tool, and 99th percentile of stress."""
    problem = problem_of(element, *divisions)
    if tip_as_sphere:
        found = problem.model.solve(problem.sphere_at(step.position))
        return found.force
    found = problem.solve(step)
    contact = problem.footprint(step, found)
    u = problem.displaced(found, contact)
    high = problem.stress_field.peaks(u, None, contact)[1]
    if isinstance(step, Load):
        return np.append(problem.under(step.position, u), high)
    return np.append(found.force, high)


def off(found, exact):
    """Relative difference of vectors, and of the last number."""
    vector = np.linalg.norm(found[:3] - exact[:3]) / np.linalg.norm(exact[:3])
    return vector, abs(found[-1] / exact[-1] - 1)


@pytest.mark.parametrize(
    ("step", "most"),
    [(Load(PLACE, TILTED, 1.5), (0.01, 0.05)), (TipPosition(PLACE + 1.7 * UP), (0.01, 0.05))],
    ids=["footprint", "tip"],
)
def test_tetrahedra_and_hexahedra_come_to_the_same_answer(step, most):
    exact = answer("hex20", (8, 8, 6), step)
    coarse, fine = (off(answer("tet10", (n, n, m), step), exact) for n, m in ((4, 3), (8, 6)))
    print(f"displacement or force, stress: {coarse}, finer {fine}")
    assert fine[0] < most[0]
    assert fine[1] < most[1]
    assert fine[0] < 0.25 * coarse[0]
    assert fine[1] < 0.6 * coarse[1]


def test_the_sphere_that_is_integrated_comes_to_the_same_force():
    """As far as faces can tell that are larger than the contact."""
    step = TipPosition(PLACE + 1.6 * UP)
    exact = answer("hex20", (8, 8, 6), step, tip_as_sphere=True)
    found = answer("tet10", (8, 8, 6), step, tip_as_sphere=True)
    print(f"force {found} and {exact}")
    assert np.linalg.norm(found - exact) < 0.05 * np.linalg.norm(exact)


def test_stress_at_the_nodes_is_that_of_hexahedra():
    load, stress = Load(PLACE, TILTED, 1.0), []
    problems = [problem_of(element, 8, 8, 6) for element in ("hex20", "tet10")]
    for problem in problems:
        u = problem.solve(load).displacement
        stress.append(problem.von_mises(u, contact=problem.footprint(load)))
    hexahedra, tetrahedra = problems
    away, same = cKDTree(hexahedra.mesh.nodes).query(tetrahedra.mesh.nodes)
    at = (away < 1e-9) & tetrahedra.beyond_clamped_layer
    assert at.sum() > 1000
    error = relative(stress[1][at], stress[0][same[at]])
    print(f"von Mises stress at {at.sum()} nodes differs by {error:.3f}")
    assert error < 0.08


def test_stress_that_has_relaxed_is_carried_to_the_nodes(rng):
    """Of a uniform state, held for some time: that of hexahedra, at all nodes."""
    H, stress = rng.uniform(-0.2, 0.2, (3, 3)), []
    for element in ("hex20", "tet10"):
        problem = problem_of(element, 2, 2, 2)
        own = FullProblem(problem.scene.of_tissue(prony=((0.4, 0.1),)), problem.mesh)
        u, weights = own.mesh.nodes @ H.T, step_weights(own.model.prony, 0.07)
        past = advanced(own.model, own.model.at_rest, u, weights)
        stress.append(own.von_mises(u, past))
        assert stress[-1].max() < 0.95 * own.von_mises(u).min()
    np.testing.assert_allclose(stress[1], stress[0][0], rtol=1e-10)
