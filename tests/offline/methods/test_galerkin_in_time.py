"""Galerkin models in time: the full model's histories in the span of a basis."""

import numpy as np
import pytest

from palpate.offline.fem.problem import Load
from palpate.offline.methods.full import Full
from palpate.offline.methods.galerkin import Galerkin
from palpate.offline.methods.method import Case
from palpate.offline.methods.spaces import modal, pod

STEPS = ((0.5, 0.02), (1.0, 0.05), (1.0, 0.3), (1.0, 2.0), (0.2, 0.01), (0.0, 0.0), (0.0, 0.5))
"""Shares of a pressure at the ends of time steps (s)."""


@pytest.fixture(scope="module")
def cases(visco_problem):
    down = np.array([0.3, 0.0, -1.0]) / np.hypot(0.3, 1.0)
    at = np.array([4.0, 5.5, 8.0])
    return [Case.of(visco_problem, Load(at, down, 1.5 * share)) for share, _ in STEPS]


def states(method, cases):
    found, state = [], method.at_rest()
    for case, (_, dt) in zip(cases, STEPS, strict=True):
        answer = method.step(state, case, dt)
        assert answer.converged
        state = answer.state
        found.append(state)
    return found


@pytest.fixture(scope="module")
def exact(visco_problem, cases):
    return states(Full(visco_problem), cases)


@pytest.fixture(scope="module")
def in_its_own_modes(visco_problem, exact):
    known = np.array([state.displacement.ravel() for state in exact])
    return Galerkin(visco_problem, pod(visco_problem.model, known, 8), in_time=True, accurate=1e-6)


def test_a_basis_that_holds_the_history_finds_it(visco_problem, cases, exact, in_its_own_modes):
    method, full = in_its_own_modes, Full(visco_problem)
    found = states(method, cases)
    for name, off in (("displacement", 1e-4), ("von_mises", 1e-3)):
        ours, true = (
            [getattr(m, name)(x) for x in own] for m, own in ((method, found), (full, exact))
        )
        np.testing.assert_allclose(ours, true, atol=off * np.abs(true[3]).max())


def test_few_modes_are_stiffer_and_a_step_changes_no_state(visco_problem, cases, exact):
    method = Galerkin(visco_problem, modal(visco_problem.model, 6), in_time=True)
    first = method.at_rest()
    second = method.step(first, cases[0], 0.02).state
    assert not method.opened(first).q.any()
    assert method.opened(second).q.any()
    held, true = states(method, cases)[3], exact[3]
    work = [np.vdot(u[cases[3].nodes], cases[3].forces) for u in
            (method.displacement(held), true.displacement)]  # fmt: skip
    assert 0.0 < work[0] < work[1]


def test_time_does_not_go_back(visco_problem, cases, in_its_own_modes):
    for method in (Full(visco_problem), in_its_own_modes):
        with pytest.raises(ValueError, match="dt"):
            method.step(method.at_rest(), cases[0], -0.1)
