"""Finer meshes of a body, all of them divisions of its base mesh.

A tetrahedron is cut in two through the middle of its longest edge, as often as it takes (Rivara,
Int. J. Numer. Methods Eng. 20, 1984).  That edge follows from the tetrahedron alone, so that all
meshes are cuts of one tree: a node of one mesh is a node of every mesh that divides it, to the bit.
New nodes lie where the quadratic map of their base element puts them, so that every mesh is of the
very same body.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from palpate.offline.bodies.base import Base
from palpate.offline.bodies.tetrahedra import EDGES, boundary, curved, edge_lengths, shape
from palpate.shared.arrays import Array, Flags, Ints, Numbers
from palpate.shared.scene import SceneError

MOST_ELEMENTS = 400_000

ALIKE = 1e-9
"""Relative difference of edges that are as long as each other."""

ASKEW = np.array([1.0, np.sqrt(2.0) - 0.3, np.sqrt(3.0) / 7.0])
"""Direction along which the middle of one of these lies farther than that of another."""

EdgeLength = Callable[[Array], Array]
"""Longest edges (k,) mm that are wanted at points (k, 3) mm."""


@dataclass(frozen=True)
class Refined:
    """A mesh of a body, and where its nodes, elements and faces lie in the base mesh."""

    nodes: Array  # (n, 3) mm
    elements: Numbers  # (e, 10)
    faces: Numbers  # (f, 6)
    element_of: Ints  # (e,) base element
    face_of: Ints  # (f,) base face, as ``boundary`` numbers them
    sites: Array  # (n, 5) where nodes lie: base element of lowest number, coordinates in it
    corners: Array  # (e, 4, 4) barycentric coordinates of an element's corners in its base element

    def at(self, sites: Array, field: Array) -> Array:
        """A nodal field (n, ...) at ``sites`` (k, 5) of this mesh or another of the same body."""
        home, where = sites[:, 0].astype(int), sites[:, 1:]
        inverse = np.linalg.inv(self.corners)
        order = np.argsort(self.element_of, kind="stable")
        ends = np.searchsorted(self.element_of[order], np.arange(self.element_of.max() + 2))
        element, own = np.empty(len(sites), int), np.empty((len(sites), 4))
        by_home = np.argsort(home, kind="stable")
        for some in np.split(by_home, np.flatnonzero(np.diff(home[by_home])) + 1):
            base = home[some[0]]
            inside = order[ends[base] : ends[base + 1]]
            found = np.einsum("ka,eab->keb", where[some], inverse[inside])
            best = found.min(axis=2).argmax(axis=1)
            element[some], own[some] = inside[best], found[np.arange(len(some)), best]
        values: Array = np.einsum("ka,ka...->k...", shape(own), field[self.elements[element]])
        return values


class _Cut:
    """Tetrahedra while they are cut: corners (e, 4), base elements (e,), where in these (e, 4, 4).

    ``points`` (n, 3) mm are those of all corners.
    """

    def __init__(self, base: Base) -> None:
        self.base = base
        self.corners = base.elements[:, :4].astype(np.int64)
        self.element_of = np.arange(len(base.elements))
        self.at = np.tile(np.eye(4), (len(base.elements), 1, 1))
        self.points = base.nodes
        self.keys, self.middles = np.empty(0, np.int64), np.empty(0, np.int64)

    def longest(self) -> tuple[Ints, Array]:
        """Which of its edges (e,) is cut of every tetrahedron, and its length (e,) mm."""
        ends = self.points[self.corners[:, EDGES]]
        length = edge_lengths(self.points, self.corners)
        most = length.max(axis=1)
        alike = length >= (1.0 - ALIKE) * most[:, None]
        along = np.where(alike, (ends[:, :, 0] + ends[:, :, 1]) @ ASKEW, -np.inf)
        return along.argmax(axis=1), most

    def cut(self, marked: Flags) -> None:
        """Cut the marked tetrahedra once, and others until they fit together again."""
        while True:
            keys = _keys(self.corners)
            chosen = np.flatnonzero(marked | np.isin(keys, self.keys).any(axis=1))
            if not len(chosen):
                return
            edge = self.longest()[0][chosen]
            self._divide(chosen, edge, keys[chosen, edge])
            marked = np.zeros(len(self.corners), dtype=bool)

    def _divide(self, chosen: Ints, edge: Ints, keys: Ints) -> None:
        rows = np.arange(len(chosen))
        one, two = EDGES[edge].T
        at, corners = self.at[chosen], self.corners[chosen]
        middle = (at[rows, one] + at[rows, two]) / 2.0
        fresh, first = np.unique(keys, return_index=True)
        new = ~np.isin(fresh, self.keys)
        fresh, first = fresh[new], first[new]
        numbers = len(self.points) + np.arange(len(fresh))
        self.points = np.vstack([self.points, np.empty((len(fresh), 3))])
        self.keys = np.concatenate([self.keys, fresh])
        self.middles = np.concatenate([self.middles, numbers])
        order = np.argsort(self.keys)
        self.keys, self.middles = self.keys[order], self.middles[order]
        number = self.middles[np.searchsorted(self.keys, keys)]
        self.points[numbers] = placed(self.base, self.element_of[chosen[first]], middle[first])
        halves = []
        for end in (one, two):
            own, where = corners.copy(), at.copy()
            own[rows, end], where[rows, end] = number, middle
            halves.append((own, where))
        self.corners[chosen], self.at[chosen] = halves[0]
        self.corners = np.vstack([self.corners, halves[1][0]])
        self.at = np.vstack([self.at, halves[1][1]])
        self.element_of = np.concatenate([self.element_of, self.element_of[chosen]])


def placed(base: Base, element: Ints, at: Array) -> Array:
    """Points (k, 3) mm at barycentric coordinates (k, 4) of elements (k,) of a base mesh."""
    points: Array = np.einsum("ka,kai->ki", shape(at), base.nodes[base.elements[element]])
    return points


def refined(base: Base, edge_length_at: EdgeLength) -> Refined:
    """The mesh of a body whose edges are as short as wanted, and no shorter than that takes.

    Raises
    ------
    SceneError
        If that takes more than ``MOST_ELEMENTS``.
    """
    mesh = _Cut(base)
    while True:
        corners = mesh.points[mesh.corners]
        wanted = edge_length_at(mesh.points)[mesh.corners].min(axis=1)
        wanted = np.minimum(wanted, edge_length_at(corners.mean(axis=1)))
        marked = mesh.longest()[1] > wanted
        if not marked.any():
            return _finished(mesh)
        mesh.cut(marked)
        if len(mesh.corners) > MOST_ELEMENTS:
            raise SceneError(
                f"geometry: edges of {wanted.min():.2g} mm take more than {MOST_ELEMENTS} "
                "tetrahedra; a larger endoscope, or a smaller body, takes fewer"
            )


def growing(points: Array, finest: float, growth: float, coarsest: float) -> EdgeLength:
    """Edges of ``finest`` (mm) at points (k, 3) mm that grow with the distance from these."""
    tree = cKDTree(points)

    def edge_length_at(at: Array) -> Array:
        away = np.asarray(tree.query(at)[0])
        return np.minimum(finest + growth * away, coarsest)

    return edge_length_at


def spread_over(base: Base, chosen: Flags, spacing: float) -> Array:
    """Points (k, 3) mm so close together (mm) all over chosen faces of the boundary."""
    faces = boundary(base.elements)[0][chosen]
    corners = base.nodes[faces[:, :3]]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max()
    return curved(faces, base.nodes, squares=int(np.ceil(longest / spacing)))[0]


def _keys(corners: Ints) -> Ints:
    """A number (e, 6) for each edge that does not depend on the tetrahedron."""
    ends = np.sort(corners[:, EDGES], axis=2)
    return np.asarray(ends[:, :, 0] << 32 | ends[:, :, 1])


def _finished(mesh: _Cut) -> Refined:
    """Quadratic elements of the tetrahedra, with nodes numbered as they first occur."""
    keys = _keys(mesh.corners)
    _, middle = np.unique(keys, return_inverse=True)
    numbers = np.hstack([mesh.corners, len(mesh.points) + middle.reshape(-1, 6)])
    at = np.concatenate([mesh.at, mesh.at[:, EDGES].mean(axis=2)], axis=1)
    order = np.lexsort([np.repeat(mesh.element_of, 10), numbers.ravel()])
    used, first = np.unique(numbers.ravel()[order], return_index=True)
    elements = np.searchsorted(used, numbers).astype(np.int32)
    within = np.repeat(mesh.element_of, 10)[order[first]]
    where = at.reshape(-1, 4)[order[first]]
    faces, owner, opposite = boundary(elements)
    face_of = _base_faces(mesh, owner, opposite)
    nodes, sites = placed(mesh.base, within, where), np.column_stack([within, where])
    return Refined(nodes, elements, faces, mesh.element_of, face_of, sites, mesh.at)


def _base_faces(mesh: _Cut, owner: Ints, opposite: Ints) -> Ints:
    """The face of the base mesh that each face of the boundary is part of."""
    _, base_owner, base_opposite = boundary(mesh.base.elements)
    others = ~np.eye(4, dtype=bool)[opposite]
    at = mesh.at[owner]
    beyond = np.where(others[:, :, None], at, 0.0).max(axis=1)  # (f, 4)
    key = 4 * mesh.element_of[owner] + beyond.argmin(axis=1)
    known = 4 * base_owner + base_opposite
    order = np.argsort(known)
    return np.asarray(order[np.searchsorted(known[order], key)])
