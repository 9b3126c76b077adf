"""Tensor-mass models against an independent assembly of the same tetrahedra."""

import numpy as np
import pytest
from scipy.sparse import lil_matrix
from scipy.sparse.linalg import cg, spsolve

from palpate.offline.fem.norms import relative
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.methods.lattice import scaled
from palpate.offline.methods.method import Case
from palpate.offline.methods.relaxation import TOLERANCE
from palpate.offline.methods.tensor_mass import POISSON, TensorMass
from palpate.offline.methods.tetrahedra import Tetrahedra, gradients, stiffness
from palpate.offline.scenes import find_scene
from palpate.shared.mechanics.tissue import lame

POINT = np.array([4.0, 6.0, 8.0])
DOWN = np.array([0.0, 0.0, -1.0])


@pytest.fixture(scope="module")
def problem():
    return FullProblem(find_scene("quick"))


@pytest.fixture(scope="module")
def method(problem):
    return TensorMass(problem, (4, 4, 3))


def voigt_stiffness(mesh, young, poisson):
    """Assemble linear elasticity in Voigt's notation, element by element."""
    mu, lam = lame(young, poisson)
    law = np.diag([2 * mu] * 3 + [mu] * 3)
    law[:3, :3] += lam
    matrix = lil_matrix((mesh.nodes.size, mesh.nodes.size))
    for element in mesh.elements:
        plane = np.column_stack([np.ones(4), mesh.nodes[element]])
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


def test_the_answer_is_a_direct_solver_s(problem, method):
    mesh, young = method.mesh, problem.scene.tissue.young
    case = Case.of(problem, Load(POINT, np.array([0.0, 0.6, -0.8]), 2.0))
    answer = method.solve(case)
    assert answer.converged
    load, free = np.empty((3, len(mesh.nodes))), 3 * mesh.free
    mesh.load(case, load)
    K = method.factor * voigt_stiffness(mesh, young, POISSON)[:free, :free]
    exact = np.zeros(mesh.nodes.size)
    exact[:free] = spsolve(K, load.T.ravel()[:free])
    expected = mesh.to_scene @ exact.reshape(-1, 3)
    found = method.displacement(answer.state)
    assert relative(found, expected) < 2 * TOLERANCE
    assert relative(1.03 * found, expected) > 2 * TOLERANCE


def test_patch_of_uniform_strain(problem, method, rng):
    """Forces of a uniform gradient: none inside, and those of the law's uniform stress outside."""
    mesh, young = method.mesh, problem.scene.tissue.young
    H = 1e-4 * rng.standard_normal((3, 3))
    K = stiffness(mesh.nodes, mesh.elements, young, 0.3)
    force = (K @ (mesh.nodes @ H.T).ravel()).reshape(-1, 3)
    mu, lam = lame(young, 0.3)
    stress = lam * np.trace(H) * np.eye(3) + mu * (H + H.T)
    g, volume = gradients(mesh.nodes, mesh.elements)
    expected = np.zeros_like(force)
    for a in range(4):
        np.add.at(expected, mesh.elements[:, a], volume[:, None] * (g[:, a] @ stress.T))
    size = np.array(problem.scene.geometry.size)
    inside = np.all((mesh.nodes > 1e-9) & (mesh.nodes < size - 1e-9), axis=1)
    assert inside.any()
    np.testing.assert_allclose(expected[inside], 0.0, atol=1e-9 * abs(expected).max())
    np.testing.assert_allclose(force, expected, atol=1e-9 * abs(expected).max())


def test_the_full_model_is_approached(problem):
    """With the tissue's own constants the error shrinks as the mesh is refined."""
    load = Load(POINT, DOWN, 0.02)
    case, expected = Case.of(problem, load), problem.solve(load).displacement
    tissue, error = problem.scene.tissue, []
    for factor in (1, 2, 4):
        mesh = Tetrahedra.of(problem, scaled(problem.scene, factor))
        force, free = np.empty((3, len(mesh.nodes))), 3 * mesh.free
        mesh.load(case, force)
        K = stiffness(mesh.nodes, mesh.elements, tissue.young, tissue.poisson)[:free, :free]
        u = np.zeros(mesh.nodes.size)
        u[:free], status = cg(K, force.T.ravel()[:free], rtol=1e-4)
        assert status == 0
        error.append(relative(mesh.to_scene @ u.reshape(-1, 3), expected))
    assert error[0] > 1.3 * error[1] > 1.3**2 * error[2]
    assert error[2] < 0.12


def test_fitting_makes_up_for_stiff_tetrahedra():
    problem = FullProblem(find_scene("turbinate"))
    point = problem.surface.vertices[len(problem.surface.vertices) // 2]
    load = Load(point, -problem.unit_load(point)[1], 0.05)
    expected = problem.solve(load).displacement
    method = TensorMass(problem, scaled(problem.scene, 1))
    fitted = method.displacement(method.solve(Case.of(problem, load)).state)
    assert relative(fitted, expected) < 0.5 * relative(method.factor * fitted, expected)
