"""Tensor-mass models against an independent assembly of the same tetrahedra."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import lil_matrix
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from palpate.offline.methods.lattice import scaled
from palpate.offline.methods.method import Case
from palpate.offline.methods.tensor_mass import LinearTetrahedra, NonlinearTetrahedra, TensorMass
from palpate.offline.methods.tetrahedra import Tetrahedra, gradients
from palpate.offline.run.workshop import Load, Workshop
from palpate.offline.scenes import find_scene
from palpate.offline.validate.loads import relative
from palpate.shared.mechanics.tissue import lame

YOUNG, POISSON = 15.0, 0.3
KINDS = LinearTetrahedra, NonlinearTetrahedra
POINT = np.array([4.0, 6.0, 8.0])
DOWN = np.array([0.0, 0.0, -1.0])


@pytest.fixture(scope="module")
def workshop():
    return Workshop(find_scene("quick"))


@pytest.fixture(scope="module")
def mesh(workshop):
    return Tetrahedra.of(workshop, (4, 3, 3))


@pytest.fixture(scope="module")
def unclamped(mesh):
    return replace(mesh, free=len(mesh.nodes))


def voigt_stiffness(mesh):
    """Assemble linear elasticity in Voigt's notation, element by element."""
    mu, lam = lame(YOUNG, POISSON)
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


def force_of(body, displacement):
    force = np.zeros_like(displacement)
    energy = body.internal(displacement, force)
    return energy, force


@pytest.mark.parametrize("tolerance", [1e-2, 1e-6])
def test_linear_model_against_a_direct_solver(workshop, tolerance):
    method = TensorMass(workshop, (4, 3, 3), poisson=POISSON, young=YOUNG, tolerance=tolerance)
    mesh = method.mesh
    case = Case.of(workshop, Load(POINT, np.array([0.0, 0.6, -0.8]), 2.0))
    answer = method.solve(case)
    assert answer.converged
    load = np.empty((3, len(mesh.nodes)))
    mesh.load(case, load)
    free = 3 * mesh.free
    exact = np.zeros(mesh.nodes.size)
    exact[:free] = spsolve(voigt_stiffness(mesh)[:free, :free], load.T.ravel()[:free])
    expected = mesh.to_scene @ exact.reshape(-1, 3)
    error = relative(method.displacement(answer.state), expected)
    assert error < 10 * tolerance
    assert relative(1.03 * method.displacement(answer.state), expected) > error


@pytest.mark.parametrize("kind", KINDS)
def test_patch_of_uniform_strain(workshop, unclamped, kind, rng):
    """Forces of a uniform gradient: none inside, and those of the law's uniform stress outside."""
    H = 1e-4 * rng.standard_normal((3, 3))
    _, force = force_of(kind(unclamped, YOUNG, POISSON), H @ unclamped.nodes.T)
    mu, lam = lame(YOUNG, POISSON)
    stress = lam * np.trace(H) * np.eye(3) + mu * (H + H.T)
    g, volume = gradients(unclamped.nodes, unclamped.elements)
    expected = np.zeros_like(force)
    for a in range(4):
        np.add.at(expected.T, unclamped.elements[:, a], volume[:, None] * (g[:, a] @ stress.T))
    size = np.array(workshop.scene.geometry.size)
    inside = np.all((unclamped.nodes > 1e-9) & (unclamped.nodes < size - 1e-9), axis=1)
    assert inside.any()
    scale = abs(expected).max()
    np.testing.assert_allclose(expected[:, inside], 0.0, atol=1e-9 * scale)
    np.testing.assert_allclose(force, expected, atol=1e-3 * scale)


@pytest.mark.parametrize("kind", KINDS)
def test_translation_meets_no_force(unclamped, kind):
    body = kind(unclamped, YOUNG, POISSON)
    energy, force = force_of(body, np.ones((3, len(unclamped.nodes))))
    # the linear tensors are in single precision
    assert abs(force).max() < 1e-4
    assert abs(energy) < 1e-3
    _, force = force_of(body, 0.01 * unclamped.nodes.T)
    assert abs(force).max() > 1e-1


def test_rotation_meets_no_force_in_the_nonlinear_model(mesh):
    turned = Rotation.from_rotvec([0.3, -1.0, 0.5]).apply(mesh.nodes) - mesh.nodes
    energy, force = force_of(NonlinearTetrahedra(mesh, YOUNG, POISSON), turned.T.copy())
    assert abs(energy) < 1e-10
    assert abs(force).max() < 1e-10


def test_nonlinear_force_and_tangent_are_derivatives(mesh, rng):
    body = NonlinearTetrahedra(mesh, YOUNG, POISSON)
    u, step = np.zeros((3, len(mesh.nodes))), np.zeros((3, len(mesh.nodes)))
    u[:, : mesh.free] = 0.1 * rng.standard_normal((3, mesh.free))
    step[:, : mesh.free] = rng.standard_normal((3, mesh.free))
    h = 1e-5
    (above, force_above), (below, force_below) = (force_of(body, u + s * step) for s in (h, -h))
    _, force = force_of(body, u)
    assert np.vdot(force, step) == pytest.approx((above - below) / (2 * h), rel=1e-6)
    body.linearise(u)
    product = np.zeros_like(u)
    body.stencil.apply(step, product)
    expected = (force_above - force_below)[:, : mesh.free] / (2 * h)
    np.testing.assert_allclose(product[:, : mesh.free], expected, atol=1e-5 * abs(expected).max())


def test_nonlinear_model_is_the_linear_one_under_a_small_load(workshop):
    case = Case.of(workshop, Load(POINT, DOWN, 1e-3))
    options = {"poisson": POISSON, "young": YOUNG, "tolerance": 1e-5}
    linear = TensorMass(workshop, (4, 3, 3), **options)
    nonlinear = TensorMass(workshop, (4, 3, 3), "st-venant-kirchhoff", **options)
    fields = [method.displacement(method.solve(case).state) for method in (linear, nonlinear)]
    assert relative(fields[1], fields[0]) < 1e-3
    large = Case.of(workshop, Load(POINT, DOWN, 3.0))
    fields = [method.displacement(method.solve(large).state) for method in (linear, nonlinear)]
    assert relative(fields[1], fields[0]) > 0.01


def test_the_full_model_is_approached(workshop):
    """With the tissue's own constants the error shrinks as the mesh is refined."""
    load = Load(POINT, DOWN, 0.02)
    case, expected = Case.of(workshop, load), workshop.solve(load).displacement
    tissue = workshop.scene.tissue
    error = []
    for factor in (1, 2, 4):
        divisions = scaled(workshop.scene, factor)
        method = TensorMass(workshop, divisions, poisson=tissue.poisson, young=tissue.young)
        error.append(relative(method.displacement(method.solve(case).state), expected))
    assert error[0] > 1.3 * error[1] > 1.3**2 * error[2]
    assert error[2] < 0.12


def test_fitted_constants_make_up_for_stiff_tetrahedra():
    workshop = Workshop(find_scene("turbinate"))
    tissue = workshop.scene.tissue
    point = workshop.surface.vertices[len(workshop.surface.vertices) // 2]
    load = Load(point, -workshop.unit_load(point)[1], 0.05)
    case, expected = Case.of(workshop, load), workshop.solve(load).displacement
    divisions = scaled(workshop.scene, 1)
    own = TensorMass(workshop, divisions, poisson=tissue.poisson, young=tissue.young)
    fitted = TensorMass(workshop, divisions)
    errors = [relative(m.displacement(m.solve(case).state), expected) for m in (own, fitted)]
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.parametrize("law", ["linear", "st-venant-kirchhoff"])
def test_two_contacts(workshop, law):
    method = TensorMass(workshop, (4, 4, 3), law)
    loads = Load(np.array([3.0, 3.0, 8.0]), DOWN, 0.5), Load(np.array([7.0, 7.0, 8.0]), DOWN, 1.0)
    both, *each = (
        method.displacement(method.solve(Case.of(workshop, *contacts)).state)
        for contacts in (loads, loads[:1], loads[1:])
    )
    assert relative(sum(each), both) < (0.03 if law == "linear" else 0.2)
    assert relative(each[1], both) > 0.2


@pytest.mark.parametrize("law", ["linear", "st-venant-kirchhoff"])
@pytest.mark.parametrize("pressure", [1e3, 1e30, 1e300])
def test_a_huge_load_does_not_raise(workshop, law, pressure):
    method = TensorMass(workshop, (4, 4, 3), law)
    answer = method.solve(Case.of(workshop, Load(POINT, DOWN, pressure)))
    assert answer.trusted == answer.converged
    assert method.displacement(answer.state).shape == workshop.mesh.nodes.shape
    if answer.converged:
        assert np.isfinite(answer.state).all()
