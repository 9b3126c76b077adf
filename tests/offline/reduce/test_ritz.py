"""Reduced spaces: path derivatives of the full model, and modes orthonormal in its energy."""

import numpy as np
import pytest

from palpate.offline.reduce.ritz import (
    RITZ_VECTORS,
    SOFT,
    Footprint,
    energy_pod,
    local_modes,
    path_derivatives,
    region,
    ritz_vectors,
    whole_numbers,
)
from palpate.shared.scene import SceneError

PRESSURE = 2.0


@pytest.fixture(scope="module")
def pressed(problem):
    """Return the weights of a footprint beside the middle, what knows its loads, and vectors."""
    point = np.array([4.0, 5.5, 8.0])
    nodal, normal = problem.unit_load(point)
    footprint = Footprint(point, normal, PRESSURE)
    loads = (nodal[:, None, None] * footprint.loads.T).reshape(-1, 3)
    return nodal, footprint, ritz_vectors(problem.model, loads[problem.model.free])


def series(problem, load, count=5, size=0.3):
    """Coefficients of the equilibrium under ``s load`` in powers of s, (powers, free dofs)."""
    s = np.linspace(-1, 1, 2 * count + 1)
    free = problem.model.free
    solved = [problem.model.solve(size * x * load).displacement.ravel()[free] for x in s]
    powers = np.polynomial.polynomial.polyfit(s, np.array(solved), 2 * count)
    return powers / size ** np.arange(2 * count + 1)[:, None]


def test_ritz_vectors_give_the_derivatives_of_the_equilibrium_along_any_load(problem, pressed, rng):
    nodal, footprint, found = pressed
    load = PRESSURE * (-footprint.normal + 0.3 * rng.standard_normal(3))
    exact = series(problem, nodal[:, None] * load)
    parts = footprint.series(found, load[None])
    for part, known, allowed in zip(parts, exact[1:4], (1e-9, 3e-3, 1e-2), strict=True):
        assert np.linalg.norm(part[0] - known) <= allowed * np.linalg.norm(known)


def test_forces_of_ritz_vectors_are_their_stiffness_times_them(problem, pressed):
    nodal, footprint, found = pressed
    free = problem.model.free
    loads = np.einsum("n,di->dni", nodal, footprint.loads).reshape(3, -1)[:, free]
    vectors, forces = path_derivatives(problem.model, np.array([loads, 2 * loads]))
    np.testing.assert_allclose(vectors[0].T, found, atol=1e-12 * np.abs(found).max())
    orders = np.repeat([1, 2, 3], [3, 6, 10])[:, None]
    np.testing.assert_allclose(vectors[1], 2.0**orders * vectors[0], atol=1e-4)
    stiff = problem.model.rest_stiffness @ vectors[1].T
    np.testing.assert_allclose(forces[1].T, stiff, atol=1e-9 * np.abs(stiff).max())


def test_modes_are_orthonormal_in_the_energy_and_span_the_vectors(problem, pressed):
    model, vectors = problem.model, pressed[2]
    modes, energies = energy_pod(model, vectors, RITZ_VECTORS)
    gram = modes.T @ (model.rest_stiffness @ modes)
    np.testing.assert_allclose(gram, np.eye(modes.shape[1]), atol=1e-10)
    assert (np.diff(energies) <= 0).all()
    missed = vectors - modes @ (modes.T @ (model.rest_stiffness @ vectors))
    norms = np.sqrt(np.sum(missed * (model.rest_stiffness @ missed), axis=0))
    assert norms.max() <= 1e-5 * np.sqrt(energies[0])


def test_vectors_with_no_more_to_give_make_fewer_modes(problem, pressed):
    vectors = pressed[2]
    twice = np.hstack([vectors[:, :4], 2 * vectors[:, :4]])
    assert energy_pod(problem.model, twice, 8)[0].shape[1] == 4
    assert energy_pod(problem.model, vectors, 5)[0].shape[1] == 5


def test_more_modes_than_a_region_has_are_refused():
    with pytest.raises(SceneError, match=r"training\.size\.modes: at most 4 here.*not 5"):
        local_modes(np.eye(4), np.zeros((4, 0)), 5)


def test_soft_directions_lead_the_modes_of_a_region(problem, pressed):
    found = region(problem, [pressed[1]], 12)
    states = found.states(problem.model) @ found.orthonormal
    volumes = np.repeat(problem.nodal_volumes, 3)[problem.model.free]
    moved = np.linalg.eigvalsh(states.T @ (volumes[:, None] * states))
    own = states @ found.soft
    np.testing.assert_allclose(
        own.T @ (volumes[:, None] * own), np.diag(moved[: -SOFT - 1 : -1]), rtol=1e-3, atol=1e-6
    )
    modes = local_modes(np.eye(12)[:, 8:], found.soft, 8)
    missed = found.soft - modes @ (modes.T @ found.soft)
    assert np.abs(missed).max() < 1e-6


def test_modes_in_whole_numbers_stay_orthonormal(rng):
    orthonormal = (np.eye(40) + np.triu(0.1 * rng.standard_normal((40, 40)))).astype(np.float32)
    own = np.linalg.qr(rng.standard_normal((40, 12)) * np.geomspace(1.0, 1e-3, 40)[:, None])[0]
    whole, mix = whole_numbers(orthonormal @ own, orthonormal)
    back = np.linalg.solve(orthonormal.astype(float), whole.astype(float) @ mix)
    np.testing.assert_allclose(back.T @ back, np.eye(12), atol=2e-6)
    np.testing.assert_allclose(back, own, atol=3e-4)  # the same modes, in the same order
    np.testing.assert_array_equal(mix, np.triu(mix))
