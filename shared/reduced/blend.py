"""Which local models answer at a place, and with what weight.

A local model counts while its centre is less than ``blend`` farther away than the nearest one.
Weights are cubic in that excess and fade with zero slope, so that answers are continuous functions
of the place.
"""

import math
from typing import Annotated, NamedTuple

import numpy as np
from numba import njit

from palpate.shared.arrays import Array, Ints

MAX_ACTIVE = 4
"""Local models blended at most; three meet at a corner of a Voronoi cell."""


class Active(NamedTuple):
    """Local models that answer; the slot of a model is that in which a caller remembers it."""

    number: Annotated[Ints, "slots"]  # -1 for a slot not in use
    weight: Annotated[Array, "slots"]
    gradient: Annotated[Array, "slots, 3"]  # 1/mm, of the weights in the place
    distance: Annotated[Array, "p"]  # mm^2, squared, of all centres


@njit(cache=True, error_model="numpy", nogil=True)
def _fading(excess):
    """Weight of a model so many widths of blending farther away than the nearest."""
    return (1.0 - excess) ** 2 * (1.0 + 2.0 * excess)


@njit(cache=True, error_model="numpy", nogil=True)
def activate(centres, blend, x, held, active):
    """Choose the models that answer at ``x``, and their weights.

    Parameters
    ----------
    centres : ndarray, shape (3, p), mm
    blend : float, mm
    x : ndarray, shape (3,), mm
    held : ndarray, shape (MAX_ACTIVE,)
        Models that the caller remembers; they keep their slots.
    active : Active, out
    """
    distance, number, weight = active.distance, active.number, active.weight
    for k in range(len(distance)):
        a, b, c = centres[0, k] - x[0], centres[1, k] - x[1], centres[2, k] - x[2]
        distance[k] = a * a + b * b + c * c
    nearest = math.sqrt(distance.min())
    reach = (nearest + blend) ** 2
    weight[:] = 0.0
    for slot in range(MAX_ACTIVE):
        k = held[slot]
        number[slot] = k if k >= 0 and distance[k] < reach else -1
    for k in range(len(distance)):
        if distance[k] < reach:
            free = -1
            for slot in range(MAX_ACTIVE):
                if number[slot] == k:
                    free = -1
                    break
                if number[slot] < 0 and free < 0:
                    free = slot
            if free >= 0:
                number[free] = k
    for slot in range(MAX_ACTIVE):
        if number[slot] >= 0:
            weight[slot] = _fading((math.sqrt(distance[number[slot]]) - nearest) / blend)
    weight /= weight.sum()


@njit(cache=True, error_model="numpy", nogil=True)
def weight_gradients(centres, blend, x, active):
    """Gradients of the weights in the place ``x``, into ``active.gradient``."""
    distance, gradient, weight = active.distance, active.gradient, active.weight
    gradient[:] = 0.0
    nearest = np.argmin(distance)
    least = math.sqrt(distance[nearest])
    whole = 0.0
    for slot in range(MAX_ACTIVE):
        k = active.number[slot]
        if k >= 0:
            own = math.sqrt(distance[k])
            excess = (own - least) / blend
            whole += _fading(excess)
            for i in range(3):
                away = (x[i] - centres[i, k]) / max(own, 1e-12)
                away -= (x[i] - centres[i, nearest]) / max(least, 1e-12)
                gradient[slot, i] = -6.0 * excess * (1.0 - excess) * away / blend
    for i in range(3):
        total = gradient[:, i].sum()
        for slot in range(MAX_ACTIVE):
            gradient[slot, i] = (gradient[slot, i] - weight[slot] * total) / whole
