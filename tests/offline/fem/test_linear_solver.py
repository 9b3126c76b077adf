import threading

import numpy as np
import pytest
from scipy.sparse import csr_matrix, diags_array, eye_array, kron

from palpate.offline.fem.linear_solver import (
    NotPositiveDefinite,
    Pardiso,
    ScipyLU,
    mkl,
    sparse_solver,
)

SOLVERS = [
    pytest.param(
        Pardiso, marks=pytest.mark.skipif(mkl() is None, reason="MKL is not installed here")
    ),
    ScipyLU,
]


def stiffness(n=6):
    """Return a grid of springs, n nodes a side, 3 coupled unknowns a node."""
    line = diags_array([-1.0, 2.1, -1.0], offsets=[-1, 0, 1], shape=(n, n))
    one = eye_array(n)
    grid = kron(kron(line, one), one) + kron(kron(one, line), one) + kron(kron(one, one), line)
    node = np.array([[3.0, 1.0, 0.5], [1.0, 4.0, 0.2], [0.5, 0.2, 5.0]])
    matrix = csr_matrix(kron(grid, node))
    matrix.sort_indices()
    return matrix


@pytest.fixture(scope="module")
def matrix():
    return stiffness()


@pytest.fixture(params=SOLVERS)
def solver(request, matrix):
    return request.param(matrix)


@pytest.mark.parametrize("shape", [(), (1,), (19,)], ids=str)
def test_solves_as_numpy_does(solver, matrix, rng, shape):
    rhs = rng.standard_normal((matrix.shape[0], *shape))
    untouched = rhs.copy()
    solver.factorise(matrix.data)
    x = solver.solve(rhs)
    assert x.shape == rhs.shape
    np.testing.assert_allclose(x, np.linalg.solve(matrix.toarray(), rhs), rtol=1e-11, atol=1e-12)
    np.testing.assert_array_equal(rhs, untouched)


def test_takes_any_memory_layout(solver, matrix, rng):
    solver.factorise(matrix.data)
    rhs = rng.standard_normal((matrix.shape[0], 6))
    strided = rhs[:, ::2]
    np.testing.assert_array_equal(solver.solve(strided), solver.solve(strided.copy(order="F")))


def test_factorises_new_values(solver, matrix, rng):
    rhs = rng.standard_normal(matrix.shape[0])
    solver.factorise(matrix.data)
    first = solver.solve(rhs)
    solver.factorise(2 * matrix.data)
    np.testing.assert_allclose(solver.solve(rhs), first / 2, rtol=1e-12)


@pytest.mark.parametrize("shift", [-5.0, -100.0], ids=["indefinite", "negative definite"])
def test_tells_an_indefinite_matrix(solver, matrix, rng, shift):
    shifted = matrix + shift * eye_array(matrix.shape[0], format="csr")
    with pytest.raises(NotPositiveDefinite):
        solver.factorise(csr_matrix(shifted).data)
    rhs = rng.standard_normal(matrix.shape[0])
    solver.factorise(matrix.data)
    np.testing.assert_allclose(matrix @ solver.solve(rhs), rhs, atol=1e-11)


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0])
def test_refuses_what_is_no_stiffness(solver, matrix, value):
    with pytest.raises(NotPositiveDefinite):
        solver.factorise(np.full_like(matrix.data, value))


def test_solvers_of_different_threads_do_not_meet(matrix, rng):
    rhs = rng.standard_normal(matrix.shape[0])
    wrong = []

    def work(scale):
        solver = sparse_solver(matrix)
        for _ in range(5):
            solver.factorise(scale * matrix.data)
            if not np.allclose(scale * (matrix @ solver.solve(rhs)), rhs):
                wrong.append(scale)

    threads = [threading.Thread(target=work, args=(scale,)) for scale in (1.0, 3.0)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


@pytest.mark.benchmark
@pytest.mark.parametrize("make", SOLVERS)
def test_time_of_a_newton_step(benchmark, make):
    matrix = stiffness(12)
    solver = make(matrix)
    rhs = np.ones(matrix.shape[0])

    def step():
        solver.factorise(matrix.data)
        return solver.solve(rhs)

    x = benchmark(step)
    np.testing.assert_allclose(matrix @ x, rhs, rtol=1e-9)
