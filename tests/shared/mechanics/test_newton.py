"""Newton's method on systems small enough to know the answer."""

import math

import numpy as np
import pytest

from palpate.shared.mechanics.newton import CONVERGED, EXHAUSTED, STALLED, newton


class System:
    """A model with a given energy, gradient and (diagonal) Hessian; the rest stiffness is 1."""

    def __init__(self, energy, gradient, hessian, force=0.0):
        self.energy, self.gradient, self.hessian, self.force = energy, gradient, hessian, force
        self.energies, self.norms, self.shifts, self.visited = [], [], [], []

    def potential(self, u, residual):
        residual[:] = self.gradient(u) - self.force
        self.visited.append(u.copy())
        return float(np.sum(self.energy(u) - self.force * u)), 1.0

    def factorise(self, u, shift):
        self.diagonal = self.hessian(u) + shift
        self.energies.append(float(np.sum(self.energy(u) - self.force * u)))
        self.norms.append(float(np.linalg.norm(self.gradient(u) - self.force)))
        self.shifts.append(shift)
        return bool((self.diagonal > 0).all())

    def correct(self, residual, step):
        step[:] = -residual / self.diagonal


def solve(system, start, target=1e-12, reuse=0.0, max_iterations=50, factorised=False, **options):
    u = np.array(start, dtype=float)
    work = np.empty((4, len(u)))
    status, iterations, _, smallest = newton(
        system, u, work, target, reuse, max_iterations, factorised, **options
    )
    return u, status, iterations, float(np.linalg.norm(work[0])), smallest


def stiffening(force):
    return System(lambda u: u**2 / 2 + u**4 / 4, lambda u: u + u**3, lambda u: 1 + 3 * u**2, force)


def test_a_linear_system_takes_one_step():
    system = System(lambda u: u**2, lambda u: 2 * u, lambda u: np.full_like(u, 2.0), force=3.0)
    u, status, iterations, norm, smallest = solve(system, [0.0, 7.0])
    assert (status, iterations, norm, smallest) == (CONVERGED, 1, 0.0, 1.0)
    assert u == pytest.approx([1.5, 1.5])


def test_at_rest_nothing_is_done():
    system = stiffening(0.0)
    assert solve(system, [0.0])[1:3] == (CONVERGED, 0)
    assert not system.shifts


def test_the_tail_is_quadratic():
    system = stiffening(np.array([2.0, 10.0, 30.0]))
    u, status, _, norm, _ = solve(system, [0.0, 0.0, 0.0], target=1e-11)
    assert status == CONVERGED
    np.testing.assert_allclose(u + u**3, system.force, rtol=1e-12)
    norms = np.array([*system.norms, norm])
    tail = norms[(norms < 1.0) & (norms > 1e-8)]
    assert len(tail) >= 2
    following = norms[np.searchsorted(-norms, -tail) + 1]
    assert (following <= 2.0 * tail**2 + 1e-13).all()


def test_an_old_tangent_serves_while_it_contracts():
    start, force = [0.9], np.array([1.0])
    fresh, thrifty = stiffening(force), stiffening(force)
    u, *_ = solve(fresh, start)
    v, status, iterations, _, _ = solve(thrifty, start, reuse=0.5)
    assert status == CONVERGED
    assert v == pytest.approx(u, abs=1e-11)
    assert len(thrifty.shifts) < len(fresh.shifts)
    assert iterations > len(thrifty.shifts)


def test_a_tangent_left_from_before_serves_first():
    system = stiffening(np.array([1.0]))
    solve(system, [0.0])
    system.shifts.clear()
    system.force = system.force + 0.01
    u, status, *_ = solve(system, [0.68], reuse=0.5, factorised=True)
    assert status == CONVERGED
    assert not system.shifts
    assert u + u**3 == pytest.approx(system.force)


def test_line_search_tames_an_overshooting_step():
    # Newton's method proper diverges from |u| > 1: the step is -u (1 + u^2).
    system = System(
        lambda u: np.sqrt(1 + u**2), lambda u: u / np.sqrt(1 + u**2), lambda u: (1 + u**2) ** -1.5
    )
    u, status, iterations, _, _ = solve(system, [4.0])
    assert status == CONVERGED
    assert abs(u[0]) < 1e-11
    assert len(system.visited) > iterations + 1


def test_every_accepted_step_lowers_the_potential():
    system = System(lambda u: np.cos(u) + u**2 / 20, lambda u: u / 10 - np.sin(u),
                    lambda u: 0.1 - np.cos(u))  # fmt: skip
    assert solve(system, [0.3, 5.0, 7.9])[1] == CONVERGED
    assert (np.diff(system.energies) <= 0).all()


def test_an_indefinite_start_is_shifted_downhill():
    # Double well: at the start, a maximum of the potential, the tangent is negative.
    system = System(
        lambda u: u**4 / 4 - u**2 / 2, lambda u: u**3 - u, lambda u: 3 * u**2 - 1, force=0.01
    )
    u, status, _, _, _ = solve(system, [0.0])
    assert status == CONVERGED
    assert u[0] == pytest.approx(1.005, abs=1e-3)
    assert max(system.shifts) > 1.0
    assert system.shifts[-1] == 0.0
    assert solve(system, [0.0], largest_shift=0.5)[1:3] == (STALLED, 0)


def test_shifts_go_on_from_the_last():
    """A long way through an indefinite region costs about one factorisation a step."""
    system = System(
        lambda u: 40.0 * np.cos(u / 20), lambda u: -2.0 * np.sin(u / 20),
        lambda u: -0.1 * np.cos(u / 20), force=0.05,
    )  # fmt: skip
    u, status, iterations, _, _ = solve(system, [0.0])
    assert status == CONVERGED
    assert np.sin(u[0] / 20) == pytest.approx(-0.025)
    indefinite = [shift for shift in system.shifts if shift > 0.0]
    assert len(indefinite) >= 4
    assert len(system.shifts) < 2 * iterations
    assert system.shifts[-1] == 0.0


FAILURES = {
    "no minimum": (lambda u: -u, lambda u: -np.ones_like(u), np.zeros_like, (EXHAUSTED, 7)),
    "no descent": (
        lambda u: np.where(u == 2.0, 1.0, math.inf), lambda u: 3 * u, np.ones_like, (STALLED, 1)
    ),
    "no definite tangent": (
        lambda u: u, np.ones_like, lambda u: np.full_like(u, -np.inf), (STALLED, 0)
    ),
}  # fmt: skip


@pytest.mark.parametrize(("energy", "gradient", "hessian", "told"), FAILURES.values(), ids=FAILURES)
def test_what_finds_no_equilibrium_is_told(energy, gradient, hessian, told):
    u, *found = solve(System(energy, gradient, hessian), [2.0], max_iterations=7)[:3]
    assert tuple(found) == told
    assert (u[0] == 2.0) == (told[0] == STALLED)  # the state is kept


def test_an_inverted_start_is_no_equilibrium():
    system = stiffening(0.0)
    # as the models do: no residual is written beyond an inverted element
    system.potential = lambda u, residual: (math.inf, -1.0)
    u, work = np.array([2.0]), np.zeros((4, 1))
    assert newton(system, u, work, 1e-12, 0.0, 50, False)[:2] == (STALLED, 0)
    assert u == [2.0]


@pytest.mark.parametrize("force", [math.nan, math.inf])
def test_a_meaningless_load_is_not_called_an_equilibrium(force):
    with np.errstate(all="ignore"):
        assert solve(stiffening(np.array([force])), [0.0])[1] != CONVERGED
