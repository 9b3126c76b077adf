"""Tetrahedra fill the body that the scene's hexahedra fill, and carry fields and forces over."""

import numpy as np
import pytest

from palpate.offline.fem.mesh import jacobians
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.methods.lattice import lattice, scaled
from palpate.offline.methods.method import Case
from palpate.offline.methods.tetrahedra import Tetrahedra, gradients, volumes
from palpate.offline.scenes import find_scene
from palpate.shared.errors import PalpateError


@pytest.fixture(scope="module", params=["quick", "turbinate"])
def problem(request):
    return FullProblem(find_scene(request.param))


def test_every_size_fills_the_body(problem):
    jacobian, weights = jacobians(problem.mesh, 3)
    body = np.sum(jacobian @ weights)
    error = []
    for factor in (1, 2):
        mesh = Tetrahedra.of(problem, scaled(problem.scene, factor))
        for cut in (mesh.elements, mesh.mirrored):
            assert len(cut) == 5 * np.prod(scaled(problem.scene, factor))
            assert volumes(mesh.nodes, cut).min() > 0
        error.append(abs(volumes(mesh.nodes, mesh.elements).sum() / body - 1))
    assert error[0] < 0.07
    # chords of a curved surface: second order
    assert error[1] < error[0] / 3 + 1e-12


def test_a_doubled_lattice_has_the_nodes_of_the_scene(problem):
    mesh = Tetrahedra.of(problem, scaled(problem.scene, 2))
    np.testing.assert_allclose(mesh.to_scene @ mesh.nodes, problem.mesh.nodes, atol=1e-12)
    clamped = np.arange(len(mesh.nodes)) >= mesh.free
    np.testing.assert_array_equal(mesh.to_scene @ clamped > 1 - 1e-12, problem.mesh.clamped)


def test_neighbours_share_whole_faces(problem):
    mesh = Tetrahedra.of(problem, scaled(problem.scene, 1))
    corners = [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]
    faces = np.sort(mesh.elements[:, corners].reshape(-1, 3), axis=1)
    _, times = np.unique(faces, axis=0, return_counts=True)
    along, second, third = lattice(problem.scene)
    outside = 4 * (along * second + second * third + third * along)
    assert sorted(set(times)) == [1, 2]
    assert np.sum(times == 1) == outside


@pytest.mark.parametrize("factor", [0.5, 1, 2])
def test_carried_forces_do_the_same_work(factor, rng):
    """On a displacement that both meshes can represent: here a linear one, then any."""
    problem = FullProblem(find_scene("quick"))
    mesh = Tetrahedra.of(problem, scaled(problem.scene, factor))
    case = Case.of(problem, Load(np.array([4.0, 6.0, 8.0]), np.array([0.0, 0.6, -0.8]), 2.0))
    load = np.empty((3, len(mesh.nodes)))
    mesh.load(case, load)
    np.testing.assert_allclose(load.sum(axis=1), case.forces.sum(axis=0), rtol=1e-3, atol=1e-9)
    own = rng.standard_normal((3, 3)) @ mesh.nodes.T
    work = np.sum(case.forces * mesh.displacement(own)[case.nodes])
    assert np.sum(load * own) == pytest.approx(work, rel=1e-3)
    if factor == 1:
        own = rng.standard_normal((3, len(mesh.nodes)))
        work = np.sum(case.forces * mesh.displacement(own)[case.nodes])
        assert np.sum(load * own) == pytest.approx(work, rel=1e-9)


def test_a_uniform_pressure_stays_one():
    """On a finer lattice every node gets its share of the area, and none is pulled."""
    problem = FullProblem(find_scene("quick"))
    mesh = Tetrahedra.of(problem, scaled(problem.scene, 2))
    # of hex20: -1/12 of a face's area to a corner, 1/3 to a midpoint
    faces = problem.mesh.faces[np.all(problem.mesh.nodes[problem.mesh.faces, 2] == 8.0, axis=1)]
    area = 10.0 * 10.0 / len(faces)
    force = np.zeros((len(problem.mesh.nodes), 3))
    np.add.at(force, (faces, 2), area * np.array([-1 / 12] * 4 + [1 / 3] * 4))
    load = np.empty((3, len(mesh.nodes)))
    mesh.load(Case((), np.arange(len(force)), force), load)
    top = (mesh.nodes[:, 2] == 8.0) & np.all(abs(mesh.nodes[:, :2] - 5.0) < 3.0, axis=1)
    assert top.sum() == 25
    np.testing.assert_allclose(load[2, top], area / 4, rtol=0.05)
    assert force[:, 2].min() < -0.05 * area


def test_gradients_of_a_linear_field(rng):
    problem = FullProblem(find_scene("quick"))
    mesh = Tetrahedra.of(problem, (3, 2, 2))
    slope = rng.standard_normal(3)
    g, _ = gradients(mesh.nodes, mesh.elements)
    found = np.einsum("ta,tai->ti", (mesh.nodes @ slope)[mesh.elements], g)
    np.testing.assert_allclose(found, np.tile(slope, (len(found), 1)), atol=1e-12)


def test_a_lattice_that_shows_the_maps_faults_is_refused():
    problem = FullProblem(find_scene("turbinate"))
    with pytest.raises(PalpateError, match="inside out"):
        Tetrahedra.of(problem, scaled(problem.scene, 4))
