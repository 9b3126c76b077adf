"""Blocks of one tissue that are clamped at their bottom, and what touches them."""

import numpy as np

from palpate.offline.fem.contact import SphereContact
from palpate.offline.fem.mesh import build_mesh
from palpate.offline.fem.model import FullModel
from palpate.offline.fem.sphere import sphere_of, sphere_surface
from palpate.offline.scenes import find_scene
from palpate.shared.mechanics.neo_hookean import NeoHookeanTissue

YOUNG, POISSON = 15.0, 0.45
ELEMENTS = ("hex8", "hex20")


def tissue_of(poisson=POISSON, prony=()):
    return NeoHookeanTissue(law="neo-hookean", young=YOUNG, poisson=poisson, prony=prony)


def body(element, divisions, size, poisson=POISSON, prony=()):
    """Full model of a block."""
    scene = find_scene("quick")
    geometry = scene.geometry.model_copy(
        update={"element": element, "divisions": divisions, "size": size}
    )
    mesh = build_mesh(scene.model_copy(update={"geometry": geometry}))
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
