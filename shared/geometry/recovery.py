"""How gradients at the points of elements are carried to the nodes.

In a lattice of hexahedra, along a line through elements, a field is known at two points of each.
At a corner its value is that of the quadratic through the four points of the two elements nearest
to it, in the least-squares sense: between two elements both, at the boundary the last two.  In
three dimensions these are products, over the points of eight elements.  At midsides a cubic runs
through the four nearest corners of the line.

Elsewhere a quadratic is fitted to the points of so many elements near a corner, first of those
that meet there, and for a midside to so many corners near it, first of all the ends of its edge.

So nodal values are right to third order of the size of elements, where values carried linearly in
each element are right to second, at the boundary most of all.  The points are those of the patches
of Zienkiewicz & Zhu, The superconvergent patch recovery, Int. J. Numer. Meth. Engng 33 (1992).
"""

import itertools
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_matrix, diags

from palpate.shared.arrays import Array, Flags, Ints, Numbers
from palpate.shared.geometry.elements import (
    HEX_CORNERS,
    HEX_EDGES,
    HEX_FACES,
    POINTS,
    Box,
    kind_of,
)

ELEMENTS, CORNERS = 24, 20
"""Elements round a corner, and corners round a midside, to which a quadratic is fitted."""

RINGS = 2
"""How often their neighbours are taken in, too, where those that meet there are too few."""

NEARER = 4
"""Power of nearness with which a corner counts for a midside."""

STEEPEST = 10.0
"""Sum of weights' sizes up to which a fit is trusted, else one of a lower degree is made."""

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
    """What carries values at the points of elements to the nodes."""

    corners: Ints  # (k,) nodes that are corners of elements
    elements: Ints  # (k, a) around each
    weights: Array  # (k, a, q) of their points
    midsides: Ints  # (m,) nodes whose values are made of corners'
    lines: Ints  # (m, l) those
    shares: Array  # (m, l)


def by_region(nodes: Array, elements: Numbers, region: Numbers) -> tuple[Patches, Numbers]:
    """How values are carried in elements (e, n) of regions (e,), and an element (m,) of each node.

    Values jump where regions meet, and are carried in each by itself.  A node there is of the
    lowest of them; for the others it has further numbers, from the number of nodes on.
    """
    parts, of = [], np.zeros(len(nodes), np.int32)
    known = np.zeros(len(nodes), dtype=bool)
    for number in np.unique(region):
        own = np.flatnonzero(region == number)
        at, first = np.unique(elements[own], return_index=True)
        again = at[known[at]]
        name = np.arange(len(nodes))
        name[again] = len(of) + np.arange(len(again))
        of = np.append(of, np.zeros(len(again), np.int32))
        of[name[at]] = own[first // elements.shape[1]]
        known[at] = True
        part = patches(nodes, elements[own])
        parts.append(
            Patches(
                name[part.corners], own[part.elements], part.weights,
                name[part.midsides], name[part.lines], part.shares,
            )
        )  # fmt: skip
    return Patches(*map(_joined, zip(*parts, strict=True))), of


def _joined(parts: tuple[Array | Ints, ...]) -> Any:
    """Arrays (k, a, ...) one after the other, filled up to one length with zeros."""
    if parts[0].ndim == 1:
        return np.concatenate(parts)
    wide = max(part.shape[1] for part in parts)
    filled = [
        np.pad(part, [(0, 0), (0, wide - part.shape[1]), *[(0, 0)] * (part.ndim - 2)])
        for part in parts
    ]
    return np.concatenate(filled)


def patches(nodes: Array, elements: Numbers) -> Patches:
    """How values are carried in elements (e, n)."""
    kind = kind_of(elements)
    if isinstance(kind, Box):
        next_to = neighbours(elements[:, :8])
        if _all_meet(elements, next_to):
            return _in_lattice(nodes, elements, next_to)
    return _fitted_patches(nodes, elements)


def _all_meet(elements: Numbers, next_to: Ints) -> bool:
    """Whether all faces that hexahedra share are on opposite sides of them, as in a lattice."""
    faces = np.sort(elements[:, np.array(HEX_FACES)].reshape(-1, 4), axis=1)
    shared = len(faces) - len(np.unique(faces, axis=0))
    return bool(np.count_nonzero(next_to >= 0) == 2 * shared)


def _in_lattice(nodes: Array, elements: Numbers, next_to: Ints) -> Patches:
    """As ``patches``, where all elements have the axes of one lattice."""
    at = nodes[elements[:, :8]]
    lengths = np.linalg.norm(at[:, OPPOSITE] - at[:, :, None], axis=3)  # (e, 8, 3)
    own, corner = np.divmod(np.arange(8 * len(elements)), 8)
    around, weights = own[:, None], np.ones((len(own), 1, 1))
    for d in range(3):
        side = SIDES[corner, d]
        beyond, inward = next_to[own, d, side], next_to[own, d, 1 - side]
        inside, alone = beyond >= 0, (beyond < 0) & (inward < 0)
        towards = np.where(inside, side, 1 - side)
        further = np.where(around >= 0, next_to[around, d, towards[:, None]], -1)
        end = np.where(inside, OPPOSITE[corner, d], corner)
        other = lengths[np.where(inside, beyond, inward), end, d] / lengths[own, corner, d]
        one = _along(other, inside, alone)  # (k, 2 elements, nearer and farther point)
        near_side = np.stack([side, np.where(inside, 1 - side, side)], axis=1)
        nearer = near_side[:, :, None] == POINT_SIDES[:, d]
        share = np.where(nearer, one[:, :, :1], one[:, :, 1:])  # (k, 2, 8)
        around = np.concatenate([around, np.where(alone[:, None], around, further)], axis=1)
        weights = np.concatenate([weights * share[:, :1], weights * share[:, 1:]], axis=1)
    # of the elements that meet at a corner the first counts round which all are there
    order = np.argsort((around < 0).any(axis=1), kind="stable")
    corners, first = np.unique(elements[:, :8].astype(int).ravel()[order], return_index=True)
    around, weights = around[order[first]], weights[order[first]]
    lost = (around < 0).any(axis=1)
    if lost.any():
        fits, rows = _from_points(nodes, elements, elements[:, :8]), np.empty(len(corners), int)
        rows[np.append(np.flatnonzero(~lost), np.flatnonzero(lost))] = np.arange(len(corners))
        around = _joined((around[~lost], fits.around[lost]))[rows]
        weights = _joined((weights[~lost], fits.weights[lost]))[rows]
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


class _Fits(NamedTuple):
    """What carries values at the points of elements (e,) to nodes."""

    nodes: Ints  # (k,)
    own: Ints  # (e, m) of these in each element
    meeting: csr_matrix  # (k, e) which elements meet at each
    around: Ints  # (k, a) elements
    weights: Array  # (k, a, q) of their points


def _from_points(nodes: Array, elements: Numbers, wanted: Numbers) -> _Fits:
    """What carries values to the ``wanted`` nodes (e, m) of elements."""
    kind = kind_of(elements)
    N, _ = kind.shape(kind.rule(POINTS)[0])
    points = N @ nodes[elements]  # (e, q, 3)
    at, own = np.unique(wanted.astype(int), return_inverse=True)
    own = own.reshape(wanted.shape)
    rows = own.ravel(), np.repeat(np.arange(len(elements)), wanted.shape[1])
    meeting = csr_matrix((np.ones(own.size), rows), (len(at), len(elements)))
    around, known = _nearest(meeting, meeting.T @ meeting, nodes[at], points.mean(axis=1), ELEMENTS)
    away = points[around] - nodes[at][:, None, None]
    counts = np.broadcast_to(known[..., None], away.shape[:3]).reshape(len(at), -1)
    weights = fitted(away.reshape(len(at), -1, 3), counts.astype(float))
    return _Fits(at, own, meeting, around, weights.reshape(away.shape[:3]))


def _fitted_patches(nodes: Array, elements: Numbers) -> Patches:
    """As ``patches``, however elements lie."""
    kind = kind_of(elements)
    corners, own, meeting, around, weights = _from_points(
        nodes, elements, elements[:, : kind.corners]
    )
    if not kind.quadratic:
        return Patches(corners, around, weights, np.empty(0, int), *np.empty((2, 0, 1), int))
    midsides, first = np.unique(elements[:, kind.corners :].astype(int), return_index=True)
    element, edge = np.divmod(first, len(kind.edges))
    ends = own[element[:, None], np.array(kind.edges)[edge]]  # (m, 2)
    joined = csr_matrix(
        (np.ones(ends.size), (np.repeat(np.arange(len(ends)), 2), ends.ravel())),
        (len(ends), len(corners)),
    )
    lines, known = _nearest(joined, meeting @ meeting.T, nodes[midsides], nodes[corners], CORNERS)
    at = nodes[corners[lines]] - nodes[midsides][:, None]
    distance = np.linalg.norm(at, axis=2)
    nearness = known * (distance.min(axis=1, keepdims=True) / distance) ** NEARER
    return Patches(corners, around, weights, midsides, corners[lines], fitted(at, nearness))


def _nearest(
    meeting: csr_matrix, beside: csr_matrix, here: Array, there: Array, most: int
) -> tuple[Ints, Flags]:
    """Which of things ``there`` (e, 3) are near those ``here`` (k, 3), (k, most), as far as known.

    First those that meet (k, e), then, where these are too few, those beside them (e, e), and once
    more; the nearest of each.
    """
    most = min(most, len(there))
    reached, rings = 1.0 * (meeting > 0), 1.0 * (meeting > 0)
    for _ in range(RINGS):
        few = diags((np.diff(reached.indptr) < most).astype(float))
        reached = 1.0 * ((reached + few @ reached @ beside).tocsr() > 0)
        rings = rings + reached
    rings = rings.tocsr()
    rows = np.repeat(np.arange(len(here)), np.diff(rings.indptr))
    distance = np.linalg.norm(there[rings.indices] - here[rows], axis=1)
    order = np.lexsort((distance, -rings.data, rows))
    rank = np.arange(len(order)) - rings.indptr[rows]
    kept = rank < most
    found, known = np.zeros((len(here), most), int), np.zeros((len(here), most), bool)
    found[rows[kept], rank[kept]] = rings.indices[order[kept]]
    known[rows[kept], rank[kept]] = True
    return found, known


def fitted(at: Array, counts: Array) -> Array:
    """Weights (k, m) of values at points (k, m, 3) in that at 0 of the field fitted to them.

    By least squares, in which points count (k, m).  The field is quadratic; linear or constant
    where the points do not tell it well.
    """
    share = counts / counts.sum(axis=1, keepdims=True)
    centre = np.einsum("km,kmi->ki", share, at)[:, None]
    away = at - centre
    spread, axes = np.linalg.eigh((share[..., None] * away).swapaxes(1, 2) @ away)
    least = np.maximum(spread, 1e-12 * spread.max(axis=1, keepdims=True) + np.finfo(float).tiny)
    axes = axes / np.sqrt(least)[:, None]
    P, p = _powers(away @ axes), _powers(-centre @ axes)[:, 0]
    weights, left = np.zeros(counts.shape), np.arange(len(at))
    for terms in (10, 4, 1):
        A = P[left, :, :terms]
        weighted = share[left, :, None] * A
        inverse = np.linalg.pinv(weighted.swapaxes(1, 2) @ A, rcond=1e-9, hermitian=True)
        found = (weighted @ (inverse @ p[left, :terms, None]))[..., 0]
        missed = np.abs(np.einsum("km,kmt->kt", found, A) - p[left, :terms]).max(axis=1)
        good = (missed < 1e-6) & (np.abs(found).sum(axis=1) < STEEPEST)
        weights[left[good]] = found[good]
        left = left[~good]
    return weights


def _powers(x: Array) -> Array:
    """1, the coordinates and their products (..., 10) of points (..., 3)."""
    i, j = np.triu_indices(3)
    return np.concatenate([np.ones_like(x[..., :1]), x, x[..., i] * x[..., j]], axis=-1)
