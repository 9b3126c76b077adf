"""Direct solution of the full model's linear systems: sparse, symmetric, positive definite.

A tangent keeps its sparsity through a whole study, so it is ordered and factorised symbolically
once; a Newton step then costs a numeric factorisation and two triangular solves. MKL's PARDISO
does both 3 to 12 times faster than SciPy's SuperLU, which serves where MKL has no wheels.

What installs from wheels, on one core of an AMD EPYC: PARDISO factorises the turbinate's rest
stiffness (hex20, 5 889 unknowns) in 18 ms, CHOLMOD (cvxopt 1.3, GPL) in 27, MUMPS (needs NumPy 1)
in 32 and SuperLU, which cannot keep its analysis, in 69; 39 480 unknowns take 0.5, 1.3, 0.8 and
6.7 s.
"""

import ctypes
import weakref
from functools import cache
from importlib import metadata
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, csr_matrix
from scipy.sparse.linalg import SuperLU, splu

from palpate.shared.arrays import Array, Numbers
from palpate.shared.errors import PalpateError

LARGE = 30_000
"""Unknowns from which on nested dissection always wins."""


class NotPositiveDefinite(PalpateError):
    """Some direction has no stiffness or a negative one."""

    def __init__(self) -> None:
        super().__init__("the stiffness matrix is not positive definite")


class Pardiso:
    """PARDISO of Intel's MKL: supernodal Cholesky factorisation.

    It works on one core, for one thread at a time, and lets other threads run meanwhile.  Minimum
    degree leaves less fill in small systems, nested dissection in large ones (5 889 unknowns: 17
    against 23 ms; 39 480: 1660 against 570 ms), so both are tried on all but ``LARGE`` ones.

    Parameters
    ----------
    pattern : csr_matrix, shape (n, n)
        Both triangles with the whole diagonal, column indices sorted; values do not matter.
    """

    def __init__(self, pattern: csr_matrix) -> None:
        n = pattern.shape[0]
        rows = np.repeat(np.arange(n), np.diff(pattern.indptr))
        self._upper = np.flatnonzero(pattern.indices >= rows)  # all that PARDISO reads
        starts = np.searchsorted(rows[self._upper], np.arange(n + 1)).astype(np.int32)
        columns = pattern.indices[self._upper].astype(np.int32)
        orderings = _PardisoJob.ORDERINGS if n < LARGE else _PardisoJob.ORDERINGS[1:]
        jobs = [_PardisoJob(starts, columns, ordering) for ordering in orderings]
        for job in jobs:
            job(_PardisoJob.ANALYSE)
        self._job, *others = sorted(jobs, key=lambda job: job.fill)
        for job in others:
            job(_PardisoJob.RELEASE)
        weakref.finalize(self, self._job, _PardisoJob.RELEASE)

    def factorise(self, data: Array) -> None:
        """Factorise the matrix of the given values.

        Parameters
        ----------
        data : ndarray, shape (nnz,)
            Values in the order of the pattern's ``data``.

        Raises
        ------
        NotPositiveDefinite
            Then there is no factorisation to solve with.
        """
        np.take(data, self._upper, out=self._job.values)
        # PARDISO takes a NaN for a positive pivot.
        if not np.isfinite(self._job.values).all():
            raise NotPositiveDefinite
        self._job(_PardisoJob.FACTORISE)

    def solve(self, rhs: Array) -> Array:
        """Solve with the last factorisation, for right-hand sides (n,) or (n, k).

        All k together take half the time of one after the other.
        """
        rhs = np.asfortranarray(rhs, dtype=np.float64)
        x = np.empty_like(rhs, order="F")
        self._job(_PardisoJob.SOLVE, rhs, x)
        return x


class _PardisoJob:
    """The arguments of MKL's ``pardiso`` that outlive a call."""

    ANALYSE, FACTORISE, SOLVE, RELEASE = 11, 22, 33, -1
    ORDERINGS = (0, 2)  # minimum degree, nested dissection
    _SYMMETRIC_POSITIVE_DEFINITE = 2
    _NEGATIVE_PIVOT = -4

    def __init__(self, starts: Numbers, columns: Numbers, ordering: int) -> None:
        self.values = np.ones(columns.size)
        self._starts = starts
        self._columns = columns
        self._handle = np.zeros(64, np.int64)
        self._settings = np.zeros(64, np.int32)
        self._settings[0] = 1  # these settings, not the defaults
        self._settings[1] = ordering
        self._settings[17] = -1  # count the entries of the factor
        self._settings[34] = 1  # indices count from zero

    @property
    def fill(self) -> int:
        """Entries of the factor, known after the analysis."""
        return int(self._settings[17])

    def __call__(
        self,
        phase: int,
        rhs: Array | None = None,
        x: Array | None = None,
    ) -> None:
        library = mkl()
        assert library is not None
        columns = 1 if rhs is None or rhs.ndim == 1 else rhs.shape[1]
        error = ctypes.c_int32()
        # one matrix of the pattern and that the first; no ordering of our own; print nothing
        one, silent = _integer(1), _integer(0)
        library.pardiso(
            _pointer(self._handle), one, one, _integer(self._SYMMETRIC_POSITIVE_DEFINITE),
            _integer(phase), _integer(self._starts.size - 1), _pointer(self.values),
            _pointer(self._starts), _pointer(self._columns), None, _integer(columns),
            _pointer(self._settings), silent, _pointer(rhs), _pointer(x), ctypes.byref(error),
        )  # fmt: skip
        if error.value == self._NEGATIVE_PIVOT:
            raise NotPositiveDefinite
        if error.value:
            raise RuntimeError(f"PARDISO failed in phase {phase} with error {error.value}")


def _integer(value: int) -> object:
    return ctypes.byref(ctypes.c_int32(value))


def _pointer(array: NDArray | None) -> ctypes.c_void_p | None:
    return None if array is None else array.ctypes.data_as(ctypes.c_void_p)


@cache
def mkl() -> ctypes.CDLL | None:
    """Load MKL, if its wheel is installed."""
    try:
        files = metadata.files("mkl") or []
    except metadata.PackageNotFoundError:
        return None
    path = next(Path(str(file.locate())) for file in files if "mkl_rt" in file.name)
    library = ctypes.CDLL(str(path))
    # Sequential: training runs one process per core, and OpenMP does not survive a fork.
    library.MKL_Set_Threading_Layer(1)
    return library


class ScipyLU:
    """SuperLU of SciPy, kept to the diagonal as pivots so that it tells a matrix is definite."""

    def __init__(self, pattern: csr_matrix) -> None:
        # A symmetric matrix by rows is the same by columns.
        self._matrix = csc_matrix(
            (np.ones(pattern.nnz), pattern.indices, pattern.indptr), shape=pattern.shape
        )
        self._factors: SuperLU | None = None

    def factorise(self, data: Array) -> None:
        """See ``Pardiso``."""
        self._matrix.data[:] = data
        try:
            self._factors = splu(
                self._matrix,
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError as singular:
            raise NotPositiveDefinite from singular
        on_diagonal = np.array_equal(self._factors.perm_r, self._factors.perm_c)
        if not on_diagonal or not (self._factors.U.diagonal() > 0).all():
            raise NotPositiveDefinite

    def solve(self, rhs: Array) -> Array:
        """See ``Pardiso``."""
        assert self._factors is not None, "factorise first"
        return self._factors.solve(rhs)


SparseSolver = Pardiso | ScipyLU
"""A symmetric matrix of fixed sparsity, factorised anew whenever its values change."""


def sparse_solver(pattern: csr_matrix) -> SparseSolver:
    """Return the fastest solver that this machine has for matrices of a pattern."""
    return Pardiso(pattern) if mkl() else ScipyLU(pattern)
