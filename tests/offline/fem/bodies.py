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


def hertz_on_a_layer(depth, radius, height, young=YOUNG, poisson=POISSON):
    """Hertz's force on a bonded layer (Dimitriadis et al., Biophys. J. 82 (2002) 2798, eq. 12)."""
    a = -(1.2876 - 1.4678 * poisson + 1.3442 * poisson**2) / (1 - poisson)
    b = (0.6387 - 1.0277 * poisson + 1.5164 * poisson**2) / (1 - poisson)
    chi, pi = np.sqrt(radius * depth) / height, np.pi
    layer = (
        1 - 2 * a / pi * chi + 4 * a**2 / pi**2 * chi**2
        - 8 / pi**3 * (a**3 + 4 * pi**2 / 15 * b) * chi**3
        + 16 * a / pi**4 * (a**3 + 3 * pi**2 / 5 * b) * chi**4
    )  # fmt: skip
    return 4 / 3 * young / (1 - poisson**2) * np.sqrt(radius) * depth**1.5 * layer
