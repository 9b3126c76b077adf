"""Meshes of hexahedra: a lattice of elements mapped onto the body of a scene.

Nodes, elements and faces are numbered by the lattice, first index slowest; degree of freedom
3·node + axis. Element and face node order is VTK's.
"""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from palpate.offline.bodies.mesh import bare_mesh, mesh_of, refined_body, stored_mesh
from palpate.offline.bodies.places import Boundary, boundary_of_corners, support_and_surface
from palpate.offline.bodies.regions import refuse_touched, regions_at
from palpate.offline.bodies.report import thickness
from palpate.offline.fem.shapes import shape_of
from palpate.offline.fem.smooth import smoothed
from palpate.shared.anatomy import FileBody
from palpate.shared.arrays import Array, Ints, Numbers
from palpate.shared.geometry.elements import HEX8, HEX20, Face, Kind, face_kind_of, kind_of
from palpate.shared.geometry.surface import Surface
from palpate.shared.local_models import Mesh
from palpate.shared.scene import Block, Extrusion, Scene, SceneError, divisions_of

T = TypeVar("T")
Cells = tuple[int, int, int]

Ticks = tuple[Array, Array, Array]
"""Parameters, rising from 0 to 1, of the corners of elements along each axis of a shape: (a + 1,),
(b + 1,) and (c + 1,), the last (a + 1, c + 1) where layers differ along the first axis."""

ROW, EDGE, FAN = 0.3, 0.1, 0.3
"""Of a refined lip: length of a row of elements over that of the next one, thickness of the first
and last layer over the whole, and how far along the section its layers go over into the others."""

SLIGHTLY = 1e-5
"""Step in parameters, over that of a face, by which its tangents are found."""

SAG, STRAIGHT, LEAST, MOST = 0.002, 2, {4: 4, 3: 2}, {4: 16, 3: 8}
"""Millimetres between a curved face and its cells, and how many lie along an edge: that many where
edges have no middles, else at least and at most so many on faces of so many corners."""


def build_mesh(scene: Scene, ticks: Ticks | None = None, bare: bool = False) -> Mesh:
    """Mesh the body of a scene.

    ``ticks`` are those of the scene's divisions if absent; a body from a file has none.  A ``bare``
    mesh is neither held nor touched anywhere, whatever the scene says.

    Raises
    ------
    SceneError
        If a file cannot be read or meshed, if an element is inverted somewhere, or if support or
        surface hold no face, or the same.
    """
    if ticks is None and isinstance(scene.geometry, FileBody):
        return bare_mesh(scene) if bare else mesh_of(scene, refined_body(scene))
    geometry = scene.lattice
    if ticks is None:
        ticks = ticks_of(geometry)
    a, b, c = cells = cells_of(ticks)
    places, elements, faces, sides = _lattice(cells, _kind(geometry))
    grid = shape_of(scene).grid(*divided(ticks, (2 * a, 2 * b, 2 * c)))
    nodes = grid.reshape(-1, 3)[np.ravel_multi_index(places.T, grid.shape[:3])]
    _refuse_inverted(nodes, elements)
    named = {name: sides == number for number, name in enumerate(geometry.sides)}
    on_sides = Boundary(*boundary_of_corners(nodes[faces[:, :4]]), sides=named)
    support, accessible = on_sides.nowhere() if bare else support_and_surface(scene, on_sides)
    clamped = np.zeros(len(nodes), dtype=bool)
    clamped[faces[support]] = True
    regions = regions_at(scene, nodes[elements[:, :8]].mean(axis=1), {})
    refuse_touched(scene, nodes, elements, regions, faces[accessible])
    return Mesh(nodes, elements, faces, clamped, accessible, regions)


def ticks_of(geometry: Extrusion | Block) -> Ticks:
    """Ticks of a geometry's divisions: even, but for graded layers and the lip of an extrusion."""
    first, second, third = _even(in_order(geometry, divisions_of(geometry)))
    if geometry.grading > 1.0:
        third = 1 - (1 - third) ** geometry.grading
    if isinstance(geometry, Extrusion) and geometry.lip_rows:
        return _refined(first, second, third, geometry.lip_rows)
    return first, second, third


def _even(cells: Cells) -> Ticks:
    a, b, c = (np.arange(n + 1) / n for n in cells)
    return a, b, c


def _refined(first: Array, second: Array, third: Array, rows: int) -> Ticks:
    """Ticks with more rows at the lip, where the first and last layer are thin.

    At both edges of a clamped side the displacement goes about as the root of the distance, and all
    that hangs from it moves with what happens there: elements of any order are off in proportion to
    their size at these edges, however fine they are elsewhere.
    """
    near = first[1] * ROW ** np.arange(rows, 0, -1)
    first = np.concatenate([[0.0], near, first[1:]])
    at_lip = third
    if len(third) > 3:
        at_lip = np.concatenate([[0.0], np.linspace(EDGE, 1 - EDGE, len(third) - 2), [1.0]])
    share = np.maximum(1 - first / FAN, 0.0)[:, None] ** 2
    return first, second, share * at_lip + (1 - share) * third


def cells_of(ticks: Ticks) -> Cells:
    """Numbers of elements between ticks."""
    a, b, c = (along.shape[-1] - 1 for along in ticks)
    return a, b, c


def divided(ticks: Ticks, cells: Cells) -> Ticks:
    """Ticks of another number of elements, spread as the given ones are.

    With twice their number, those between are half-way.
    """
    at, own = _even(cells), _even(cells_of(ticks))
    first, second = (np.interp(at[axis], own[axis], ticks[axis]) for axis in range(2))
    third = np.array([np.interp(at[2], own[2], row) for row in np.atleast_2d(ticks[2])])
    if len(third) == 1:
        return first, second, third[0]
    return first, second, np.array([np.interp(at[0], own[0], row) for row in third.T]).T


def in_order(geometry: Extrusion | Block, three: Sequence[T]) -> tuple[T, T, T]:
    """Values of the axes of a shape in the order of a geometry's divisions, or the other way round.

    Along the section, along y and through it, its axes are right-handed.
    """
    first, second, third = three
    return (first, third, second) if isinstance(geometry, Extrusion) else (first, second, third)


class Inverted(SceneError):
    """A mesh with elements that are inverted or flat somewhere."""


def _refuse_inverted(nodes: Array, elements: Numbers) -> None:
    """Refuse elements that are inverted or flat somewhere."""
    least = determinants(nodes, elements).min(axis=1)
    if not (least > 0).all():
        x, y, z = nodes[elements[np.argmin(least)]].mean(axis=0)
        raise Inverted(
            f"geometry: {np.sum(~(least > 0))} of {len(elements)} elements are inverted, the worst "
            f"near ({x:.2f}, {y:.2f}, {z:.2f}) mm; move corners, so that opposite sides are about "
            "as long, change divisions or grading, or give the outline more points"
        )


def _kind(geometry: Extrusion | Block) -> Kind:
    """Kind of the elements of a geometry."""
    return HEX20 if geometry.element == "hex20" else HEX8


def _lattice(divisions: Cells, kind: Kind) -> tuple[Ints, Numbers, Numbers, Ints]:
    """Hexahedra of a kind in a lattice.

    Returns the places of the nodes (n, 3) in the grid of corners and half-way places, elements and
    faces as in ``Mesh``, and on which side each face lies (f,), as an index into the sides of a
    geometry.
    """
    grid = 2 * np.array(divisions) + 1
    cells = np.moveaxis(np.indices(divisions), 0, -1).reshape(-1, 3)
    points = 2 * cells[:, None] + (kind.nodes + 1).astype(int)
    used, numbers = np.unique(
        np.ravel_multi_index(np.moveaxis(points, -1, 0), grid), return_inverse=True
    )
    elements = numbers.reshape(len(cells), -1).astype(np.int32)
    places = np.column_stack(np.unravel_index(used, grid))

    faces, sides = [], []
    for side, corners in enumerate(kind.faces):
        axis, high = divmod(side, 2)
        boundary = cells[:, axis] == (divisions[axis] - 1 if high else 0)
        faces.append(elements[boundary][:, kind.on_face(corners)])
        sides.append(np.full(boundary.sum(), side))
    return places, elements, np.concatenate(faces), np.concatenate(sides)


def parameters_of(scene: Scene, ticks: Ticks) -> Array:
    """Parameters (n, 3) of the nodes of a scene's mesh of these ticks."""
    a, b, c = cells = cells_of(ticks)
    first, second, third = divided(ticks, (2 * a, 2 * b, 2 * c))
    i, j, k = _lattice(cells, _kind(scene.lattice))[0].T
    through = third[k] if third.ndim == 1 else third[i, k]
    return np.column_stack([first[i], second[j], through])


def mesh_quality(mesh: Mesh) -> dict[str, float]:
    """How good a mesh is.

    Returns
    -------
    dict
        ``scaled_jacobian_min`` and ``scaled_jacobian_median``: per element the smallest det J over
        the product of edge lengths, at the corners of the straight-edged element, 1 at best
        (Verdict); ``jacobian_ratio_min``: per element the smallest det J over the mean one, at the
        nodes and 5³ points of the true, curved element; ``aspect_ratio_max``: longest over shortest
        edge; ``volume_mm3``.
    """
    kind = kind_of(mesh.elements).straight
    corners = mesh.nodes[mesh.elements[:, : kind.corners]]
    jacobian = _determinants_at(kind, corners, kind.nodes)
    at_corners, lengths = (
        np.linalg.norm(corners[:, ends[..., 0]] - corners[:, ends[..., 1]], axis=-1)
        for ends in (kind.edges_at, np.array(kind.edges))
    )
    scaled = jacobian / at_corners.prod(axis=2) / kind.best
    everywhere = determinants(mesh.nodes, mesh.elements)
    jacobian, weights = jacobians(mesh, points=3)
    return {
        "scaled_jacobian_min": float(scaled.min()),
        "scaled_jacobian_median": float(np.median(scaled.min(axis=1))),
        "jacobian_ratio_min": float((everywhere.min(axis=1) / everywhere.mean(axis=1)).min()),
        "aspect_ratio_max": float((lengths.max(axis=1) / lengths.min(axis=1)).max()),
        "volume_mm3": float(np.sum(jacobian @ weights)),
    }


def jacobians(mesh: Mesh, points: int) -> tuple[Array, Array]:
    """Jacobian determinants (e, q) mm³ at points of elements, see ``Kind.rule``; weights (q,)."""
    kind = kind_of(mesh.elements)
    at, weights = kind.rule(points)
    return _determinants_at(kind, mesh.nodes[mesh.elements], at), weights


def determinants(nodes: Array, elements: Numbers) -> Array:
    """Jacobian determinants (e, n + 125) mm³ at the n nodes of elements and at 5³ points.

    Where these are positive, an element may be trusted to be nowhere inverted.
    """
    kind = kind_of(elements)
    return _determinants_at(kind, nodes[elements], np.vstack([kind.nodes, kind.rule(5)[0]]))


def _determinants_at(kind: Kind, X: Array, at: Array) -> Array:
    """Jacobian determinants (e, q) mm³ at coordinates (q, 3) of elements with nodes (e, n, 3)."""
    _, slopes = kind.shape(at)
    determinants: Array = np.linalg.det(np.einsum("eni,qnj->eqij", X, slopes))
    return determinants


def least_volume_ratio(mesh: Mesh, displacement: Array) -> float:
    """Smallest det F of a displacement (n, 3) mm, where ``determinants`` are taken."""
    deformed = determinants(mesh.nodes + displacement, mesh.elements)
    return float((deformed / determinants(mesh.nodes, mesh.elements)).min())


def local_thickness(mesh: Mesh, points: Array, normals: Array) -> Array:
    """How thick the body is (p,) mm under points (p, 3) of its boundary of given outward normals.

    See ``bodies.report.thickness``.
    """
    opposite, outward = points_of(mesh, mesh.faces, face_kind_of(mesh.faces).rule(4)[0])
    return thickness(points, normals, opposite, outward)


def points_of(mesh: Mesh, faces: Numbers, at: Array) -> tuple[Array, Array]:
    """Points (k, 3) mm at coordinates (q, 2) of faces (f, n), and their outward unit normals."""
    N, dN = face_kind_of(faces).shape(at)
    X = mesh.nodes[faces]
    tangents = np.einsum("fai,qaj->fqij", X, dN)
    outward = np.cross(tangents[..., 0], tangents[..., 1]).reshape(-1, 3)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    return np.einsum("qa,fai->fqi", N, X).reshape(-1, 3), outward


def accessible_surface(mesh: Mesh, scene: Scene | None = None) -> Surface:
    """The surface an endoscope can touch, subdivided so that it follows curved faces.

    That of the body of a scene on whose own mesh it lies, if given: faces of 2 mm differ from it by
    7 um and .7 degrees, which a tip that is .1 mm deep feels as a tenth of its force, and what
    hangs from a lip as a push aside.  That of a body from a file is of its stored mesh's faces,
    smoothed.
    """
    if scene is not None and isinstance(scene.geometry, FileBody):
        stored = stored_mesh(scene)
        return smoothed(accessible_surface(stored), stored, scene.endoscope.radius)
    faces = mesh.faces[mesh.accessible]
    kind = face_kind_of(faces)
    grid, cells = kind.cells(*_counts(kind, mesh.nodes[faces]))
    N, dN = kind.shape(grid)
    if scene is None:
        points, normals = N @ mesh.nodes[faces], N @ _nodal_normals(mesh, faces)[faces]
    else:
        points, normals = _on_body(scene, N, dN, faces)
    points, normals = points.reshape(-1, 3), normals.reshape(-1, 3)
    cells = cells + len(grid) * np.arange(len(faces))[:, None, None]
    cells = cells.reshape(-1, kind.corners)
    _, first, weld = np.unique(points.round(9), axis=0, return_index=True, return_inverse=True)
    fan = [[0, i, i + 1] for i in range(1, kind.corners - 1)]
    triangles = weld[np.vstack([cells[:, corners] for corners in fan])]
    unit = normals[first] / np.linalg.norm(normals[first], axis=1, keepdims=True)
    return Surface(points[first], triangles.astype(np.int32), unit)


def _counts(kind: Face, X: Array) -> Sequence[int]:
    """Cells along the axes of faces with nodes X (f, n, 3) mm, as many as their curvature wants."""
    if not kind.quadratic:
        return [STRAIGHT] * kind.axes
    wanted = np.ceil(np.sqrt(kind.bent(X).max(axis=0) / SAG))
    return [int(count) for count in np.clip(wanted, LEAST[kind.corners], MOST[kind.corners])]


def _nodal_normals(mesh: Mesh, faces: Numbers) -> Array:
    """Outward unit normals (nodes, 3): area-weighted mean over the given faces, 0 elsewhere."""
    kind = face_kind_of(faces)
    _, dN = kind.shape(kind.nodes)
    tangents = np.einsum("fai,qaj->fqij", mesh.nodes[faces], dN)
    normals = np.zeros_like(mesh.nodes)
    np.add.at(normals, faces, np.cross(tangents[..., 0], tangents[..., 1]))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 0, length, 1)


def _on_body(scene: Scene, N: Array, dN: Array, faces: Numbers) -> tuple[Array, Array]:
    """Points (f, q, 3) mm of a scene's body and its outward normals (not of unit length) there.

    ``N`` (q, a) and ``dN`` (q, a, 2) are shape functions at points of faces (f, a).
    """
    body, own = shape_of(scene), parameters_of(scene, ticks_of(scene.lattice))[faces]
    at, ways = N @ own, SLIGHTLY * np.einsum("qaj,fai->jfqi", dN, own)
    one, two = (
        body.at(np.minimum(at + way, 1.0)) - body.at(np.maximum(at - way, 0.0)) for way in ways
    )
    return body.at(at), np.cross(one, two)
