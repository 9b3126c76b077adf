"""The surface of a body as a tip feels it: faces that meet in kinks, smoothed.

Faces of a body from a file meet at angles of some 20 degrees, within the contact of a tip.  To
first order a sphere feels a height ``h`` of a half-space, beyond the paraboloid of Hertz's contact
of radius ``a``, as if it were deeper by

    int h p dA / int p dA,    p = 1 / sqrt(a^2 - r^2),

the pressure of a flat punch, by reciprocity (Johnson, Contact Mechanics, 1985, ch. 3).  About a
paraboloid fitted to the surface that is nearly nothing.
"""

import numpy as np
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from palpate.shared.geometry.edges import BLUNT
from palpate.shared.geometry.quadrature import surface_quadrature
from palpate.shared.geometry.surface import Surface, blocks, neighbours
from palpate.shared.local_models import Mesh

WITHIN = 0.4
"""Radii of the endoscope within which a paraboloid is fitted."""

SPACING = 0.1
"""Radii from point to point of the faces that it is fitted to."""

FACING = np.cos(BLUNT / 2)
"""Cosine between the normals of a vertex and of points about it: sharp edges stay."""


def smoothed(surface: Surface, mesh: Mesh, radius: float) -> Surface:
    """A surface of faces of a mesh moved onto paraboloids about its vertices, with their normals.

    They are fitted by least squares to the boundary around, whether accessible or not, that faces
    the same way; ``radius`` (mm) is the endoscope's.
    """
    around = surface_quadrature(mesh.nodes, mesh.faces, SPACING * radius)
    tree, reach = cKDTree(around.points), WITHIN * radius
    vertices, normals = surface.vertices.copy(), surface.normals.copy()
    for own in blocks(len(vertices)):
        n = surface.normals[own]
        one, two, frames = neighbours(surface, own, tree, around.normals, reach, FACING)
        away = (around.points[two] - surface.vertices[own][one]) / reach
        s, t = np.einsum("nai,ni->an", frames[one], away)
        terms = np.column_stack([np.ones(len(s)), s, t, s * s, s * t, t * t])
        squares = (terms[:, :, None] * terms[:, None]).reshape(len(s), -1)
        summed = coo_array((around.areas[two], (one, np.arange(len(s)))), (len(n), len(s))).tocsr()
        left = (summed @ squares).reshape(-1, 6, 6)
        right = summed @ (terms * np.sum(away * n[one], axis=1)[:, None])
        fit = np.einsum("vab,vb->va", np.linalg.pinv(left, rcond=1e-6, hermitian=True), right)
        vertices[own] += reach * fit[:, :1] * n
        normals[own] -= np.einsum("va,vai->vi", fit[:, 1:3], frames)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Surface(vertices, surface.triangles, normals)
