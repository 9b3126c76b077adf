"""Empirical cubature, few quadrature points that do the work of all, and polynomial fits.

The reduced internal force is a sum over quadrature points ``sum_q w_q G_q^T P_q``.  Points ``c``
and weights ``x_c > 0`` are chosen by non-negative least squares so that ``sum_c x_c G_c^T P_c``
equals the whole sum in training states (An, Kim & James 2008; Hernandez, Caicedo & Ferrer 2017, who
add the volume, which is not done here).  States off equilibrium belong to the training: in
equilibrium the sum is the load, whatever the tissue does, and says little about the points.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr_delete, qr_insert, solve, solve_triangular

from palpate.offline.fem.problem import FullProblem, Load
from palpate.shared.arrays import Array, Field, Ints
from palpate.shared.errors import PalpateError
from palpate.shared.mechanics.tissue import Law
from palpate.shared.reduced.features import RESIDUAL_FEATURES, residual_features
from palpate.shared.reduced.points import LANES, Points, add_past_stress, nonlinear_stress

Past = tuple[Field, Field]

OFF_EQUILIBRIUM = 0.03
"""Size of the random departure from equilibrium, relative to each mode's part in the states."""

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

    From contributions (q, r) of each point to each sum, returns equations A (size, q) and their
    sums over all points (size,): ``|A x|`` is ``|contributions.T x|`` but for what ``size``
    directions of ``x`` do not catch.
    """
    noise = rng.standard_normal((contributions.shape[1], size))
    Q = np.linalg.qr(contributions @ noise.astype(contributions.dtype))[0]
    B = contributions.T @ Q
    A = np.asarray(np.linalg.qr(B, mode="r"), dtype=float) @ Q.T
    return A, A.sum(axis=1)


def drawn(contributions: Field, count: int, rng: np.random.Generator) -> tuple[Ints, Field]:
    """Points to choose from, at random, the likelier the more they do; and contributions to fit.

    Among all points the search below soon takes neighbours that are no better than one of them.
    From few drawn ones it finds points that err by less, in a tenth of the time.

    Returns
    -------
    points : ndarray, shape (<= count,)
        Ascending.
    contributions : ndarray, shape (<= count + 1, r)
        Of these, and in the last row of all others together.
    """
    norms = np.linalg.norm(contributions, axis=1)
    count = min(count, int(np.count_nonzero(norms)))
    points = np.sort(rng.choice(len(norms), count, replace=False, p=norms / norms.sum()))
    rest = np.delete(contributions, points, axis=0).sum(axis=0)
    return points, np.vstack([contributions[points], rest])


def nonnegative(A: NDArray[np.floating[Any]], b: Array, most: int) -> tuple[Ints, Array]:
    """Sparse non-negative solution of ``A x ~ b`` (Lawson & Hanson 1974, stopped early).

    A (r, q) is searched twice as fast in single precision.  Returns the columns with positive
    weight, ascending and at ``most`` so many, and their weights.
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
        Q, R = qr_insert(Q, R, A[:, best].astype(float), len(chosen), which="col")
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


def points_alone(points: Points) -> tuple[Field, tuple[Array, Law]]:
    """Gradients (r, 9 c) of the modes at the points of the first local model, in tiles, 1/mm.

    Also their weights (c,) mm^3 and their law (c,).
    """
    rows = points.gradients[0] * points.steps[0][:, None]
    return rows, (points.weights[0], points.law.at(0))


def by_point(rows: Field) -> Field:
    """Gradients (c, 9, r) of modes, from those in tiles (r, 9 c)."""
    tiles = rows.reshape(len(rows), -1, 9, LANES)
    return np.ascontiguousarray(tiles.transpose(1, 3, 2, 0).reshape(-1, 9, len(rows)))


def point_forces(
    gradients: Field,
    weights: Array,
    law: Law,
    state: Array,
    past: Past | None = None,
) -> Field | None:
    """Nonlinear force of every point (c, r) at a state (r,) of a local model; None if inverted.

    Gradients (c, 9, r) 1/mm of the modes at points, a multiple of ``LANES``, of weights (c,) mm^3.
    ``past`` (6 c,) of tissue that remembers is ``B`` and ``S`` of ``points.predict_points``.
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


def linear_forces(gradients: Field, weights: Array, law: Law, states: Array) -> Field:
    """Linear elasticity's force of every point (c, r k) at states (k, r); see ``point_forces``."""
    H = (gradients @ states.T.astype(np.float32)).reshape(len(gradients), 3, 3, -1)
    P = law.mu[:, None, None, None] * (H + H.swapaxes(1, 2))
    P += (law.lam[:, None] * np.trace(H, axis1=1, axis2=2))[:, None, None] * np.eye(3)[..., None]
    P = (weights[:, None, None, None] * P).reshape(len(gradients), 9, -1).astype(np.float32)
    return (gradients.swapaxes(1, 2) @ P).reshape(len(gradients), -1)


def training_forces(
    gradients: Field,
    law: tuple[Array, Law],
    states: Sequence[tuple[Array, Array, Past | None]],
    count: int,
    responses: int,
    rng: np.random.Generator,
) -> Field:
    """What each point (row) contributes to internal forces in and off equilibrium (columns).

    A local model adds to linear elasticity what the points have beyond it.  Points of great weight
    do that well in training states and are far too stiff for linear elasticity in other directions,
    in which the potential then falls without end.  So the points shall have its stiffness, too.

    Parameters
    ----------
    gradients, law
        See ``point_forces``; weights of the points and their law.
    states : sequence of (ndarray, shape (r,); ndarray, shape (r, k); past)
        Equilibria, what the components of a force there count for, and what the tissue remembers.
    count : int
        Random combinations of the k sums that stand for them; their errors add up alike.
    responses : int
        Random displacements in which the points have to do what linear elasticity does.
    """
    columns = []
    for q, looks, past in states:
        departure = OFF_EQUILIBRIUM * np.abs(q) * rng.standard_normal(len(q))
        for state in (q, q + departure):
            force = point_forces(gradients, *law, state, past)
            if force is not None:
                columns.append(force @ _combined(looks.astype(np.float32), count, rng))
    forces = np.hstack(columns)
    size = np.linalg.norm(forces.sum(axis=0)) / np.sqrt(forces.shape[1])
    small = rng.standard_normal((responses, gradients.shape[2]))
    small *= LINEAR * size / np.linalg.norm(small, axis=1, keepdims=True)
    linear = linear_forces(gradients, *law, small)
    return np.hstack([forces, _combined(linear, 2 * responses, rng)])


def _combined(columns: Field, count: int, rng: np.random.Generator) -> Field:
    """Random combinations (q, count) of columns (q, k), whose squares add up to about the same."""
    noise = rng.standard_normal((columns.shape[1], count), dtype=np.float32)
    return columns @ (noise / np.float32(np.sqrt(count)))


def nonlinear_forces(rows: Field, weights: Array, law: Law, states: Array) -> Array:
    """Nonlinear force of all points together (k, r) at states (k, r); NaN where inverted.

    ``rows`` (r, 9 c) 1/mm are gradients of the modes in tiles.
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
    fitted: Array = solve(normal, A.T @ B, assume_a="pos") / scale[:, None]
    return fitted


def fit_residual(
    problem: FullProblem,
    frame: Array,
    centre: Array,
    modes: Array,
    known: Sequence[tuple[Load, Array, float, Array]],
) -> Array:
    """Fit the log of the relative residual (RESIDUAL_FEATURES,) left in the full model by answers.

    ``known`` are loads, their directions (3,), their shares of the largest, and the answers (r,) in
    ``modes`` (free dofs, r) mm; see ``reduced.features.residual_features`` for frame and centre.
    """
    rows = np.empty((len(known), RESIDUAL_FEATURES))
    for row, (load, direction, share, _) in zip(rows, known, strict=True):
        residual_features(frame, centre, load.position, direction, share, row)
    states = modes @ np.transpose([q for *_, q in known])
    sizes = [np.linalg.norm(q) for *_, q in known]  # the modes are orthonormal in that energy
    residuals = residuals_left(problem, states, [load for load, *_ in known]) / sizes
    kept = (residuals > 0) & np.isfinite(residuals)
    logs = np.log(residuals[kept])
    fitted = damped_fit(rows[kept], (logs - logs.mean())[:, None], RESIDUAL_DAMPING)[:, 0]
    fitted[0] += logs.mean()
    return fitted


def residuals_left(problem: FullProblem, states: Array, loads: Sequence[Load]) -> Array:
    """What states (free dofs, k) mm leave of loads in the full model, (k,).

    As a displacement, in the root of its energy of the rest state; infinite where the state inverts
    an element.
    """
    model = problem.model
    left, sound = np.zeros_like(states), np.ones(len(loads), dtype=bool)
    for i, load in enumerate(loads):
        try:
            left[:, i] = model.internal_free(states[:, i])
        except PalpateError:
            sound[i] = False
        left[: len(model.free), i] -= problem.load_vector(load).ravel()[model.free]
    energies = np.sum(left * model.solve_linear(left), axis=0)
    return np.where(sound, np.sqrt(energies), np.inf)
