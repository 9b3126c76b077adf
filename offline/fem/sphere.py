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

Only faces whose surroundings the tip reaches are looked at, and of those only the blocks of points
that it can reach.  A point whose outward normal (at rest) faces away from the tip's centre does not
feel it: it belongs to the far side of a thin wall.
"""

import math
from typing import Annotated, NamedTuple

import numpy as np
from numba import njit
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from palpate.shared.arrays import Array, Flags, Ints, Numbers
from palpate.shared.compiled import room
from palpate.shared.geometry.edges import shared_edges
from palpate.shared.geometry.elements import Face, face_kind_of

HARDNESS = 12000.0
"""Of the penalty, in units of Young's modulus over the tip's radius."""

ONSET = 5e-4
"""Penetration over which the penalty sets in, in radii of the tip."""

SPACING = 0.05
"""Largest distance of integration points, in radii of the tip."""

SIDE = 4
BLOCK = SIDE * SIDE
"""Points of a block, ``SIDE`` along an edge of it: two vectors of double precision."""

SAG = 4.0
"""By which the squared distance of the tip's centre from a point of a block is at most less than
from the nearest corner of the block, in squared half diagonals at rest; 1 on a plane."""

SMOOTH = np.radians(45.0)
"""Angle of normals up to which faces go on in one another."""

REACH = 1.25
"""A curved face stays in the box of its nodes stretched by this factor."""


FORCE, STIFFNESS, CONVEX = 0.0, 1.0, 2.0
"""What is wanted of ``touch``; for integers the compiler would make a version of it each."""


class Sphere(NamedTuple):
    """The tip and its penalty."""

    radius: float  # mm
    stiffness: float  # kPa/mm
    onset: float  # mm


class SphereSurface(NamedTuple):
    """Faces that a tip can touch, with b blocks of ``BLOCK`` integration points each."""

    nodes: Array  # (n, 3) mm, at rest
    faces: Numbers  # (f, k) rows of ``nodes``
    shape: Array  # (b, k, BLOCK) shape functions at the points of a face
    corner_shape: Array  # (k, e) the same at the corners of blocks
    corners: Numbers  # (b, 4) those of each block
    reach: Array  # (f, b) mm^2, squared distance of all corners at which the tip misses the block
    areas: Array  # (f, b, BLOCK) mm^2
    normals: Array  # (f, b, 3, BLOCK) outward unit normals at rest


class Touching(NamedTuple):
    """What the tip does to the faces that it touches; room for f of them."""

    face: Annotated[Numbers, "f"]  # places in the list of faces looked at
    force: Annotated[Array, "f, k, 3"]  # mN, on their nodes
    stiffness: Annotated[Array, "f, 3, 3, k, k"]  # mN/mm, second derivative in the nodes' places
    touched: Annotated[Ints, "1"]  # number of faces
    deepest: Annotated[Array, "1"]  # mm, largest penetration
    around: Annotated[Array, "k, 3"]  # scratch: nodes of a face from the tip's centre, mm
    gap: Annotated[Array, "4, block"]  # scratch: points of a block from there, squared distances
    row: Annotated[Array, "k"]  # scratch: shape functions at a point
    ends: Annotated[Array, "4, ends"]  # scratch: as ``gap``, of the corners of blocks


def sphere_of(radius: float, young: float) -> Sphere:
    """Tip of a radius (mm) for a tissue of Young's modulus ``young`` (kPa)."""
    return Sphere(radius, HARDNESS * young / radius, ONSET * radius)


def sphere_surface(nodes: Array, faces: Numbers, accessible: Flags, radius: float) -> SphereSurface:
    """Faces that a tip on the accessible ones can touch: those and their smooth continuation.

    As far as a radius of the tip.

    Parameters
    ----------
    nodes : ndarray, shape (n, 3), mm
    faces : ndarray, shape (f, k)
        Of the whole boundary.
    accessible : ndarray, shape (f,), bool
    radius : float, mm
        Of the tip; sets the distance of integration points.
    """
    touched = faces[_with_smooth_neighbours(nodes, faces, accessible, radius)]
    kind = face_kind_of(faces)
    at, ends, corners = _grid(kind, nodes[touched], SPACING * radius)
    N, dN = kind.shape(at)
    tangents = np.einsum("fai,qaj->fijq", nodes[touched], dN)
    normals = np.cross(tangents[:, :, 0], tangents[:, :, 1], axis=1)
    areas = np.linalg.norm(normals, axis=1)
    blocks = len(touched), -1, BLOCK
    at_ends, _ = kind.shape(ends)
    placed = np.einsum("fai,qa->fqi", nodes[touched], at_ends)[:, corners]  # (f, b, 4, 3)
    across = placed[:, :, :, None] - placed[:, :, None]
    diagonals = np.linalg.norm(across, axis=-1).max(axis=(-1, -2))
    return SphereSurface(
        nodes=nodes,
        faces=np.ascontiguousarray(touched, dtype=np.int32),
        shape=np.ascontiguousarray(N.reshape(-1, BLOCK, N.shape[1]).transpose(0, 2, 1)),
        corner_shape=np.ascontiguousarray(at_ends.T),
        corners=corners,
        reach=np.ascontiguousarray(radius**2 + SAG * (diagonals / 2) ** 2),
        areas=(areas * kind.rule(1)[1].sum() / len(N)).reshape(blocks),
        normals=np.ascontiguousarray(
            np.moveaxis((normals / areas[:, None]).reshape(len(touched), 3, -1, BLOCK), 1, 2)
        ),
    )


def _grid(kind: Face, X: Array, spacing: float) -> tuple[Array, Array, Numbers]:
    """Blocks of equal cells of a face, at most ``spacing`` mm wide on any with nodes (f, k, 3).

    Returns
    -------
    centres : ndarray, shape (b BLOCK, 2)
        Of the cells, block by block.
    ends : ndarray, shape (e, 2)
        Corners of the blocks.
    corners : ndarray, shape (b, 4)
        Which those of a block are; the first stands twice where there are three.
    """
    # a block more or less must not hang on round-off
    wanted = np.ceil(kind.lengths(X).max(axis=0) / (SIDE * spacing) - 1e-6)
    ends, corners = kind.cells(*np.maximum(wanted, 1).astype(int))
    grid, cells = kind.cells(*[SIDE] * kind.axes)
    own, _ = kind.straight.shape(grid[cells].mean(axis=1))
    return (own @ ends[corners]).reshape(-1, 2), ends, corners[:, np.arange(4) % kind.corners]


def _with_smooth_neighbours(nodes: Array, faces: Numbers, accessible: Flags, reach: float) -> Ints:
    """Accessible faces and those that go on from them, edge by edge at less than 45 degrees.

    As far as ``reach`` (mm).
    """
    edges = shared_edges(nodes, faces)
    joined = edges.faces[np.abs(edges.turn) < SMOOTH]
    away, _ = cKDTree(nodes[np.unique(faces[accessible])]).query(
        nodes[faces[:, : face_kind_of(faces).corners]]
    )
    joined = joined[(away.min(axis=1) < reach)[joined].all(axis=1)]
    graph = coo_matrix((np.ones(len(joined)), joined.T), shape=(len(faces), len(faces)))
    _, part = connected_components(graph, directed=False)
    # what goes on from an accessible face may do so by way of faces that are not
    return np.flatnonzero(accessible | np.isin(part, part[accessible]))


def room_for(surface: SphereSurface, f: int) -> Touching:
    """Memory for what touches f faces of a surface."""
    k, ends = surface.corner_shape.shape
    return room(Touching, f=f, k=k, block=BLOCK, ends=ends)


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
def _within_reach(tip, surface, face, x, moved, at):
    """Whether the tip at x reaches the surroundings of a deformed face; writes its nodes from x."""
    nodes, faces = surface.nodes, surface.faces
    squared = largest = 0.0
    for i in range(3):
        low, high = np.inf, -np.inf
        for k in range(faces.shape[1]):
            node = faces[face, k]
            at[k, i] = nodes[node, i] + moved[node, i] - x[i]
            low, high = min(low, at[k, i]), max(high, at[k, i])
        largest = max(largest, high - low)
        # of all nodes from the tip's centre; what a curved face goes beyond them comes off below
        beside = max(low, -high, 0.0)
        squared += beside * beside
    return math.sqrt(squared) - 0.5 * (REACH - 1.0) * math.sqrt(3.0) * largest < tip.radius


@njit(cache=True, error_model="numpy", nogil=True, fastmath={"contract", "reassoc", "nsz"})
def _gaps(shape, at, gap):
    """Points of a face from the tip's centre and their squared distances, into ``gap`` (4, n).

    shape (k, n); four nodes are taken at once.
    """
    x, y, z, squared = gap[0], gap[1], gap[2], gap[3]
    for q in range(len(x)):
        x[q] = y[q] = z[q] = 0.0
    fours = len(at) // 4 * 4
    for k in range(0, fours, 4):
        K, L, M, N = shape[k], shape[k + 1], shape[k + 2], shape[k + 3]
        a0, b0, c0, d0 = at[k, 0], at[k + 1, 0], at[k + 2, 0], at[k + 3, 0]
        a1, b1, c1, d1 = at[k, 1], at[k + 1, 1], at[k + 2, 1], at[k + 3, 1]
        a2, b2, c2, d2 = at[k, 2], at[k + 1, 2], at[k + 2, 2], at[k + 3, 2]
        for q in range(len(x)):
            x[q] += K[q] * a0 + L[q] * b0 + M[q] * c0 + N[q] * d0
            y[q] += K[q] * a1 + L[q] * b1 + M[q] * c1 + N[q] * d1
            z[q] += K[q] * a2 + L[q] * b2 + M[q] * c2 + N[q] * d2
    for k in range(fours, len(at)):
        K, a0, a1, a2 = shape[k], at[k, 0], at[k, 1], at[k, 2]
        for q in range(len(x)):
            x[q] += K[q] * a0
            y[q] += K[q] * a1
            z[q] += K[q] * a2
    for q in range(len(x)):
        squared[q] = x[q] * x[q] + y[q] * y[q] + z[q] * z[q]


@njit(cache=True, error_model="numpy", nogil=True)
def touch(tip, surface, near, x, moved, touching, wanted):
    """Find the faces that touch the tip, and what it does to them.

    Parameters
    ----------
    tip : Tip
    surface : SphereSurface
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
    at, ends, corner = touching.around, touching.ends, touching.ends[3]
    corners, reach = surface.corners, surface.reach
    for place in range(len(near)):
        face = near[place]
        if not _within_reach(tip, surface, face, x, moved, at):
            continue
        _gaps(surface.corner_shape, at, ends)
        new = True
        for b in range(len(corners)):
            first = min(corner[corners[b, 0]], corner[corners[b, 1]])
            if min(first, corner[corners[b, 2]], corner[corners[b, 3]]) >= reach[face, b]:
                continue
            _gaps(surface.shape[b], at, touching.gap)
            density, depth = _touch_block(tip, surface, face, b, touching, count, new, wanted)
            if depth > 0.0:
                touching.face[count] = place
                new = False
                energy += density
                deepest = max(deepest, depth)
        if not new:
            count += 1
    touching.touched[0], touching.deepest[0] = count, deepest
    return count, energy, deepest


@njit(cache=True, error_model="numpy", nogil=True)
def _touch_block(tip, surface, face, block, touching, place, new, wanted):
    """Add what the tip does to the points of a block whose ``gap`` is known: energy, penetration.

    ``new`` faces have nothing at their place yet.
    """
    radius, gap, row, areas = tip.radius, touching.gap, touching.row, surface.areas
    normals = surface.normals
    energy = deepest = 0.0
    for q in range(BLOCK):
        if gap[3, q] >= radius * radius:
            continue
        y0, y1, y2 = gap[0, q], gap[1, q], gap[2, q]
        facing = normals[face, block, 0, q] * y0 + normals[face, block, 1, q] * y1
        if facing + normals[face, block, 2, q] * y2 >= 0.0:
            continue
        if new:
            new = False
            touching.force[place] = 0.0
            if wanted > FORCE:
                touching.stiffness[place] = 0.0
        distance, area = math.sqrt(gap[3, q]), areas[face, block, q]
        density, pressure, slope = penalty(tip, radius - distance)
        energy += area * density
        deepest = max(deepest, radius - distance)
        n = y0 / distance, y1 / distance, y2 / distance
        for k in range(len(row)):
            row[k] = surface.shape[block, k, q]
            for i in range(3):
                touching.force[place, k, i] += row[k] * area * pressure * n[i]
        if wanted > FORCE:
            across = -area * pressure / distance if wanted == STIFFNESS else 0.0
            _stiffen(touching, place, n, area * slope, across)
    return energy, deepest


@njit(cache=True, error_model="numpy", nogil=True)
def _stiffen(touching, place, n, along, across):
    """Add a point's second derivative to the upper blocks of its face's."""
    row = touching.row
    for i in range(3):
        for j in range(i, 3):
            h = (along - across) * n[i] * n[j] + (across if i == j else 0.0)
            K = touching.stiffness[place, i, j]
            for a in range(len(row)):
                value = h * row[a]
                for b in range(len(row)):
                    K[a, b] += value * row[b]
