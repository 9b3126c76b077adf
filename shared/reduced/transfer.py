"""The past of visco-elastic tissue as a value, and how it follows the tool from model to model.

Theory.  See ``reduced.past`` for what a local model remembers.  What the modes of the next model
cannot hold, such as a dent that the tool has left far behind, is *left behind*: it recovers by
linear visco-elasticity in the modes it was made in, beside the answer of the new model, and costs
nothing until fields are asked for.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba import njit

from palpate.shared.arrays import Array, Field, Numbers
from palpate.shared.reduced.features import estimate_errors
from palpate.shared.reduced.outcome import HISTORY_FEATURES
from palpate.shared.reduced.past import Memory, Remembering, opened, recall_points, remembering

if TYPE_CHECKING:
    from palpate.shared.reduced.workspace import Workspace


FORGOTTEN = 1e-3
"""Size of what is left behind, over the largest, below which it is dropped."""

MOST_MOVES = 12
"""Moves from model to model that are remembered; the slowest recovery takes no longer."""

MOST_PARTS = 4
"""Local models among which a move is shared out."""

_NOTHING = math.log(1e-6)

Parts = list[tuple[int, float, Array]]
"""Local model, weight, and a state in its modes."""


class LeftBehind(NamedTuple):
    """What is left of the past in the modes of a local model that does not answer any more."""

    mean: Array  # (terms, r), as ``past.Memory.mean``, at
    time: float  # s
    size: float  # its norm

    @classmethod
    def of(cls, mean: Array, time: float) -> LeftBehind:
        """Of a mean at a time."""
        return cls(mean, time, math.sqrt(np.vdot(mean, mean)))


class Local(NamedTuple):
    """Past of a local model in use, and what each move of the tool left in the modes of others."""

    record: Array  # (n,) of ``past.Memory``
    moves: tuple[Mapping[int, LeftBehind], ...]


class Past(NamedTuple):
    """All that the tissue remembers; it never changes, so that it is its own snapshot.

    Attributes
    ----------
    time : float, s
        Since rest.
    locals : mapping of int to Local
        Of the local models that answered last.
    main : int
        The local model that had most weight; -1 at rest.
    position : ndarray, shape (3,), mm, or None
        The last contact point.
    features : ndarray, shape (HISTORY_FEATURES,)
        Of the error estimate so far, see ``estimate_history``.
    tip : bool
        Whether it is of the rigid tip; loads do not go on from there.
    dent : ndarray, shape (terms + 1,)
        What the tip's law remembers; see ``mechanics.tip``.
    """

    time: float = 0.0
    locals: Mapping[int, Local] = {}
    main: int = -1
    position: Array | None = None
    features: Array = np.array([1.0, 0.0, _NOTHING, 1.0, 0.0, 0.0, 0.0, 0.0, _NOTHING])
    tip: bool = False
    dent: Array = np.zeros(1)


REST = Past()


@njit(cache=True, error_model="numpy", nogil=True)
def estimate_history(solver, before, way, share, response):
    """Estimated errors of a history; infinite where it has left the trained range.

    The features: 1; the largest share of the limit so far and its log; smallest det F so far; the
    normal (where on the body); the log of 1 + the way over the surface; the log of the largest
    response over the largest share.  ``before`` are those before this step, which goes a ``way``
    (mm) and is answered by a ``response`` (3,), a displacement of the contact or a force.
    """
    outcome, features = solver.outcome, solver.outcome.features[:HISTORY_FEATURES]
    most = max(before[1], share, 1e-6)
    largest = math.exp(before[8]) * max(before[1], 1e-6)
    largest = max(largest, math.sqrt(np.dot(response, response)))
    features[0], features[1], features[2] = 1.0, most, math.log(most)
    features[3] = min(before[3], outcome.min_jacobian[0])
    features[4:7] = outcome.upward
    features[7] = math.log1p(math.expm1(before[7]) + way)
    features[8] = math.log(max(largest / most, 1e-6))
    estimate_errors(solver.coefficients, features, outcome.errors)
    if most > 1.0 + 1e-9:
        outcome.errors[:] = np.inf


@njit(cache=True, error_model="numpy", nogil=True)
def _recall(solver, k, slot):
    recall_points(solver.models.points.of(k), solver.scratch.work, solver.past, slot)


class Transfer:
    """Takes what local models remember from one to the next.

    Parameters
    ----------
    deviatoric : ndarray, shape (p, r, r)
        Deviatoric part of the rest stiffness in the modes.
    pairs : ndarray, shape (n, 2), int32
        Local models whose modes meet, the lower number first.
    matrices : ndarray, shape (n, r, r)
        ``B_k^T K_0 B_l`` of each pair (k, l).
    prony : sequence of (float, float)
    points : int
        Of a local model.
    """

    def __init__(
        self,
        deviatoric: Field,
        pairs: Numbers,
        matrices: Field,
        prony: Sequence[tuple[float, float]],
        points: int,
    ) -> None:
        self._deviatoric = deviatoric
        self._share, self._tau = np.array(prony, dtype=float).T
        self.modes, self._points = deviatoric.shape[1], points
        self._between = {}
        for (k, n), matrix in zip(pairs.tolist(), matrices, strict=True):
            self._between[k, n], self._between[n, k] = matrix, matrix.T
        # the slowest that anything recovers
        self._slowest = self._tau.max() / (1.0 - self._share.sum())
        # of D: Q, and of the terms that each of its eigenvalues couples
        d, self._vectors = np.linalg.eigh(deviatoric.astype(float))
        self._scale = np.sqrt(self._share * self._tau)
        coupling = np.sqrt(self._share / self._tau)
        coupled = d[:, :, None, None] * np.outer(coupling, coupling) - np.diag(1.0 / self._tau)
        self._rates, self._coupled = np.linalg.eigh(coupled)

    def new_past(self) -> Remembering:
        """Room for what the local models of a caller remember."""
        return remembering(self._deviatoric, len(self._tau), self._points)

    def opened(self, record: Array) -> Memory:
        """Views of a record."""
        memory: Memory = opened(record, len(self._tau), self.modes, self._points)
        return memory

    def begin(
        self, workspace: Workspace, answering: list[tuple[int, int, float]], past: Past
    ) -> dict[int, tuple[Mapping[int, LeftBehind], ...]]:
        """Write what the local models that answer remember into a workspace.

        Returns what each move left behind, by the number of the active model.
        """
        moves = {}
        assert isinstance(workspace.past, Remembering)
        records = workspace.past.records
        for slot, k, _ in answering:
            known = past.locals.get(k)
            if known is not None:
                records[slot], moves[k] = known
            else:
                records[slot] = 0.0
                memory = self.opened(records[slot])
                memory.share[-1] = 1.0
                moves[k] = self._follow(memory, past, k)
                if past.main >= 0:
                    _recall(workspace.solver, k, slot)
        return moves

    def _follow(self, new: Memory, past: Past, k: int) -> tuple[Mapping[int, LeftBehind], ...]:
        """Give local model k the path of answers; what its modes do not hold is left behind."""
        if past.main < 0:
            return ()
        source, time = past.locals[past.main], past.time
        old = self.opened(source.record)
        move = {past.main: LeftBehind.of(old.mean.copy(), time)}
        T = self._matrix(k, past.main)
        if T is not None:
            new.knots[:] = old.knots @ T.T
            new.share[:] = old.share
            new.mean[:] = old.mean @ T.T
            self._add(move, k, -new.mean, time)
        moves = [move]
        for earlier in source.moves:
            left = dict(earlier)
            projected = self._projected(k, left, time)
            if projected is not None:
                mean, moved = projected
                new.mean[:] += mean
                # the earlier displacement has changed little over the times of the knots
                new.knots[:] += moved
                self._add(left, k, -mean, time)
            moves.append(left)
        new.q[:] = new.knots[-1]
        return self._largest(moves, time)

    def _projected(
        self, k: int, left: Mapping[int, LeftBehind], time: float
    ) -> tuple[Array, Array] | None:
        """Mean (terms, r) and displacement (r,) of what a move left, in the modes of model k.

        None where one of its parts, which nearly cancel, does not meet these modes.
        """
        mean, moved = np.zeros((len(self._tau), self.modes)), np.zeros(self.modes)
        if len(left) > MOST_PARTS or any(self._matrix(k, n) is None for n in left):
            return None
        for n, part in left.items():
            T, own = self._matrix(k, n), self._recover(n, part, time)
            mean += own @ T.T
            moved += T @ (self._deviatoric[n] @ (self._share @ own))
        return mean, moved

    def displacements(self, time: float, active: Sequence[tuple[int, float, Local]]) -> Parts:
        """States of an answer: of the models that answer, and of what is left behind."""
        found = [(k, weight, local.record[: self.modes]) for k, weight, local in active]
        return found + [
            (k, weight, self._deviatoric[k] @ mean)
            for k, weight, mean in self.lasting(time, active)
        ]

    def knots(self, active: Sequence[tuple[int, float, Local]]) -> Parts:
        """States of the past, each with its share in the stress."""
        memories = [(k, weight, self.opened(local.record)) for k, weight, local in active]
        return [
            (k, weight * float(share), knot)
            for k, weight, memory in memories
            for knot, share in zip(memory.knots, memory.share @ self._share, strict=True)
            if share > 0.0
        ]

    def lasting(self, time: float, active: Sequence[tuple[int, float, Local]]) -> Parts:
        """Means over the past, times shares, of what is left behind."""
        return [
            (n, weight, self._share @ self._recover(n, left, time))
            for _, weight, local in active
            for move in local.moves
            for n, left in move.items()
        ]

    def _matrix(self, k: int, n: int) -> Any:
        """``B_k^T K_0 B_n`` (r, r) if the two meet, else None."""
        return np.eye(self.modes, dtype=np.float32) if k == n else self._between.get((k, n))

    def _add(self, move: dict[int, LeftBehind], k: int, mean: Array, time: float) -> None:
        """Add a mean (terms, r) to what is left behind in model k."""
        if k in move:
            mean = mean + self._recover(k, move[k], time)
        move[k] = LeftBehind.of(mean, time)

    def _largest(
        self, moves: Sequence[dict[int, LeftBehind]], time: float
    ) -> tuple[dict[int, LeftBehind], ...]:
        """What is worth keeping, the latest first."""
        sizes = [
            max(part.size * math.exp((part.time - time) / self._slowest) for part in move.values())
            for move in moves
        ]
        least = FORGOTTEN * max(sizes)
        kept = [move for move, size in zip(moves, sizes, strict=True) if size > least]
        return tuple(kept[:MOST_MOVES])

    def _recover(self, k: int, left: LeftBehind, time: float) -> Array:
        """Mean (terms, r) of what is left behind at a time.

        Without a load ``u = D sum g z`` and ``tau dz/dt = u - z``, which an eigenvector of D of
        eigenvalue d turns into terms coupled by a matrix that ``sqrt(g tau)`` makes symmetric.
        """
        Q, modes = self._vectors[k], self._coupled[k]
        y = np.einsum("rab,ra->rb", modes, (left.mean @ Q).T * self._scale)
        y *= np.exp(self._rates[k] * (time - left.time))
        return np.asarray((np.einsum("rab,rb->ra", modes, y) / self._scale).T @ Q.T)
