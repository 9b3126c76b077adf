"""Blocks of one tissue that are clamped at their bottom, and what touches them."""

import numpy as np

from palpate.offline.fem.contact import SphereContact
from palpate.offline.fem.mesh import build_mesh
from palpate.offline.fem.model import FullModel
from palpate.offline.fem.sphere import sphere_of, sphere_surface
from palpate.offline.scenes import find_scene
from palpate.shared.geometry.elements import TET10
from palpate.shared.local_models import Mesh
from palpate.shared.mechanics.neo_hookean import NeoHookeanTissue

YOUNG, POISSON = 15.0, 0.45
ELEMENTS = ("hex8", "hex20", "tet10")


def tissue_of(poisson=POISSON, prony=()):
    return NeoHookeanTissue(law="neo-hookean", young=YOUNG, poisson=poisson, prony=prony)


def body(element, divisions, size, poisson=POISSON, prony=()):
    """Full model of a block; of six tet10 where it has one of the hexahedra."""
    scene = find_scene("quick")
    hexahedra = "hex8" if element == "tet10" else element
    geometry = scene.geometry.model_copy(
        update={"element": hexahedra, "divisions": divisions, "size": size}
    )
    mesh = build_mesh(scene.model_copy(update={"geometry": geometry}))
    if element == "tet10":
        mesh = in_tetrahedra(mesh)
    return FullModel(mesh, tissue_of(poisson, prony))


def sphere_contact(model, radius):
    """Contact of a block's top with a rigid tip."""
    mesh = model.mesh
    surface = sphere_surface(mesh.nodes, mesh.faces, mesh.accessible, radius)
    return SphereContact(model, surface, sphere_of(radius, YOUNG))


def support_force(model, displacement):
    """Force (3,) mN with which a deformed body holds on to its support."""
    force = np.zeros(displacement.size)
    model.internal(displacement.ravel(), force)
    return force.reshape(-1, 3)[model.mesh.clamped].sum(axis=0)


BRICK = ((0, 1, 2, 6), (0, 2, 3, 6), (0, 3, 7, 6), (0, 7, 4, 6), (0, 4, 5, 6), (0, 5, 1, 6))
"""Corners of the six tetrahedra of a brick."""


def with_middles(nodes, elements):
    """Nodes and elements of straight tet10, of tetrahedra (e, 4); and all edges (m, 2)."""
    ends = np.sort(elements[:, np.array(TET10.edges)], axis=2)
    edges, middle = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
    middle = len(nodes) + middle.reshape(len(elements), -1)
    elements = np.hstack([elements, middle]).astype(np.int32)
    return np.vstack([nodes, nodes[edges].mean(axis=1)]), elements, edges


def in_tetrahedra(bricks):
    """Mesh of tet10, straight, six to each brick of a mesh of hex8."""
    corners = bricks.elements[:, np.array(BRICK)].reshape(-1, 4)
    nodes, elements, edges = with_middles(bricks.nodes, corners)
    faces = elements[:, np.array([TET10.on_face(face) for face in TET10.faces])].reshape(-1, 6)
    _, first, count = np.unique(
        np.sort(faces[:, :3], axis=1), axis=0, return_index=True, return_counts=True
    )
    faces = faces[first[count == 1]]
    accessible = np.isin(faces[:, :3], bricks.faces[bricks.accessible]).all(axis=1)
    return Mesh(
        nodes=nodes,
        elements=elements,
        faces=faces,
        clamped=np.concatenate([bricks.clamped, bricks.clamped[edges].all(axis=1)]),
        accessible=accessible,
        regions=None if bricks.regions is None else np.repeat(bricks.regions, len(BRICK)),
    )
