"""The rigid sphere pushed into the surface of a full model, integrated over its faces: a reference.

It is right where the faces are much smaller than the contact, which takes a mesh that no scene can
afford; see ``mechanics.tip`` for the tip that is served.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from palpate.offline.fem import assembly
from palpate.offline.fem.sphere import (
    CONVEX,
    FORCE,
    STIFFNESS,
    Sphere,
    SphereSurface,
    Touching,
    room_for,
    touch,
)
from palpate.offline.fem.terms import Reaction
from palpate.shared.arrays import Array, Numbers

if TYPE_CHECKING:
    from palpate.offline.fem.model import FullModel
    from palpate.offline.fem.potential import Potential


class SphereContact:
    """The surface of a full model where a rigid tip can touch it, with room for what it touches."""

    def __init__(self, model: FullModel, surface: SphereSurface, sphere: Sphere) -> None:
        self.sphere = sphere
        self.surface = surface
        self.young = model.tissue.young
        self._all = np.arange(len(surface.faces), dtype=np.int32)
        self.slots = model.face_slots(surface.faces)
        self.touching: Touching = room_for(surface, len(surface.faces))

    def touch(
        self, position: Array, displacement: Array, wanted: float
    ) -> tuple[Numbers, float, float]:
        """Write to ``touching`` what ``sphere.touch`` finds; return faces (f, k), energy, depth."""
        count, energy, deepest = touch(
            self.sphere, self.surface, self._all, position, displacement.reshape(-1, 3),
            self.touching, wanted,
        )  # fmt: skip
        return self.surface.faces[self.touching.face[:count]], energy, deepest


@dataclass(frozen=True)
class SphereLoad:
    """A rigid tip held at a place, against the surface of a body."""

    contact: SphereContact
    position: Array  # (3,) mm, centre of the tip
    approach: Array  # (3,) mm, its way from ``position - approach``, where it had no contact
    lower: ClassVar[str] = "depth"

    @property
    def size(self) -> float:
        """See ``DeadLoad``: about the force, which is not known beforehand."""
        radius = self.contact.sphere.radius
        depth = max(float(np.linalg.norm(self.approach)), 1e-6 * radius)
        return self.contact.young * math.sqrt(radius * depth) * depth

    def at(self, fraction: float) -> SphereLoad:
        """See ``DeadLoad``."""
        return replace(self, position=self.position - (1.0 - fraction) * self.approach)

    def add_force(self, displacement: Array, force: Array) -> float:
        """See ``DeadLoad``; the energy is that of the penalty."""
        faces, energy, _ = self.contact.touch(self.position, displacement, FORCE)
        np.subtract.at(force.reshape(-1, 3), faces, self.contact.touching.force[: len(faces)])
        return energy

    def add_stiffness(self, displacement: Array, data: Array, convex: bool) -> None:
        """See ``DeadLoad``."""
        wanted = CONVEX if convex else STIFFNESS
        faces, _, _ = self.contact.touch(self.position, displacement, wanted)
        touching = self.contact.touching
        slots = self.contact.slots[touching.face[: len(faces)]]
        assembly.scatter_faces(touching.stiffness[: len(faces)], slots, data)

    def reaction(self, potential: Potential, displacement: Array) -> Reaction:
        """See ``DeadLoad``; its derivative, which takes one more factorisation, is not found."""
        faces, _, deepest = self.contact.touch(self.position, displacement, FORCE)
        return Reaction(
            force=-self.contact.touching.force[: len(faces)].sum(axis=(0, 1)),
            tangent=np.full((3, 3), np.nan),
            penetration=deepest,
        )
