"""Empirical cubature: few positive weights that reproduce the sums over all points."""

import numpy as np
import pytest

from palpate.offline.fem.mesh import build_mesh
from palpate.offline.fem.model import FullModel
from palpate.offline.reduce.cubature import (
    STATES,
    compress,
    linear_forces,
    nonlinear_forces,
    nonnegative,
    point_forces,
)
from palpate.offline.scenes import find_scene
from palpate.shared.mechanics.neo_hookean import NeoHookean
from palpate.shared.reduced.points import LANES

POINTS, EQUATIONS = 300, 20


@pytest.fixture
def equations(rng):
    """Return equations (r, q) and their sums: random ones and the volume."""
    A = np.vstack([rng.standard_normal((EQUATIONS - 1, POINTS)), np.ones(POINTS)])
    return A, A.sum(axis=1)


def test_as_many_points_as_equations_reproduce_the_sums(equations):
    A, b = equations
    chosen, weights = nonnegative(A, b, EQUATIONS)
    assert len(chosen) <= EQUATIONS
    np.testing.assert_allclose(A[:, chosen] @ weights, b, atol=1e-8 * np.linalg.norm(b))


@pytest.mark.parametrize("most", [1, 5, 12, EQUATIONS])
def test_weights_are_positive_and_points_few(equations, most):
    A, b = equations
    chosen, weights = nonnegative(A, b, most)
    assert 0 < len(chosen) == len(weights) <= most
    assert (weights > 0).all()
    assert (np.diff(chosen) > 0).all()


def test_more_points_miss_less(equations):
    A, b = equations
    missed = []
    for most in (2, 5, 10, 15, EQUATIONS):
        chosen, weights = nonnegative(A, b, most)
        missed.append(np.linalg.norm(A[:, chosen] @ weights - b))
    assert (np.diff(missed) < 0).all()


def test_no_more_points_than_it_takes(rng):
    A = np.abs(rng.standard_normal((EQUATIONS, POINTS)))
    chosen, weights = nonnegative(A, 3 * A[:, 7], EQUATIONS)
    np.testing.assert_array_equal(chosen, [7])
    np.testing.assert_allclose(weights, 3)


def test_what_solves_the_compressed_equations_solves_all(rng):
    rank = 12
    contributions = rng.standard_normal((POINTS, rank)) @ rng.standard_normal((rank, 500))
    contributions += 1.0
    A, b = compress(contributions, rank + 1, rng)
    assert A.shape == (rank + 1, POINTS)
    chosen, weights = nonnegative(A, b, rank + 1)
    sums = contributions.sum(axis=0)
    found = weights @ contributions[chosen]
    np.testing.assert_allclose(found, sums, atol=1e-7 * np.linalg.norm(sums))


def test_compression_keeps_what_matters(rng):
    contributions = rng.standard_normal((POINTS, 40)) * 0.5 ** np.arange(40)
    A, b = compress(contributions, 15, rng)
    assert A.shape == (15, POINTS)
    np.testing.assert_allclose(b, A.sum(axis=1))
    for x in rng.standard_normal((10, POINTS)):
        exact = np.linalg.norm(contributions.T @ x)
        assert np.linalg.norm(A @ x) == pytest.approx(exact, rel=1e-3)


def test_forces_of_all_points_are_the_sum_of_each_ones(rng):
    count, modes = 2 * LANES, 8
    gradients = rng.standard_normal((count, 9, modes)).astype(np.float32)
    tiles = gradients.reshape(2, LANES, 9, modes)
    rows = np.ascontiguousarray(tiles.transpose(3, 0, 2, 1)).reshape(modes, -1)
    weights, mu, lam = rng.uniform(1.0, 2.0, (3, count))
    law = weights, NeoHookean(mu, lam)
    states = 0.02 * rng.standard_normal((STATES + 3, modes))
    states[1] *= 100.0  # turns points inside out
    together = nonlinear_forces(rows, *law, states)
    for state, force in zip(states, together, strict=True):
        each = point_forces(gradients, *law, state)
        if each is None:
            assert np.isnan(force).all()
        else:
            np.testing.assert_allclose(force, each.sum(axis=0), rtol=1e-4, atol=1e-5)
    assert np.isnan(together).any(axis=1).sum() == 1


def test_linear_forces_are_those_of_the_rest_stiffness(rng):
    scene = find_scene("quick")
    model = FullModel.of(scene, build_mesh(scene))
    u = np.zeros((3 * len(model.mesh.nodes), 5))
    u[model.free] = rng.standard_normal((len(model.free), 5))
    nodal = u.reshape(-1, 3, 5)[model.connectivity]
    gradients = np.einsum("enim,eqnj->eqijm", nodal, model.gradients).reshape(-1, 9, 5)
    law = model.law.at(np.repeat(np.arange(len(model.weights)), model.weights.shape[1]))
    states = rng.standard_normal((3, 5))
    points = linear_forces(gradients.astype(np.float32), model.weights.ravel(), law, states)
    exact = u[model.free].T @ (model.rest_stiffness @ u[model.free]) @ states.T
    np.testing.assert_allclose(points.sum(axis=0).reshape(5, 3), exact, rtol=1e-3)
