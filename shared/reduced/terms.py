"""Loads of a local model as terms of its potential; see ``reduced.problem``."""

from typing import Annotated, NamedTuple

from palpate.shared.arrays import Array, Ints
from palpate.shared.compiled import methods
from palpate.shared.mechanics import tip


@methods()
class Dead(NamedTuple):
    """A load that does not follow the tissue."""

    f: Array  # (r,) mN times mode

    def push(self, q, residual):
        """Subtract the load from the residual; return its potential."""
        energy = 0.0
        for i in range(len(q)):
            residual[i] -= self.f[i]
            energy -= self.f[i] * q[i]
        return energy


class Contact(NamedTuple):
    """The tip at a place of the surface, and what a state does there; see ``mechanics.tip``."""

    mean: Annotated[Array, "3, r"]  # mm, of the modes under a footprint there
    steps: Annotated[Array, "2, 3, r"]  # its derivatives along two tangents of the surface
    normal: Annotated[Array, "3"]  # along which the tip pushes
    along: Annotated[Array, "r"]  # the mean's component along that
    away: Annotated[Array, "3"]  # mm, from the place at rest to the tip's centre
    law: Annotated[Array, "6"]  # beta, relief, loss, held; penetration (mm) of tissue at rest, past
    found: Annotated[Array, "3"]  # force, stiffness, penetration of the last state
    fading: Annotated[Array, "3"]  # see ``Tip.fading``


class TipWarm(NamedTuple):
    """Last answer of the tip."""

    known: Annotated[Array, "1"]  # 1 if there is one
    centre: Annotated[Array, "3"]  # mm
    place: Annotated[Array, "3"]  # mm
    follows: Annotated[Array, "3, 3"]  # derivative of the place in the centre
    force: Annotated[Array, "3"]  # mN
    tangent: Annotated[Array, "3, 3"]  # mN/mm


class TipScratch(NamedTuple):
    """Working memory of a query of the tip."""

    contact: Contact
    place: Annotated[Array, "3"]  # mm, where the next round presses
    tangents: Annotated[Array, "2, 3"]
    bent: Annotated[Array, "2, 2"]  # curvature along them, 1/mm
    nodal: Annotated[Array, "6, nodes"]  # see ``footprint.means``
    steady: Annotated[Array, "r"]
    answer: Annotated[Array, "r"]
    seen: Annotated[Array, "5, r"]  # what the contact sees of a state, see ``mechanics.tip``
    answered: Annotated[Array, "5, r"]
    slopes: Annotated[Array, "2, 3"]
    curved: Annotated[Array, "2, 2"]
    inwards: Annotated[Array, "2"]  # change of the distance from an edge along the tangents
    towards: Annotated[Array, "3"]  # from the smoothed surface to the centre
    gradient: Annotated[Array, "5"]  # of the energy of one model, see ``tip.settle``
    hessian: Annotated[Array, "5, 5"]
    g: Annotated[Array, "5"]  # of all, by weight
    H: Annotated[Array, "5, 5"]
    forces: Annotated[Array, "slots, 3"]  # mN, of the models
    step: Annotated[Array, "2"]  # mm, Newton's step of the place
    wanted: Annotated[Array, "2"]  # mm, what is made of it
    moved: Annotated[Array, "2"]  # mm, what has come of it
    wall: Annotated[Array, "3"]  # out of the surface, where its rim bars the place; else zero
    barred: Annotated[Array, "2"]  # the same along the tangents
    turned: Annotated[Array, "2, 3"]  # derivative of the place in the centre
    last: Annotated[Array, "3"]  # mm, the last place with contact
    before: Annotated[Array, "3"]  # normal there
    way: Annotated[Array, "3"]  # mm, out to where the tip does not touch
    at: Annotated[Array, "3"]  # mm, its centre on the way in
    begun: Annotated[Ints, "slots"]  # models whose past is known, in their slots


@methods()
class Pushed(NamedTuple):
    """The rigid tip, and a dead load."""

    contact: Contact
    f: Array  # (r,) dead
    steady: Array  # (r,) load and past that do not depend on the state
    external: Array  # (r,) the same with the tip's force, for ``corrections.Secants``

    def push(self, q, residual):
        """Subtract the tip's force and the dead load from the residual; return their potential."""
        law, found, along = self.contact.law, self.contact.found, self.contact.along
        d = law[4]
        for j in range(len(q)):
            d += along[j] * q[j]
        force, stiffness, energy = tip.push(law[0], law[1], law[2], law[3], d)
        found[0], found[1], found[2] = force, stiffness, d
        for j in range(len(q)):
            residual[j] += force * along[j] - self.f[j]
            energy -= self.f[j] * q[j]
            self.external[j] = self.steady[j] - force * along[j]
        return energy
