"""Empirical cubature: few quadrature points of positive weight that do the work of all.

The reduced internal force is a sum over quadrature points ``sum_q w_q G_q^T P_q``.  Points ``c``
and weights ``x_c > 0`` are chosen by non-negative least squares so that ``sum_c x_c G_c^T P_c``
equals the whole sum in training states (An, Kim & James 2008; Hernandez, Caicedo & Ferrer 2017, who
add the volume, which is not done here).  States off equilibrium belong to the training: in
equilibrium the sum is the load, whatever the tissue does, and says little about the points.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr_delete, solve, solve_triangular

from palpate.shared.mechanics.tissue import Law
from palpate.shared.reduced.points import LANES, add_past_stress, nonlinear_stress

Array = NDArray[np.float64]

RESIDUAL_DAMPING = 0.15
"""Of the fit of the residuals' logs: they scatter about any smooth function."""

EXACT = 1e-9
"""Relative residual that needs no further point."""

LINEAR = 0.01
"""How much linear elasticity in a random displacement counts beside a training state."""

STATES = 32
"""States whose stresses are held at once."""


def compress(
    contributions: NDArray[np.floating[Any]], size: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Replace many equations by few of the same least squares (randomised range finder).

    Parameters
    ----------
    contributions : ndarray, shape (q, r)
        Contribution of each point (row) to each sum (column).
    size : int
        Equations to keep.

    Returns
    -------
    A : ndarray, shape (size, q)
        Equations: ``|A x|`` is ``|contributions.T x|`` but for what ``size`` directions of ``x``
        do not catch.
    b : ndarray, shape (size,)
        Their sums over all points.
    """
    noise = rng.standard_normal((contributions.shape[1], size))
    Q = np.linalg.qr(contributions @ noise.astype(contributions.dtype))[0]
    B = contributions.T @ Q
    A = np.asarray(np.linalg.qr(B, mode="r"), dtype=float) @ Q.T
    return A, A.sum(axis=1)


def combined(
    columns: NDArray[np.float32], count: int, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Random combinations (q, count) of columns (q, k), whose squares add up to about the same."""
    noise = rng.standard_normal((columns.shape[1], count), dtype=np.float32)
    return columns @ (noise / np.float32(np.sqrt(count)))


def nonnegative(
    A: NDArray[np.floating[Any]], b: Array, most: int
) -> tuple[NDArray[np.int64], Array]:
    """Sparse non-negative solution of ``A x ~ b`` (Lawson & Hanson 1974, stopped early).

    Parameters
    ----------
    A : ndarray, shape (r, q)
        In single precision it is searched twice as fast.
    b : ndarray, shape (r,)
    most : int
        Largest number of points.

    Returns
    -------
    chosen : ndarray, shape (c,)
        Columns with positive weight, ascending.
    weights : ndarray, shape (c,)
    """
    norms, tiny = np.linalg.norm(A, axis=0), np.finfo(A.dtype).tiny
    usable = norms > 1e-12 * norms.max()
    chosen: list[int] = []
    x = np.empty(0)
    Q, R = np.empty((len(b), 0)), np.empty((0, 0))
    residual = b.copy()
    target = EXACT * np.linalg.norm(b)
    blocked = np.zeros(A.shape[1], dtype=bool)
    while np.linalg.norm(residual) > target and len(chosen) < min(most, len(b)):
        gain = A.T @ residual.astype(A.dtype) / np.maximum(norms, tiny)
        gain[~usable | blocked] = -np.inf
        gain[chosen] = -np.inf
        best = int(np.argmax(gain))
        if not gain[best] > 0:
            break
        Q, R = _append(Q, R, A[:, best].astype(float))
        chosen.append(best)
        x = np.append(x, 0.0)
        while True:
            z = solve_triangular(R, Q.T @ b)
            if (z > 0).all():
                x = z
                blocked[:] = False
                break
            falling = z <= 0
            step = np.min(x[falling] / (x[falling] - z[falling]))
            x = x + step * (z - x)
            dropped = int(np.flatnonzero(falling)[np.argmin(x[falling])])
            if dropped == len(chosen) - 1 and step == 0.0:
                blocked[best] = True  # would leave at once: try another first
            del chosen[dropped]
            x = np.delete(x, dropped)
            Q, R = qr_delete(Q, R, dropped, which="col", check_finite=False)
            Q, R = Q[:, : len(chosen)], R[: len(chosen)]
        residual = b - A[:, chosen] @ x
    order = np.argsort(chosen)
    return np.array(chosen, dtype=np.int64)[order], x[order]


def _append(Q: Array, R: Array, column: Array) -> tuple[Array, Array]:
    """Thin QR with one more column (twice-iterated Gram-Schmidt)."""
    r = Q.T @ column
    rest = column - Q @ r
    again = Q.T @ rest
    rest -= Q @ again
    norm = np.linalg.norm(rest)
    k = R.shape[0]
    grown = np.zeros((k + 1, k + 1))
    grown[:k, :k] = R
    grown[:k, k] = r + again
    grown[k, k] = norm
    return np.column_stack([Q, rest / norm]), grown


def point_forces(
    gradients: NDArray[np.float32],
    weights: Array,
    law: Law,
    state: Array,
    past: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None,
) -> NDArray[np.float32] | None:
    """Nonlinear force of every point (c, r) at a state (r,) of a local model; None if inverted.

    Parameters
    ----------
    gradients : ndarray, shape (c, 9, r), 1/mm
        Of the modes; c is a multiple of ``LANES``.
    weights : ndarray, shape (c,), mm^3
    law : Law
        Of the points (c,).
    state : ndarray, shape (r,)
    past : (ndarray, ndarray), shape (6 c,), optional
        Of tissue that remembers: ``B`` and ``S`` of ``reduced.points.predict_points``.
    """
    H = np.dot(gradients, state.astype(np.float32)).reshape(-1, LANES, 9)
    rows = np.ascontiguousarray(H.transpose(0, 2, 1)).reshape(-1)
    P, (J, part, linear) = np.empty_like(rows), np.empty((3, len(gradients)))
    nonlinear_stress(rows, weights, law, J, part, linear, P)
    if not J.min() > 0.0:
        return None
    if past is not None:
        add_past_stress(rows, weights, law.mu, J, *past, 0.0, part, P)
    points = P.reshape(-1, 9, LANES).transpose(0, 2, 1).reshape(-1, 1, 9)
    return (points @ gradients)[:, 0]


def linear_forces(
    gradients: NDArray[np.float32], weights: Array, law: Law, states: Array
) -> NDArray[np.float32]:
    """Linear elasticity's force of every point (c, r k) at states (k, r); see ``point_forces``."""
    H = (gradients @ states.T.astype(np.float32)).reshape(len(gradients), 3, 3, -1)
    P = law.mu[:, None, None, None] * (H + H.swapaxes(1, 2))
    P += (law.lam[:, None] * np.trace(H, axis1=1, axis2=2))[:, None, None] * np.eye(3)[..., None]
    P = (weights[:, None, None, None] * P).reshape(len(gradients), 9, -1).astype(np.float32)
    return np.asarray((gradients.swapaxes(1, 2) @ P).reshape(len(gradients), -1))


def with_linear_forces(
    forces: NDArray[np.float32],
    gradients: NDArray[np.float32],
    law: tuple[Array, Law],
    count: int,
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """Forces (c, k) of every point, and those of linear elasticity in random states beside them.

    A local model adds to linear elasticity what the points have beyond it.  Points of great weight
    do that well in training states and are far too stiff for linear elasticity in other directions,
    in which the potential then falls without end.  So the points shall have its stiffness, too.

    Parameters
    ----------
    forces : ndarray, shape (c, k)
    gradients : ndarray, shape (c, 9, r), 1/mm
    law : (ndarray, shape (c,), and Law)
        Weights (mm^3) and parameters of the points.
    count : int
        Of random states.
    rng : Generator
    """
    size = np.linalg.norm(forces.sum(axis=0)) / np.sqrt(forces.shape[1])
    states = rng.standard_normal((count, gradients.shape[2]))
    states *= LINEAR * size / np.linalg.norm(states, axis=1, keepdims=True)
    linear = linear_forces(gradients, *law, states)
    return np.hstack([forces, combined(linear, 2 * count, rng)])


def nonlinear_forces(rows: NDArray[np.float32], weights: Array, law: Law, states: Array) -> Array:
    """Nonlinear force of all points together (k, r) at states (k, r); NaN where inverted.

    Parameters
    ----------
    rows : ndarray, shape (r, 9 c), 1/mm
        Gradients of the modes in tiles.
    weights : ndarray, shape (c,), mm^3
    law : Law
        Of the points (c,).
    states : ndarray, shape (k, r)
    """
    forces = np.empty(states.shape)
    J, part, linear = np.empty((3, len(weights)))
    for start in range(0, len(states), STATES):
        some = slice(start, start + STATES)
        H = states[some].astype(np.float32) @ rows
        P = np.empty_like(H)
        for h, p in zip(H, P, strict=True):
            nonlinear_stress(h, weights, law, J, part, linear, p)
            if not J.min() > 0.0:
                p[:] = np.nan
        forces[some] = P @ rows.T
    return forces


def damped_fit(A: Array, B: Array, damping: float = 1e-4) -> Array:
    """Least squares ``A X ~ B``, each column of A scaled to one and damped."""
    scale = np.sqrt(np.mean(A**2, axis=0)) + 1e-300
    A = A / scale
    normal = A.T @ A + damping**2 * len(A) * np.eye(A.shape[1])
    return np.asarray(solve(normal, A.T @ B, assume_a="pos")) / scale[:, None]


def fit_of_residuals(A: Array, residuals: Array) -> Array:
    """Logs of residuals (k,) as sums of features A (k, f), the first of which is one; (f,).

    Residuals that are zero or infinite do not count.
    """
    kept = (residuals > 0) & np.isfinite(residuals)
    logs = np.log(residuals[kept])
    fitted = damped_fit(A[kept], (logs - logs.mean())[:, None], RESIDUAL_DAMPING)[:, 0]
    fitted[0] += logs.mean()
    return fitted
