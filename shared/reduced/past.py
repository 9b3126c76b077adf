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

import math
from typing import Annotated, NamedTuple

import numpy as np
from numba import njit

from palpate.shared.arrays import Array, Field, Ints
from palpate.shared.compiled import methods, room
from palpate.shared.mechanics import viscosity
from palpate.shared.mechanics.viscosity import Weights
from palpate.shared.reduced.blend import MAX_ACTIVE
from palpate.shared.reduced.points import (
    FAST,
    SYMMETRIC,
    add_past_stress,
    drive_points,
    predict_points,
    superpose,
)

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


@methods()
class Elastic(NamedTuple):
    """Tissue without a past, which does nothing; see ``Remembering``."""

    in_time: bool = False

    def begin_step(self, mu, k, slot):
        """Nothing is known."""

    def end_step(self, points, work, slot, q, again):
        """Nothing is remembered."""

    def last_answer(self, slot, q):
        """The tissue itself is at rest."""
        q[:] = 0.0

    def recall(self, points, work):
        """No stress, no energy."""
        return 0.0

    def soften(self, q, residual):
        """No force, no energy."""
        return 0.0

    def external_force(self, load, external, origin):
        """Write the load (r,); return its size."""
        external[:] = load
        return math.sqrt(np.dot(load, load))

    def follow(self, inverse, q, before, missed, change, start):
        """There is no force to follow."""

    def note_answer(self, q, followed, before, missed):
        """There is nothing to note."""


class Step(NamedTuple):
    """What the past does at the end of a time step, and working memory; see ``problem``."""

    model: Annotated[Ints, "1"]  # that it is known of; -1 before the first of a step
    mean: Annotated[Array, "r"]  # h
    exerted: Annotated[Array, "r"]  # D h
    loss: Annotated[Array, "1"]  # l
    B: Annotated[Field, "6 c"]  # in tiles, what the past drives the points to
    S: Annotated[Field, "6 c"]  # in tiles, kPa, minus the stress of the linear part
    softer: Annotated[Array, "r"]  # D q of the last evaluation


@methods()
class Remembering(NamedTuple):
    """The past of all local models that answer, as a term of the potential of one at a time."""

    deviatoric: Field  # (p, r, r) D
    records: Array  # (MAX_ACTIVE, n) of the models in their slots; advanced by a step
    time: Weights  # of the step
    step: Step
    in_time: bool = True

    def begin_step(self, mu, k, slot):
        """Find what is known of a step of model k before it is solved."""
        memory, time, step = memory_of(self, slot), self.time, self.step
        if step.model[0] == k:
            return
        step.mean[:] = 0.0
        for a in range(len(time.share)):
            kept, old = time.share[a] * time.decay[a], time.share[a] * time.old[a]
            for i in range(len(step.mean)):
                step.mean[i] += kept * memory.mean[a, i] + old * memory.q[i]
        step.loss[0] = predict_points(memory.points, memory.linear, time, mu, step.B, step.S)
        superpose(self.deviatoric[k], step.mean, step.exerted)
        step.model[0] = k

    def end_step(self, points, work, slot, q, again):
        """Take the memory of a slot to the end of a step that ``q`` is the answer of.

        Points that are not evaluated ``again`` keep the strains of the last evaluation.
        """
        memory, time, driven, linear = memory_of(self, slot), self.time, self.step.B, self.step.S
        if again:
            points.strain(q, work.stepped, work.H)
        drive_points(work.H, driven, linear)
        viscosity.advance(driven, time, memory.points)
        viscosity.advance(linear, time, memory.linear)
        for a in range(len(time.share)):
            mean = memory.mean[a]
            for i in range(len(q)):
                mean[i] = time.decay[a] * mean[i] + time.old[a] * memory.q[i] + time.new[a] * q[i]
        memory.q[:] = q
        _add_knot(memory, time)

    def last_answer(self, slot, q):
        """Write the last answer that the tissue itself remembers."""
        q[:] = self.records[slot, : len(q)]

    def recall(self, points, work):
        """Add what is beyond linear visco-elasticity to the stress; return its energy."""
        # the parts of the elastic energy have served; their room is that of the past's
        add_past_stress(
            work.H, points.weights, points.law.mu, work.J, self.step.B, self.step.S,
            self.step.loss[0], work.part, work.P,
        )  # fmt: skip
        return np.dot(points.weights, work.part)

    def soften(self, q, residual):
        """Add linear visco-elasticity to the residual; return its energy."""
        step, energy = self.step, 0.0
        superpose(self.deviatoric[step.model[0]], q, step.softer)
        for i in range(len(q)):
            lost = step.loss[0] * step.softer[i]
            residual[i] -= lost + step.exerted[i]
            energy -= (0.5 * lost + step.exerted[i]) * q[i]
        return energy

    def external_force(self, load, external, origin):
        """Write load and past (r,); return their size.  Secants of another past are of no use."""
        size, exerted = 0.0, self.step.exerted
        for i in range(len(load)):
            external[i] = load[i] + exerted[i]
            size += max(load[i] ** 2, exerted[i] ** 2)
        origin[:] = np.nan
        return math.sqrt(size)

    def follow(self, inverse, q, before, missed, change, start):
        """Move a start by what the force of the past on linear tissue has changed since.

        What the last start ``missed`` is added; it becomes minus the start without that.
        """
        step = self.step
        superpose(self.deviatoric[step.model[0]], q, step.softer)
        for i in range(len(q)):
            change[i] = step.exerted[i] + step.loss[0] * step.softer[i] - before[i]
        superpose(inverse, change, step.softer)
        for i in range(len(q)):
            start[i] += step.softer[i] + missed[i]
            missed[i] -= start[i]

    def note_answer(self, q, followed, before, missed):
        """Write the past's force on linear tissue, and what the start missed if it ``followed``."""
        for i in range(len(before)):
            before[i] = self.step.exerted[i] + self.step.loss[0] * self.step.softer[i]
            missed[i] = missed[i] + q[i] if followed else 0.0


def remembering(deviatoric: Field, terms: int, points: int) -> Remembering:
    """Of local models with so many points each, for a Prony series of so many terms."""
    modes = deviatoric.shape[1]
    return Remembering(
        deviatoric=deviatoric,
        records=np.zeros((MAX_ACTIVE, record_size(terms, modes, points))),
        time=Weights(*np.zeros((4, terms))),
        step=room(Step, r=modes, c=points),
    )


def set_step(past: Remembering, weights: Weights) -> None:
    """Go on by a time step of such weights: what is known of another is not known of that."""
    for own, value in zip(past.time, weights, strict=True):
        own[:] = value
    past.step.model[0] = -1


@njit(cache=True, error_model="numpy", nogil=True)
def memory_of(past, slot):
    """What is remembered in a slot."""
    terms, modes = len(past.time.share), len(past.step.mean)
    return opened(past.records[slot], terms, modes, len(past.step.B) // SYMMETRIC)


# --- the path of answers -------------------------------------------------------------------------


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def _add_knot(memory, time):
    """Append the last answer to the knots; two of the others become one."""
    knots, share = memory.knots, memory.share
    last, terms = KNOTS - 1, share.shape[1]
    for a in range(terms):
        for j in range(KNOTS):
            share[j, a] *= time.decay[a]
        share[last, a] += time.old[a]
    best, least, ratio = 0, np.inf, 1.0
    for j in range(last):
        x = y = distance = 0.0
        for a in range(terms):
            x += time.share[a] * share[j, a]
            y += time.share[a] * share[j + 1, a]
        for i in range(knots.shape[1]):
            distance += (knots[j, i] - knots[j + 1, i]) ** 2
        cost = x * y / (x + y) * distance if x * y > 0.0 else 0.0
        if cost < least:
            best, least, ratio = j, cost, (y / (x + y) if x + y > 0.0 else 1.0)
    for i in range(knots.shape[1]):
        knots[best, i] += ratio * (knots[best + 1, i] - knots[best, i])
    for a in range(terms):
        share[best, a] += share[best + 1, a]
    for j in range(best + 1, last):
        knots[j] = knots[j + 1]
        share[j] = share[j + 1]
    knots[last] = memory.q
    for a in range(terms):
        share[last, a] = time.new[a]


@njit(cache=True, error_model="numpy", nogil=True)
def recall_points(points, work, past, slot):
    """Give the points of the model in a slot the history that its knots and means tell."""
    memory, driven, straight = memory_of(past, slot), past.step.B, past.step.S
    histories, linear, share = memory.points, memory.linear, memory.share
    terms = len(memory.mean)
    histories[:] = np.float32(0.0)
    linear[:] = np.float32(0.0)
    for j in range(KNOTS):
        points.strain(memory.knots[j], work.stepped, work.H)
        drive_points(work.H, driven, straight)
        for a in range(terms):
            histories[a] += np.float32(share[j, a]) * driven
            linear[a] += np.float32(share[j, a]) * straight
    histories[terms], linear[terms] = driven, straight
    for a in range(terms):
        points.strain(memory.mean[a], work.stepped, work.H)
        drive_points(work.H, driven, straight)
        histories[a] -= straight - linear[a]
        linear[a] = straight
