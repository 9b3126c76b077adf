"""Tetrahedra fill the body that the scene's hexahedra fill; tensor-mass models of them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import lil_matrix
from scipy.sparse.linalg import cg, spsolve

from palpate.offline.fem.mesh import jacobians
from palpate.offline.fem.norms import relative
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.methods.full import Remeshed
from palpate.offline.methods.method import Case
from palpate.offline.methods.tetrahedra import POISSON, TensorMass, cut, gradients, stiffness
from palpate.offline.scenes import find_scene
from palpate.shared.errors import PalpateError
from palpate.shared.mechanics.tissue import lame

POINT = np.array([4.0, 6.0, 8.0])
DOWN = np.array([0.0, 0.0, -1.0])
TILTED = np.array([0.0, 0.6, -0.8])


@pytest.fixture(scope="module", params=["quick", "turbinate-paper"])
def body(request):
    return FullProblem(find_scene(request.param))


@pytest.fixture(scope="module")
def method(problem):
    return TensorMass(problem, 1)


def tetrahedra(remeshed):
    """Return both ways to cut a mesh so that its tetrahedra fit together."""
    odd = np.indices(remeshed.cells).sum(axis=0).ravel() % 2 == 1
    return cut(remeshed.other.mesh, odd), cut(remeshed.other.mesh, ~odd)


def test_every_size_fills_the_body(body):
    jacobian, weights = jacobians(body.mesh, 3)
    whole, error = np.sum(jacobian @ weights), []
    for factor in (1, 2):
        fine = Remeshed(body, factor, "hex8")
        volumes = [gradients(fine.other.mesh.nodes, own)[1] for own in tetrahedra(fine)]
        assert min(own.min() for own in volumes) > 0
        error.append(abs(volumes[0].sum() / whole - 1))
    assert error[0] < 0.07
    # chords of a curved surface: second order
    assert error[1] < error[0] / 3 + 1e-12


def test_a_doubled_lattice_has_the_nodes_of_the_scene(body):
    fine = Remeshed(body, 2, "hex8")
    mesh = fine.other.mesh
    np.testing.assert_allclose(fine.to_scene @ mesh.nodes, body.mesh.nodes, atol=1e-9)
    np.testing.assert_array_equal(fine.to_scene @ mesh.clamped > 1 - 1e-9, body.mesh.clamped)


def test_neighbours_share_whole_faces(body):
    same = Remeshed(body, 1, "hex8")
    corners = [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]
    faces = np.sort(tetrahedra(same)[0][:, corners].reshape(-1, 3), axis=1)
    _, times = np.unique(faces, axis=0, return_counts=True)
    along, second, third = same.cells
    outside = 4 * (along * second + second * third + third * along)
    assert sorted(set(times)) == [1, 2]
    assert np.sum(times == 1) == outside


@pytest.mark.parametrize("factor", [1, 2])
def test_a_load_on_another_mesh_is_as_large_and_turns_as_much(problem, factor):
    case, other = Case.of(problem, Load(POINT, TILTED, 2.0)), Remeshed(problem, factor, "hex8")
    load, own = other.load(case), case.load(len(problem.mesh.nodes))
    moments = [np.cross(mesh.nodes - POINT, f).sum(axis=0) for mesh, f in
               ((other.other.mesh, load), (problem.mesh, own))]  # fmt: skip
    size = np.linalg.norm(case.forces.sum(axis=0))
    np.testing.assert_allclose(load.sum(axis=0), own.sum(axis=0), atol=0.02 * size)
    np.testing.assert_allclose(*moments, atol=0.1 * size)


def test_gradients_of_a_linear_field(method, rng):
    mesh, slope = method.other.mesh, rng.standard_normal(3)
    elements = tetrahedra(method)[0]
    g, _ = gradients(mesh.nodes, elements)
    found = np.einsum("ta,tai->ti", (mesh.nodes @ slope)[elements], g)
    np.testing.assert_allclose(found, np.tile(slope, (len(found), 1)), atol=1e-12)


def test_tetrahedra_that_are_inside_out_are_refused(method):
    mesh = method.other.mesh
    nodes = mesh.nodes.copy()
    nodes[mesh.elements[0, 0]] = nodes[mesh.elements[0, 6]]
    with pytest.raises(PalpateError, match="inside out"):
        cut(replace(mesh, nodes=nodes), np.zeros(len(mesh.elements), dtype=bool))


def voigt_stiffness(nodes, elements, young, poisson):
    """Assemble linear elasticity in Voigt's notation, element by element."""
    mu, lam = lame(young, poisson)
    law = np.diag([2 * mu] * 3 + [mu] * 3)
    law[:3, :3] += lam
    matrix = lil_matrix((nodes.size, nodes.size))
    for element in elements:
        plane = np.column_stack([np.ones(4), nodes[element]])
        volume, slopes = abs(np.linalg.det(plane)) / 6, np.linalg.inv(plane)[1:]
        strain = np.zeros((6, 12))
        for a in range(4):
            x, y, z = slopes[:, a]
            strain[:, 3 * a : 3 * a + 3] = (
                [x, 0, 0], [0, y, 0], [0, 0, z], [y, x, 0], [0, z, y], [z, 0, x],
            )  # fmt: skip
        dofs = (3 * element[:, None] + np.arange(3)).ravel()
        matrix[np.ix_(dofs, dofs)] += volume * strain.T @ law @ strain
    return matrix.tocsr()


def test_the_answer_is_that_of_another_assembly(problem, method):
    mesh, free = method.other.mesh, method.other.model.free
    case = Case.of(problem, Load(POINT, TILTED, 2.0))
    K = voigt_stiffness(mesh.nodes, tetrahedra(method)[0], 1.0, POISSON)[free][:, free]
    load = method.load(case).ravel()[free] / problem.scene.tissue.young
    exact = method.other.model.filled(spsolve(K.tocsc(), load)).reshape(-1, 3)
    found = method.solve(case).state
    assert relative(found, exact) < 1e-9


def test_patch_of_uniform_strain(problem, method, rng):
    """Forces of a uniform gradient: none inside, and those of the law's uniform stress outside."""
    mesh, young = method.other.mesh, problem.scene.tissue.young
    elements = tetrahedra(method)[0]
    H = 1e-4 * rng.standard_normal((3, 3))
    force = stiffness(mesh.nodes, elements, young, 0.3) @ (mesh.nodes @ H.T).ravel()
    mu, lam = lame(young, 0.3)
    stress = lam * np.trace(H) * np.eye(3) + mu * (H + H.T)
    g, volume = gradients(mesh.nodes, elements)
    expected = np.zeros_like(mesh.nodes)
    for a in range(4):
        np.add.at(expected, elements[:, a], volume[:, None] * (g[:, a] @ stress.T))
    size = np.array(problem.scene.geometry.size)
    inside = np.all((mesh.nodes > 1e-9) & (mesh.nodes < size - 1e-9), axis=1)
    assert inside.any()
    np.testing.assert_allclose(expected[inside], 0.0, atol=1e-9 * abs(expected).max())
    np.testing.assert_allclose(force.reshape(-1, 3), expected, atol=1e-9 * abs(expected).max())


def test_the_full_model_is_approached(problem):
    """With the tissue's own constants the error shrinks as the mesh is refined."""
    load, tissue, error = Load(POINT, DOWN, 0.02), problem.scene.tissue, []
    case, expected = Case.of(problem, load), problem.solve(load).displacement
    for factor in (1, 2, 4):
        method = Remeshed(problem, factor, "hex8")
        model, (elements, _) = method.other.model, tetrahedra(method)
        K = stiffness(method.other.mesh.nodes, elements, tissue.young, tissue.poisson)
        u, status = cg(
            K[model.free][:, model.free], method.load(case).ravel()[model.free], rtol=1e-4
        )
        assert status == 0
        error.append(relative(method.field(model.filled(u).reshape(-1, 3)), expected))
    assert error[0] > 1.3 * error[1] > 1.3**2 * error[2]
    assert error[2] < 0.12


def test_fitting_makes_up_for_stiff_tetrahedra():
    problem = FullProblem(find_scene("turbinate-paper"))
    point = problem.surface.vertices[len(problem.surface.vertices) // 2]
    load = Load(point, -problem.unit_load(point)[1], 0.05)
    expected = problem.solve(load).displacement
    method = TensorMass(problem, 1)
    fitted = method.displacement(method.solve(Case.of(problem, load)).state)
    assert relative(fitted, expected) < 0.5 * relative(method.factor * fitted, expected)
