"""Meshes from files: cells become quadratic tetrahedra, their names sets of faces and cells.

Hexahedra, wedges and pyramids are split: every face that is no triangle from its corner of the
lowest number, every cell from its own corner of the lowest number, so that neighbours agree.
Middles of edges are kept where a file has them; those of new edges are straight.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.offline.bodies.files import refuse_size, require
from palpate.offline.bodies.tetrahedra import (
    EDGES,
    boundary,
    determinants,
    manifold,
    raised,
    volumes,
)
from palpate.shared.anatomy import MILLIMETRES, Unit
from palpate.shared.arrays import Array, Flags, Ints, Numbers
from palpate.shared.geometry.elements import HEX_EDGES
from palpate.shared.scene import SceneError

KINDS = ".vtu", ".vtk", ".msh"

TETRAHEDRON = (((0, 1, 2), (0, 3, 1), (1, 3, 2), (0, 2, 3)), tuple(map(tuple, EDGES.tolist())))
HEXAHEDRON = (
    ((0, 1, 2, 3), (4, 7, 6, 5), (0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0)),
    HEX_EDGES,
)
WEDGE = (((0, 1, 2), (3, 5, 4), (0, 3, 4, 1), (1, 4, 5, 2), (2, 5, 3, 0)), ())
PYRAMID = (((0, 1, 2, 3), (0, 4, 1), (1, 4, 2), (2, 4, 3), (3, 4, 0)), ())
"""Corners of the faces of a cell, and of its edges in the order of their middles."""

SOLID = {
    "tetra": TETRAHEDRON, "tetra10": TETRAHEDRON, "hexahedron": HEXAHEDRON,
    "hexahedron20": HEXAHEDRON, "hexahedron27": HEXAHEDRON, "wedge": WEDGE, "pyramid": PYRAMID,
}  # fmt: skip
FLAT = {"triangle": 3, "triangle6": 3, "quad": 4, "quad8": 4, "quad9": 4}
"""Corners of cells that only name parts of a boundary."""

IGNORED = {"vertex", "line", "line3"}


class Sets(NamedTuple):
    """Which faces and elements names stand for."""

    faces: dict[str, Flags]
    cells: dict[str, Flags]


def read_mesh(path: Path, unit: Unit) -> tuple[Array, Numbers, Sets]:
    """Nodes (n, 3) mm, elements (e, 10) and sets of a file; raise `SceneError` if it is no body."""
    mesh = _read(path)
    points = np.array(mesh.points, float)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise SceneError(f"{path}: has no points in three dimensions; save a mesh of a solid body")
    points = points * MILLIMETRES[unit]
    refuse_size(path, points, unit)
    corners, cells, middles = _tetrahedra(path, mesh, points)
    used, compact = np.unique(corners, return_inverse=True)
    nodes, elements = raised(points[used], compact.reshape(-1, 4).astype(np.int32))
    _curve(nodes, elements, used, points, middles)
    _refuse_wrong(path, nodes, elements)
    return nodes, elements, _sets(mesh, used, elements, cells)


def _read(path: Path) -> Any:
    meshio = require("meshio")
    try:
        return meshio.read(path)
    except (Exception, SystemExit) as error:  # the library ends the program at unknown files
        said = (str(error) or type(error).__name__).splitlines()[0][:80]
        raise SceneError(
            f"{path}: cannot be read as {path.suffix[1:].upper()} ({said}); save it anew"
        ) from error


def _tetrahedra(
    path: Path, mesh: Any, points: Array
) -> tuple[Ints, Ints, dict[tuple[int, int], int]]:
    """Corners (e, 4) of tetrahedra, the cell of the file each is of (e,), middles by ends.

    Kinds of cells that are numbered the other way round throughout are turned.
    """
    corners, cells, first = [], [], 0
    middles: dict[tuple[int, int], int] = {}
    for block in mesh.cells:
        data, kind = np.asarray(block.data), block.type
        if kind in SOLID and len(data):
            faces, edges = SOLID[kind]
            own = 1 + max(max(face) for face in faces)
            if data.shape[1] < own or data.min() < 0 or data.max() >= len(points):
                raise SceneError(f"{path}: has cells of points that are not there; save it anew")
            tetrahedra, of = _split(data[:, :own], faces)
            if np.median(volumes(points[tetrahedra])) < 0:
                tetrahedra = tetrahedra[:, [0, 2, 1, 3]]
            corners.append(tetrahedra)
            cells.append(first + of)
            if data.shape[1] >= own + len(edges) > own:
                ends = np.sort(data[:, np.array(edges)], axis=2).reshape(-1, 2).tolist()
                own_middles = data[:, own : own + len(edges)].ravel().tolist()
                middles |= dict(zip(map(tuple, ends), own_middles, strict=True))
        elif kind not in FLAT and kind not in IGNORED:
            raise SceneError(
                f"{path}: has cells of kind {kind}; tetrahedra, hexahedra, wedges and pyramids are "
                "read: save it with these"
            )
        first += len(data)
    if not corners:
        raise SceneError(f"{path}: has no solid cells; geometry.kind = 'surface' reads surfaces")
    return np.concatenate(corners), np.concatenate(cells), middles


def _split(cells: Ints, faces: tuple[tuple[int, ...], ...]) -> tuple[Ints, Ints]:
    """Tetrahedra (k, 4) that cells (c, n) are split into, and which cell each is of."""
    if cells.shape[1] == 4:
        return cells, np.arange(len(cells))
    found, of, rows = [], [], np.arange(len(cells))
    apex = cells.min(axis=1)
    for face in faces:
        own = cells[:, face]
        turned = np.take_along_axis(
            own, (own.argmin(axis=1)[:, None] + np.arange(len(face))) % len(face), axis=1
        )
        away = ~(own == apex[:, None]).any(axis=1)
        for k in range(1, len(face) - 1):
            triangle = turned[away][:, [0, k, k + 1]]
            found.append(np.column_stack([triangle, apex[away]]))
            of.append(rows[away])
    return np.concatenate(found), np.concatenate(of)


def _curve(
    nodes: Array,
    elements: Numbers,
    used: Ints,
    points: Array,
    middles: dict[tuple[int, int], int],
) -> None:
    """Move middles of edges to where a file has them."""
    if not middles:
        return
    ends = np.sort(used[elements[:, EDGES]], axis=2).reshape(-1, 2)
    at = elements[:, 4:].ravel()
    for pair, node in zip(map(tuple, ends.tolist()), at.tolist(), strict=True):
        if pair in middles:
            nodes[node] = points[middles[pair]]


def _refuse_wrong(path: Path, nodes: Array, elements: Numbers) -> None:
    """Refuse elements that are inverted, and boundaries that are not closed and simple."""
    if not np.isfinite(nodes).all():
        raise SceneError(f"{path}: middles of edges are not finite; save it anew")
    least = determinants(nodes, elements).min(axis=1)
    wrong = ~(least > 0)
    if wrong.any():
        x, y, z = nodes[elements[np.argmin(least), :4]].mean(axis=0)
        raise SceneError(
            f"{path}: {wrong.sum()} of {len(elements)} tetrahedra are inverted or flat, the worst "
            f"near ({x:.2f}, {y:.2f}, {z:.2f}) mm; repair the mesh, or give its surface as "
            "geometry.kind = 'surface'"
        )
    if not manifold(boundary(elements)[0]):
        raise SceneError(
            f"{path}: cells do not fit together face to face, or touch along an edge only; merge "
            "coincident points, and save one conforming body"
        )


def _sets(mesh: Any, used: Ints, elements: Numbers, cells: Ints) -> Sets:
    """Named sets: of points and flat cells as faces, of solid cells as elements and their faces."""
    faces, owner, _ = boundary(elements)
    solid, flat = dict[str, Any](), dict[str, Any]()
    keys = np.sort(used[faces[:, :3]], axis=1)
    corner_sets = _corner_sets(mesh)
    for name, chosen in _cell_sets(mesh).items():
        inside = chosen[cells]
        if inside.any():
            solid[name], flat[name] = inside, inside[owner]
        if name in corner_sets or not inside.any():
            named = corner_sets.get(name, set())
            flat[name] = flat.get(name, inside[owner]) | _are_in(keys, named)
    for name, values in mesh.point_data.items():
        if values.ndim == 1 and set(np.unique(values).tolist()) == {0, 1}:
            flat[name] = values[keys].all(axis=1).astype(bool)
    for name, own in getattr(mesh, "point_sets", {}).items():
        flat[name] = np.isin(keys, own).all(axis=1)
    return Sets(flat, solid)


def _are_in(keys: Ints, corners: set[frozenset[int]]) -> Flags:
    """Which triangles (f, 3) have all their corners in one of some flat cells."""
    by_corner: dict[int, list[frozenset[int]]] = {}
    for cell in corners:
        for corner in cell:
            by_corner.setdefault(corner, []).append(cell)
    return np.array(
        [any(cell.issuperset(key) for cell in by_corner.get(key[0], ())) for key in keys.tolist()]
    )


def _cell_sets(mesh: Any) -> dict[str, NDArray[np.bool_]]:
    """Cells of a file that names stand for, as flags over all its cells in their order."""
    count = sum(len(block.data) for block in mesh.cells)
    starts = np.cumsum([0, *(len(block.data) for block in mesh.cells)])
    found: dict[str, NDArray[np.bool_]] = {}
    for name, blocks in (mesh.cell_sets or {}).items():
        chosen = np.zeros(count, dtype=bool)
        for start, own in zip(starts, blocks, strict=False):
            if own is not None and len(own):
                chosen[start + np.asarray(own, dtype=int)] = True
        if not name.startswith("gmsh:"):
            found[name] = chosen
    groups = {int(number): name for name, (number, _) in mesh.field_data.items()}
    for key, blocks in mesh.cell_data.items():
        values = np.concatenate([np.asarray(own).reshape(len(own), -1) for own in blocks])
        if values.shape[1] != 1 or values.dtype.kind not in "iub" or key == "gmsh:geometrical":
            continue
        for value in np.unique(values):
            physical = groups.get(int(value)) if key == "gmsh:physical" else None
            found[physical or f"{key}={value}"] = values[:, 0] == value
    return found


def _corner_sets(mesh: Any) -> dict[str, set[frozenset[int]]]:
    """Corners of the flat cells that names stand for."""
    flat: list[frozenset[int] | None] = []
    for block in mesh.cells:
        own = FLAT.get(block.type)
        flat += [frozenset(cell[:own].tolist()) if own else None for cell in block.data]
    found = {}
    for name, chosen in _cell_sets(mesh).items():
        named = {flat[i] for i in np.flatnonzero(chosen) if flat[i] is not None}
        if named:
            found[name] = named
    return found  # type: ignore[return-value]
