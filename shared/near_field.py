"""Near field of a contact: what a mesh cannot follow of what happens right under the endoscope.

Under a footprint the gradients of the displacement change within a fraction of its radius, less
than an element.  What becomes of them is known in linear elasticity: the local field of a
half-space (``mechanics.half_space``), bent to the curvature of the surface.  What a mesh makes of
that field is nearly its interpolant.  So the interpolant is taken off the displacement of the
nodes, gradients are recovered from what is left, which is smooth, and those of the local field are
added.

A tip presses closer than the footprint of its force: its near field is that of Hertz's pressure,
and by what it does more than the footprint's the surface is dented.

Moduli are those of tissue at once, also where the past has relaxed it: the stress that is added is
then right, as it hardly depends on them, with the past ``B`` that the mesh has.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from palpate.shared.arrays import Array
from palpate.shared.local_models import Body
from palpate.shared.mechanics.half_space import (
    ABOVE,
    REACH,
    dent,
    local_field,
    pressed,
    whole_field,
)
from palpate.shared.mechanics.stress import NearField
from palpate.shared.mechanics.tip import bend, tangents_of


class Contact(NamedTuple):
    """A footprint as it presses."""

    place: Array  # (3,) mm, on the surface at rest
    normal: Array  # (3,) outward there
    curvature: Array  # (6,) 1/mm there, see ``Surface.curvature``
    traction: Array  # (3,) kPa, on the tissue at the footprint's centre
    radius: float  # mm
    tip: bool = False  # whether a sphere of that radius presses with the footprint's force


class HalfSpace(NamedTuple):
    """Tissue under a contact."""

    local: Array  # see ``half_space.local_field``
    whole: Array  # see ``half_space.whole_field``
    poisson: float
    softness: float  # 1/kPa, ``1 / 2 mu``


NO_CONTACT = NearField(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))


class NearFields:
    """Near fields of a body, whose tissue is the same wherever it can be touched."""

    def __init__(self, body: Body) -> None:
        mu, lam = body.touched
        poisson = 0.5 * lam / (lam + mu)
        self._tissue = HalfSpace(local_field(poisson), whole_field(poisson), poisson, 0.5 / mu)

    def dent(self, points: Array, contact: Contact | None) -> NearField:
        """What a tip does more than the footprint of its force, at points (n, 3) mm."""
        return self.at(points, contact if contact and contact.tip else None, 0.0)

    def at(self, points: Array, contact: Contact | None, footprint: float = 1.0) -> NearField:
        """Near field of a contact, if there is one, at points (n, 3) mm.

        With a share of that of its footprint.
        """
        if contact is None:
            return NO_CONTACT
        n = len(points)
        numbers, displacement = np.empty(n, np.int64), np.empty((n, 3))
        gradient = np.empty((n, 3, 3))
        found = numbers, displacement, gradient
        count = near_field(self._tissue, points, contact, footprint, *found)
        return NearField(numbers[:count], displacement[:count], gradient[:count])


@njit(cache=True, error_model="numpy", nogil=True)
def near_field(tissue, points, contact, footprint, numbers, displacement, gradient):
    """Write the near field at the points (n, 3) mm it reaches; return how many these are.

    Parameters
    ----------
    tissue : HalfSpace
    contact : Contact
    footprint : float
        Share of the footprint's own; the dent of a tip comes on top.
    numbers, displacement, gradient : ndarray, shape (n,), (n, 3) mm, (n, 3, 3), out
        The first so many are written.
    """
    radius, normal, traction = contact.radius, contact.normal, contact.traction
    Q, bent, away = np.empty((3, 3)), np.empty((2, 2)), np.empty(3)
    u, H = np.empty(3), np.empty((3, 3))
    tangents_of(normal, Q[:2])
    into = -np.dot(traction, normal)
    shear = traction + into * normal
    along = math.sqrt(np.dot(shear, shear))
    if along > 1e-9 * abs(into):
        Q[0] = shear / along
    Q[2] = -normal
    Q[1] = np.cross(Q[2], Q[0])
    sharpness, softness = bend(contact.curvature, Q[:2], radius, bent), tissue.softness
    # Hertz's contact radius; the modulus is E / (1 - nu^2), the force that of the footprint
    force = 8.0 / 15.0 * math.pi * radius**2 * max(into, 0.0)
    cubed = 0.75 * force * softness * (1.0 - tissue.poisson) / sharpness
    touched = max(cubed ** (1.0 / 3.0) / radius, 1e-3)
    count = 0
    for n in range(len(points)):
        far = 0.0
        for i in range(3):
            away[i] = (points[n, i] - contact.place[i]) / radius
            far += away[i] ** 2
        if far > 2.0 * REACH**2:
            continue
        x = y = z = 0.0
        for i in range(3):
            x += Q[0, i] * away[i]
            y += Q[1, i] * away[i]
            z += Q[2, i] * away[i]
        # the surface falls away where it is convex
        a = radius * (bent[0, 0] * x + bent[0, 1] * y)
        b = radius * (bent[1, 0] * x + bent[1, 1] * y)
        z -= 0.5 * (a * x + b * y)
        if x * x + y * y > REACH**2 or z > REACH or z < -ABOVE:
            continue
        u[:], H[:] = 0.0, 0.0
        if footprint > 0.0:
            pressed(tissue.local, x, y, z, footprint * into, footprint * along, u, H)
        if contact.tip:
            dent(tissue.whole, touched, tissue.poisson, x, y, z, into, u, H)
        numbers[count] = n
        for i in range(3):
            # of the gradient in the half-space's own coordinates, row i
            p = Q[0, i] * H[0, 0] + Q[1, i] * H[1, 0] + Q[2, i] * H[2, 0]
            q = Q[0, i] * H[0, 1] + Q[1, i] * H[1, 1] + Q[2, i] * H[2, 1]
            r = Q[0, i] * H[0, 2] + Q[1, i] * H[1, 2] + Q[2, i] * H[2, 2]
            p, q = softness * (p - a * r), softness * (q - b * r)
            moved = Q[0, i] * u[0] + Q[1, i] * u[1] + Q[2, i] * u[2]
            displacement[count, i] = softness * radius * moved
            for j in range(3):
                gradient[count, i, j] = p * Q[0, j] + q * Q[1, j] + softness * r * Q[2, j]
        count += 1
    return count
