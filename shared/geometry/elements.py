"""Kinds of elements and of their faces: nodes, shape functions, points, parts.

All that hangs on the kind is asked of it here; a further one is an entry of ``ELEMENTS`` or
``FACES``, where kinds are found by their number of nodes.  Node order is VTK's: corners, then the
middles of edges.
"""

import itertools
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import factorial, sqrt
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import roots_jacobi

from palpate.shared.arrays import Array, Ints, Numbers
from palpate.shared.mechanics.tissue import BULK, COMPRESSIBLE, WHOLE

POINTS = 2
"""Points along an axis of an element at which stress is known; see ``Kind.rule``."""


def gauss(points: int, dimension: int) -> tuple[Array, Array]:
    """Gauss-Legendre rule on [-1, 1]^d: coordinates (points^d, d) and weights (points^d,)."""
    x, w = np.polynomial.legendre.leggauss(points)
    grid = np.array(list(itertools.product(x, repeat=dimension)))
    weights = np.array([np.prod(c) for c in itertools.product(w, repeat=dimension)])
    return grid, weights


def collapsed_gauss(points: int, dimension: int) -> tuple[Array, Array]:
    """As ``gauss`` on the simplex of coordinates >= 0 whose sum is <= 1, as exact.

    The cube is collapsed onto it; what that does to volumes is a weight of Gauss and Jacobi.
    """
    at, weights = np.zeros((1, 0)), np.ones(1)
    for k in range(dimension):
        x, own = roots_jacobi(points, k, 0)
        x, own = (1 + x) / 2, own / 2 ** (k + 1)
        inner = np.multiply.outer(1 - x, at).reshape(len(x) * len(at), k)
        at = np.column_stack([np.repeat(x, len(at)), inner])
        weights = np.outer(own, weights).ravel()
    return at, weights


@dataclass(frozen=True, eq=False)
class Kind(ABC):
    """A kind of element, d = 3, or of face, d = 2."""

    nodes: Array  # (n, d) reference coordinates
    edges: tuple[tuple[int, int], ...]  # corners at their ends, in the order of the middles
    faces: tuple[tuple[int, ...], ...] = ()  # their corners, outward by the right-hand rule
    triangles: tuple[tuple[int, int, int], ...] = ()  # of nodes, that a face is drawn with
    vtk: int = 0  # VTK's number of an element

    @property
    @abstractmethod
    def corners(self) -> int:
        """Number of corners."""

    @property
    @abstractmethod
    def best(self) -> float:
        """Largest Jacobian determinant that edges of length 1 allow."""

    @abstractmethod
    def shape(self, at: Array) -> tuple[Array, Array]:
        """Shape functions (q, n) and their derivatives (q, n, d) at coordinates (q, d)."""

    @abstractmethod
    def rule(self, points: int) -> tuple[Array, Array]:
        """Quadrature with so many points along an axis: coordinates (q, d) and weights (q,)."""

    @property
    def quadratic(self) -> bool:
        """Whether edges have middles."""
        return len(self.nodes) > self.corners

    @cached_property
    def straight(self) -> Self:
        """The kind with corners alone."""
        return replace(self, nodes=self.nodes[: self.corners])

    @property
    def integration(self) -> tuple[Array, Array, Ints]:
        """Points of models: coordinates (q, d), weights (q,), and parts of the law there (q,).

        First those at which stress is known.
        """
        at, weights = self.rule(POINTS)
        return at, weights, np.full(len(weights), WHOLE)

    @cached_property
    def points(self) -> int:
        """Number of points of an element at which stress is known."""
        return len(self.rule(POINTS)[1])

    @cached_property
    def edges_at(self) -> Ints:
        """Corners (corners, 3, 2) at the ends of the edges that meet in each corner."""
        return np.array([[e for e in self.edges if c in e] for c in range(self.corners)])

    def on_face(self, corners: Sequence[int]) -> list[int]:
        """Nodes of the face with these corners."""
        if not self.quadratic:
            return list(corners)
        ends = [{a, b} for a, b in zip(corners, [*corners[1:], corners[0]], strict=True)]
        edges = [set(edge) for edge in self.edges]
        return [*corners, *(self.corners + edges.index(end) for end in ends)]


@dataclass(frozen=True, eq=False)
class Box(Kind):
    """Quadrilaterals and hexahedra on [-1, 1]^d, Lagrange or serendipity."""

    @property
    def corners(self) -> int:
        """See ``Kind``."""
        return int(2 ** self.nodes.shape[1])

    @property
    def best(self) -> float:
        """See ``Kind``: the unit cube."""
        return 1.0 / self.corners

    def shape(self, at: Array) -> tuple[Array, Array]:
        """See ``Kind``.

        Notes
        -----
        Serendipity (Hughes, The Finite Element Method, ch. 3): with ``l_i = 1 + x_i a_i``, corners
        ``prod l_i (sum x_i a_i - d + 1) / 2^d``, middles ``(1 - x_k^2) prod_{i != k} l_i /
        2^(d-1)``.
        """
        n, d = self.nodes.shape
        N = np.empty((len(at), n))
        dN = np.empty((len(at), n, d))
        for a, corner in enumerate(self.nodes):
            middle = corner == 0
            factor = np.where(middle, 1 - at**2, 1 + at * corner)
            slope = np.where(middle, -2 * at, np.broadcast_to(corner, at.shape))
            scale = 2.0 ** -(d - middle.sum())
            others = [np.prod(np.delete(factor, i, axis=1), axis=1) for i in range(d)]
            product = np.prod(factor, axis=1)
            N[:, a] = scale * product
            for i in range(d):
                dN[:, a, i] = scale * slope[:, i] * others[i]
            if self.quadratic and not middle.any():
                extra = at @ corner - (d - 1)
                for i in range(d):
                    dN[:, a, i] = dN[:, a, i] * extra + N[:, a] * corner[i]
                N[:, a] *= extra
        return N, dN

    def rule(self, points: int) -> tuple[Array, Array]:
        """See ``Kind``: Gauss and Legendre's."""
        return gauss(points, self.nodes.shape[1])


@dataclass(frozen=True, eq=False)
class Simplex(Kind):
    """Triangles and tetrahedra of coordinates >= 0 whose sum is <= 1, linear or quadratic.

    Quadratic tetrahedra that must keep their volume at four points are too stiff, and at the centre
    alone they follow no change of pressure.  So what keeps the volume of nearly incompressible
    tissue is integrated at the centre, the rest at those four.
    """

    @property
    def corners(self) -> int:
        """See ``Kind``."""
        return self.nodes.shape[1] + 1

    @property
    def best(self) -> float:
        """See ``Kind``: the regular simplex."""
        d = self.nodes.shape[1]
        return sqrt((d + 1) / 2**d)

    def shape(self, at: Array) -> tuple[Array, Array]:
        """See ``Kind``: with barycentric coordinates L, corners L (2 L - 1), middles 4 L_a L_b."""
        d = self.nodes.shape[1]
        L = np.column_stack([1 - at.sum(axis=1), at])
        dL = np.vstack([-np.ones(d), np.eye(d)])
        if not self.quadratic:
            return L, np.broadcast_to(dL, (len(at), *dL.shape)).copy()
        a, b = np.array(self.edges).T
        N = np.hstack([L * (2 * L - 1), 4 * L[:, a] * L[:, b]])
        middles = 4 * (L[:, a, None] * dL[b] + L[:, b, None] * dL[a])
        return N, np.concatenate([(4 * L - 1)[..., None] * dL, middles], axis=1)

    def rule(self, points: int) -> tuple[Array, Array]:
        """See ``Kind``: 1 is the centre, 2 are d + 1 points, exact for quadratic functions.

        Hammer, Marlowe & Stroud, Math. Tables Aids Comput. 10 (1956); from 3 on points^d.
        """
        d = self.nodes.shape[1]
        if points > 2:
            return collapsed_gauss(points, d)
        share = (1 - 1 / sqrt(d + 2)) / (d + 1)
        near = np.full((d + 1, d), share) + (1 - (d + 1) * share) * np.eye(d + 1)[:, 1:]
        at = near if points == 2 else np.full((1, d), 1 / (d + 1))
        return at, np.full(len(at), 1 / (factorial(d) * len(at)))

    @property
    def integration(self) -> tuple[Array, Array, Ints]:
        """See ``Kind``."""
        rules, parts = [self.rule(POINTS), self.rule(1)], (COMPRESSIBLE, BULK)
        at, weights = (np.concatenate(own) for own in zip(*rules, strict=True))
        return at, weights, np.repeat(parts, [len(own) for _, own in rules])


class Face(Kind):
    """A kind of face, which can be cut into cells like itself along one or two axes."""

    axes: int

    @abstractmethod
    def along(self, values: Array) -> Array:
        """Largest (f, axes) along each axis of values (f, edges)."""

    @abstractmethod
    def cells(self, *counts: int) -> tuple[Array, Numbers]:
        """Equal cells, so many along each axis: points (q, 2), and their corners (c, corners)."""

    @abstractmethod
    def spread(self, *counts: int) -> tuple[Array, Array]:
        """Points (q, 2), so many along each axis, that see a load alike; and weights (q,)."""

    def lengths(self, X: Array) -> Array:
        """Longest edges (f, axes) mm along each axis of faces with nodes (f, n, 3) mm."""
        ends = X[:, np.array(self.edges)]
        return self.along(np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2))

    def bent(self, X: Array) -> Array:
        """How far (f, axes) mm middles of edges lie from the chords, as ``lengths``."""
        chords = X[:, np.array(self.edges)].mean(axis=2)
        return self.along(np.linalg.norm(X[:, self.corners :] - chords, axis=2))


class Quadrilateral(Box, Face):
    """A face of a hexahedron."""

    axes = 2

    def along(self, values: Array) -> Array:
        """See ``Face``: edges 0 and 2 run along the first axis."""
        return np.maximum(values[:, :2], values[:, 2:])

    def cells(self, *counts: int) -> tuple[Array, Numbers]:
        """See ``Face``."""
        a, b = counts
        y, x = np.meshgrid(np.linspace(-1, 1, b + 1), np.linspace(-1, 1, a + 1), indexing="ij")
        first = np.arange((a + 1) * b).reshape(b, a + 1)[:, :-1].reshape(-1, 1)
        corners = first + np.array([0, 1, a + 2, a + 1])
        return np.column_stack([x.ravel(), y.ravel()]), corners.astype(np.int32)

    def spread(self, *counts: int) -> tuple[Array, Array]:
        """See ``Face``: Gauss and Legendre's."""
        (x, wx), (y, wy) = (gauss(count, 1) for count in counts)
        at = np.column_stack([np.repeat(x[:, 0], len(y)), np.tile(y[:, 0], len(x))])
        return at, np.outer(wx, wy).ravel()


class Triangle(Simplex, Face):
    """A face of a tetrahedron."""

    axes = 1

    def along(self, values: Array) -> Array:
        """See ``Face``: all edges alike."""
        return np.max(values, axis=1, keepdims=True)

    def cells(self, *counts: int) -> tuple[Array, Numbers]:
        """See ``Face``: from one edge to the next, upright and upside down."""
        (n,) = counts
        i, j = np.array([(i, j) for i in range(n + 1) for j in range(n + 1 - i)]).T
        number = np.full((n + 2, n + 2), -1, np.int32)
        number[i, j] = np.arange(len(i))
        upright = number[i, j], number[i + 1, j], number[i, j + 1]
        others = number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]
        corners = np.hstack([upright, others]).T
        return np.column_stack([i, j]) / n, corners[(corners >= 0).all(axis=1)]

    def spread(self, *counts: int) -> tuple[Array, Array]:
        """See ``Face``: three in each cell, of which there are half as many along an axis."""
        at, cells = self.cells(-(-counts[0] // 2))
        (own, weights), straight = self.rule(2), self.straight
        points = straight.shape(own)[0] @ at[cells]
        return points.reshape(-1, 2), np.tile(weights / len(cells), len(cells))


def _with_middles(corners: Array, edges: Sequence[tuple[int, int]]) -> Array:
    return np.vstack([corners, corners[np.array(edges)].mean(axis=1)])


HEX_CORNERS = np.array(
    [
        [-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1],
        [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1],
    ],
    dtype=float,
)  # fmt: skip
HEX_EDGES = (
    (0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7),
)  # fmt: skip
# low and high end of each axis, the order in which a geometry names its sides
HEX_FACES = ((0, 4, 7, 3), (1, 2, 6, 5), (0, 1, 5, 4), (3, 7, 6, 2), (0, 3, 2, 1), (4, 5, 6, 7))
TET_CORNERS = np.vstack([np.zeros(3), np.eye(3)])
TET_EDGES = ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))
TET_FACES = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3))
QUAD_CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=float)
QUAD_EDGES = ((0, 1), (1, 2), (2, 3), (3, 0))
TRIANGLE_CORNERS = np.vstack([np.zeros(2), np.eye(2)])
TRIANGLE_EDGES = ((0, 1), (1, 2), (2, 0))

HEX8 = Box(HEX_CORNERS, HEX_EDGES, HEX_FACES, vtk=12)
HEX20 = Box(_with_middles(HEX_CORNERS, HEX_EDGES), HEX_EDGES, HEX_FACES, vtk=25)
TET10 = Simplex(_with_middles(TET_CORNERS, TET_EDGES), TET_EDGES, TET_FACES, vtk=24)
QUAD4 = Quadrilateral(QUAD_CORNERS, QUAD_EDGES, triangles=((0, 1, 2), (0, 2, 3)))
QUAD8 = Quadrilateral(
    _with_middles(QUAD_CORNERS, QUAD_EDGES),
    QUAD_EDGES,
    triangles=((0, 4, 7), (4, 1, 5), (5, 2, 6), (6, 3, 7), (4, 5, 7), (5, 6, 7)),
)
TRIANGLE6 = Triangle(
    _with_middles(TRIANGLE_CORNERS, TRIANGLE_EDGES),
    TRIANGLE_EDGES,
    triangles=((0, 3, 5), (3, 1, 4), (4, 2, 5), (3, 4, 5)),
)

ELEMENTS: dict[int, Kind] = {len(kind.nodes): kind for kind in (HEX8, HEX20, TET10)}
FACES: dict[int, Face] = {len(kind.nodes): kind for kind in (QUAD4, QUAD8, TRIANGLE6)}


def kind_of(elements: NDArray[np.integer[Any]]) -> Kind:
    """Kind of elements (e, n)."""
    return ELEMENTS[elements.shape[1]]


def face_kind_of(faces: Numbers) -> Face:
    """Kind of faces (f, n)."""
    return FACES[faces.shape[1]]
