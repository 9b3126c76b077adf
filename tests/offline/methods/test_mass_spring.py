"""Mass-spring systems: their mechanics, and how near identified springs come to tissue."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from palpate.offline.methods.lattice import scaled
from palpate.offline.methods.mass_spring import (
    POISSON,
    MassSpring,
    Springs,
    identify,
    linear_stiffness,
)
from palpate.offline.methods.method import Case
from palpate.offline.methods.tetrahedra import Tetrahedra, edges_of
from palpate.offline.run.workshop import Load, Workshop
from palpate.offline.scenes import find_scene
from palpate.offline.validate.loads import relative

YOUNG = 15.0
POINT = np.array([4.0, 6.0, 8.0])
DOWN = np.array([0.0, 0.0, -1.0])


@pytest.fixture(scope="module")
def workshop():
    return Workshop(find_scene("quick"))


@pytest.fixture(scope="module")
def springs(workshop):
    return Springs.identified(Tetrahedra.of(workshop, (4, 3, 3)), YOUNG)


def force_of(body, displacement):
    force = np.zeros_like(displacement)
    energy = body.internal(displacement, force)
    return energy, force


def test_moved_as_a_whole_they_do_not_pull(springs):
    turned = Rotation.from_rotvec([0.3, -1.0, 0.5]).apply(springs.points) + 2.0
    energy, force = force_of(springs, (turned - springs.points).T.copy())
    assert energy < 1e-20
    assert abs(force).max() < 1e-10
    _, force = force_of(springs, (1.01 * springs.points - springs.points).T.copy())
    assert abs(force).max() > 1e-2


def test_one_spring_obeys_hooke():
    points = np.array([[3.0, 0.0, 4.0], [0.0, 0.0, 0.0]])
    spring = Springs(points, 1, np.array([[0, 1]]), np.array([7.0]))
    displacement = np.zeros((3, 2))
    displacement[:, 0] = points[0]  # from 5 mm to 10 mm
    energy, force = force_of(spring, displacement)
    assert energy == pytest.approx(7.0 * 5.0**2 / 2)
    np.testing.assert_allclose(force, 35.0 * np.array([[0.6, -0.6], [0, 0], [0.8, -0.8]]))


def test_force_is_the_derivative_of_energy(springs, rng):
    u, step = 0.3 * rng.standard_normal((2, 3, len(springs.points)))
    h = 1e-6
    (above, _), (below, _) = force_of(springs, u + h * step), force_of(springs, u - h * step)
    _, force = force_of(springs, u)
    assert np.vdot(force, step) == pytest.approx((above - below) / (2 * h), rel=1e-6)


def test_tangent_is_the_derivative_of_force_where_springs_are_stretched(springs, rng):
    free, shape = springs.stencil.free, (3, len(springs.points))
    u, step = 0.3 * springs.points.T.copy(), np.zeros(shape)
    step[:, :free] = rng.standard_normal((3, free))
    h, product = 1e-6, np.zeros(shape)
    (_, above), (_, below) = force_of(springs, u + h * step), force_of(springs, u - h * step)
    springs.linearise(u)
    springs.stencil.apply(step, product)
    expected = (above - below)[:, :free] / (2 * h)
    np.testing.assert_allclose(product[:, :free], expected, atol=1e-5 * abs(expected).max())


def test_tangent_of_compressed_springs_is_definite(springs):
    springs.linearise(-0.3 * springs.points.T.copy())
    stencil = springs.stencil
    dense = np.zeros((stencil.free, 3, stencil.free, 3))
    for w, length in enumerate(stencil.lengths):
        for a in range(length):
            dense[a, :, stencil.neighbours[w, a]] += stencil.tensors[w, :, a].reshape(3, 3)
    dense = dense.reshape(3 * stencil.free, -1)
    np.testing.assert_allclose(dense, dense.T, atol=1e-5 * dense.max())
    assert np.linalg.eigvalsh(dense).min() > 0


def test_springs_of_a_regular_tetrahedron_are_lloyds():
    """Lloyd et al. give 2 sqrt(2) / 25 E times the edge."""
    points = 3.0 / np.sqrt(8) * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    elements = np.array([[0, 2, 1, 3], [0, 2, 1, 3]])  # as of two cuts
    ends = edges_of(elements)
    np.testing.assert_allclose(np.linalg.norm(np.diff(points[ends], axis=1), axis=2), 3.0)
    expected = 2 * np.sqrt(2) / 25 * YOUNG * 3.0
    np.testing.assert_allclose(identify(points, elements, ends, YOUNG), expected, rtol=1e-3)


def test_springs_of_cubes():
    """Inside a lattice of unit cubes the normal equations are two, for edges and diagonals."""
    scene = find_scene("quick")
    geometry = scene.geometry.model_copy(update={"size": (6.0, 6.0, 6.0), "divisions": (6, 6, 6)})
    mesh = Tetrahedra.of(Workshop(scene.model_copy(update={"geometry": geometry})), (6, 6, 6))
    ends = edges_of(mesh.both_cuts)
    k = identify(mesh.nodes, mesh.both_cuts, ends, YOUNG)
    matrix = 0.5 * linear_stiffness(mesh.nodes, mesh.both_cuts, YOUNG)
    middle = mesh.nodes[ends].mean(axis=1)
    inner = np.all(abs(middle - 3.0) < 1.1, axis=1)
    vector = np.diff(mesh.nodes[ends], axis=1)[:, 0]
    length = np.linalg.norm(vector, axis=1)
    found, wanted = [], []
    for a in (1.0, np.sqrt(2)):
        same = inner & np.isclose(length, a)
        np.testing.assert_allclose(k[same], k[same].mean(), rtol=0.01)
        found.append(k[same].mean())
        first = np.flatnonzero(same)[0]
        b = np.zeros((len(mesh.nodes), 3))
        b[ends[first]] = np.outer([-1, 1], vector[first] / length[first])
        wanted.append(b.ravel() @ matrix @ b.ravel())
    np.testing.assert_allclose([[6, 8], [4, 10]] @ np.array(found), wanted, rtol=0.01)


def test_identified_springs_are_the_nearest(springs, workshop, rng):
    """No other nonnegative stiffnesses come nearer to the matrix of the tetrahedra."""
    mesh = Tetrahedra.of(workshop, (4, 3, 3))
    wanted = (0.5 * linear_stiffness(mesh.nodes, mesh.both_cuts, YOUNG)).toarray()
    along = np.diff(springs.points[springs.ends], axis=1)[:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)

    def distance(stiffness):
        matrix = np.zeros((len(mesh.nodes), 3, len(mesh.nodes), 3))
        for (a, b), n, k in zip(springs.ends, along, stiffness, strict=True):
            block = k * np.outer(n, n)
            matrix[a, :, a] += block
            matrix[b, :, b] += block
            matrix[a, :, b] -= block
            matrix[b, :, a] -= block
        return np.linalg.norm(matrix.reshape(wanted.shape) - wanted)

    best = distance(springs.stiffness)
    assert springs.stiffness.min() >= 0
    assert best < np.linalg.norm(wanted)
    for _ in range(10):
        change = rng.uniform(-1, 1, len(springs.ends)) * 0.05 * springs.stiffness.max()
        assert distance(np.maximum(springs.stiffness + change, 0.0)) > best


def small_error(workshop, method):
    """Error under a small load, of both models' linear answers in effect."""
    case = Case.of(workshop, Load(POINT, DOWN, 1e-3))
    load, free = np.zeros(workshop.mesh.nodes.shape), workshop.model.free
    load[case.nodes] = case.forces
    expected = np.zeros(load.size)
    expected[free] = workshop.model.solve_linear(load.ravel()[free])
    return relative(method.displacement(method.solve(case).state), expected.reshape(-1, 3))


def test_tissue_of_a_networks_own_ratio_is_met_better():
    """Under small loads within 20 % at a Poisson's ratio of 1/4, and not at .45."""
    scene, error = find_scene("quick"), {}
    for poisson in (POISSON, 0.45):
        tissue = scene.tissue.model_copy(update={"poisson": poisson})
        workshop = Workshop(scene.model_copy(update={"tissue": tissue}))
        error[poisson] = small_error(workshop, MassSpring(workshop, scaled(scene, 2)))
    assert error[POISSON] < 0.2
    assert error[0.45] > 1.5 * error[POISSON]


def test_fitting_helps(workshop):
    divisions = scaled(workshop.scene, 1)
    plain, fitted = MassSpring(workshop, divisions, young=YOUNG), MassSpring(workshop, divisions)
    assert small_error(workshop, fitted) < 0.8 * small_error(workshop, plain)


def test_the_answer_is_at_rest(workshop):
    method = MassSpring(workshop, scaled(workshop.scene, 2))
    case = Case.of(workshop, Load(POINT, DOWN, 3.0))
    answer = method.solve(case)
    assert answer.converged
    load = np.empty((3, len(method.mesh.nodes)))
    method.mesh.load(case, load)
    _, force = force_of(method.body, answer.state)
    left = (load - force)[:, : method.mesh.free]
    assert np.linalg.norm(left) <= method.tolerance * np.linalg.norm(load)
    assert not answer.state[:, method.mesh.free :].any()
    moved = method.displacement(answer.state)
    assert moved[:, 2].min() < -0.3
    assert not moved[workshop.mesh.clamped].any()


def test_two_contacts(workshop):
    method = MassSpring(workshop, (4, 4, 3))
    loads = Load(np.array([3.0, 3.0, 8.0]), DOWN, 0.5), Load(np.array([7.0, 7.0, 8.0]), DOWN, 1.0)
    both, *each = (
        method.displacement(method.solve(Case.of(workshop, *contacts)).state)
        for contacts in (loads, loads[:1], loads[1:])
    )
    assert relative(sum(each), both) < 0.2
    assert relative(each[1], both) > 0.2


@pytest.mark.parametrize("pressure", [1e3, 1e30, 1e300])
def test_a_huge_load_does_not_raise(workshop, pressure):
    method = MassSpring(workshop, (4, 4, 3))
    answer = method.solve(Case.of(workshop, Load(POINT, DOWN, pressure)))
    assert answer.trusted == answer.converged
    assert method.displacement(answer.state).shape == workshop.mesh.nodes.shape
    if answer.converged:
        assert np.isfinite(answer.state).all()
