"""The accessible surface as triangles, fine enough to follow curved faces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.mesh import Mesh
from palpate.shared.geometry.elements import quadrilateral, shape
from palpate.shared.geometry.surface import Surface

Array = NDArray[np.float64]

SUBDIVISIONS = {4: 2, 8: 4}
"""Squares per face edge: a straight face needs few, a curved one enough to be smooth to 0.01 mm."""


def nodal_normals(mesh: Mesh, faces: NDArray[np.int32]) -> Array:
    """Outward unit normals (nodes, 3): area-weighted mean over the given faces, 0 elsewhere."""
    reference = quadrilateral(faces.shape[1])
    _, dN = shape(reference, reference)
    tangents = np.einsum("fai,qaj->fqij", mesh.nodes[faces], dN)
    normals = np.zeros_like(mesh.nodes)
    np.add.at(normals, faces, np.cross(tangents[..., 0], tangents[..., 1]))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 0, length, 1)


def accessible_surface(mesh: Mesh) -> Surface:
    """The surface an endoscope can touch, subdivided so that it follows curved faces."""
    faces = mesh.faces[mesh.accessible]
    cells = SUBDIVISIONS[faces.shape[1]]
    ticks = np.linspace(-1, 1, cells + 1)
    grid = np.array([(x, y) for y in ticks for x in ticks])
    N, _ = shape(quadrilateral(faces.shape[1]), grid)
    points = np.einsum("qa,fai->fqi", N, mesh.nodes[faces]).reshape(-1, 3)
    normals = np.einsum("qa,fai->fqi", N, nodal_normals(mesh, faces)[faces]).reshape(-1, 3)
    corner = np.arange((cells + 1) * cells).reshape(cells, cells + 1)[:, :-1].ravel()
    squares = corner[:, None] + np.array([0, 1, cells + 2, cells + 1])
    quads = (squares[None] + len(grid) * np.arange(len(faces))[:, None, None]).reshape(-1, 4)
    _, first, weld = np.unique(points.round(9), axis=0, return_index=True, return_inverse=True)
    triangles = weld[np.vstack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])]
    unit = normals[first] / np.linalg.norm(normals[first], axis=1, keepdims=True)
    return Surface(points[first], triangles.astype(np.int32), unit)
