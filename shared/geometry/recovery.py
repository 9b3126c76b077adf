"""How gradients at 2x2x2 points of hexahedra are carried to the nodes of a lattice of them.

Along a line through elements, a field is known at two points of each.  At a corner between two
elements the quadratic through the four nearest points in the least-squares sense is the mean of
what each element says by itself, the nearer of its points weighted by ``1 + NEARER``, the other by
``-NEARER``; elements of unequal size count in inverse proportion to it.  At a corner on the
boundary the quadratic goes on: along an element it changes by its mean slope.  In three dimensions
these are products.  At midsides a cubic runs through the four nearest corners of the line.

So nodal values are right to third order of the size of elements, where values carried linearly are
right to second, at the boundary most of all (cf. Zienkiewicz & Zhu, The superconvergent patch
recovery, Int. J. Numer. Meth. Engng 33, 1992, whose patches have the same points).
"""

import itertools
from typing import NamedTuple

import numpy as np

from palpate.shared.arrays import Array, Flags, Ints, Numbers
from palpate.shared.geometry.elements import HEX_CORNERS, HEX_EDGES

_NEAR, _FAR = (1 - 3**-0.5) / 2, (1 + 3**-0.5) / 2
NEARER = _NEAR**2 / (_FAR**2 - _NEAR**2)
LINEAR = _NEAR / (_FAR - _NEAR)
SLOPE = 1 / (_FAR - _NEAR)
INSIDE, BOUNDARY, ALONE = 0, 1, 2
OF_NEARER = np.array([1 + NEARER, SLOPE, 1 + LINEAR])
OF_FARTHER = np.array([-NEARER, -SLOPE, -LINEAR])
"""Weights of an element's points in a corner inside, in what one on the boundary differs by from
the next, and in one of a single layer of elements, where values are carried linearly."""

SIDES = (HEX_CORNERS > 0).astype(int)
_NUMBER = np.array([4, 2, 1])
OPPOSITE = np.array(
    [[np.flatnonzero((s ^ np.eye(3, dtype=int)[d] == SIDES).all(axis=1))[0] for d in range(3)]
     for s in SIDES]
)  # fmt: skip
"""Corners (8, 3) that lie opposite along each axis."""


class Lattice(NamedTuple):
    """What carries values at the points of hexahedra to the nodes."""

    to_corners: Array  # (e, 8, 8) shares of an element's points, first index, in its corners
    boundary: Ints  # (k,) nodes to whose values those of others are added, in this order
    partners: Ints  # (k,) these others
    signs: Array  # (k,)
    midsides: Ints  # (m,) nodes whose values are made of corners'
    lines: Ints  # (m, 4) those
    shares: Array  # (m, 4)


def lattice(nodes: Array, elements: Numbers) -> Lattice:
    """How values are carried in elements (e, 8 or 20) that all have the axes of one lattice."""
    corners, next_to = elements[:, :8], neighbours(elements[:, :8])
    away = np.linalg.norm(nodes[corners[:, OPPOSITE]] - nodes[corners][:, :, None], axis=3)
    ends = next_to < 0  # (e, 3, 2)
    at = np.stack([ends[:, d, SIDES[:, d]] for d in range(3)], axis=2)  # (e, 8, 3)
    alone = ends.all(axis=2)[:, None]
    kind = np.where(at & alone, ALONE, np.where(at, BOUNDARY, INSIDE))
    counts = 1.0 / away.prod(axis=2)
    counts /= np.bincount(corners.ravel(), counts.ravel(), len(nodes))[corners]
    # of corner c and point q along each axis
    nearer = SIDES[:, None] == SIDES[None][:, _gauss_order()]
    weights = np.where(nearer, OF_NEARER[kind][:, :, None], OF_FARTHER[kind][:, :, None])
    to_corners = counts[..., None] * weights.prod(axis=3)
    midsides, lines, shares = _midsides(away, elements, next_to)
    return Lattice(
        np.swapaxes(to_corners, 1, 2), *_partners(corners, kind), midsides, lines, shares
    )


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


def _gauss_order() -> Ints:
    """Corners nearest to the points of ``elements.gauss(2, 3)``."""
    return np.argsort(SIDES @ _NUMBER)


def _partners(corners: Numbers, kind: Ints) -> tuple[Ints, Ints, Array]:
    """Nodes of the boundary, those added to them, and signs: from faces to edges to corners."""
    bounded, found = kind == BOUNDARY, []
    for axes in itertools.product((False, True), repeat=3):
        size = sum(axes)
        if size == 0:
            continue
        opposite = np.arange(8)
        for d in np.flatnonzero(axes):
            opposite = OPPOSITE[opposite, d]
        e, c = np.nonzero(bounded[:, :, np.array(axes)].all(axis=2))
        order = bounded[e, c].sum(axis=1)
        sign = np.full(len(e), (-1) ** (size + 1))
        found.append(np.column_stack([order, corners[e, c], corners[e, opposite[c]], sign]))
    rows = np.unique(np.concatenate(found), axis=0)  # ascending in the number of axes
    return rows[:, 1], rows[:, 2], rows[:, 3].astype(float)


def _midsides(away: Array, elements: Numbers, next_to: Ints) -> tuple[Ints, Ints, Array]:
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
            further = away[beyond, corner, d] / away[:, corner, d]
            at[:, 1 + place], at[:, 3 * place] = sign, sign + 2.0 * sign * further
        lines.append(four)
        shares.append(_lagrange(at, known))
    midsides, first = np.unique(elements[:, 8:].T.ravel(), return_index=True)
    return midsides, np.concatenate(lines)[first], np.concatenate(shares)[first]


def _lagrange(at: Array, known: Flags) -> Array:
    """Weights (n, 4) of values at ``at`` (n, 4), of those known, in that at 0."""
    weights = known.astype(float)
    for i, j in itertools.permutations(range(4), 2):
        both = known[:, i] & known[:, j]
        weights[both, i] *= at[both, j] / (at[both, j] - at[both, i])
    return weights
