"""The relaxer against direct solvers, and where there is nothing to find."""

import numpy as np
import pytest

from palpate.offline.methods.relaxation import Stencil, invert_diagonal, relax

POINTS, FREE = 12, 9
ENDS = np.array([(a, b) for a in range(POINTS) for b in range(a + 1, POINTS) if (a + b) % 3])


def fill(stencil, rng):
    """Give a stencil a random symmetric tangent, definite and of uneven scale; return it dense."""
    dense = np.zeros((POINTS, POINTS, 3, 3))
    for a, b in ENDS:
        block = rng.standard_normal((3, 3))
        dense[a, b], dense[b, a] = block, block.T
    for a in range(POINTS):
        block = rng.standard_normal((3, 3))
        dense[a, a] = 10.0 ** (a % 3) * (30.0 * np.eye(3) + block + block.T)
    pairs = np.array(
        [(a, b) for a in range(POINTS) for b in range(POINTS) if (a + b) % 3 or a == b]
    )
    for (a, b), rank in zip(pairs, stencil.ranks(pairs), strict=True):
        assert (rank < 0) == (max(a, b) >= FREE)
        if rank >= 0:
            assert stencil.neighbours[rank, a] == b
            stencil.tensors[rank, :, a] = dense[a, b].ravel()
    stencil.prepare()
    return np.moveaxis(dense[:FREE, :FREE], 1, 2).reshape(3 * FREE, 3 * FREE)


def dofs(vectors):
    """(3, f) as (3 f,), point by point."""
    return vectors.T.ravel()


class Quartic:
    """Points on springs that stiffen, with a known equilibrium: force ``k u + |u|^2 u``."""

    forcing = 0.1

    def __init__(self, stiffness=1.0):
        self.stiffness = stiffness
        self.stencil = Stencil(np.empty((0, 2), int), 4, 3)

    def internal(self, u, force):
        square = np.sum(u**2, axis=0)
        force[:] = (self.stiffness + square) * u
        return float(np.sum(self.stiffness * square / 2 + square**2 / 4))

    def linearise(self, u):
        for a in range(3):
            v = u[:, a]
            block = (self.stiffness + v @ v) * np.eye(3) + 2 * np.outer(v, v)
            self.stencil.tensors[0, :, a] = block.ravel()
        self.stencil.prepare()


@pytest.fixture
def stencil():
    return Stencil(ENDS, POINTS, FREE)


def test_tangent_times_a_displacement(stencil, rng):
    dense = fill(stencil, rng)
    u, force = rng.standard_normal((3, POINTS)), np.zeros((3, POINTS))
    energy = stencil.apply(u, force)
    free = dofs(u[:, :FREE])
    np.testing.assert_allclose(dofs(force[:, :FREE]), dense @ free, rtol=1e-5, atol=1e-4)
    assert energy == pytest.approx(free @ dense @ free / 2, rel=1e-5)
    assert not force[:, FREE:].any()


def test_conjugate_gradients_against_a_direct_solver(stencil, rng):
    dense = fill(stencil, rng)
    load, found = rng.standard_normal((3, FREE)), np.empty((3, FREE))
    iterations = stencil.solve(load, 1e-5, 1000, found)
    assert 1 < iterations < 3 * FREE
    exact = np.linalg.solve(dense, dofs(load))
    np.testing.assert_allclose(dofs(found), exact, atol=1e-4 * np.linalg.norm(exact))


def test_the_asked_residual_is_left_and_no_less(stencil, rng):
    dense = fill(stencil, rng)
    load, found = rng.standard_normal((3, FREE)), np.empty((3, FREE))
    stencil.solve(load, 0.3, 1000, found)
    left = np.linalg.norm(dense @ dofs(found) - dofs(load)) / np.linalg.norm(load)
    assert 0.003 < left <= 0.3


def test_an_indefinite_tangent_still_gives_descent(stencil, rng):
    fill(stencil, rng)
    stencil.tensors[0] *= -1.0
    stencil.prepare()
    load, found = rng.standard_normal((3, FREE)), np.empty((3, FREE))
    stencil.solve(load, 1e-3, 1000, found)
    assert np.vdot(load, found) > 0


def test_inverse_of_the_diagonal(rng):
    factors = rng.standard_normal((7, 3, 3))
    blocks = factors @ np.swapaxes(factors, 1, 2) + 0.3 * np.eye(3)
    inverse = np.empty((9, 7))
    invert_diagonal(np.ascontiguousarray(blocks.reshape(7, 9).T), inverse)
    np.testing.assert_allclose(inverse.T.reshape(7, 3, 3), np.linalg.inv(blocks), rtol=1e-9)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-8])
def test_a_nonlinear_equilibrium(tolerance):
    load = np.zeros((3, 4))
    load[0, 0], load[1, 1], load[:, 2] = 10.0, 2.0, 30.0 / np.sqrt(3)
    load[2, 3] = 5.0  # on a clamped point
    rest = relax(Quartic(), load, tolerance)
    assert rest.converged
    assert rest.residual <= tolerance
    # u + u^3 = 10, 2, 30
    expected = np.zeros((3, 4))
    expected[0, 0], expected[1, 1], expected[:, 2] = 2.0, 1.0, 3.0 / np.sqrt(3)
    np.testing.assert_allclose(rest.displacement, expected, atol=20 * tolerance)


def test_no_load_no_displacement():
    rest = relax(Quartic(), np.zeros((3, 4)), 1e-3)
    assert rest.converged
    assert rest.iterations == 0
    assert not rest.displacement.any()


@pytest.mark.parametrize("size", [1e200, np.inf, np.nan])
def test_absurd_loads_are_told(size):
    rest = relax(Quartic(), np.full((3, 4), size), 1e-3)
    assert not rest.converged


def test_what_has_no_equilibrium_is_told():
    class Falling(Quartic):
        def internal(self, u, force):
            force[:] = 0.0
            return 0.0

    rest = relax(Falling(), np.ones((3, 4)), 1e-3)
    assert not rest.converged
