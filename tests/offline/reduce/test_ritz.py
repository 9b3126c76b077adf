"""Reduced spaces: path derivatives of the full model, and modes orthonormal in its energy."""

import numpy as np
import pytest

from palpate.offline.fem.problem import FullProblem
from palpate.offline.reduce.ritz import (
    RITZ_VECTORS,
    Footprint,
    energy_pod,
    local_modes,
    ritz_vectors,
    whole_numbers,
)
from palpate.offline.scenes import find_scene

PRESSURE = 2.0


@pytest.fixture(scope="module")
def problem():
    return FullProblem(find_scene("quick"))


@pytest.fixture(scope="module")
def loads(problem):
    """Return three directions of a footprint beside the middle, (n, 3, 3) mN."""
    nodal, _ = problem.unit_load(np.array([4.0, 5.5, 8.0]))
    return PRESSURE * nodal[:, None, None] * np.eye(3)


@pytest.fixture(scope="module")
def vectors(problem, loads):
    return ritz_vectors(problem.model, loads.reshape(-1, 3)[problem.model.free])


def series(problem, load, count=5, size=0.3):
    """Coefficients of the equilibrium under ``s load`` in powers of s, (powers, free dofs)."""
    s = np.linspace(-1, 1, 2 * count + 1)
    free = problem.model.free
    solved = [problem.model.solve(size * x * load).displacement.ravel()[free] for x in s]
    powers = np.polynomial.polynomial.polyfit(s, np.array(solved), 2 * count)
    return powers / size ** np.arange(2 * count + 1)[:, None]


@pytest.mark.parametrize(
    ("direction", "second", "third"),
    [((0, 0, 1), 0, 0), ((1, 0, 0), 5, 9), ((0, 0.5, 0.5), 1, None)],
)
def test_ritz_vectors_are_the_derivatives_of_the_equilibrium(
    problem, loads, vectors, direction, second, third
):
    exact = series(problem, loads @ direction)
    found = {1: vectors[:, :3] @ direction, 2: vectors[:, 3 + second]}
    if third is not None:
        found[3] = vectors[:, 9 + third]
    for order, vector in found.items():
        assert np.linalg.norm(vector - exact[order]) <= 3e-3 * np.linalg.norm(exact[order]), order


def test_ritz_vectors_give_the_derivatives_along_any_load(problem, rng):
    point = np.array([4.0, 5.5, 8.0])
    nodal, normal = problem.unit_load(point)
    footprint = Footprint(point, normal, PRESSURE)
    free = problem.model.free
    loads = (nodal[:, None, None] * footprint.loads.T).reshape(-1, 3)[free]
    found = ritz_vectors(problem.model, loads)
    load = PRESSURE * (-normal + 0.3 * rng.standard_normal(3))
    first, second, third = footprint.path_derivatives(found, load[None])
    exact = series(problem, nodal[:, None] * load)
    assert np.linalg.norm(first[0] - exact[1]) <= 1e-9 * np.linalg.norm(exact[1])
    assert np.linalg.norm(second[0] / 2 - exact[2]) <= 3e-3 * np.linalg.norm(exact[2])
    assert np.linalg.norm(third[0] / 6 - exact[3]) <= 1e-2 * np.linalg.norm(exact[3])


def test_modes_are_orthonormal_in_the_energy_and_span_the_vectors(problem, vectors):
    model = problem.model
    modes, energies = energy_pod(model, vectors, RITZ_VECTORS)
    gram = modes.T @ (model.rest_stiffness @ modes)
    np.testing.assert_allclose(gram, np.eye(modes.shape[1]), atol=1e-10)
    assert (np.diff(energies) <= 0).all()
    missed = vectors - modes @ (modes.T @ (model.rest_stiffness @ vectors))
    norms = np.sqrt(np.sum(missed * (model.rest_stiffness @ missed), axis=0))
    assert norms.max() <= 1e-5 * np.sqrt(energies[0])


def test_vectors_with_no_more_to_give_make_fewer_modes(problem, vectors):
    twice = np.hstack([vectors[:, :4], 2 * vectors[:, :4]])
    assert energy_pod(problem.model, twice, 8)[0].shape[1] == 4
    assert energy_pod(problem.model, vectors, 5)[0].shape[1] == 5


def test_local_modes_lead_with_the_vectors_and_fill_up_with_the_basis(rng):
    vectors = rng.standard_normal((12, 3))
    modes = local_modes(vectors, 8)
    np.testing.assert_allclose(modes.T @ modes, np.eye(8), atol=1e-10)
    leading = modes[:, :3]
    np.testing.assert_allclose(leading @ (leading.T @ vectors), vectors, atol=1e-10)


def test_modes_in_whole_numbers_stay_orthonormal(rng):
    orthonormal = (np.eye(40) + np.triu(0.1 * rng.standard_normal((40, 40)))).astype(np.float32)
    own = np.linalg.qr(rng.standard_normal((40, 12)) * np.geomspace(1.0, 1e-3, 40)[:, None])[0]
    whole, mix = whole_numbers(orthonormal @ own, orthonormal)
    back = np.linalg.solve(orthonormal.astype(float), whole.astype(float) @ mix)
    np.testing.assert_allclose(back.T @ back, np.eye(12), atol=2e-6)
    np.testing.assert_allclose(back, own, atol=3e-4)  # the same modes, in the same order
    np.testing.assert_array_equal(mix, np.triu(mix))
