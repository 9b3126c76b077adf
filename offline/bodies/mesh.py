"""The mesh of a body from a file, with what is held and what can be touched."""

import numpy as np

from palpate.offline.bodies.base import Base, base_mesh, body_file
from palpate.offline.bodies.places import Boundary, boundary_of_corners, support_and_surface
from palpate.offline.bodies.refine import Refined, growing, refined, spread_over
from palpate.offline.bodies.tetrahedra import boundary
from palpate.shared.arrays import Array, Flags
from palpate.shared.local_models import Mesh
from palpate.shared.scene import Scene

GROWTH = 0.7
"""Of an edge over its distance from the surface that can be touched and the ends of the support."""


def refined_body(scene: Scene) -> Refined:
    """The body of a scene, its elements as fine as ``geometry.finest`` says; else as stored."""
    base, finest = base_mesh(scene), body_file(scene)[0].finest
    if finest is None:
        return refined(base, _as_it_is)
    touched = support_and_surface(scene, boundary_of(base))[1]
    fine = np.concatenate([spread_over(base, touched, finest), support_edges(scene)])
    return refined(base, growing(fine, finest, GROWTH, np.inf))


def stored_mesh(scene: Scene) -> Mesh:
    """The mesh of a scene's body as it is stored; see ``mesh_of``."""
    return mesh_of(scene, refined(base_mesh(scene), _as_it_is))


def mesh_of(scene: Scene, finer: Refined) -> Mesh:
    """The mesh of a scene's body, with what is held and can be touched.

    That is made of whole faces of the base mesh, and so is the same in every mesh.

    Raises
    ------
    SceneError
        If support or surface hold no face, or the same.
    """
    return _mesh(finer, *support_and_surface(scene, boundary_of(base_mesh(scene))))


def bare_mesh(scene: Scene) -> Mesh:
    """The mesh of a scene's body as it is stored, neither held nor touched anywhere."""
    base = base_mesh(scene)
    return _mesh(refined(base, _as_it_is), *boundary_of(base).nowhere())


def support_edges(scene: Scene) -> Array:
    """Points (k, 3) mm where what is held ends: nodes of the base mesh."""
    base = base_mesh(scene)
    held = support_and_surface(scene, boundary_of(base))[0]
    faces = boundary(base.elements)[0]
    return base.nodes[np.intersect1d(faces[held], faces[~held])]


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
