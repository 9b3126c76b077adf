"""The mesh of a body from a file, with what is held and what can be touched."""

import numpy as np

from palpate.offline.bodies.base import Base, base_mesh
from palpate.offline.bodies.places import Boundary, boundary_of_corners, support_and_surface
from palpate.offline.bodies.refine import EdgeLength, Refined, refined
from palpate.offline.bodies.tetrahedra import boundary
from palpate.shared.arrays import Array, Flags
from palpate.shared.local_models import Mesh
from palpate.shared.scene import Scene


def mesh_of_body(
    scene: Scene, edge_length_at: EdgeLength | None = None, bare: bool = False
) -> Mesh:
    """Mesh the body of a scene, as fine as wanted; as its base mesh is if nothing is said.

    Whatever is held or can be touched is made of whole faces of the base mesh, and so is the same
    in every mesh; of a ``bare`` one nothing is.

    Raises
    ------
    SceneError
        If the file is no body, or support or surface hold no face, or the same.
    """
    base = base_mesh(scene)
    faces = boundary_of(base)
    support, accessible = faces.nowhere() if bare else support_and_surface(scene, faces)
    finer = refined(base, edge_length_at or _as_it_is)
    return _mesh(finer, support, accessible)


def boundary_of(base: Base) -> Boundary:
    """Faces of a base mesh and their sets."""
    faces, _, _ = boundary(base.elements)
    return Boundary(*boundary_of_corners(base.nodes[faces[:, :3]]), sets=base.faces)


def _as_it_is(points: Array) -> Array:
    return np.full(len(points), np.inf)


def _mesh(finer: Refined, support: Flags, accessible: Flags) -> Mesh:
    clamped = np.zeros(len(finer.nodes), dtype=bool)
    clamped[finer.faces[support[finer.face_of]]] = True
    return Mesh(finer.nodes, finer.elements, finer.faces, clamped, accessible[finer.face_of])
