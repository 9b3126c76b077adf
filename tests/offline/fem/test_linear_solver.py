from concurrent.futures import ThreadPoolExecutor

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


LAYOUTS = {
    "by rows": np.ascontiguousarray,
    "by columns": np.asfortranarray,
    "with gaps": lambda rhs: np.repeat(rhs, 2, axis=0)[::2],
}


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
@pytest.mark.parametrize("shape", [(), (1,), (19,)], ids=str)
def test_solves_as_numpy_does_for_new_values_too(solver, matrix, rng, shape, layout):
    rhs = layout(rng.standard_normal((matrix.shape[0], *shape)))
    untouched = rhs.copy()
    for scale in (1.0, 2.0):
        solver.factorise(scale * matrix.data)
        x = solver.solve(rhs)
        assert x.shape == rhs.shape
        exact = np.linalg.solve(scale * matrix.toarray(), rhs)
        np.testing.assert_allclose(x, exact, rtol=1e-11, atol=1e-12)
    np.testing.assert_array_equal(rhs, untouched)


@pytest.mark.parametrize("own", [0.0, np.nan, np.inf, -5.0, -100.0])
def test_tells_what_is_not_positive_definite_and_goes_on(solver, matrix, rng, own):
    """Also indefinite and negative definite: the matrix less a multiple of the identity."""
    shifted = csr_matrix(matrix + own * eye_array(matrix.shape[0], format="csr"))
    with pytest.raises(NotPositiveDefinite):
        solver.factorise(shifted.data if own < 0.0 else np.full_like(matrix.data, own))
    rhs = rng.standard_normal(matrix.shape[0])
    solver.factorise(matrix.data)
    np.testing.assert_allclose(matrix @ solver.solve(rhs), rhs, atol=1e-11)


def test_solvers_of_different_threads_do_not_meet(matrix, rng):
    rhs = rng.standard_normal(matrix.shape[0])

    def work(scale):
        solver = sparse_solver(matrix)
        for _ in range(5):
            solver.factorise(scale * matrix.data)
            np.testing.assert_allclose(scale * (matrix @ solver.solve(rhs)), rhs, atol=1e-8)

    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(work, (1.0, 3.0))) == [None, None]


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
