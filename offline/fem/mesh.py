"""All-hexahedral meshes: a lattice of elements mapped onto the body of a scene.

Nodes, elements and faces are numbered by the lattice, first index slowest; degree of freedom
3·node + axis. Element and face node order is VTK's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.section import map_section, read_outline
from palpate.shared.geometry.elements import (
    HEX20_NODES,
    HEX_CORNERS,
    HEX_EDGES,
    gauss,
    hexahedron,
    quadrilateral,
    shape,
)
from palpate.shared.scene import Block, Extrusion, Patch, Scene, SceneError, divisions_of

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

# Corners of an element's faces, outward by the right-hand rule: low and high end of each axis,
# the order in which a geometry names its sides.
HEX_FACES = ((0, 4, 7, 3), (1, 2, 6, 5), (0, 1, 5, 4), (3, 7, 6, 2), (0, 3, 2, 1), (4, 5, 6, 7))


@dataclass(frozen=True)
class Mesh:
    """A body of n nodes, e elements and f boundary faces.

    Attributes
    ----------
    nodes : ndarray, shape (n, 3), mm
    elements : ndarray, shape (e, 8) or (e, 20)
        VTK hexahedron or quadratic hexahedron.
    faces : ndarray, shape (f, 4) or (f, 8)
        VTK quad or quadratic quad, outward by the right-hand rule.
    clamped : ndarray, shape (n,), bool
        Nodes held fixed.
    accessible : ndarray, shape (f,), bool
        Faces an endoscope can touch.
    """

    nodes: Floats
    elements: Ints
    faces: Ints
    clamped: NDArray[np.bool_]
    accessible: NDArray[np.bool_]


def build_mesh(scene: Scene) -> Mesh:
    """Mesh the body of a scene.

    Raises
    ------
    SceneError
        If the section cannot be read or meshed, or if support or surface hold no face.
    """
    geometry = scene.geometry
    if isinstance(geometry, Extrusion):
        # Along the section, along y, through the section: right-handed in this order.
        along, through, length = divisions_of(geometry)
        divisions, body = (along, length, through), _extrusion(scene, geometry)
    else:
        divisions, body = divisions_of(geometry), _block(geometry)
    reference = HEX20_NODES if geometry.element == "hex20" else HEX_CORNERS
    parameters, elements, faces, sides = _lattice(divisions, reference)
    nodes = body(parameters)

    centres = nodes[faces[:, :4]].mean(axis=1)

    def patch(name: str, patch: Patch) -> NDArray[np.bool_]:
        inside = sides == geometry.sides.index(patch.side)
        for axis, bounds in enumerate((patch.x, patch.y, patch.z)):
            if bounds is not None:
                inside &= (bounds[0] <= centres[:, axis]) & (centres[:, axis] <= bounds[1])
        if not inside.any():
            raise SceneError(
                f"{name}: no face of side {patch.side!r} has its centre in the given ranges"
            )
        return inside

    clamped = np.zeros(len(nodes), dtype=bool)
    clamped[faces[patch("support", scene.support)]] = True
    return Mesh(nodes, elements, faces, clamped, patch("surface", scene.surface))


def _extrusion(scene: Scene, geometry: Extrusion) -> Callable[[Floats], Floats]:
    if scene.folder is None:
        raise SceneError("geometry.section: the scene's folder is not known")
    section = map_section(read_outline(scene.folder / geometry.section), geometry.corners)

    def body(parameters: Floats) -> Floats:
        u, w, v = parameters.T
        x, z = section(u, 1 - (1 - v) ** geometry.grading).T
        return np.column_stack([x, geometry.length * w, z])

    return body


def _block(geometry: Block) -> Callable[[Floats], Floats]:
    return lambda parameters: parameters * np.array(geometry.size)


def _lattice(
    divisions: tuple[int, int, int], reference: Floats
) -> tuple[Floats, Ints, Ints, NDArray[np.int64]]:
    """Cut the unit cube into hexahedra.

    Parameters
    ----------
    divisions : tuple of 3 int
        Elements along each axis.
    reference : ndarray, shape (8 or 20, 3)
        Nodes of the element on [-1, 1]³.

    Returns
    -------
    parameters : ndarray, shape (n, 3)
        Nodes in the unit cube.
    elements, faces : ndarray, int32
        As in `Mesh`.
    sides : ndarray, shape (f,)
        On which side each face lies, as an index into the sides of a geometry.
    """
    steps = 1 if len(reference) == 8 else 2
    grid = steps * np.array(divisions) + 1
    cells = np.moveaxis(np.indices(divisions), 0, -1).reshape(-1, 3)
    offsets = ((reference + 1) * steps / 2).astype(int)
    points = steps * cells[:, None] + offsets
    used, numbers = np.unique(
        np.ravel_multi_index(np.moveaxis(points, -1, 0), grid), return_inverse=True
    )
    elements = numbers.reshape(len(cells), -1).astype(np.int32)
    parameters = np.column_stack(np.unravel_index(used, grid)) / (grid - 1)

    faces, sides = [], []
    for side, corners in enumerate(HEX_FACES):
        axis, high = divmod(side, 2)
        boundary = cells[:, axis] == (divisions[axis] - 1 if high else 0)
        faces.append(elements[boundary][:, _face_nodes(corners, len(reference))])
        sides.append(np.full(boundary.sum(), side))
    return parameters, elements, np.concatenate(faces), np.concatenate(sides)


def _face_nodes(corners: tuple[int, ...], nodes_per_element: int) -> list[int]:
    """Element-local nodes of the face with these corners."""
    if nodes_per_element == 8:
        return list(corners)
    edges = [{corners[i], corners[(i + 1) % 4]} for i in range(4)]
    lookup = [set(edge) for edge in HEX_EDGES]
    return [*corners, *(8 + lookup.index(edge) for edge in edges)]


def mesh_quality(mesh: Mesh) -> dict[str, float]:
    """How good a mesh is.

    Returns
    -------
    dict
        ``scaled_jacobian_min`` and ``scaled_jacobian_median``: per element the smallest det J over
        the product of edge lengths, at the corners of the straight-edged hexahedron (Verdict);
        ``jacobian_ratio_min``: per element smallest over largest det J at 3³ Gauss points of the
        true, curved element; ``aspect_ratio_max``: longest over shortest edge; ``volume_mm3``.
    """
    corners = mesh.nodes[mesh.elements[:, :8]]
    _, slopes = shape(HEX_CORNERS, HEX_CORNERS)
    edges = np.einsum("eni,qnj->eqij", corners, slopes)
    scaled = np.linalg.det(edges) / np.linalg.norm(edges, axis=2).prod(axis=2)
    ends = np.array(HEX_EDGES)
    lengths = np.linalg.norm(corners[:, ends[:, 0]] - corners[:, ends[:, 1]], axis=2)
    jacobian, weights = jacobians(mesh, points=3)
    return {
        "scaled_jacobian_min": float(scaled.min()),
        "scaled_jacobian_median": float(np.median(scaled.min(axis=1))),
        "jacobian_ratio_min": float((jacobian.min(axis=1) / jacobian.max(axis=1)).min()),
        "aspect_ratio_max": float((lengths.max(axis=1) / lengths.min(axis=1)).max()),
        "volume_mm3": float(np.sum(jacobian @ weights)),
    }


def jacobians(mesh: Mesh, points: int) -> tuple[Floats, Floats]:
    """Jacobian determinants at Gauss points, shape (e, points³) mm³, and weights (points³,)."""
    at, weights = gauss(points, 3)
    _, slopes = shape(hexahedron(mesh.elements.shape[1]), at)
    gradient = np.einsum("eni,qnj->eqij", mesh.nodes[mesh.elements], slopes)
    determinants: Floats = np.linalg.det(gradient)
    return determinants, weights


def local_thickness(mesh: Mesh, points: Floats, normals: Floats) -> Floats:
    """How thick the body is under points of its surface.

    Parameters
    ----------
    mesh : Mesh
    points : ndarray, shape (p, 3), mm
        On the boundary.
    normals : ndarray, shape (p, 3)
        Outward unit normals there.

    Returns
    -------
    thickness : ndarray, shape (p,), mm
        Diameter of the largest ball that touches the surface at the point from inside and does not
        reach through the opposite side; inf where there is none.

    Notes
    -----
    The ball through ``x`` (normal ``n``) and ``y`` has diameter ``|x - y|^2 / (n . (x - y))``; the
    opposite side is where the normal differs by more than 120 degrees (cf. Hildebrand & Ruegsegger,
    J. Microscopy 1997).
    """
    at, _ = gauss(4, 2)
    N, dN = shape(quadrilateral(mesh.faces.shape[1]), at)
    X = mesh.nodes[mesh.faces]
    opposite = np.einsum("qa,fai->fqi", N, X).reshape(-1, 3)
    tangent = np.einsum("fai,qaj->fqij", X, dN)
    outward = np.cross(tangent[..., 0], tangent[..., 1]).reshape(-1, 3)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    thickness = np.full(len(points), np.inf)
    for i, (point, normal) in enumerate(zip(points, normals, strict=True)):
        across = point - opposite[outward @ normal < -0.5]
        depth = across @ normal
        diameter = np.sum(across**2, axis=1)[depth > 0] / depth[depth > 0]
        thickness[i] = diameter.min(initial=np.inf)
    return thickness
