"""The rigid spherical tip of the endoscope, pushed into the surface: frictionless contact.

The tip with its centre at ``x`` and of radius ``R`` adds to the potential energy of the body

    Phi(u, x) = int phi(d) dA,     d = R - |X + u - x|,

summed over integration points of the surface at rest.  The penalty ``phi`` is zero for d <= 0 and
twice continuously differentiable,

    phi' = k d^2 / (2 e)  for d <= e,        phi' = k (d - e / 2)  beyond,

so ``phi'`` is the contact pressure and grows in proportion to the penetration ``d`` but for the
onset ``e``.  What Phi exerts on the tissue and on the tool, and how stiff it is, are its first and
second derivatives in ``u`` and ``x``; no friction, no adhesion (Wriggers, Computational Contact
Mechanics, 2006, ch. 5 and 6).

On a mesh much finer than the contact the pressure is Hertz's, about E sqrt(D / R) at a depth ``D``.
On a coarse one, whose faces cannot dent, the contact is far smaller: as on a rigid plane, a force F
needs the penetration sqrt(F / (pi k R)).  ``HARDNESS`` is set by the latter, and the points are so
close (``SPACING``) that even such a contact holds several.

Only faces whose surroundings the tip reaches are looked at.  A point whose outward normal (at rest)
faces away from the tip's centre does not feel it: it belongs to the far side of a thin wall.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from shared.elements import quadrilateral, shape

Array = NDArray[np.float64]
Ints = NDArray[np.int32]

HARDNESS = 4000.0
"""Of the penalty, in units of Young's modulus over the tip's radius."""

ONSET = 2.5e-4
"""Penetration over which the penalty sets in, in radii of the tip."""

SPACING = 0.075
"""Largest distance of integration points, in radii of the tip."""

SMOOTH = np.cos(np.radians(45.0))
"""Faces that meet at less than this angle go on in one another."""

REACH = 1.25
"""A curved face stays in the box of its nodes stretched by this factor."""


FORCE, STIFFNESS, CONVEX = 0.0, 1.0, 2.0
"""What is wanted of ``touch``; for integers the compiler would make a version of it each."""


class Tip(NamedTuple):
    """The tip and its penalty."""

    radius: float  # mm
    stiffness: float  # kPa/mm
    onset: float  # mm


class TipSurface(NamedTuple):
    """Faces that a tip can touch, with q integration points each."""

    nodes: Array  # (n, 3) mm, at rest
    faces: Ints  # (f, k) rows of ``nodes``
    shape: Array  # (k, q) shape functions at the points of a face
    areas: Array  # (f, q) mm^2
    normals: Array  # (f, 3, q) outward unit normals at rest


class Touching(NamedTuple):
    """What the tip does to the faces that it touches; room for all of a surface's."""

    face: Ints  # (f,) places in the list of faces looked at
    force: Array  # (f, k, 3) mN, on their nodes
    stiffness: Array  # (f, 3, 3, k, k) mN/mm, second derivative in the places of the nodes
    own: Array  # (3, 3) mN/mm, in the place of the tip
    count: NDArray[np.int64]  # (1,) faces touched
    deepest: Array  # (1,) mm, largest penetration
    gap: Array  # (4, q) scratch: points of a face from the tip's centre, mm, and their distance


def tip_of(radius: float, young: float) -> Tip:
    """Tip of a radius (mm) for a tissue of Young's modulus ``young`` (kPa)."""
    return Tip(radius, HARDNESS * young / radius, ONSET * radius)


def tip_surface(
    nodes: Array, faces: Ints, accessible: NDArray[np.bool_], radius: float
) -> TipSurface:
    """Faces that a tip on the accessible ones can touch: those and their smooth continuation.

    Parameters
    ----------
    nodes : ndarray, shape (n, 3), mm
    faces : ndarray, shape (f, 4) or (f, 8)
        Of the whole boundary.
    accessible : ndarray, shape (f,), bool
    radius : float, mm
        Of the tip; sets the distance of integration points.
    """
    touched = faces[_with_smooth_neighbours(nodes, faces, accessible)]
    at = _grid(nodes[touched], SPACING * radius)
    N, dN = shape(quadrilateral(faces.shape[1]), at)
    tangents = np.einsum("fai,qaj->fijq", nodes[touched], dN)
    normals = np.cross(tangents[:, :, 0], tangents[:, :, 1], axis=1)
    areas = np.linalg.norm(normals, axis=1)
    return TipSurface(
        nodes=nodes,
        faces=np.ascontiguousarray(touched, dtype=np.int32),
        shape=np.ascontiguousarray(N.T),
        areas=areas * 4 / len(at),
        normals=normals / areas[:, None],
    )


def _grid(corners: Array, spacing: float) -> Array:
    """Centres (q, 2) of equal cells of the reference face, at most ``spacing`` mm wide on any."""
    edges = np.linalg.norm(corners[:, [1, 2, 3, 0]] - corners[:, :4], axis=2)
    counts = [max(1, int(np.ceil(edges[:, axis::2].max() / spacing))) for axis in range(2)]
    ticks = [(np.arange(count) + 0.5) * 2 / count - 1 for count in counts]
    return np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 2)


def _with_smooth_neighbours(
    nodes: Array, faces: Ints, accessible: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Accessible faces and those that share an edge with one at less than 45 degrees."""
    reference = quadrilateral(faces.shape[1])
    _, dN = shape(reference, reference[:4])
    tangents = np.einsum("fai,qaj->fqij", nodes[faces], dN)
    normals = np.cross(tangents[..., 0], tangents[..., 1])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)  # (f, 4, 3) at the corners
    at_corner = {
        (int(face), int(node)): normals[face, corner]
        for face in range(len(faces))
        for corner, node in enumerate(faces[face, :4])
    }
    of_edge: dict[tuple[int, int], list[int]] = {}
    for face, corners in enumerate(faces[:, :4].tolist()):
        for a, b in zip(corners, corners[1:] + corners[:1], strict=True):
            of_edge.setdefault((min(a, b), max(a, b)), []).append(face)
    kept = accessible.copy()
    for edge, pair in of_edge.items():
        if len(pair) == 2 and accessible[pair].any():
            smooth = all(
                at_corner[pair[0], node] @ at_corner[pair[1], node] > SMOOTH for node in edge
            )
            kept[pair] |= smooth
    return np.flatnonzero(kept)


def room_for(surface: TipSurface, f: int) -> Touching:
    """Memory for what touches f faces of a surface."""
    k = surface.faces.shape[1]
    return Touching(
        face=np.zeros(f, np.int32),
        force=np.zeros((f, k, 3)),
        stiffness=np.zeros((f, 3, 3, k, k)),
        own=np.zeros((3, 3)),
        count=np.zeros(1, np.int64),
        deepest=np.zeros(1),
        gap=np.zeros((4, surface.shape.shape[1])),
    )


@njit(cache=True, error_model="numpy", nogil=True)
def penalty(tip, d):
    """Energy density (mN/mm), pressure (kPa) and stiffness (kPa/mm) at a penetration (mm)."""
    k, e = tip.stiffness, tip.onset
    if d <= 0.0:
        return 0.0, 0.0, 0.0
    if d <= e:
        return k * d * d * d / (6.0 * e), k * d * d / (2.0 * e), k * d / e
    return k * (0.5 * d * (d - e) + e * e / 6.0), k * (d - 0.5 * e), k


@njit(cache=True, error_model="numpy", nogil=True)
def _within_reach(tip, surface, face, x, moved):
    """Whether the tip at x reaches the surroundings of a deformed face."""
    squared = largest = 0.0
    nodes, own = surface.nodes, surface.faces[face]
    middle = np.empty(3)
    half = np.empty(3)
    for i in range(3):
        low, high = np.inf, -np.inf
        for k in range(len(own)):
            at = nodes[own[k], i] + moved[own[k], i]
            low, high = min(low, at), max(high, at)
        middle[i], half[i] = 0.5 * (low + high), 0.5 * (high - low)
        largest = max(largest, half[i])
    for i in range(3):
        beyond = abs(x[i] - middle[i]) - half[i] - (REACH - 1.0) * largest
        if beyond > 0.0:
            squared += beyond * beyond
    return squared < tip.radius * tip.radius


@njit(cache=True, error_model="numpy", nogil=True, fastmath={"contract", "reassoc", "nsz"})
def _gaps(surface, face, x, moved, gap):
    """Points of a deformed face relative to x and their squared distances, into ``gap`` (4, q)."""
    own, nodes, shape = surface.faces[face], surface.nodes, surface.shape
    for i in range(3):
        row = gap[i]
        for q in range(len(row)):
            row[q] = -x[i]
        for k in range(0, len(own), 4):  # a face has 4 or 8 nodes
            a, b = nodes[own[k], i] + moved[own[k], i], nodes[own[k + 1], i] + moved[own[k + 1], i]
            c = nodes[own[k + 2], i] + moved[own[k + 2], i]
            d = nodes[own[k + 3], i] + moved[own[k + 3], i]
            K, L, M, N = shape[k], shape[k + 1], shape[k + 2], shape[k + 3]
            for q in range(len(row)):
                row[q] += K[q] * a + L[q] * b + M[q] * c + N[q] * d
    y0, y1, y2, square = gap[0], gap[1], gap[2], gap[3]
    for q in range(len(square)):
        square[q] = y0[q] * y0[q] + y1[q] * y1[q] + y2[q] * y2[q]


@njit(cache=True, error_model="numpy", nogil=True)
def touch(tip, surface, near, x, moved, touching, wanted):
    """Find the faces that touch the tip, and what it does to them.

    Parameters
    ----------
    tip : Tip
    surface : TipSurface
    near : ndarray, shape (s,), int32
        Faces to look at.
    x : ndarray, shape (3,), mm
        Centre of the tip.
    moved : ndarray, shape (n, 3), mm
        Displacement of the surface's nodes.
    touching : Touching, out
        The first ``count`` faces are overwritten.
    wanted : float
        ``FORCE``, ``STIFFNESS`` (second derivatives, too) or ``CONVEX`` (second derivatives without
        their negative part, that of the normal's turning: positive definite far from equilibrium).

    Returns
    -------
    count : int
    energy : float, mN mm
        Of the penalty.
    deepest : float, mm
        Largest penetration.
    """
    count, energy, deepest = 0, 0.0, 0.0
    radius, gap = tip.radius, touching.gap
    y, n, H = np.empty(3), np.empty(3), touching.own
    H[:] = 0.0
    for place in range(len(near)):
        face = near[place]
        if not _within_reach(tip, surface, face, x, moved):
            continue
        _gaps(surface, face, x, moved, gap)
        touches = False
        outward, areas = surface.normals[face], surface.areas[face]
        for q in range(gap.shape[1]):
            if gap[3, q] >= radius * radius:
                continue
            for i in range(3):
                y[i] = gap[i, q]
            if outward[0, q] * y[0] + outward[1, q] * y[1] + outward[2, q] * y[2] >= 0.0:
                continue
            if not touches:
                touches = True
                touching.face[count] = place
                touching.force[count] = 0.0
                if wanted > FORCE:
                    touching.stiffness[count] = 0.0
                count += 1
            distance = math.sqrt(gap[3, q])
            density, pressure, slope = penalty(tip, radius - distance)
            energy += areas[q] * density
            deepest = max(deepest, radius - distance)
            for i in range(3):
                n[i] = y[i] / distance
            _press(surface.shape, q, areas[q] * pressure, n, touching.force[count - 1])
            if wanted > FORCE:
                along = areas[q] * slope
                across = -areas[q] * pressure / distance if wanted == STIFFNESS else 0.0
                _stiffen(surface.shape, q, along, across, n, touching.stiffness[count - 1], H)
    touching.count[0], touching.deepest[0] = count, deepest
    return count, energy, deepest


@njit(cache=True, error_model="numpy", nogil=True)
def _press(shape, q, push, n, force):
    """Share a point's force among the nodes of its face: force (k, 3)."""
    for k in range(len(force)):
        for i in range(3):
            force[k, i] += shape[k, q] * push * n[i]


@njit(cache=True, error_model="numpy", nogil=True)
def _stiffen(shape, q, along, across, n, K, own):
    """Add a point's second derivative to that of its face, K (3, 3, k, k), upper blocks."""
    for i in range(3):
        for j in range(i, 3):
            h = (along - across) * n[i] * n[j] + (across if i == j else 0.0)
            own[i, j] += h
            if i != j:
                own[j, i] += h
            block = K[i, j]
            for a in range(len(block)):
                value = h * shape[a, q]
                for b in range(len(block)):
                    block[a, b] += value * shape[b, q]


@njit(cache=True, error_model="numpy", nogil=True)
def reaction(touching, count, force):
    """Write the tissue's force on the tool (3,) mN."""
    force[:] = 0.0
    for c in range(count):
        for k in range(touching.force.shape[1]):
            for i in range(3):
                force[i] -= touching.force[c, k, i]
