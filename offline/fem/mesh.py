"""Meshes of hexahedra: a lattice of elements mapped onto the body of a scene.

Nodes, elements and faces are numbered by the lattice, first index slowest; degree of freedom
3·node + axis. Element and face node order is VTK's.
"""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from palpate.offline.bodies.mesh import mesh_of_body
from palpate.offline.bodies.places import Boundary, boundary_of_corners, support_and_surface
from palpate.offline.bodies.report import thickness
from palpate.offline.fem.shapes import shape_of
from palpate.shared.anatomy import FileBody
from palpate.shared.arrays import Array, Ints, Numbers
from palpate.shared.geometry.elements import (
    HEX20_NODES,
    HEX_CORNERS,
    HEX_EDGES,
    gauss,
    hexahedron,
    quadrilateral,
    shape,
)
from palpate.shared.geometry.surface import Surface
from palpate.shared.local_models import Mesh
from palpate.shared.scene import Block, Extrusion, Scene, SceneError, divisions_of

T = TypeVar("T")
Cells = tuple[int, int, int]

# Corners of an element's faces, outward by the right-hand rule: low and high end of each axis,
# the order in which a geometry names its sides.
HEX_FACES = ((0, 4, 7, 3), (1, 2, 6, 5), (0, 1, 5, 4), (3, 7, 6, 2), (0, 3, 2, 1), (4, 5, 6, 7))

Ticks = tuple[Array, Array, Array]
"""Parameters, rising from 0 to 1, of the corners of elements along each axis of a shape: (a + 1,),
(b + 1,) and (c + 1,), the last (a + 1, c + 1) where layers differ along the first axis."""

ROW, EDGE, FAN = 0.3, 0.1, 0.3
"""Of a refined lip: length of a row of elements over that of the next one, thickness of the first
and last layer over the whole, and how far along the section its layers go over into the others."""

SLIGHTLY = 1e-5
"""Step in parameters, over that of a face, by which its tangents are found."""

SAG, SQUARES, STRAIGHT = 0.002, (4, 16), 2
"""Millimetres between a curved face and its triangles, and least and most squares along an edge: as
many as that takes.  Faces of straight edges have as many squares as the last."""


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
        return mesh_of_body(scene, bare=bare)
    geometry = scene.lattice
    if ticks is None:
        ticks = ticks_of(geometry)
    a, b, c = cells = cells_of(ticks)
    places, elements, faces, sides = _lattice(cells, _reference(geometry))
    grid = shape_of(scene).grid(*divided(ticks, (2 * a, 2 * b, 2 * c)))
    nodes = grid.reshape(-1, 3)[np.ravel_multi_index(places.T, grid.shape[:3])]
    _refuse_inverted(nodes, elements)
    named = {name: sides == number for number, name in enumerate(geometry.sides)}
    on_sides = Boundary(*boundary_of_corners(nodes[faces[:, :4]]), sides=named)
    support, accessible = on_sides.nowhere() if bare else support_and_surface(scene, on_sides)
    clamped = np.zeros(len(nodes), dtype=bool)
    clamped[faces[support]] = True
    return Mesh(nodes, elements, faces, clamped, accessible)


def ticks_of(geometry: Extrusion | Block) -> Ticks:
    """Ticks of a geometry's divisions: even, but for the layers of an extrusion and its lip."""
    first, second, third = _even(in_order(geometry, divisions_of(geometry)))
    if isinstance(geometry, Extrusion):
        third = 1 - (1 - third) ** geometry.grading
        if geometry.lip_rows:
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


def _refuse_inverted(nodes: Array, elements: Numbers) -> None:
    """Refuse elements that are inverted or flat somewhere."""
    least = determinants(nodes, elements).min(axis=1)
    if not (least > 0).all():
        x, y, z = nodes[elements[np.argmin(least)]].mean(axis=0)
        raise SceneError(
            f"geometry: {np.sum(~(least > 0))} of {len(elements)} elements are inverted, the worst "
            f"near ({x:.2f}, {y:.2f}, {z:.2f}) mm; change divisions, grading or corners"
        )


def _reference(geometry: Extrusion | Block) -> Array:
    """Nodes (8 or 20, 3) of an element on [-1, 1]^3."""
    return HEX20_NODES if geometry.element == "hex20" else HEX_CORNERS


def _lattice(divisions: Cells, reference: Array) -> tuple[Ints, Numbers, Numbers, Ints]:
    """Hexahedra of a lattice whose nodes on [-1, 1]^3 are ``reference`` (8 or 20, 3).

    Returns the places of the nodes (n, 3) in the grid of corners and half-way places, elements and
    faces as in ``Mesh``, and on which side each face lies (f,), as an index into the sides of a
    geometry.
    """
    grid = 2 * np.array(divisions) + 1
    cells = np.moveaxis(np.indices(divisions), 0, -1).reshape(-1, 3)
    points = 2 * cells[:, None] + (reference + 1).astype(int)
    used, numbers = np.unique(
        np.ravel_multi_index(np.moveaxis(points, -1, 0), grid), return_inverse=True
    )
    elements = numbers.reshape(len(cells), -1).astype(np.int32)
    places = np.column_stack(np.unravel_index(used, grid))

    faces, sides = [], []
    for side, corners in enumerate(HEX_FACES):
        axis, high = divmod(side, 2)
        boundary = cells[:, axis] == (divisions[axis] - 1 if high else 0)
        faces.append(elements[boundary][:, _face_nodes(corners, len(reference))])
        sides.append(np.full(boundary.sum(), side))
    return places, elements, np.concatenate(faces), np.concatenate(sides)


def _face_nodes(corners: tuple[int, ...], nodes_per_element: int) -> list[int]:
    """Element-local nodes of the face with these corners."""
    if nodes_per_element == 8:
        return list(corners)
    edges = [{corners[i], corners[(i + 1) % 4]} for i in range(4)]
    lookup = [set(edge) for edge in HEX_EDGES]
    return [*corners, *(8 + lookup.index(edge) for edge in edges)]


def parameters_of(scene: Scene, ticks: Ticks) -> Array:
    """Parameters (n, 3) of the nodes of a scene's mesh of these ticks."""
    a, b, c = cells = cells_of(ticks)
    first, second, third = divided(ticks, (2 * a, 2 * b, 2 * c))
    i, j, k = _lattice(cells, _reference(scene.lattice))[0].T
    through = third[k] if third.ndim == 1 else third[i, k]
    return np.column_stack([first[i], second[j], through])


def mesh_quality(mesh: Mesh) -> dict[str, float]:
    """How good a mesh is.

    Returns
    -------
    dict
        ``scaled_jacobian_min`` and ``scaled_jacobian_median``: per element the smallest det J over
        the product of edge lengths, at the corners of the straight-edged hexahedron (Verdict);
        ``jacobian_ratio_min``: per element the smallest det J over the mean one, at the nodes and
        5³ Gauss points of the true, curved element; ``aspect_ratio_max``: longest over shortest
        edge; ``volume_mm3``.
    """
    corners = mesh.nodes[mesh.elements[:, :8]]
    _, slopes = shape(HEX_CORNERS, HEX_CORNERS)
    edges = np.einsum("eni,qnj->eqij", corners, slopes)
    scaled = np.linalg.det(edges) / np.linalg.norm(edges, axis=2).prod(axis=2)
    ends = np.array(HEX_EDGES)
    lengths = np.linalg.norm(corners[:, ends[:, 0]] - corners[:, ends[:, 1]], axis=2)
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
    """Jacobian determinants at Gauss points, shape (e, points³) mm³, and weights (points³,)."""
    at, weights = gauss(points, 3)
    return _determinants_at(mesh.nodes, mesh.elements, at), weights


def determinants(nodes: Array, elements: Numbers) -> Array:
    """Jacobian determinants (e, n + 125) mm³ at the n nodes of elements and at 5³ Gauss points.

    Where these are positive, an element may be trusted to be nowhere inverted.
    """
    at, _ = gauss(5, 3)
    return _determinants_at(nodes, elements, np.vstack([hexahedron(elements.shape[1]), at]))


def _determinants_at(nodes: Array, elements: Numbers, at: Array) -> Array:
    """Jacobian determinants (e, q) mm³ at reference coordinates (q, 3)."""
    _, slopes = shape(hexahedron(elements.shape[1]), at)
    determinants: Array = np.linalg.det(np.einsum("eni,qnj->eqij", nodes[elements], slopes))
    return determinants


def least_volume_ratio(mesh: Mesh, displacement: Array) -> float:
    """Smallest det F of a displacement (n, 3) mm, where ``determinants`` are taken."""
    deformed = determinants(mesh.nodes + displacement, mesh.elements)
    return float((deformed / determinants(mesh.nodes, mesh.elements)).min())


def local_thickness(mesh: Mesh, points: Array, normals: Array) -> Array:
    """How thick the body is (p,) mm under points (p, 3) of its boundary of given outward normals.

    See ``bodies.report.thickness``.
    """
    at, _ = gauss(4, 2)
    N, dN = shape(quadrilateral(mesh.faces.shape[1]), at)
    X = mesh.nodes[mesh.faces]
    opposite = np.einsum("qa,fai->fqi", N, X).reshape(-1, 3)
    tangent = np.einsum("fai,qaj->fqij", X, dN)
    outward = np.cross(tangent[..., 0], tangent[..., 1]).reshape(-1, 3)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    return thickness(points, normals, opposite, outward)


def accessible_surface(mesh: Mesh, scene: Scene | None = None) -> Surface:
    """The surface an endoscope can touch, subdivided so that it follows curved faces.

    That of the body of a scene on whose own mesh it lies, if given: faces of 2 mm differ from it by
    7 um and .7 degrees, which a tip that is .1 mm deep feels as a tenth of its force, and what
    hangs from a lip as a push aside.
    """
    faces = mesh.faces[mesh.accessible]
    a, b = _squares(mesh.nodes[faces])
    grid = np.array([(x, y) for y in np.linspace(-1, 1, b + 1) for x in np.linspace(-1, 1, a + 1)])
    N, dN = shape(quadrilateral(faces.shape[1]), grid)
    if scene is None:
        points, normals = N @ mesh.nodes[faces], N @ _nodal_normals(mesh, faces)[faces]
    else:
        points, normals = _on_body(scene, N, dN, faces)
    points, normals = points.reshape(-1, 3), normals.reshape(-1, 3)
    corner = np.arange((a + 1) * b).reshape(b, a + 1)[:, :-1].ravel()
    squares = corner[:, None] + np.array([0, 1, a + 2, a + 1])
    quads = (squares[None] + len(grid) * np.arange(len(faces))[:, None, None]).reshape(-1, 4)
    _, first, weld = np.unique(points.round(9), axis=0, return_index=True, return_inverse=True)
    triangles = weld[np.vstack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])]
    unit = normals[first] / np.linalg.norm(normals[first], axis=1, keepdims=True)
    return Surface(points[first], triangles.astype(np.int32), unit)


def _squares(faces: Array) -> tuple[int, int]:
    """Squares along both axes of faces (f, 4 or 8, 3) mm, as many as their curvature asks for."""
    if faces.shape[1] == 4:
        return STRAIGHT, STRAIGHT
    # edges 0-1 and 2-3 run along the first axis, 1-2 and 3-0 along the second
    chords = (faces[:, :4] + faces[:, [1, 2, 3, 0]]) / 2
    bent = np.linalg.norm(faces[:, 4:] - chords, axis=2).max(axis=0)
    wanted = np.ceil(np.sqrt(np.array([max(bent[0::2]), max(bent[1::2])]) / SAG))
    a, b = np.clip(wanted, *SQUARES).astype(int)
    return int(a), int(b)


def _nodal_normals(mesh: Mesh, faces: Numbers) -> Array:
    """Outward unit normals (nodes, 3): area-weighted mean over the given faces, 0 elsewhere."""
    reference = quadrilateral(faces.shape[1])
    _, dN = shape(reference, reference)
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
