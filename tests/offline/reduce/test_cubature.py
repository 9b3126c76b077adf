"""Empirical cubature: few positive weights that reproduce the sums over all points."""

import numpy as np
import pytest

from palpate.offline.reduce.cubature import (
    STATES,
    compress,
    drawn,
    linear_forces,
    nonlinear_forces,
    nonnegative,
    point_forces,
)
from palpate.shared.mechanics.neo_hookean import NeoHookean
from palpate.shared.reduced.points import LANES

POINTS, EQUATIONS = 300, 20


def test_points_are_few_weights_positive_and_more_points_miss_less_down_to_nothing(rng):
    """For random equations and the volume."""
    A = np.vstack([rng.standard_normal((EQUATIONS - 1, POINTS)), np.ones(POINTS)])
    b, missed = A.sum(axis=1), []
    for most in (1, 5, 10, 15, EQUATIONS):
        chosen, weights = nonnegative(A, b, most)
        assert 0 < len(chosen) == len(weights) <= most
        assert (weights > 0).all()
        assert (np.diff(chosen) > 0).all()
        missed.append(np.linalg.norm(A[:, chosen] @ weights - b))
    assert (np.diff(missed) < 0).all()
    assert missed[-1] <= 1e-8 * np.linalg.norm(b)


def test_no_more_points_than_it_takes(rng):
    A = np.abs(rng.standard_normal((EQUATIONS, POINTS)))
    chosen, weights = nonnegative(A, 3 * A[:, 7], EQUATIONS)
    np.testing.assert_array_equal(chosen, [7])
    np.testing.assert_allclose(weights, 3)


def test_compression_keeps_what_matters(rng):
    contributions = rng.standard_normal((POINTS, 40)) * 0.5 ** np.arange(40)
    A, b = compress(contributions, 15, rng)
    assert A.shape == (15, POINTS)
    np.testing.assert_allclose(b, A.sum(axis=1))
    for x in rng.standard_normal((10, POINTS)):
        exact = np.linalg.norm(contributions.T @ x)
        assert np.linalg.norm(A @ x) == pytest.approx(exact, rel=1e-3)


def test_points_are_drawn_by_what_they_do_and_the_others_stay_in_the_sum(rng):
    contributions = rng.standard_normal((POINTS, 40)) * rng.uniform(0.0, 1.0, POINTS)[:, None] ** 3
    contributions[7] = 0.0
    points, rows = drawn(contributions, 60, rng)
    assert len(np.unique(points)) == len(points) == 60
    np.testing.assert_array_equal(rows[:-1], contributions[points])
    np.testing.assert_allclose(rows.sum(axis=0), contributions.sum(axis=0), atol=1e-10)
    norms = np.linalg.norm(contributions, axis=1)
    assert norms[points].mean() > 1.5 * norms.mean()
    everything, rows = drawn(contributions, POINTS, rng)
    np.testing.assert_array_equal(everything, np.delete(np.arange(POINTS), 7))
    np.testing.assert_allclose(rows[-1], 0.0, atol=1e-10)


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


@pytest.mark.parametrize("name", ["problem", "tetrahedra"])
def test_linear_forces_are_those_of_the_rest_stiffness(name, request, rng):
    model = request.getfixturevalue(name).model
    u = np.zeros((3 * len(model.mesh.nodes), 5))
    u[model.free] = rng.standard_normal((len(model.free), 5))
    nodal = u.reshape(-1, 3, 5)[model.connectivity]
    gradients = np.einsum("enim,eqnj->eqijm", nodal, model.gradients).reshape(-1, 9, 5)
    law = model.point_law.at(np.divmod(np.arange(model.weights.size), model.weights.shape[1]))
    states = rng.standard_normal((3, 5))
    points = linear_forces(gradients.astype(np.float32), model.weights.ravel(), law, states)
    exact = u[model.free].T @ (model.rest_stiffness @ u[model.free]) @ states.T
    np.testing.assert_allclose(points.sum(axis=0).reshape(5, 3), exact, rtol=1e-3)
