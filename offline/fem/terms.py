"""What acts on a body, each as a term of its potential energy: the past of its tissue, and loads.

A term adds its energy, its force (the gradient of the energy) and its stiffness at a displacement,
and knows nothing of other terms.  The elastic tissue is the term that every body has, see
``fem.model``; the sum of all is what ``fem.potential`` gives to Newton's method.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from palpate.offline.fem import assembly
from palpate.shared.arrays import Array, Numbers
from palpate.shared.mechanics import sphere, viscosity
from palpate.shared.mechanics.sphere import Tip, TipSurface, Touching, room_for

if TYPE_CHECKING:
    from palpate.offline.fem.model import FullModel
    from palpate.offline.fem.potential import Potential


class Reaction(NamedTuple):
    """What the tool that loads a body feels."""

    force: Array  # (3,) mN, on the tool
    tangent: Array  # (3, 3) mN/mm, derivative of the force in the tool's position
    penetration: float  # mm, largest


@dataclass(frozen=True)
class DeadLoad:
    """Nodal forces that do not change as the body moves."""

    forces: Array  # (3 nodes,) mN
    lower: ClassVar[str] = "pressure"
    """What a user lowers where there is no equilibrium."""

    @property
    def size(self) -> float:
        """Force (mN) beside which a residual is judged."""
        return float(np.linalg.norm(self.forces))

    def at(self, fraction: float) -> DeadLoad:
        """The load on its way: nothing at 0, all of it at 1."""
        return DeadLoad(fraction * self.forces)

    def add_force(self, displacement: Array, force: Array) -> float:
        """Add the gradient of the energy to ``force``; return the energy, mN mm.

        Parameters
        ----------
        displacement : ndarray, shape (3 nodes,), mm
            Nowhere inverted.
        force : ndarray, shape (3 nodes,), mN
        """
        force -= self.forces
        return -float(self.forces @ displacement)

    def add_stiffness(self, displacement: Array, data: Array, convex: bool) -> None:
        """Add the second derivative of the energy: none.

        Parameters
        ----------
        displacement : ndarray, shape (3 nodes,), mm
        data : ndarray, shape (nnz,), mN/mm
            In the pattern of the full model.
        convex : bool
            Whether to leave out what is not positive semi-definite, where the term can tell.
        """

    def reaction(self, potential: Potential, displacement: Array) -> Reaction:
        """What the tool feels at an equilibrium (3 nodes,) mm of a potential with this load.

        The force does not change as the tool moves.
        """
        return Reaction(-self.forces.reshape(-1, 3).sum(axis=0), np.zeros((3, 3)), 0.0)


class TipContact:
    """The surface of a full model where a rigid tip can touch it, with room for what it touches."""

    def __init__(self, model: FullModel, surface: TipSurface, tip: Tip) -> None:
        self.tip = tip
        self.surface = surface
        self.size = model.tissue.young * tip.radius**2
        """The force is not known beforehand; this one dents the tissue by about the radius."""
        self._all = np.arange(len(surface.faces), dtype=np.int32)
        self.slots = model.face_slots(surface.faces)
        self.touching: Touching = room_for(surface, len(surface.faces))

    def touch(
        self, position: Array, displacement: Array, wanted: float
    ) -> tuple[Numbers, float, float]:
        """Write to ``touching`` what ``sphere.touch`` finds; return faces (f, k), energy, depth."""
        count, energy, deepest = sphere.touch(
            self.tip, self.surface, self._all, position, displacement.reshape(-1, 3),
            self.touching, wanted,
        )  # fmt: skip
        return self.surface.faces[self.touching.face[:count]], energy, deepest


@dataclass(frozen=True)
class TipLoad:
    """A rigid tip held at a place, against the surface of a body."""

    contact: TipContact
    position: Array  # (3,) mm, centre of the tip
    approach: Array  # (3,) mm, its way from ``position - approach``, where it had no contact
    lower: ClassVar[str] = "depth"

    @property
    def size(self) -> float:
        """See ``DeadLoad``."""
        return self.contact.size

    def at(self, fraction: float) -> TipLoad:
        """See ``DeadLoad``."""
        return replace(self, position=self.position - (1.0 - fraction) * self.approach)

    def add_force(self, displacement: Array, force: Array) -> float:
        """See ``DeadLoad``; the energy is that of the penalty."""
        faces, energy, _ = self.contact.touch(self.position, displacement, sphere.FORCE)
        np.subtract.at(force.reshape(-1, 3), faces, self.contact.touching.force[: len(faces)])
        return energy

    def add_stiffness(self, displacement: Array, data: Array, convex: bool) -> None:
        """See ``DeadLoad``."""
        wanted = sphere.CONVEX if convex else sphere.STIFFNESS
        faces, _, _ = self.contact.touch(self.position, displacement, wanted)
        touching = self.contact.touching
        slots = self.contact.slots[touching.face[: len(faces)]]
        assembly.scatter_faces(touching.stiffness[: len(faces)], slots, data)

    def reaction(self, potential: Potential, displacement: Array) -> Reaction:
        """See ``DeadLoad``.

        With ``own`` the second derivative of the potential in the tip's position and ``coupling``
        minus the mixed one, the tangent is ``coupling^T K^-1 coupling - own``.
        """
        free, touching = potential.free, self.contact.touching
        potential.factorise(displacement[free], 0.0)
        faces, _, deepest = self.contact.touch(self.position, displacement, sphere.STIFFNESS)
        K = touching.stiffness[: len(faces)].copy()
        for i, j in ((1, 0), (2, 0), (2, 1)):
            K[:, i, j] = K[:, j, i]
        coupling = np.zeros((len(displacement) // 3, 3, 3))
        np.add.at(coupling, faces, np.einsum("fijab->faij", K))
        coupling = coupling.reshape(-1, 3)[free]
        return Reaction(
            force=-touching.force[: len(faces)].sum(axis=(0, 1)),
            tangent=coupling.T @ potential.solve(coupling) - touching.own,
            penetration=deepest,
        )


@dataclass(frozen=True)
class Past:
    """What visco-elastic tissue remembers; see ``mechanics.viscosity``."""

    displacement: Array  # (nodes, 3) mm, the last
    points: Array  # (terms + 1, e, q, 6), at quadrature points


class PastStress:
    """What a past does to the stress at the end of a time step of given weights."""

    def __init__(self, model: FullModel, past: Past, weights: viscosity.Weights) -> None:
        self._mesh = model.connectivity, model.gradients, model.weights, model.law.mu
        self._slots = model.slots
        points = past.points
        self._B = np.empty(points.shape[1:])
        loss = viscosity.predict(points.reshape(len(points), -1), weights, self._B.reshape(-1))
        self._B[..., :3] -= loss
        force = np.zeros(past.displacement.size)
        self.add_force(past.displacement.reshape(-1), force)
        self.size = float(np.linalg.norm(force[model.free]))

    def add_force(self, displacement: Array, force: Array) -> float:
        """See ``DeadLoad``."""
        energy: float = assembly.viscous_residual(*self._mesh, self._B, displacement, force)
        return energy

    def add_stiffness(self, displacement: Array, data: Array, convex: bool) -> None:
        """See ``DeadLoad``."""
        assembly.viscous_tangent(*self._mesh, self._B, displacement, self._slots, data)


def advanced(model: FullModel, past: Past, displacement: Array, weights: viscosity.Weights) -> Past:
    """The past after a step that ends at a displacement (nodes, 3) mm."""
    if not model.prony:
        return Past(displacement, past.points)
    points = past.points.copy()
    m = np.empty(points.shape[1:])
    assembly.drive(model.connectivity, model.gradients, displacement.reshape(-1), m)
    viscosity.advance(m.reshape(-1), weights, points.reshape(len(points), -1))
    return Past(displacement, points)


AppliedLoad = DeadLoad | TipLoad
"""A term that can be applied little by little."""

Term = AppliedLoad | PastStress
"""A part of the potential energy of a body."""
