"""Visco-elastic tissue in time: histories of the atlas, and how they follow the tool.

See ``reduced.press_in_time`` for the theory.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from palpate.shared.compiled import bind
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.viscosity import Weights
from palpate.shared.reduced.press_in_time import (
    Memory,
    new_record,
    new_scratch,
    opened,
    recall_points,
    step_at,
)

Array = NDArray[np.float64]
Field = NDArray[np.float32]

FORGOTTEN = 1e-3
"""Size of what remains, over the largest, below which it is let go."""

MOST_REMAINS = 12
"""Moves from patch to patch that are remembered; the slowest recovery takes no longer."""

MOST_PARTS = 4
"""Patches among which a move is shared out."""

HISTORY_FEATURES = 9
"""Of the error estimate; see ``judge``."""

Answers = list[tuple[int, float, Array]]


@dataclass(frozen=True)
class ViscousModels:
    """What steps in time need beyond elastic local models.

    Attributes
    ----------
    deviatoric : ndarray, shape (p, r, r)
        Deviatoric part of the rest stiffness in the wide modes.
    pairs : ndarray, shape (n, 2), int32
        Patches whose wide spaces meet, the lower number first.
    overlap : ndarray, shape (n, r, r)
        ``B_k^T K_0 B_l`` of each pair (k, l).
    """

    deviatoric: Field
    pairs: NDArray[np.int32]
    overlap: Field


class Remains(NamedTuple):
    """What is left of the past in the space of a patch that does not answer any more."""

    mean: Array  # (terms, r), as Memory.mean, at
    time: float  # s
    size: float  # its norm

    @classmethod
    def of(cls, mean: Array, time: float) -> Remains:
        """What a mean leaves at a time."""
        return cls(mean, time, math.sqrt(np.vdot(mean, mean)))


class Local(NamedTuple):
    """History of a patch in use, and what each move of the tool left in the spaces of others."""

    record: Array  # (n,) of reduced_history.Memory, or touch_history.TipMemory under the tip
    remains: tuple[Mapping[int, Remains], ...]


class History(NamedTuple):
    """All that the tissue remembers; it never changes, so that it is its own snapshot.

    Attributes
    ----------
    time : float, s
    locals : mapping of int to Local
        Of the patches that answered last.
    main : int
        The patch that had most weight; -1 at rest.
    position : ndarray, shape (3,), mm, or None
        The last contact point; where the tip was over the surface last: models about it answer
        when it is off.
    share : float
        Largest pressure or depth so far, over its limit there.
    response : float
        Largest displacement of the contact (mm), or force of the tip (mN), so far.
    travel : float, mm
        Over the surface.
    smallest : float
        Smallest det F so far.
    """

    time: float = 0.0
    locals: Mapping[int, Local] = {}
    main: int = -1
    position: Array | None = None
    share: float = 0.0
    response: float = 0.0
    travel: float = 0.0
    smallest: float = 1.0


@njit(cache=True, error_model="numpy", nogil=True)
def judge(coefficients, normal, share, response, travel, smallest):
    """Features of a history and its estimated errors, ``log error = c . features``.

    The features: 1; the largest share of the limit so far and its log; smallest det F so far; the
    normal (where on the body); the way over the surface; the log of the largest response over the
    largest share.
    """
    features, errors = np.empty(HISTORY_FEATURES), np.empty(len(coefficients))
    share = max(share, 1e-6)
    features[0], features[1], features[2], features[3] = 1.0, share, math.log(share), smallest
    features[4:7] = normal
    features[7], features[8] = math.log1p(travel), math.log(max(response / share, 1e-6))
    for i in range(len(errors)):
        logarithm = 0.0
        for j in range(HISTORY_FEATURES):
            logarithm += coefficients[i, j] * features[j]
        errors[i] = math.exp(logarithm)
    return features, errors


class Moment(NamedTuple):
    """Answer at the end of a time step; see ``shared.model.Solution``.

    Its estimated errors are the largest until now of displacement and stress, relative to the
    largest of these until now.

    Attributes
    ----------
    time : float, s
        Since rest.
    contact_point, normal, direction, force, contact_displacement : ndarray, shape (3,)
    distance, tilt, pressure, radius, pressure_limit : float
    converged : bool
        If not, the history has not gone on.
    iterations : int
    in_range : bool
    out_of_range : tuple of str
    error_displacement, error_von_mises : float
    min_jacobian : float
    features : ndarray, shape (HISTORY_FEATURES,)
        What the error estimate is made of.
    active : tuple of (int, float, Local)
        Patches that answer, with their weights.
    solve_seconds : float
    """

    time: float
    contact_point: Array
    normal: Array
    distance: float
    direction: Array
    tilt: float
    pressure: float
    radius: float
    pressure_limit: float
    force: Array
    contact_displacement: Array
    converged: bool
    iterations: int
    in_range: bool
    out_of_range: tuple[str, ...]
    error_displacement: float
    error_von_mises: float
    min_jacobian: float
    features: Array
    active: tuple[tuple[int, float, Local], ...]
    solve_seconds: float


class Remembered(Protocol):
    """An answer with what its patches remember."""

    @property
    def time(self) -> float:
        """Since rest, s."""

    @property
    def active(self) -> tuple[tuple[int, float, Local], ...]:
        """Patches that answer, with their weights."""


class Pressed(NamedTuple):
    """What pressing some patches for a time step has led to."""

    locals: dict[int, Local]
    displacement: Array  # (3,) mm, of the contact
    area: float  # mm^2, force over pressure
    converged: bool
    iterations: int
    min_jacobian: float


class HistoryTransfer(ABC):
    """Takes what patches remember from one to the next.

    Parameters
    ----------
    models : ViscousModels
    prony : sequence of (float, float)
    points : int
        Of a patch.
    """

    def __init__(
        self, models: ViscousModels, prony: Sequence[tuple[float, float]], points: int
    ) -> None:
        self._models = models
        self._share, self._tau = np.array(prony, dtype=float).T
        self._points = points
        self.modes = models.deviatoric.shape[1]
        self._pair = {(int(k), int(n)): i for i, (k, n) in enumerate(models.pairs)}
        # the slowest that anything recovers
        self._slowest = self._tau.max() / (1.0 - self._share.sum())
        # of D: Q, and of the terms that each of its eigenvalues couples
        d, self._vectors = np.linalg.eigh(models.deviatoric.astype(float))
        self._scale = np.sqrt(self._share * self._tau)
        coupling = np.sqrt(self._share / self._tau)
        coupled = d[:, :, None, None] * np.outer(coupling, coupling) - np.diag(1.0 / self._tau)
        self._rates, self._coupled = np.linalg.eigh(coupled)

    @abstractmethod
    def _new_record(self) -> Array:
        """Of a patch that nothing has happened to."""

    @abstractmethod
    def opened(self, record: Array) -> Any:
        """Memory in a record: a named tuple as ``reduced_history.Memory``."""

    @abstractmethod
    def _take_over(self, k: int, new: Any, old: Any, overlap: Field | None) -> None:
        """Make a memory whose knots, shares and means are known one of patch k.

        ``old`` is of the patch before, ``overlap`` ``B_k^T K_0 B`` with that if the two meet.
        """

    def at_rest(self) -> Local:
        """A patch that nothing has happened to."""
        return Local(self._new_record(), ())

    def follow(self, history: History, k: int) -> Local:
        """Local history of patch k, which does not have one yet.

        What the patch that answered last remembers is projected on the space of patch k, and so is
        what remains of earlier moves; what that space does not hold remains.
        """
        if history.main < 0:
            return self.at_rest()
        source, time = history.locals[history.main], history.time
        record = self._new_record()
        new, old = self.opened(record), self.opened(source.record)
        move = {history.main: Remains.of(old.mean.copy(), time)}
        T = self._overlap(k, history.main)
        if T is not None:
            new.knots[:] = old.knots @ T.T
            new.share[:] = old.share
            new.mean[:] = old.mean @ T.T
            self._add(move, k, -new.mean, time)
        remains = [move]
        for earlier in source.remains:
            left = dict(earlier)
            projected = self._projected(k, left, time)
            if projected is not None:
                mean, moved = projected
                new.mean[:] += mean
                new.knots[:] += moved  # about as far as it was while the knots were made
                self._add(left, k, -mean, time)
            remains.append(left)
        new.wide[:] = new.knots[-1]
        self._take_over(k, new, old, T)
        return Local(record, self._largest(remains, time))

    def _projected(
        self, k: int, left: Mapping[int, Remains], time: float
    ) -> tuple[Array, Array] | None:
        """Mean (terms, r) and displacement (r,) of what a move left, in the space of patch k.

        None where one of its parts, which nearly make up for each other, does not meet that space.
        """
        if len(left) > MOST_PARTS:
            return None
        overlaps = {}
        for n in left:
            T = self._overlap(k, n)
            if T is None:
                return None
            overlaps[n] = T
        mean, moved = np.zeros((len(self._tau), self.modes)), np.zeros(self.modes)
        for n, T in overlaps.items():
            own = self._recover(n, left[n], time)
            mean += own @ T.T
            moved += T @ (self._models.deviatoric[n] @ (self._share @ own))
        return mean, moved

    def answers(self, moment: Remembered) -> Answers:
        """Displacements of a moment: patch, weight and (r,) in the wide space of each part."""
        found = [(k, weight, local.record[: self.modes]) for k, weight, local in moment.active]
        return found + [
            (k, weight, self._models.deviatoric[k] @ mean)
            for k, weight, mean in self.lasting(moment)
        ]

    def knots(self, moment: Remembered) -> Answers:
        """Displacements of the past, likewise, each with its share in the stress."""
        opened = [(k, weight, self.opened(local.record)) for k, weight, local in moment.active]
        return [
            (k, weight * float(share), knot)
            for k, weight, memory in opened
            for knot, share in zip(memory.knots, memory.share @ self._share, strict=True)
            if share > 0.0
        ]

    def lasting(self, moment: Remembered) -> Answers:
        """Means over the past, times shares, of what remains in patches that do not answer."""
        return [
            (n, weight, self._share @ self._recover(n, remains, moment.time))
            for _, weight, local in moment.active
            for left in local.remains
            for n, remains in left.items()
        ]

    def _overlap(self, k: int, n: int) -> Field | None:
        """``B_k^T K_0 B_n`` if the two meet."""
        if k == n:
            return np.eye(self.modes, dtype=np.float32)
        index = self._pair.get((min(k, n), max(k, n)))
        if index is None:
            return None
        overlap = self._models.overlap[index]
        return overlap if k < n else overlap.T

    def _add(self, remains: dict[int, Remains], k: int, mean: Array, time: float) -> None:
        """Add a mean (terms, r) to what remains in patch k."""
        if k in remains:
            mean = mean + self._recover(k, remains[k], time)
        remains[k] = Remains.of(mean, time)

    def _largest(
        self, remains: Sequence[dict[int, Remains]], time: float
    ) -> tuple[dict[int, Remains], ...]:
        """What is worth keeping, the latest first."""
        sizes = [
            max(r.size * math.exp((r.time - time) / self._slowest) for r in left.values())
            for left in remains
        ]
        least = FORGOTTEN * max(sizes)
        kept = [left for left, size in zip(remains, sizes, strict=True) if size > least]
        return tuple(kept[:MOST_REMAINS])

    def _recover(self, k: int, remains: Remains, time: float) -> Array:
        """Mean (terms, r) of what remains at a time.

        Without a load ``u = D sum g z`` and ``tau dz/dt = u - z``, which an eigenvector of D of
        eigenvalue d turns into terms coupled by a matrix that ``sqrt(g tau)`` makes symmetric.
        """
        Q, modes = self._vectors[k], self._coupled[k]
        y = np.einsum("rab,ra->rb", modes, (remains.mean @ Q).T * self._scale)
        y *= np.exp(self._rates[k] * (time - remains.time))
        return np.asarray((np.einsum("rab,rb->ra", modes, y) / self._scale).T @ Q.T)


class TimeStepper(HistoryTransfer):
    """Presses footprints on patches, step by step.

    Parameters
    ----------
    solver : Bound of reduced.press.Solver
    models, prony, points
        See ``HistoryTransfer``.
    """

    def __init__(
        self,
        solver: Any,
        models: ViscousModels,
        prony: Sequence[tuple[float, float]],
        points: int,
    ) -> None:
        super().__init__(models, prony, points)
        self._solver = solver
        self._scratch = bind(new_scratch(self.modes, points))

    def press(
        self,
        history: History,
        active: Sequence[tuple[int, float]],
        pressure: float,
        radius: float,
        weights: Weights,
    ) -> Pressed:
        """Press patches (number and weight) where ``place`` has found, at the end of a step."""
        found: dict[int, Local] = {}
        moved = np.zeros(3)
        iterations, smallest, converged, area = 0, math.inf, True, 0.0
        for k, share in active:
            local = history.locals.get(k) or self.follow(history, k)
            record = local.record.copy()
            status, count, least, area = step_at(
                self._solver, k, pressure, radius, self._models.deviatoric[k], weights,
                record, self._scratch, share, moved,
            )  # fmt: skip
            found[k] = Local(record, local.remains)
            iterations, smallest = max(iterations, count), min(smallest, least)
            converged = converged and status == newton.CONVERGED
        return Pressed(found, moved, area, converged, iterations, smallest)

    def _new_record(self) -> Array:
        return new_record(len(self._tau), self.modes, self._points)

    def opened(self, record: Array) -> Memory:
        """See ``HistoryTransfer``."""
        memory: Memory = opened(record, len(self._tau), self.modes, self._points)
        return memory

    def _take_over(self, k: int, new: Memory, old: Memory, overlap: Field | None) -> None:
        if overlap is not None:
            new.pull[:] = overlap @ old.pull
            rest = np.eye(self.modes)  # what nothing is known of
            new.secants[:] = rest + overlap @ (old.secants - rest) @ overlap.T
        recall_points(self._solver, k, new, self._scratch)
