"""What a local model of visco-elastic tissue remembers, and how a time step changes it.

Theory.  See ``mechanics.viscosity`` for the law and ``reduced.problem`` for the potential of a
step.  Each cubature point keeps its history.  What is linear in the displacement needs no points:
the means ``z_a`` of the answers over the past hold it exactly.

When another local model takes over, the history moves with the tool.  Displacements are projected
on the new modes in the energy of the rest state.  They are few: *knots* of the path of answers,
each with its weight in the mean of every term.  A step adds a knot; where there are too many, two
neighbours become their mean, those for which the sum of squared distances grows least (Ward, J. Am.
Stat. Assoc. 58 (1963) 236-244).  The new points' histories are the weighted sums of what the knots
drive them to, with the linear part corrected to the exact means.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from palpate.shared.compiled import by_type
from palpate.shared.mechanics import viscosity
from palpate.shared.mechanics.viscosity import Weights
from palpate.shared.reduced.blend import MAX_ACTIVE
from palpate.shared.reduced.points import (
    FAST,
    LANES,
    PAST_STATE,
    SYMMETRIC,
    drive_points,
    multiply,
    predict_points,
    superpose,
)
from palpate.shared.reduced.terms import Elastic, Viscous, distance

Array = NDArray[np.float64]
Field = NDArray[np.float32]

KNOTS = 8
"""Of the path of answers; the last is the last answer."""


class Memory(NamedTuple):
    """What one local model remembers: views of a record, which is copied and passed as one."""

    q: Array  # (r,) last answer
    mean: Array  # (terms, r) of the answers over the past
    knots: Array  # (KNOTS, r)
    share: Array  # (KNOTS, terms) weight of a knot in each mean; sums to 1
    points: Field  # (terms + 1, 6 c) histories of the cubature points, in tiles
    linear: Field  # (terms + 1, 6 c) minus their linear part: of 2 dev sym H


class Remembering(NamedTuple):
    """The past of all local models that answer, and working memory of a step."""

    deviatoric: Field  # (p, r, r) D
    records: Array  # (MAX_ACTIVE, n) of the models in their slots; advanced by a step
    time: Weights  # of the step
    mean: Array  # see ``terms.Viscous`` for these
    exerted: Array
    loss: Array
    B: Field
    S: Field
    softer: Array
    state: Field


@njit(cache=True, error_model="numpy", nogil=True)
def _cut(record, start, rows, columns):
    """Part of a record (n,) as (rows, columns), and where it ends."""
    stop = start + rows * columns
    return record[start:stop].reshape(rows, columns), stop


@njit(cache=True, error_model="numpy", nogil=True)
def opened(record, terms, modes, points):
    """Memory in a record (n,), which starts with the last answer."""
    q, at = _cut(record, 0, 1, modes)
    mean, at = _cut(record, at, terms, modes)
    knots, at = _cut(record, at, KNOTS, modes)
    share, at = _cut(record, at, KNOTS, terms)
    histories = record[at:].view(np.float32).reshape(2, terms + 1, SYMMETRIC * points)
    return Memory(q[0], mean, knots, share, histories[0], histories[1])


def record_size(terms: int, modes: int, points: int) -> int:
    """Numbers in a record."""
    return modes * (1 + terms + KNOTS) + KNOTS * terms + (terms + 1) * SYMMETRIC * points


def remembering(deviatoric: Field, terms: int, points: int) -> Remembering:
    """Of local models with so many points each, for a Prony series of so many terms."""
    modes = deviatoric.shape[1]
    return Remembering(
        deviatoric=deviatoric,
        records=np.zeros((MAX_ACTIVE, record_size(terms, modes, points))),
        time=Weights(*np.zeros((4, terms))),
        mean=np.zeros(modes),
        exerted=np.zeros(modes),
        loss=np.zeros(1),
        B=np.zeros(SYMMETRIC * points, np.float32),
        S=np.zeros(SYMMETRIC * points, np.float32),
        softer=np.zeros(modes),
        state=np.zeros(PAST_STATE * LANES, np.float32),
    )


@njit(cache=True, error_model="numpy", nogil=True)
def _memory(past, slot):
    terms, modes, points = len(past.time.share), len(past.mean), len(past.B) // SYMMETRIC
    return opened(past.records[slot], terms, modes, points)


# --- a time step ---------------------------------------------------------------------------------


def begin_step(past, mu, k, slot):
    """Term of the potential at the end of a step: what is known before it is solved."""


def _begin_elastic(past, mu, k, slot):
    return past


def _begin_step(past, mu, k, slot):
    memory, time, mean = _memory(past, slot), past.time, past.mean
    mean[:] = 0.0
    for a in range(len(time.share)):
        kept, old = time.share[a] * time.decay[a], time.share[a] * time.old[a]
        for i in range(len(mean)):
            mean[i] += kept * memory.mean[a, i] + old * memory.q[i]
    past.loss[0] = predict_points(memory.points, memory.linear, time, mu, past.B, past.S)
    multiply(past.deviatoric[k], mean, past.exerted)
    return Viscous(
        past.deviatoric[k], mean, past.exerted, past.loss, past.B, past.S, past.softer, past.state
    )


def end_step(past, points, work, slot, q):
    """Take the memory of a slot to the end of a step that ``q`` is the answer of."""


def _end_elastic(past, points, work, slot, q):
    pass


def _end_step(past, points, work, slot, q):
    memory, time = _memory(past, slot), past.time
    if distance(q, work.latest) > 0.0:  # the last evaluation was of another state
        for i in range(len(q)):
            work.stepped[i] = q[i] * points.steps[i]
        superpose(points.gradients, work.stepped, work.H)
    drive_points(work.H, past.B, past.S)
    viscosity.advance(past.B, time, memory.points)
    viscosity.advance(past.S, time, memory.linear)
    for a in range(len(time.share)):
        mean = memory.mean[a]
        for i in range(len(q)):
            mean[i] = time.decay[a] * mean[i] + time.old[a] * memory.q[i] + time.new[a] * q[i]
    memory.q[:] = q
    _add_knot(memory, time)


def last_answer(past, slot, q):
    """Write the last answer that the tissue itself remembers; zero for one without a past."""


def _no_last_answer(past, slot, q):
    q[:] = 0.0


def _last_answer(past, slot, q):
    q[:] = past.records[slot, : len(q)]


by_type(begin_step, {Elastic: _begin_elastic, Remembering: _begin_step})
by_type(end_step, {Elastic: _end_elastic, Remembering: _end_step})
by_type(last_answer, {Elastic: _no_last_answer, Remembering: _last_answer})


# --- the path of answers -------------------------------------------------------------------------


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def _add_knot(memory, time):
    """Append the last answer to the knots; two of the others become one."""
    knots, share = memory.knots, memory.share
    last = len(knots) - 1
    for a in range(share.shape[1]):
        for j in range(last + 1):
            share[j, a] *= time.decay[a]
        share[last, a] += time.old[a]
    best, least, ratio = 0, np.inf, 1.0
    for j in range(last):
        x, y = 0.0, 0.0
        for a in range(share.shape[1]):
            x += time.share[a] * share[j, a]
            y += time.share[a] * share[j + 1, a]
        apart = 0.0
        for i in range(knots.shape[1]):
            apart += (knots[j, i] - knots[j + 1, i]) ** 2
        cost = x * y / (x + y) * apart if x * y > 0.0 else 0.0
        if cost < least:
            best, least, ratio = j, cost, (y / (x + y) if x + y > 0.0 else 1.0)
    for i in range(knots.shape[1]):
        knots[best, i] += ratio * (knots[best + 1, i] - knots[best, i])
    for a in range(share.shape[1]):
        share[best, a] += share[best + 1, a]
    for j in range(best + 1, last):
        knots[j] = knots[j + 1]
        share[j] = share[j + 1]
    knots[last] = memory.q
    for a in range(share.shape[1]):
        share[last, a] = time.new[a]


@njit(cache=True, error_model="numpy", nogil=True)
def recall_points(points, work, past, slot):
    """Give the points of the model in a slot the history that its knots and means tell."""
    memory = _memory(past, slot)
    histories, linear, mean = memory.points, memory.linear, memory.mean
    knots, share = memory.knots, memory.share
    driven, straight = past.B, past.S
    terms = len(mean)
    histories[:] = np.float32(0.0)
    linear[:] = np.float32(0.0)
    for j in range(len(knots)):
        _drive(points, work, knots[j], driven, straight)
        for a in range(terms):
            histories[a] += np.float32(share[j, a]) * driven
            linear[a] += np.float32(share[j, a]) * straight
    histories[terms] = driven
    linear[terms] = straight
    for a in range(terms):
        _drive(points, work, mean[a], driven, straight)
        histories[a] -= straight - linear[a]
        linear[a] = straight


@njit(cache=True, error_model="numpy", nogil=True)
def _drive(points, work, q, driven, straight):
    """What a state (r,) drives the points to."""
    for i in range(len(q)):
        work.stepped[i] = q[i] * points.steps[i]
    superpose(points.gradients, work.stepped, work.H)
    drive_points(work.H, driven, straight)
