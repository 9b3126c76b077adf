"""How gradients at 2x2x2 points of hexahedra are carried to the nodes of a lattice of them.

Along a line through elements, a field is known at two points of each.  At a corner its value is
that of the quadratic through the four points of the two elements nearest to it, in the
least-squares sense: between two elements both, at the boundary the last two.  In three dimensions
these are products, over the points of eight elements.  At midsides a cubic runs through the four
nearest corners of the line.

So nodal values are right to third order of the size of elements, where values carried linearly in
each element are right to second, at the boundary most of all.  The points are those of the patches
of Zienkiewicz & Zhu, The superconvergent patch recovery, Int. J. Numer. Meth. Engng 33 (1992).
"""

import itertools
from typing import NamedTuple

import numpy as np

from palpate.shared.arrays import Array, Flags, Ints, Numbers
from palpate.shared.geometry.elements import HEX_CORNERS, HEX_EDGES

NEAR, FAR = (1 - 3**-0.5) / 2, (1 + 3**-0.5) / 2
"""Of an element's points from one of its ends, over its length."""

SIDES = (HEX_CORNERS > 0).astype(int)
OPPOSITE = np.array(
    [[np.flatnonzero((s ^ np.eye(3, dtype=int)[d] == SIDES).all(axis=1))[0] for d in range(3)]
     for s in SIDES]
)  # fmt: skip
"""Corners (8, 3) that lie opposite along each axis."""

POINT_SIDES = np.array(list(itertools.product((0, 1), repeat=3)))
"""Sides (8, 3) on which the points of ``elements.gauss(2, 3)`` lie."""


class Patches(NamedTuple):
    """What carries values at the points of hexahedra to the nodes."""

    corners: Ints  # (k,) nodes that are corners of elements
    elements: Ints  # (k, 8) around each
    weights: Array  # (k, 8, 8) of their points
    midsides: Ints  # (m,) nodes whose values are made of corners'
    lines: Ints  # (m, 4) those
    shares: Array  # (m, 4)


def patches(nodes: Array, elements: Numbers) -> Patches:
    """How values are carried in elements (e, 8 or 20) that all have the axes of one lattice."""
    next_to = neighbours(elements[:, :8])
    at = nodes[elements[:, :8]]
    lengths = np.linalg.norm(at[:, OPPOSITE] - at[:, :, None], axis=3)  # (e, 8, 3)
    corners, first = np.unique(elements[:, :8].astype(int), return_index=True)
    own, corner = np.divmod(first, 8)
    around, weights = own[:, None], np.ones((len(own), 1, 1))
    for d in range(3):
        side = SIDES[corner, d]
        beyond, inward = next_to[own, d, side], next_to[own, d, 1 - side]
        inside, alone = beyond >= 0, (beyond < 0) & (inward < 0)
        towards = np.where(inside, side, 1 - side)
        further = next_to[around, d, towards[:, None]]
        end = np.where(inside, OPPOSITE[corner, d], corner)
        other = lengths[np.where(inside, beyond, inward), end, d] / lengths[own, corner, d]
        one = _along(other, inside, alone)  # (k, 2 elements, nearer and farther point)
        near_side = np.stack([side, np.where(inside, 1 - side, side)], axis=1)
        nearer = near_side[:, :, None] == POINT_SIDES[:, d]
        share = np.where(nearer, one[:, :, :1], one[:, :, 1:])  # (k, 2, 8)
        around = np.concatenate([around, np.where(alone[:, None], around, further)], axis=1)
        weights = np.concatenate([weights * share[:, :1], weights * share[:, 1:]], axis=1)
    return Patches(corners, around, weights, *_midsides(lengths, elements, next_to))


def neighbours(corners: Numbers) -> Ints:
    """Elements (e, 3, 2) beyond the low and the high side of each axis, -1 where there is none."""
    faces = np.stack([[SIDES[:, d] == end for end in (0, 1)] for d in range(3)])
    keys = np.sort(np.stack([[corners[:, face] for face in own] for own in faces]), axis=-1)
    _, number = np.unique(keys.reshape(-1, 4), axis=0, return_inverse=True)
    number = number.reshape(3, 2, -1)
    found = np.full((2, number.max() + 1), -1)
    for end in (0, 1):
        found[end, number[:, end]] = np.arange(len(corners))
    return np.stack([found[1 - end, number[:, end]].T for end in (0, 1)], axis=2)


def _along(other: Array, inside: Flags, alone: Flags) -> Array:
    """Weights (k, 2, 2) along a line of an element's points and of the other's in a corner's value.

    ``other`` is the other's length over that of the one which the corner ends; it lies beyond the
    corner where that is inside, else next to the one.
    """
    sign, start = np.where(inside, -1.0, 1.0), np.where(inside, 0.0, 1.0)
    ends = np.ones_like(other)
    at = [NEAR * ends, FAR * ends, start + sign * NEAR * other, start + sign * FAR * other]
    powers = np.stack(at, axis=1)[..., None] ** np.arange(3)
    weights = np.linalg.pinv(powers)[:, 0]
    weights[alone] = FAR / (FAR - NEAR), -NEAR / (FAR - NEAR), 0.0, 0.0
    return np.asarray(weights.reshape(-1, 2, 2))


def _midsides(lengths: Array, elements: Numbers, next_to: Ints) -> tuple[Ints, Ints, Array]:
    """Midside nodes, the four corners on the line of each, and their shares."""
    if elements.shape[1] == 8:
        return np.empty(0, int), np.empty((0, 4), int), np.empty((0, 4))
    lines, shares = [], []
    for a, b in HEX_EDGES:
        d = int(np.flatnonzero(SIDES[a] != SIDES[b])[0])
        at = np.zeros((len(elements), 4))  # along the line, in lengths of the edge from its middle
        four = np.empty((len(elements), 4), int)
        known = np.ones((len(elements), 4), dtype=bool)
        for place, (corner, sign) in enumerate(((a, -0.5), (b, 0.5))):
            beyond = next_to[:, d, SIDES[corner, d]]
            known[:, 3 * place] = beyond >= 0
            four[:, 1 + place] = elements[:, corner]
            # the next element has the corner at its other end
            four[:, 3 * place] = elements[beyond, corner]
            further = lengths[beyond, corner, d] / lengths[:, corner, d]
            at[:, 1 + place], at[:, 3 * place] = sign, sign + 2.0 * sign * further
        lines.append(four)
        shares.append(_lagrange(at, known))
    midsides, first = np.unique(elements[:, 8:].T.astype(int), return_index=True)
    return midsides, np.concatenate(lines)[first], np.concatenate(shares)[first]


def _lagrange(at: Array, known: Flags) -> Array:
    """Weights (n, 4) of values at ``at`` (n, 4), of those known, in that at 0."""
    weights = known.astype(float)
    for i, j in itertools.permutations(range(4), 2):
        both = known[:, i] & known[:, j]
        weights[both, i] *= at[both, j] / (at[both, j] - at[both, i])
    return weights
