"""What acts on a body, each as a term of its potential energy: the past of its tissue, and loads.

A term adds its energy, its force (the gradient of the energy) and its stiffness at a displacement,
and knows nothing of other terms.  The elastic tissue is the term that every body has, see
``fem.model``; the sum of all is what ``fem.potential`` gives to Newton's method.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar, NamedTuple, TypeAlias

import numpy as np

from palpate.offline.fem import assembly
from palpate.shared.arrays import Array
from palpate.shared.mechanics import viscosity
from palpate.shared.mechanics.tip import (
    LONGEST,
    SEEN,
    Tip,
    follow,
    next_place,
    push,
    pushed,
    settle,
)

if TYPE_CHECKING:
    from palpate.offline.fem.contact import SphereLoad
    from palpate.offline.fem.model import FullModel
    from palpate.offline.fem.potential import Potential


class Reaction(NamedTuple):
    """What the tool that loads a body feels."""

    force: Array  # (3,) mN, on the tool
    tangent: Array  # (3, 3) mN/mm, derivative of the force in the tool's position
    penetration: float  # mm, largest
    place: Place | None = None  # of a tip that touches


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


@dataclass(frozen=True)
class TipLoad:
    """The rigid tip that touches at a place and pushes along a normal; see ``mechanics.tip``."""

    tip: Tip
    nodal: Array  # (MEANS, nodes), see ``footprint.means`` of that place
    tangents: Array  # (2, 3) there
    bent: Array  # (2, 2) 1/mm, curvature along them
    away: Array  # (3,) mm, from there to the tip's centre
    normal: Array  # (3,)
    law: tuple[float, float, float, float]  # beta, relief, loss, held
    edge: Array  # (4,) mm, distance from a sharp edge, and its gradient
    lower: ClassVar[str] = "depth"

    @property
    def size(self) -> float:
        """See ``DeadLoad``: about the force, which is not known beforehand."""
        depth = min(max(self._depth, 1e-6 * self.tip.radius), self.tip.radius)
        return self.tip.modulus * math.sqrt(self.tip.radius * depth) * depth

    def at(self, fraction: float) -> TipLoad:
        """See ``DeadLoad``; at 0 the tip is where it just does not touch the surface at rest."""
        out = (1.0 - fraction) * max(self._depth, 0.0)
        return replace(self, away=self.away + out * self.normal)

    @property
    def _depth(self) -> float:
        """In the surface at rest, mm."""
        return self.tip.radius - float(self.normal @ self.away)

    def touch(self, displacement: Array) -> Touch:
        """What the tip does to a displacement (3 nodes,) mm."""
        away = self.away - self.nodal[0] @ displacement.reshape(-1, 3)
        gap, depth = float(np.linalg.norm(away)), self.tip.radius - float(self.normal @ away)
        return Touch(away / gap, gap, depth, *push(*self.law, depth))

    def add_force(self, displacement: Array, force: Array) -> float:
        """See ``DeadLoad``."""
        found = self.touch(displacement)
        force.reshape(-1, 3)[:] += found.force * np.outer(self.nodal[0], self.normal)
        return found.energy

    def add_stiffness(self, displacement: Array, data: Array, convex: bool) -> None:
        """See ``DeadLoad``; its stiffness is that of a ``spring``."""

    def spring(self, displacement: Array) -> tuple[Array, float]:
        """Direction (3 nodes,) and stiffness (mN/mm) of the law at a displacement (3 nodes,) mm."""
        return np.outer(self.nodal[0], self.normal).ravel(), self.touch(displacement).stiffness

    def nearer(self, displacement: Array) -> tuple[Array, Array]:
        """Step (2,) mm towards the place whose deformed surface is nearest; the normal there."""
        rigid, u = np.zeros((SEEN, SEEN)), displacement.ravel()
        g, H = self._settled(u, rigid, 1.0, 0.0, np.zeros(3))
        moved, force = np.empty(2), self.touch(u).towards.copy()
        length = next_place(g, H, np.zeros(2), 0.0, moved)
        share = min(1.0, LONGEST * self.tip.radius / max(length, 1e-12))
        size = pushed(g, H, moved, share, force)
        return share * moved, force / size

    def _settled(
        self,
        displacement: Array,
        compliance: Array,
        force: float,
        stiffness: float,
        fading: Array,
    ) -> tuple[Array, Array]:
        """See ``tip.settle``."""
        found, u = self.touch(displacement), displacement.reshape(-1, 3)
        one, both, two = self.nodal[3:] @ u @ self.normal
        g, H = np.empty(SEEN), np.empty((SEEN, SEEN))
        settle(
            compliance, force, stiffness, found.gap, self.normal, found.towards,
            self.tangents + self.nodal[1:3] @ u, np.array([[one, both], [both, two]]) - self.bent,
            self.tangents @ self.edge[1:], fading, g, H,
        )  # fmt: skip
        return g, H

    def reaction(self, potential: Potential, displacement: Array) -> Reaction:
        """See ``DeadLoad``."""
        found, means = self.touch(displacement), np.einsum("n,ij->nij", self.nodal[0], np.eye(3))
        if found.force == 0.0:
            return Reaction(np.zeros(3), np.zeros((3, 3)), 0.0)
        turned = np.einsum("an,i->nia", self.nodal[1:3], self.normal)
        seen = np.concatenate([means, turned], axis=2).reshape(-1, SEEN)[potential.free]
        compliance = potential.compliance(displacement[potential.free], seen)
        fading = np.empty(3)
        self.tip.fading(self.edge[0], self.law, found.penetration, fading)
        g, H = self._settled(displacement, compliance, found.force, found.stiffness, fading)
        place = Place(g, H, found.force * found.towards)
        return Reaction(place.pushes, place.tangent(np.zeros(2)), found.penetration, place)


class Touch(NamedTuple):
    """What the tip does to a state at a given place."""

    towards: Array  # (3,) from the smoothed surface to the tip's centre
    gap: float  # mm, between these
    penetration: float  # mm
    force: float  # mN
    stiffness: float  # mN/mm
    energy: float  # mN mm


class Place(NamedTuple):
    """How an equilibrium under the tip changes with its place and centre; see ``tip.settle``."""

    g: Array  # (SEEN,) mN
    H: Array  # (SEEN, SEEN) mN/mm
    pushes: Array  # (3,) mN, force on the tool now

    def step(self, wall: Array, least: float) -> tuple[Array, Array]:
        """Newton's step (2,) mm of the place along the tangents, and the wall that bars it.

        See ``tip.next_place``.
        """
        moved, barred = np.empty(2), wall.copy()
        next_place(self.g, self.H, barred, least, moved)
        return moved, barred

    def force(self, step: Array, share: float) -> Array:
        """Force (3,) mN on the tool after a share of a step (2,) mm of the place."""
        force = self.pushes.copy()
        pushed(self.g, self.H, step, share, force)
        return force

    def tangent(self, wall: Array) -> Array:
        """Derivative (3, 3) mN/mm of the force on the tool in its position."""
        tangent = np.empty((3, 3))
        follow(self.H, wall, np.empty((2, 3)), tangent)
        return tangent


@dataclass(frozen=True)
class Past:
    """What visco-elastic tissue remembers; see ``mechanics.viscosity``."""

    displacement: Array  # (nodes, 3) mm, the last
    points: Array  # (terms + 1, e, q, 6), at quadrature points
    dent: Array = field(default_factory=lambda: np.zeros(1))  # see ``mechanics.tip``
    foot: Array | None = None  # (3,) mm, where the tip touched last, if it did


class PastStress:
    """What a past does to the stress at the end of a time step of given weights."""

    def __init__(self, model: FullModel, past: Past, weights: viscosity.Weights) -> None:
        self._mesh = model.connectivity, model.gradients, model.weights, model.point_law.mu
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
        return Past(displacement, past.points, past.dent)
    points = past.points.copy()
    m = np.empty(points.shape[1:])
    assembly.drive(model.connectivity, model.gradients, displacement.reshape(-1), m)
    viscosity.advance(m.reshape(-1), weights, points.reshape(len(points), -1))
    return Past(displacement, points, past.dent)


AppliedLoad: TypeAlias = "DeadLoad | TipLoad | SphereLoad"
"""A term that can be applied little by little."""

Term: TypeAlias = "AppliedLoad | PastStress"
"""A part of the potential energy of a body."""
