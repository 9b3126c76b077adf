"""Edges of a boundary: which faces share one, and how sharply they meet there."""

from typing import NamedTuple

import numpy as np

from palpate.shared.arrays import Array, Flags, Ints, Numbers
from palpate.shared.geometry.elements import face_kind_of

BLUNT = np.radians(45.0)
"""Angle of normals up to which faces are parts of one smooth surface."""

ALONG = np.linspace(0.0, 1.0, 9)
"""Where points of an edge lie, over its length."""


class Edges(NamedTuple):
    """Edges that two faces of a boundary share."""

    faces: Ints  # (p, 2)
    nodes: Numbers  # (p, 2 or 3), ends and then the middle, as one of the faces has them
    turn: Array  # (p,) rad, angle of the normals at the sharper end; negative in a valley


def shared_edges(nodes: Array, faces: Numbers) -> Edges:
    """Edges of faces (f, k) whose nodes (n, 3) are given."""
    kind = face_kind_of(faces)
    count = kind.corners
    _, dN = kind.shape(kind.straight.nodes)
    tangents = np.einsum("fai,qaj->fqij", nodes[faces], dN)
    normals = np.cross(tangents[..., 0], tangents[..., 1])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)  # (f, c, 3) at the corners
    corners = faces[:, :count]
    parts = [corners, np.roll(corners, -1, axis=1), *([faces[:, count:]] if kind.quadratic else [])]
    edges = np.stack(parts, axis=-1).reshape(-1, len(parts))
    ends = np.stack([normals, np.roll(normals, -1, axis=1)], axis=2).reshape(-1, 2, 3)
    ends[edges[:, 0] > edges[:, 1]] = ends[edges[:, 0] > edges[:, 1], ::-1]
    _, number, sides = np.unique(
        np.sort(edges[:, :2], axis=1), axis=0, return_inverse=True, return_counts=True
    )
    order = np.argsort(number.ravel(), kind="stable")
    pairs = order[sides[number.ravel()[order]] == 2].reshape(-1, 2)
    own, other = ends[pairs[:, 0]], ends[pairs[:, 1]]
    shared = edges[pairs[:, 0]]
    along = nodes[shared[:, 1]] - nodes[shared[:, 0]]
    angle = np.arccos(np.clip(np.sum(own * other, axis=-1), -1.0, 1.0))
    turn = np.copysign(angle, np.einsum("pei,pi->pe", np.cross(own, other), along))
    sharper = np.abs(turn).argmax(axis=1)
    return Edges(pairs // count, shared, turn[np.arange(len(turn)), sharper])


def sharp_points(nodes: Array, faces: Numbers, clamped: Flags) -> tuple[Array, Array]:
    """Points (k, 3) mm close together along sharp edges, and how sharp: 1 is a right angle, (k,).

    Of edges that are free to move: nodes (n,) may be clamped.
    Valleys are none: beyond them there is more tissue and not less.  Sharpness is the share of the
    image of a contact there (``mechanics.tip``) that spheres integrated at edges have: .6 at 75
    degrees, .36 at 60 and .27 at 48 are nearly squares of the angle.
    """
    edges = shared_edges(nodes, faces)
    sharp = (edges.turn > BLUNT) & ~clamped[edges.nodes].any(axis=1)
    turn, ends, t = edges.turn[sharp], nodes[edges.nodes[sharp]], ALONG
    N = np.array([1.0 - t, t])
    if ends.shape[1] == 3:
        N = np.array([(1.0 - t) * (1.0 - 2.0 * t), t * (2.0 * t - 1.0), 4.0 * t * (1.0 - t)])
    sharpness = np.minimum((turn / (np.pi / 2)) ** 2, 1.0)
    return np.einsum("ka,pki->pai", N, ends).reshape(-1, 3), np.repeat(sharpness, len(t))
