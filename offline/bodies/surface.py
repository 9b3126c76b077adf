"""Closed surfaces from files: read, repaired where that is no matter of opinion, or refused."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from palpate.offline.bodies.files import first_line, refuse_size, require
from palpate.shared.anatomy import MILLIMETRES, Unit
from palpate.shared.arrays import Array, Ints, Numbers
from palpate.shared.geometry.surface import Surface
from palpate.shared.scene import SceneError

KINDS = ".stl", ".obj", ".ply"

CRUMB, HOLE, CROSSED = 0.01, 0.2, 0.01
"""Largest share of the area of a loose part that is left out; largest length round a hole that is
closed, in diagonals of the body's box; most pairs of triangles that may cross each other, over the
triangles: the mesh must then follow the surface all the same."""

COINCIDE = 6  # decimals of mm in which points that coincide agree

BRANCHES = (
    "{path}: the surface branches: edges belong to more than two triangles, or it has one side "
    "only; repair it (MeshLab: Repair Non Manifold Edges) and save it anew"
)


class Repaired(NamedTuple):
    """A closed surface of one part, outward by the right-hand rule, and what was done for it."""

    points: Array  # (p, 3) mm
    triangles: Numbers  # (t, 3)
    done: dict[str, int]
    crossings: int  # pairs of triangles that cross each other
    place: Array  # (3,) mm, of one of these


def read_surface(path: Path, unit: Unit) -> Any:
    """Triangles of a file in mm, as a mesh of trimesh; raise `SceneError` if there are none."""
    trimesh = require("trimesh")
    try:
        mesh = trimesh.load(path, force="mesh", process=False)
        points, triangles = np.array(mesh.vertices, float), np.array(mesh.faces, np.int64)
    except Exception as error:  # of the library's readers, whatever they trip over
        raise SceneError(
            f"{path}: cannot be read as {path.suffix[1:].upper()} ({first_line(error)}); "
            "save it anew, as binary STL for example"
        ) from error
    if not len(triangles) or points.shape[1:] != (3,) or triangles.shape[1:] != (3,):
        raise SceneError(f"{path}: has no triangles, or is cut short; save the body's surface anew")
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise SceneError(f"{path}: has triangles of points that are not there; save it anew")
    used, compact = np.unique(triangles, return_inverse=True)
    points = MILLIMETRES[unit] * points[used]
    refuse_size(path, points, unit)
    return mesh_of(points, compact.reshape(-1, 3))


def mesh_of(points: Array, triangles: Ints | Numbers) -> Any:
    """Points (p, 3) mm and triangles (t, 3) as a mesh of trimesh, as they are."""
    return require("trimesh").Trimesh(points, triangles, process=False)


def repaired(path: Path, mesh: Any) -> Repaired:
    """A closed surface; raise `SceneError` with what is wrong and what helps if it is none.

    Points that coincide are joined, triangles without area and copies left out, crumbs left out,
    small holes closed, and all triangles turned outward.
    """
    trimesh = require("trimesh")
    points, triangles = _joined(mesh)
    done = {
        "points_joined": len(mesh.vertices) - len(points),
        "triangles_left_out": len(mesh.faces) - len(triangles),
    }
    if not len(triangles):
        raise SceneError(f"{path}: all triangles are without area; save the body's surface anew")
    mesh = mesh_of(points, triangles)
    if (np.unique(mesh.edges_sorted, axis=0, return_counts=True)[1] > 2).any():
        raise SceneError(BRANCHES.format(path=path))
    mesh, done["crumbs_left_out"] = _largest_part(path, mesh)
    if not mesh.is_winding_consistent:
        trimesh.repair.fix_winding(mesh)
        done["turned"] = 1
    done["holes_closed"] = _close(path, mesh)
    if not (mesh.is_watertight and mesh.is_winding_consistent):
        raise SceneError(BRANCHES.format(path=path))
    if mesh.volume < 0:
        mesh.invert()
        done["turned"] = 1
    found = np.array(mesh.vertices), np.array(mesh.faces, np.int32)
    crossings, place = _crossings(*found)
    if crossings > CROSSED * len(mesh.faces):
        raise SceneError(f"{path}: {in_words(crossings, place)}")
    return Repaired(*found, done, crossings, place)


def in_words(crossings: int, place: Array) -> str:
    """That triangles cross each other, where, and what helps."""
    x, y, z = place
    return (
        f"{crossings} pairs of triangles cross each other, one near ({x:.1f}, {y:.1f}, {z:.1f}) "
        "mm: repair it (MeshLab: Select Self Intersecting Faces; Blender: Boolean union)"
    )


def _joined(mesh: Any) -> tuple[Array, Ints]:
    """Points and triangles with points that coincide made one, but triangles that are then none."""
    points, triangles = np.array(mesh.vertices), np.array(mesh.faces)
    _, first, number = np.unique(
        points.round(COINCIDE), axis=0, return_index=True, return_inverse=True
    )
    triangles = number.ravel()[triangles]
    ordered = np.sort(triangles, axis=1)
    distinct = np.zeros(len(triangles), dtype=bool)
    distinct[np.unique(ordered, axis=0, return_index=True)[1]] = True
    return points[first], triangles[distinct & (np.diff(ordered, axis=1) > 0).all(axis=1)]


def _largest_part(path: Path, mesh: Any) -> tuple[Any, int]:
    """The largest part by area, and how many crumbs beside it are left out."""
    trimesh = require("trimesh")
    labels = trimesh.graph.connected_component_labels(mesh.face_adjacency, len(mesh.faces))
    areas = np.bincount(labels, mesh.area_faces)
    largest, others = int(np.argmax(areas)), np.sort(areas)[:-1]
    large = others[others > CRUMB * areas.sum()]
    if len(large):
        largest_few = " and ".join(f"{area:.3g}" for area in [areas.max(), *large[::-1][:3]])
        raise SceneError(
            f"{path}: the surface has {len(large) + 1} separate parts, of {largest_few} mm²; a "
            "body is one: save one of them, without cavities, or join them"
        )
    mesh.update_faces(labels == largest)
    mesh.remove_unreferenced_vertices()
    return mesh, len(others)


def _close(path: Path, mesh: Any) -> int:
    """Close small holes; refuse large ones.  Returns how many were closed."""
    trimesh = require("trimesh")
    open_edges = mesh.edges[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]
    if not len(open_edges):
        return 0
    labels = trimesh.graph.connected_component_labels(open_edges, len(mesh.vertices))
    length = np.linalg.norm(np.diff(mesh.vertices[open_edges], axis=1)[:, 0], axis=1)
    around = np.bincount(labels[open_edges[:, 0]], length)
    worst = int(np.argmax(around))
    most = HOLE * np.linalg.norm(np.ptp(mesh.vertices, axis=0))
    if around[worst] > most:
        x, y, z = mesh.vertices[np.unique(open_edges[labels[open_edges[:, 0]] == worst])].mean(0)
        raise SceneError(
            f"{path}: the surface is open: a hole {around[worst]:.3g} mm round, near "
            f"({x:.1f}, {y:.1f}, {z:.1f}) mm, and only holes of up to {most:.2g} mm are closed: "
            "close it (MeshLab: Close Holes; Slicer: export a closed surface) and save it anew"
        )
    trimesh.repair.fill_holes(mesh, use_fan=True)
    return int(np.sum(around > 0))


def index_of(points: Array, triangles: Numbers) -> Surface:
    """Triangles as a surface that points are projected to."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    normals = np.zeros_like(points)
    np.add.at(normals, triangles, np.cross(b - a, c - a)[:, None])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 0, normals / np.where(length > 0, length, 1.0), [0.0, 0.0, 1.0])
    return Surface(np.ascontiguousarray(points), triangles.astype(np.int32), normals)


def nearest(surface: Surface, points: Array) -> tuple[Array, Array]:
    """Nearest points (n, 3) mm of a surface and their distances (n,) mm."""
    found = [surface.project(point) for point in points]
    return np.array([x for x, _, _ in found]), np.array([gap for _, _, gap in found])


def sampled(points: Array, triangles: Numbers, most: int, seed: int = 0) -> Array:
    """Points (k, 3) mm spread over triangles: corners and centres, so many at most."""
    every = np.vstack([points[np.unique(triangles)], points[triangles].mean(axis=1)])
    rng = np.random.default_rng(seed)
    return every if len(every) <= most else rng.choice(every, most, replace=False)


def _crossings(points: Array, triangles: Numbers) -> tuple[int, Array]:
    """How many pairs of triangles (t, 3) cross each other, and where one pair does."""
    corners = points[triangles]
    axis = int(np.argmax(np.ptp(points, axis=0)))
    order = np.argsort(corners[:, :, axis].min(axis=1), kind="stable")
    count, one = _count_crossings(corners[order], triangles[order].astype(np.int64), axis)
    return int(count), corners[order][one].mean(axis=0)


@njit(cache=True, error_model="numpy", nogil=True)
def _count_crossings(corners, numbers, axis):
    """Sweep along an axis over triangles (t, 3, 3) whose low ends rise along it."""
    count, one = 0, 0
    low, high = np.empty((len(corners), 3)), np.empty((len(corners), 3))
    for t in range(len(corners)):
        for i in range(3):
            low[t, i] = min(corners[t, 0, i], corners[t, 1, i], corners[t, 2, i])
            high[t, i] = max(corners[t, 0, i], corners[t, 1, i], corners[t, 2, i])
    for s in range(len(corners)):
        for t in range(s + 1, len(corners)):
            if low[t, axis] > high[s, axis]:
                break
            apart = False
            for i in range(3):
                apart |= low[t, i] > high[s, i] or low[s, i] > high[t, i]
            if not apart and (_pierces(corners, numbers, s, t) or _pierces(corners, numbers, t, s)):
                count, one = count + 1, s
    return count, one


@njit(cache=True, error_model="numpy", nogil=True)
def _pierces(corners, numbers, s, t):
    """Whether a side of triangle s that has no corner in common with t goes through t."""
    a, b, c = corners[t, 0], corners[t, 1], corners[t, 2]
    for k in range(3):
        m = (k + 1) % 3
        shared = False
        for j in range(3):
            shared |= numbers[s, k] == numbers[t, j] or numbers[s, m] == numbers[t, j]
        if shared:
            continue
        p, q = corners[s, k], corners[s, m]
        over, under = _six_volumes(a, b, c, p), _six_volumes(a, b, c, q)
        if over * under >= 0.0:
            continue
        one, two = _six_volumes(p, q, a, b), _six_volumes(p, q, b, c)
        three = _six_volumes(p, q, c, a)
        if one * two > 0.0 and two * three > 0.0:
            return True
    return False


@njit(cache=True, error_model="numpy", nogil=True)
def _six_volumes(a, b, c, d):
    ux, uy, uz = a[0] - d[0], a[1] - d[1], a[2] - d[2]
    vx, vy, vz = b[0] - d[0], b[1] - d[1], b[2] - d[2]
    wx, wy, wz = c[0] - d[0], c[1] - d[1], c[2] - d[2]
    return ux * (vy * wz - vz * wy) - uy * (vx * wz - vz * wx) + uz * (vx * wy - vy * wx)
