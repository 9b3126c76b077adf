"""The mesh of a body from a file, with what is held and what can be touched."""

import numpy as np

from palpate.offline.bodies.base import Base, base_mesh, body_file
from palpate.offline.bodies.places import (
    Boundary,
    boundary_of_corners,
    faces_at,
    support_and_surface,
)
from palpate.offline.bodies.refine import Refined, growing, refined, spread_over
from palpate.offline.bodies.regions import refuse_touched, regions_at
from palpate.offline.bodies.tetrahedra import boundary
from palpate.shared.arrays import Array, Flags, Numbers
from palpate.shared.local_models import Mesh
from palpate.shared.scene import Scene, SceneError

GROWTH = 0.7
"""Of an edge over its distance from the surface that can be touched and the ends of the support."""


def refined_body(scene: Scene) -> Refined:
    """The body of a scene, its elements as fine as ``geometry.finest`` and ``finer`` say.

    As stored where the former is not given.

    Raises
    ------
    SceneError
        If ``geometry.finer`` is where nothing can be touched and nothing held ends.
    """
    base, geometry = base_mesh(scene), body_file(scene)[0]
    if geometry.finest is None:
        return refined(base, _as_it_is)
    faces = boundary_of(base)
    held, touched = support_and_surface(scene, faces)
    places = [(geometry.finest, np.ones(len(faces.centres), dtype=bool))]
    if (finer := geometry.finer) is not None:
        places.append((finer.finest, faces_at(scene, "geometry.finer", finer, faces)))
    wanted = [
        growing(_points(base, held & at, touched & at, ~held & at, edge), edge, GROWTH, np.inf)
        for edge, at in places
    ]
    return refined(base, lambda at: np.min([edge_length_at(at) for edge_length_at in wanted], 0))


def _points(base: Base, held: Flags, touched: Flags, others: Flags, edge: float) -> Array:
    """Points (k, 3) mm of a place where edges have to be as short (mm), of its faces (f,)."""
    ends = _shared_nodes(base, held, others)
    if touched.any():
        return np.concatenate([spread_over(base, touched, edge), ends])
    if not len(ends):
        raise SceneError(
            "geometry.finer: nothing there can be touched, and nothing held ends there"
        )
    return ends


def _shared_nodes(base: Base, some: Flags, others: Flags) -> Array:
    """Nodes (k, 3) mm where some faces (f,) border on others."""
    faces = boundary(base.elements)[0]
    return base.nodes[np.intersect1d(faces[some], faces[others])]


def stored_mesh(scene: Scene) -> Mesh:
    """The mesh of a scene's body as it is stored; see ``mesh_of``."""
    return mesh_of(scene, refined(base_mesh(scene), _as_it_is))


def mesh_of(scene: Scene, finer: Refined) -> Mesh:
    """The mesh of a scene's body, with what is held and can be touched.

    That is made of whole faces of the base mesh, regions of its elements, and so the same in every
    mesh.

    Raises
    ------
    SceneError
        If support or surface hold no face, or the same, or a region no element, or what can be
        touched.
    """
    base = base_mesh(scene)
    centres = base.nodes[base.elements[:, :4]].mean(axis=1)
    regions = regions_at(scene, centres, base.cells)
    mesh = _mesh(finer, *support_and_surface(scene, boundary_of(base)), regions)
    touched = mesh.faces[mesh.accessible]
    refuse_touched(scene, mesh.nodes, mesh.elements, mesh.regions, touched)
    return mesh


def bare_mesh(scene: Scene) -> Mesh:
    """The mesh of a scene's body as it is stored, neither held nor touched anywhere."""
    base = base_mesh(scene)
    return _mesh(refined(base, _as_it_is), *boundary_of(base).nowhere())


def support_edges(scene: Scene) -> Array:
    """Points (k, 3) mm where what is held ends: nodes of the base mesh."""
    base = base_mesh(scene)
    held = support_and_surface(scene, boundary_of(base))[0]
    return _shared_nodes(base, held, ~held)


def boundary_of(base: Base) -> Boundary:
    """Faces of a base mesh and their sets."""
    faces, _, _ = boundary(base.elements)
    return Boundary(*boundary_of_corners(base.nodes[faces[:, :3]]), sets=base.faces)


def _as_it_is(points: Array) -> Array:
    return np.full(len(points), np.inf)


def _mesh(
    finer: Refined, support: Flags, accessible: Flags, regions: Numbers | None = None
) -> Mesh:
    clamped = np.zeros(len(finer.nodes), dtype=bool)
    clamped[finer.faces[support[finer.face_of]]] = True
    return Mesh(
        finer.nodes,
        finer.elements,
        finer.faces,
        clamped,
        accessible[finer.face_of],
        None if regions is None else regions[finer.element_of],
    )
