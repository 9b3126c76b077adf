"""3x3 tensors in compiled code: tuples of nine numbers, so that loops over them become vector code.

``T[3 * i + j]`` is row i, column j.  A symmetric tensor can be *packed* into six numbers: 00, 11,
22, 12, 02, 01.  An array holds many tensors component by component: component k of the tensor at
``at`` is ``values[at + k * stride]``, so that a loop over ``at`` reads neighbouring numbers.

All functions are inlined where they are called and keep the precision of their arguments.
"""

import numpy as np
from numba import njit, types
from numba.extending import overload

SYMMETRIC = 6
"""Components of a symmetric tensor."""

FAST = {"contract", "reassoc", "nsz"}
"""What the compiler may do to sums in loops over many points."""

inline = njit(cache=True, error_model="numpy", inline="always")


def constant(value, like):
    """``value`` in the precision of the number ``like``."""
    return type(like)(value)


@overload(constant, inline="always")
def _constant(value, like):
    if like == types.float32:
        return lambda value, like: np.float32(value)
    return lambda value, like: float(value)


@inline
def load(values, at, stride):
    """Tensor of an array."""
    return (
        values[at], values[at + stride], values[at + 2 * stride],
        values[at + 3 * stride], values[at + 4 * stride], values[at + 5 * stride],
        values[at + 6 * stride], values[at + 7 * stride], values[at + 8 * stride],
    )  # fmt: skip


@inline
def store(T, values, at, stride):
    """Write a tensor into an array."""
    values[at], values[at + stride], values[at + 2 * stride] = T[0], T[1], T[2]
    values[at + 3 * stride], values[at + 4 * stride], values[at + 5 * stride] = T[3], T[4], T[5]
    values[at + 6 * stride], values[at + 7 * stride], values[at + 8 * stride] = T[6], T[7], T[8]


@inline
def load_packed(values, at, stride):
    """Packed symmetric tensor of an array."""
    return (
        values[at], values[at + stride], values[at + 2 * stride],
        values[at + 3 * stride], values[at + 4 * stride], values[at + 5 * stride],
    )  # fmt: skip


@inline
def store_packed(S, values, at, stride):
    """Write a packed symmetric tensor into an array."""
    values[at], values[at + stride], values[at + 2 * stride] = S[0], S[1], S[2]
    values[at + 3 * stride], values[at + 4 * stride], values[at + 5 * stride] = S[3], S[4], S[5]


@inline
def add_to_packed(a, S, values, at, stride):
    """Add ``a S``, S packed, to a tensor in an array."""
    values[at] += a * S[0]
    values[at + stride] += a * S[1]
    values[at + 2 * stride] += a * S[2]
    values[at + 3 * stride] += a * S[3]
    values[at + 4 * stride] += a * S[4]
    values[at + 5 * stride] += a * S[5]


@inline
def packed(T):
    """Six numbers of a symmetric tensor."""
    return (T[0], T[4], T[8], T[5], T[2], T[1])


@inline
def unpacked(S):
    """All nine numbers of a packed symmetric tensor."""
    return (S[0], S[5], S[4], S[5], S[1], S[3], S[4], S[3], S[2])


@inline
def add(A, B):
    """``A + B``."""
    return (
        A[0] + B[0], A[1] + B[1], A[2] + B[2],
        A[3] + B[3], A[4] + B[4], A[5] + B[5],
        A[6] + B[6], A[7] + B[7], A[8] + B[8],
    )  # fmt: skip


@inline
def subtract(A, B):
    """``A - B``."""
    return (
        A[0] - B[0], A[1] - B[1], A[2] - B[2],
        A[3] - B[3], A[4] - B[4], A[5] - B[5],
        A[6] - B[6], A[7] - B[7], A[8] - B[8],
    )  # fmt: skip


@inline
def scale(a, A):
    """``a A``."""
    return (
        a * A[0], a * A[1], a * A[2],
        a * A[3], a * A[4], a * A[5],
        a * A[6], a * A[7], a * A[8],
    )  # fmt: skip


@inline
def combine(a, A, b, B):
    """``a A + b B``."""
    return (
        a * A[0] + b * B[0], a * A[1] + b * B[1], a * A[2] + b * B[2],
        a * A[3] + b * B[3], a * A[4] + b * B[4], a * A[5] + b * B[5],
        a * A[6] + b * B[6], a * A[7] + b * B[7], a * A[8] + b * B[8],
    )  # fmt: skip


@inline
def add_identity(A, a):
    """``A + a I``."""
    return (A[0] + a, A[1], A[2], A[3], A[4] + a, A[5], A[6], A[7], A[8] + a)


@inline
def transposed(A):
    """``A^T``."""
    return (A[0], A[3], A[6], A[1], A[4], A[7], A[2], A[5], A[8])


@inline
def dot(A, B):
    """``A B``."""
    return (
        *_row_times(A[0], A[1], A[2], B),
        *_row_times(A[3], A[4], A[5], B),
        *_row_times(A[6], A[7], A[8], B),
    )


@inline
def _row_times(a, b, c, B):
    return (
        a * B[0] + b * B[3] + c * B[6],
        a * B[1] + b * B[4] + c * B[7],
        a * B[2] + b * B[5] + c * B[8],
    )


@inline
def ddot(A, B):
    """``A : B``."""
    return (
        A[0] * B[0] + A[1] * B[1] + A[2] * B[2]
        + A[3] * B[3] + A[4] * B[4] + A[5] * B[5]
        + A[6] * B[6] + A[7] * B[7] + A[8] * B[8]
    )  # fmt: skip


@inline
def gram(A):
    """``A^T A``, packed."""
    return (
        A[0] * A[0] + A[3] * A[3] + A[6] * A[6],
        A[1] * A[1] + A[4] * A[4] + A[7] * A[7],
        A[2] * A[2] + A[5] * A[5] + A[8] * A[8],
        A[1] * A[2] + A[4] * A[5] + A[7] * A[8],
        A[0] * A[2] + A[3] * A[5] + A[6] * A[8],
        A[0] * A[1] + A[3] * A[4] + A[6] * A[7],
    )


@inline
def trace(A):
    """Sum of the diagonal."""
    return A[0] + A[4] + A[8]


@inline
def cofactor(A):
    """``det A A^-T``."""
    return _minors(A, A)


@inline
def _minors(A, B):
    return (
        A[4] * B[8] - A[5] * B[7], A[5] * B[6] - A[3] * B[8], A[3] * B[7] - A[4] * B[6],
        A[7] * B[2] - A[8] * B[1], A[8] * B[0] - A[6] * B[2], A[6] * B[1] - A[7] * B[0],
        A[1] * B[5] - A[2] * B[4], A[2] * B[3] - A[0] * B[5], A[0] * B[4] - A[1] * B[3],
    )  # fmt: skip


@inline
def det(A, cofactors):
    """Determinant of A, of which the cofactors are known."""
    return A[0] * cofactors[0] + A[1] * cofactors[1] + A[2] * cofactors[2]


@inline
def cross(A, B):
    """Tensor cross product ``A x B``: the derivative of ``cofactor`` at A along B."""
    return add(_minors(A, B), _minors(B, A))


@inline
def twice_deviator(A, third):
    """``2 dev sym A``, where ``third`` is a third of the trace."""
    two = constant(2.0, third)
    a, b, c = A[1] + A[3], A[2] + A[6], A[5] + A[7]
    return (
        two * (A[0] - third), a, b,
        a, two * (A[4] - third), c,
        b, c, two * (A[8] - third),
    )  # fmt: skip


@inline
def unit(k):
    """Tensor whose component k is 1, all others 0."""
    return (
        1.0 * (k == 0), 1.0 * (k == 1), 1.0 * (k == 2),
        1.0 * (k == 3), 1.0 * (k == 4), 1.0 * (k == 5),
        1.0 * (k == 6), 1.0 * (k == 7), 1.0 * (k == 8),
    )  # fmt: skip


@inline
def isochoric(J):
    """``J^(-2/3)`` of a positive determinant, to double precision in vector code.

    Newton's method for the inverse cube root, from a guess within 4 % of it: read as an integer, a
    number in single precision is nearly its logarithm, which is divided by -3.
    """
    root = np.float64(np.int32(1419967116 - np.float32(J).view(np.int32) // 3).view(np.float32))
    for _ in range(4):
        root *= (4.0 - J * root * root * root) / 3.0
    return root * root
