"""Bases: orthonormal, nested, and each spans what its name says."""

from functools import partial

import numpy as np
import pytest
from scipy.linalg import eigh

from palpate.offline.fem.problem import Load
from palpate.offline.methods.catalogue import loads_about
from palpate.offline.methods.method import Case
from palpate.offline.methods.spaces import krylov, mass, modal, pod, static_derivatives

SIZE = 12


@pytest.fixture(scope="module")
def model(problem):
    return problem.model


@pytest.fixture(scope="module")
def M(model):
    return mass(model)


@pytest.fixture(scope="module")
def loads(training):
    """Return unit pressures in two places along three axes, (free dofs, 6)."""
    return training.loads(2)


@pytest.fixture(scope="module")
def spaces(model, M, loads, training):
    """Return the spaces by name, as functions of their size."""
    return {
        "modal": partial(modal, model),
        "ritz": partial(krylov, model, M, loads[:, :1]),
        "krylov": partial(krylov, model, M, loads),
        "derivatives": partial(static_derivatives, model, 2.0 * loads[:, :3]),
        "pod": partial(pod, model, training.snapshots.displacements),
        "pod-euclidean": partial(pod, model, training.snapshots.displacements, inner="euclidean"),
    }


NAMES = ["modal", "ritz", "krylov", "derivatives", "pod", "pod-euclidean"]


def energy(model, u):
    return np.sqrt(np.sum(u * (model.rest_stiffness @ u), axis=0))


def missed(model, basis, u):
    """Relative distance of vectors from a space, in the energy norm."""
    rest = u - basis @ (basis.T @ (model.rest_stiffness @ u))
    return energy(model, rest) / energy(model, u)


@pytest.mark.parametrize("name", NAMES)
def test_a_basis_is_orthonormal_in_the_energy_at_rest_and_holds_smaller_ones(spaces, model, name):
    basis = spaces[name](SIZE)
    assert basis.shape == (len(model.free), SIZE)
    gram = basis.T @ (model.rest_stiffness @ basis)
    np.testing.assert_allclose(gram, np.eye(SIZE), atol=1e-9)
    assert missed(model, basis, spaces[name](SIZE // 2)).max() <= 1e-6


def test_the_mass_of_a_linear_field_is_its_integral(problem, M):
    # z^2 over the block; z is nought on the clamped bottom
    x, y, z = problem.scene.geometry.size
    field = np.zeros_like(problem.mesh.nodes)
    field[:, 1] = problem.mesh.nodes[:, 2]
    u = field.ravel()[problem.model.free]
    assert u @ M @ u == pytest.approx(x * y * z**3 / 3)


def test_modes_solve_the_eigenproblem_and_are_its_lowest(spaces, model, M):
    modes, K = spaces["modal"](SIZE), model.rest_stiffness
    squares = 1 / np.sum(modes * (M @ modes), axis=0)
    residual = K @ modes - (M @ modes) * squares
    assert np.linalg.norm(residual) <= 1e-8 * np.linalg.norm(K @ modes)
    lowest = eigh(K.toarray(), M.toarray(), eigvals_only=True, subset_by_index=[0, SIZE - 1])
    np.testing.assert_allclose(squares, lowest, rtol=1e-8)


def test_ritz_vectors_of_a_load_are_wilson_s_sequence(model, M, loads):
    basis = krylov(model, M, loads[:, :1], 4)
    first = model.solve_linear(loads[:, :1])
    assert missed(model, basis[:, :1], first).max() <= 1e-9
    second = model.solve_linear(M @ first)
    assert missed(model, basis[:, :1], second).max() > 0.01
    assert missed(model, basis[:, :2], second).max() <= 1e-9


def test_a_block_holds_every_load_s_own_vectors_and_a_load_given_twice_adds_nothing(
    model, M, loads
):
    basis = krylov(model, M, loads, 2 * loads.shape[1])
    for load in loads.T:
        assert missed(model, basis, krylov(model, M, load[:, None], 2)).max() <= 1e-6
    once = krylov(model, M, loads[:, :3], 6)
    twice = krylov(model, M, np.hstack([loads[:, :3], 2 * loads[:, :3]]), 6)
    assert missed(model, once, twice).max() <= 1e-6


def test_static_derivatives_are_of_third_order_in_the_load(problem, queries):
    contact = queries[0][0]
    free, errors = problem.model.free, []
    basis = static_derivatives(
        problem.model, loads_about(problem, Case.of(problem, contact))[free], 19
    )
    for fraction in (1.0, 0.5, 0.25):
        load = Load(contact.position, contact.direction, fraction * contact.pressure)
        exact = problem.solve(load).displacement.ravel()[free]
        errors.append(missed(problem.model, basis, exact[:, None]).item())
    # the first term left out is of fourth order, relative to the answer of third
    assert errors[0] < 0.01
    assert errors[0] / errors[1] == pytest.approx(8, rel=0.3)
    assert errors[1] / errors[2] == pytest.approx(8, rel=0.3)


def test_energy_pod_leaves_least_energy_and_euclidean_pod_least_length(spaces, model, training):
    u = training.snapshots.displacements[:, model.free].T
    left = {}
    for name in ("pod", "pod-euclidean"):
        V = spaces[name](6)
        in_energy = u - V @ (V.T @ (model.rest_stiffness @ u))
        in_length = u - V @ np.linalg.lstsq(V, u, rcond=None)[0]
        left[name] = np.linalg.norm(energy(model, in_energy)), np.linalg.norm(in_length)
    assert left["pod"][0] < left["pod-euclidean"][0]
    assert left["pod"][1] > left["pod-euclidean"][1]
