"""Interpolated internal force: exact when everything is sampled, and what it costs otherwise."""

import numpy as np
import pytest

from palpate.offline.fem.problem import Load
from palpate.offline.methods.deim import Deim, Samples, force_modes, sample
from palpate.offline.methods.galerkin import Galerkin
from palpate.offline.methods.method import Case
from palpate.offline.validate.against_full import held_out_loads


@pytest.fixture(scope="module")
def snapshots(training):
    return training.snapshots.displacements[:, training.model.free]


@pytest.fixture(scope="module")
def modes(training, snapshots, basis):
    return force_modes(training.model, snapshots, basis.shape[1])


@pytest.fixture(scope="module")
def galerkin(training, basis):
    return Galerkin(training.problem, basis)


@pytest.fixture(scope="module")
def complete(training, basis):
    """Return the method with every dof sampled: Galerkin's, with plain Newton."""
    every = np.eye(len(training.model.free))
    samples = Samples(np.arange(len(every)), every)
    return Deim(training.problem, basis, every, samples)


def test_with_every_dof_sampled_it_is_galerkin_s_method(training, complete, galerkin, queries):
    assert len(complete.points) == training.model.weights.size
    for load, _ in queries:
        case = Case.of(training.problem, load)
        found, exact = complete.solve(case), galerkin.solve(case)
        assert found.converged
        off = np.linalg.norm(found.state - exact.state)
        assert off <= 3e-4 * np.linalg.norm(exact.state)


def test_it_interpolates_force_modes_of_displacements_that_invert_no_element(
    training, snapshots, modes
):
    samples, count = sample(modes, 1), modes.shape[1]
    assert len(samples.dofs) == count
    np.testing.assert_allclose(modes @ (samples.fit @ modes[samples.dofs]), modes, atol=1e-10)
    inverted = np.vstack([snapshots, 100 * snapshots[:1]])
    np.testing.assert_array_equal(force_modes(training.model, inverted, count), modes)


def test_beyond_its_range_it_fails_where_galerkin_does_not_and_fits_fail_less(
    training, basis, modes, complete, galerkin
):
    cases = []
    for load in held_out_loads(training.atlas, 40, 1):
        beyond = Load(load.position, load.direction, 4 * load.pressure)
        cases.append(Case.of(training.problem, beyond))
    interpolated, fitted = (
        Deim(training.problem, basis, modes, sample(modes, per_mode)) for per_mode in (1, 3)
    )
    found = [
        sum(method.solve(case).converged for case in cases)
        for method in (interpolated, fitted, complete, galerkin)
    ]
    assert found == sorted(found)
    # plain Newton is not to blame: of a complete sum it loses next to nothing
    assert found[1] < 0.9 * found[2]
    assert found[3] == len(cases)
