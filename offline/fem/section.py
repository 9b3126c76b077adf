"""A cross-section: its smooth outline and a smooth map of the unit square onto it.

The outline is a periodic cubic spline through the measured points. The map minimises the mean
ratio energy (the variational form of Winslow's smoothing) of a fine grid whose nodes are uniform
along the outer side and the two ends and slide freely along the inner side, so that the mesh lines
leave the boundary as squarely as the shape allows. Every mesh of a section, coarse or fine, is a
sampling of the same map.
"""

import io
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline, RectBivariateSpline
from scipy.optimize import minimize

from palpate.shared.arrays import Array
from palpate.shared.files import open_regular
from palpate.shared.scene import SceneError

# Grids on which the map is found. The last is fine enough that its cubic interpolation error
# (microns) is far below the resolution of any medical image.
LEVELS = ((18, 3), (36, 6), (72, 12))

TURN, TURNING = 0.2, 2.0
"""Angle (rad) by which each of two sides turns inward where they meet, and the length (mm) along
which it does, at most a third of the side: elements in the corner of a smooth outline would have
no volume.  The outline moves by .15 of their product at most, .06 mm."""

BETWEEN = 9
"""Places on the line between two points at which the outline is compared with it."""

ON_OUTLINE = 0.02
"""How far a corner may lie from the outline, over its length."""

Section = Callable[[ArrayLike, ArrayLike], Array]
"""Points (..., 2) mm for parameters u, v (...): u runs from the lip (0) to the tip (1), v from the
inner (0) to the outer side (1)."""


def read_section(path: Path) -> bytes:
    """Content of the file of an outline; raise ``SceneError`` if it cannot be read."""
    try:
        with open_regular(path) as file:
            return file.read()
    except OSError as error:
        raise SceneError(
            f"geometry.section: {path} cannot be read: {error.strerror or error}"
        ) from error


def read_outline(path: Path) -> Array:
    """Read a closed outline (n, 2) mm, clockwise when x points right and z up.

    The CSV file has one header line and two columns, x and z; the last point is joined to the
    first.

    Raises
    ------
    SceneError
        If the file cannot be read, has fewer than 8 points, repeats one or crosses itself.
    """
    content = read_section(path)
    if not re.match(rb".*[A-Za-z]", content):
        raise SceneError(
            f"geometry.section: {path} cannot be read: its first line must name the columns, x,z"
        )
    try:
        points = np.loadtxt(io.BytesIO(content), delimiter=",", skiprows=1, ndmin=2)
    except ValueError as error:
        raise SceneError(
            f"geometry.section: {path} cannot be read: below its first line must be two numbers "
            f"a line with a comma between; {error}"
        ) from error
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 8 or not np.isfinite(points).all():
        raise SceneError(f"geometry.section: {path} must hold at least 8 rows of finite x, z")
    if (np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1) == 0).any():
        raise SceneError(f"geometry.section: {path} repeats a point")
    crossing = _first_crossing(points)
    if crossing is not None:
        one, other = crossing
        raise SceneError(
            f"geometry.section: {path} crosses itself between points {one} and {other}"
        )
    return points if polygon_area(points) < 0 else points[::-1]


def bulge(points: Array) -> tuple[float, Array]:
    """How far (mm) the smooth outline strays from straight lines between its points, and where."""
    curve, arc = smooth(points)
    ends = np.linspace(arc[:-1], arc[1:], BETWEEN, axis=1)  # (n, BETWEEN) along each line
    share = np.linspace(0.0, 1.0, BETWEEN)[:, None]
    lines = (1.0 - share) * points[:, None] + share * np.roll(points, -1, axis=0)[:, None]
    away = np.linalg.norm(curve(ends) - lines, axis=2)
    return float(away.max()), curve(ends.ravel()[away.argmax()])


def smooth(points: Array) -> tuple[CubicSpline, Array]:
    """The smooth outline by its arc length (mm) along the polygon, and that of its points."""
    closed = np.vstack([points, points[:1]])
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    return CubicSpline(arc, closed, bc_type="periodic"), arc


def polygon_area(points: Array) -> float:
    """Signed area of a closed polygon, shape (n, 2); mm², positive if counter-clockwise."""
    after = np.roll(points, -1, axis=0)
    return float(0.5 * np.sum(_cross(points, after)))


def _first_crossing(points: Array) -> tuple[int, int] | None:
    """Find the first two edges of a closed polygon that cross, if any do."""
    a, b = points, np.roll(points, -1, axis=0)
    # Two edges cross where each separates the other's ends.
    side_a = _cross((b - a)[:, None], a[None] - a[:, None])
    side_b = _cross((b - a)[:, None], b[None] - a[:, None])
    separates = side_a * side_b < 0
    found = np.argwhere(np.triu(separates & separates.T))
    return (int(found[0, 0]), int(found[0, 1])) if len(found) else None


def _cross(a: Array, b: Array) -> Array:
    cross: Array = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return cross


def map_section(points: Array, corners: ArrayLike) -> Section:
    """Find a smooth map of the unit square onto the inside of an outline.

    Parameters
    ----------
    points : ndarray, shape (n, 2), mm
        Clockwise outline.
    corners : array, shape (4, 2), mm
        Where (u, v) = (0, 1), (1, 1), (1, 0), (0, 0) go; moved to the nearest outline point.

    Returns
    -------
    section : Section

    Raises
    ------
    SceneError
        If the corners are off the outline or out of order, or leave the grid folded.

    Notes
    -----
    Minimises the sum of (|a|² + |b|²) / (2 det(a, b)) over the four corners of every grid cell, a
    and b being its edges scaled by the mean cell size. As cells may be folded at first, det stands
    for (det + sqrt(det² + ε²)) / 2 with ε going down (Escobar et al., Comput. Methods Appl. Mech.
    Eng. 192, 2003). The coarser levels only serve to start the finest well.
    """
    boundary = _Boundary(points, corners)
    u, v = _uniform(LEVELS[0])
    slid = boundary.inner * u[1:-1]
    grid = boundary.blend(u, v, slid)
    for level in LEVELS:
        refined = _uniform(level)
        grid = np.stack(
            [RectBivariateSpline(u, v, grid[..., i])(*refined) for i in (0, 1)], axis=-1
        )
        slid = CubicSpline(u, [0.0, *slid, boundary.inner])(refined[0])[1:-1]
        u, v = refined
        for epsilon in (1.0, 0.1, 0.01) if level is LEVELS[0] else (0.01,):
            grid, slid = _smooth(boundary, grid, slid, epsilon)
    if _mean_ratio(grid, boundary.scale(grid), epsilon)[2] <= 0:
        raise SceneError("geometry.corners: this split of the outline leaves a folded mesh")
    x, z = (RectBivariateSpline(u, v, grid[..., i]) for i in (0, 1))

    def section(u: ArrayLike, v: ArrayLike) -> Array:
        return np.stack([x(u, v, grid=False), z(u, v, grid=False)], axis=-1)

    return section


class _Boundary:
    """A smooth outline cut into four sides, of arc lengths ``outer, tip, inner, lip`` (mm)."""

    def __init__(self, points: Array, corners: ArrayLike) -> None:
        self._curve, arc = smooth(points)
        dense = np.linspace(0.0, arc[-1], 40 * len(points), endpoint=False)
        curve, most = self._curve(dense), ON_OUTLINE * arc[-1]
        gaps = np.linalg.norm(np.asarray(corners)[:, None] - curve[None], axis=2)
        for number, (x, z) in enumerate(np.asarray(corners).tolist()):
            gap = gaps[number].min()
            if gap > most:
                near = ", ".join(f"{c:.3g}" for c in curve[gaps[number].argmin()])
                raise SceneError(
                    f"geometry.corners.{number} = [{x:g}, {z:g}]: lies {gap:.2g} mm from the "
                    f"outline of the section, and may lie {most:.2g}; nearest is [{near}]"
                )
        self._starts = dense[gaps.argmin(axis=1)]
        sides = np.diff(self._starts, append=self._starts[0]) % arc[-1]
        if not np.isclose(sides.sum(), arc[-1]) or sides.min() < 0.01 * arc[-1]:
            raise SceneError("geometry.corners: must lie apart and go clockwise round the section")
        self.outer, self.tip, self.inner, self.lip = sides
        # (4, 2) mm of the sides before and after a corner
        self._turning = np.minimum(TURNING, np.column_stack([np.roll(sides, 1), sides]) / 3)

    def scale(self, grid: Array) -> Array:
        """Inverse of a grid's mean cell size along u and v, shape (2,), 1/mm."""
        cells = np.array(grid.shape[:2]) - 1
        return 2 * cells / np.array([self.outer + self.inner, self.tip + self.lip])

    def place(self, grid: Array, slid: Array) -> None:
        """Put the rim of a grid (nu + 1, nv + 1, 2) mm onto the outline.

        ``slid`` (nu - 1,) mm is where its inner nodes lie along the inner side, from the lip.
        """
        u, v = _uniform((grid.shape[0] - 1, grid.shape[1] - 1))
        grid[:, -1] = self._at(0, self.outer * u)
        grid[-1] = self._at(1, self.tip * (1 - v))
        grid[0] = self._at(3, self.lip * v)
        grid[1:-1, 0] = self._at(3, -slid)

    def blend(self, u: Array, v: Array, slid: Array) -> Array:
        """Coons patch over the outline, shape (nu + 1, nv + 1, 2), mm."""
        grid = np.empty((len(u), len(v), 2))
        self.place(grid, slid)
        u, v = u[:, None, None], v[None, :, None]
        along = (1 - v) * grid[:, :1] + v * grid[:, -1:]
        across = (1 - u) * grid[:1] + u * grid[-1:]
        lip = (1 - v) * grid[:1, :1] + v * grid[:1, -1:]
        tip = (1 - v) * grid[-1:, :1] + v * grid[-1:, -1:]
        blend: Array = along + across - (1 - u) * lip - u * tip
        return blend

    def slope(self, slid: Array) -> Array:
        """How the inner nodes move as they slide, shape (nu - 1, 2)."""
        return -self._at(3, -slid, derivative=1)

    def _at(self, corner: int, distance: Array, derivative: int = 0) -> Array:
        """Points (..., 2) mm at a distance (mm) past a corner, or their derivative in it."""
        arc = (self._starts[corner] + distance) % self._curve.x[-1]
        at, tangent, bend = (self._curve(arc, order) for order in range(3))
        inward, turning = (np.stack([d[..., 1], -d[..., 0]], axis=-1) for d in (tangent, bend))
        depth, slope = self._turned(arc)
        if derivative == 0:
            moved: Array = at + depth[..., None] * inward
            return moved
        tangents: Array = tangent + slope[..., None] * inward + depth[..., None] * turning
        return tangents

    def _turned(self, arc: Array) -> tuple[Array, Array]:
        """How far (mm) the outline is moved inward at arc lengths (mm), and the slope of that."""
        depth, slope = np.zeros((2, *arc.shape))
        half = self._curve.x[-1] / 2
        for start, (before, after) in zip(self._starts, self._turning, strict=True):
            away = (arc - start + half) % (2 * half) - half
            share = np.abs(away) / np.where(away < 0, before, after)
            rest = np.maximum(1 - share, 0.0)
            depth += TURN * np.abs(away) * rest**2
            slope += TURN * np.where(away < 0, -1.0, 1.0) * rest * (1 - 3 * share)
        return depth, slope


def _uniform(cells: tuple[int, int]) -> tuple[Array, Array]:
    """Grid lines u (cells[0] + 1,) and v (cells[1] + 1,) of the unit square."""
    return np.linspace(0.0, 1.0, cells[0] + 1), np.linspace(0.0, 1.0, cells[1] + 1)


def _smooth(boundary: _Boundary, grid: Array, slid: Array, epsilon: float) -> tuple[Array, Array]:
    """Move a grid's inside, and its inner side's nodes along that side, to the least energy."""
    grid, inside, scale = grid.copy(), grid[1:-1, 1:-1].shape, boundary.scale(grid)

    def unpack(unknown: Array) -> Array:
        slid, free = np.split(unknown, [len(grid) - 2])
        boundary.place(grid, slid)
        grid[1:-1, 1:-1] = free.reshape(inside)
        return slid

    def objective(unknown: Array) -> tuple[float, Array]:
        slope = boundary.slope(unpack(unknown))
        energy, gradient, _ = _mean_ratio(grid, scale, epsilon)
        sliding = np.sum(gradient[1:-1, 0] * slope, axis=1)
        return energy, np.concatenate([sliding, gradient[1:-1, 1:-1].ravel()])

    found = minimize(
        objective,
        np.concatenate([slid, grid[1:-1, 1:-1].ravel()]),
        jac=True,
        method="L-BFGS-B",
        options={"maxiter": 5000, "maxcor": 30, "ftol": 1e-9},
    )
    slid = unpack(found.x)
    return grid, slid


def _mean_ratio(grid: Array, scale: Array, epsilon: float) -> tuple[float, Array, float]:
    """Mean ratio energy of a grid, its gradient, and the smallest scaled corner determinant.

    ``scale`` (2,) 1/mm is the inverse of the wanted cell size along the two grid directions,
    ``epsilon`` > 0 regularises folded cells.
    """
    gradient = np.zeros_like(grid)
    energy, smallest = 0.0, np.inf
    low, high = slice(None, -1), slice(1, None)
    for i in (low, high):
        for j in (low, high):
            # The two edges that meet in this corner of every cell.
            a = scale[0] * (grid[high, j] - grid[low, j])
            b = scale[1] * (grid[i, high] - grid[i, low])
            det = _cross(a, b)
            root = np.sqrt(det**2 + epsilon**2)
            smallest = min(smallest, det.min())
            safe = (det + root) / 2
            term = (np.sum(a**2, axis=-1) + np.sum(b**2, axis=-1)) / (2 * safe)
            pull = (term / safe * (1 + det / root) / 2)[..., None]
            turned_a = np.stack([-a[..., 1], a[..., 0]], axis=-1)
            turned_b = np.stack([b[..., 1], -b[..., 0]], axis=-1)
            by_a = scale[0] * (a / safe[..., None] - pull * turned_b)
            by_b = scale[1] * (b / safe[..., None] - pull * turned_a)
            energy += float(term.sum())
            gradient[high, j] += by_a
            gradient[low, j] -= by_a
            gradient[i, high] += by_b
            gradient[i, low] -= by_b
    return energy, gradient, float(smallest)
