"""The rigid spherical tip of the endoscope: a footprint of some force, and Hertz's law in series.

A sphere of radius ``R`` dents the tissue within a fraction of its radius, far too closely for the
faces of a mesh and the modes of a reduced model.  Further away only its force counts.  So a
footprint of radius ``R`` presses the body with the force ``F`` of the tip, and what it does not do
near the contact is added in closed form.  With ``m(X) = X + u(X)`` the surface as the
footprint at ``X`` moves it, ``u(X)`` the displacement's mean weighted with the pressure, a tip with
its centre at ``c`` adds to the potential energy of the body

    e(d),    d = R - min_X |c - m(X)|,

the largest penetration of the sphere in that smoothed surface; no friction, no adhesion.  ``d`` is
what the footprint leaves of Hertz's approach of a sphere on a half-space:

    d = (3 F / (4 E* sqrt(R_e)))^(2/3) - RELIEF F / (E* R),    F = e',    E* = E / (1 - nu^2),

where ``1 / R_e^2 = det(1 / R + curvature)`` of the surface (Johnson, Contact Mechanics, 1985,
ch. 4) and the last term is what a half-space moves by under the footprint itself.  On a half-space
this is Hertz's law; layers and finite strains are in ``u(X)``.

At an edge with a right angle half of the contact is missing.  That half is made up for by a mirror
image, which takes the shear stress off the side of the body, and the more so by a factor ``psi``,
which takes off the normal stress (Guilbault, J. Tribol. 133 (2011) 031402).  So at an edge ``d`` is
``(1 + psi) / 2`` times that of twice the force; further away, at a distance ``s``, the image fades
with ``exp(-s / (EDGE R))``, and the energy is ``e(d, s)``: the place lies away from the edge, out
of which the force leans.  Blunter edges have a share of the image, see ``geometry.edges``.

Tissue that remembers relaxes: the law's force is its elastic one less what the past takes off it,
``F = (1 - loss) F_e(d) - held`` (Lee & Radok, J. Appl. Mech. 27 (1960) 438-444).  Near an edge it
leans as that of tissue at rest does, ``de/ds = F (de/ds)_e / F_e``, since all stresses relax alike.

The place ``X`` is where ``c - m(X)`` is normal to the smoothed surface.  It is sought in rounds:
the body is brought to equilibrium with the force along a given normal ``n`` at a given place, where
``d = R - n.(c - m(X))`` and the potential is convex in that, and with the compliance ``M`` of what
the contact sees of the body ``settle`` tells how the energy changes with place and centre: Newton's
step to the next place and normal, and the tangent on the tool.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numba import njit

from palpate.shared.arrays import Array
from palpate.shared.compiled import methods
from palpate.shared.mechanics.laws import AnyTissue
from palpate.shared.mechanics.tissue import lame
from palpate.shared.mechanics.viscosity import Weights

RELIEF = 0.67961113553
"""Mean displacement of a half-space under a footprint, times ``E* R`` over its force: with ``P``
the Hankel transform of its pressure, ``int P(k)^2 dk / (pi P(0)^2)``."""

STEEPEST = 0.8
"""Share of the force's cube root at which the law would have no stiffness left, and up to which it
holds; beyond, which is deeper than any tip goes, its stiffness stays."""

FLATTEST = 0.2
"""Least sum of the tip's and the surface's curvature, in units of the tip's: in a hollow that is as
round as the tip, contact is not local."""

CURVED_WITHIN = 0.3
"""Distance, in radii of the tip, over which the surface's curvature is taken."""

EDGE = 0.19
"""Distance from a sharp edge, in radii of the tip, over which the image of a contact fades: spheres
integrated up to 0.4 radii from edges, 0.05 to 0.4 radii deep, at Poisson's ratios of 0.3 and 0.45,
have forces within 8 % of that, 4 % in root mean square."""

EDGE_FIELD = 6
CONTACT_FIELDS = EDGE_FIELD + 4
"""Values that describe the body at a surface point: its curvature, see ``geometry.surface``, the
distance (mm) from a sharp edge and the gradient (3,) of that."""

LONGEST = 0.3
"""Longest step from place to place, in radii of the tip."""

TURNED = 0.1
"""Shortest step away from the rim, in radii of the tip, where one off it has been turned round."""

BARRED = 0.1
"""Share of a step that is lost where the surface ends, and not for its curvature."""

ROUND_OFF = 1e-12
"""Millimetres of a step that are none."""

LIFTED = 8
"""Rounds after which a tip that loses contact on the way to its place has none, on tissue with a
past: what that takes off the force changes with the place, too."""

VANISHED = 1e-2
"""Share of the largest force so far below which a step has gone too far: the energy, largest at the
place sought, is stationary where contact just begins, too."""

LEAST_KEPT = 0.1
"""Share of a force that a step to the next place must leave for its prediction to be believed."""

REMEMBERED = 0.6
"""Power of ``beta`` by which a force is remembered: what the past takes off then changes with the
place as it does in an energy, as long as ``relief`` does little."""

SEEN = 5
"""Of the body by the contact: three means, and the slopes along the normal of two tangents."""


@methods()
class Tip(NamedTuple):
    """The tip and the tissue under it."""

    radius: float  # mm
    modulus: float  # kPa, E*
    lost: float  # share of it that is lost with a share of the shear modulus, over the latter
    psi: float

    def local_law(self, sharpness, edge):
        """Coefficients ``beta, relief`` of the law where the contact's curvature is ``1 / R_e``.

        It is ``edge`` mm away from an edge with a right angle.
        """
        fade = math.exp(-edge / (EDGE * self.radius))
        images, softer = 1.0 + fade, 1.0 + 0.5 * (self.psi - 1.0) * fade
        beta = (0.75 * images / self.modulus) ** (2.0 / 3.0) * sharpness ** (1.0 / 3.0)
        return softer * beta, softer * images * RELIEF / (self.modulus * self.radius)

    def fading(self, edge, law, d, changes):
        """Write how the law changes ``edge`` mm away from an edge, at a penetration (mm).

        Derivatives ``changes`` (3,) in that distance: of the energy (mN), of the force (mN/mm), and
        second of the energy (mN/mm).  ``law`` is beta, relief, loss, held; see ``push``.
        """
        elastic, stiffness, _ = squeeze(law[0], law[1], d)
        if elastic == 0.0:
            changes[:] = 0.0
            return
        energy, change, second = self.faded(edge, law[0], law[1], elastic, stiffness)
        lean = energy / elastic
        more = (change - lean * stiffness) / elastic  # of the lean with the penetration
        force = (1.0 - law[2]) * elastic - law[3]
        changes[0] = force * lean
        changes[1] = (1.0 - law[2]) * change - law[3] * more
        changes[2] = changes[1] * lean + force * (second - lean * change) / elastic

    def faded(self, edge, beta, relief, force, stiffness):
        """Derivatives as those of ``fading``, of tissue at rest."""
        length, more = EDGE * self.radius, 0.5 * (self.psi - 1.0)
        fade = math.exp(-edge / length)
        images, softer = fade / (1.0 + fade), more * fade / (1.0 + more * fade)
        # derivatives of the logarithms of beta and relief
        b, r = -(2.0 / 3.0 * images + softer) / length, -(images + softer) / length
        soft = softer * (1.0 - softer)
        bb = (2.0 / 3.0 * images * (1.0 - images) + soft) / length**2
        rr = (images * (1.0 - images) + soft) / length**2
        dent, eased = beta * force ** (2.0 / 3.0), relief * force
        shift = b * dent - r * eased  # of the penetration at this force
        second = shift**2 * stiffness
        second -= force * (0.6 * (b * b + bb) * dent - 0.5 * (r * r + rr) * eased)
        return -force * (0.6 * b * dent - 0.5 * r * eased), -shift * stiffness, second

    def image_distance(self, away, share):
        """Distance from a right angle that does as much as one ``away`` mm with a share of it."""
        return away - EDGE * self.radius * math.log(share)


def tip_of(radius: float, tissue: AnyTissue) -> Tip:
    """Tip of a radius (mm) on a tissue; its bulk modulus does not relax."""
    share = sum(g for g, _ in tissue.prony)
    mu, lam = lame(tissue.young, tissue.poisson)
    whole, left = (plane_modulus(m, lam + 2.0 * mu / 3.0) for m in (mu, (1.0 - share) * mu))
    lost = (1.0 - left / whole) / share if share else 1.0
    psi = 1.29 - (0.08 - 0.5 * tissue.poisson) / (1.0 - tissue.poisson)
    return Tip(radius, whole, lost, psi)


def plane_modulus(shear: float, bulk: float) -> float:
    """``E / (1 - nu^2)`` of the moduli."""
    return 4.0 * shear * (3.0 * bulk + shear) / (3.0 * bulk + 4.0 * shear)


def history(tip: Tip, dent: Array, time: Weights) -> tuple[float, float]:
    """``loss`` of the law in a time step, and its past, of which it is ``held`` at a place.

    ``dent`` (terms + 1,) is what it remembers: the means over the past of its elastic force, and
    the last, times ``beta ** REMEMBERED``; of tissue at rest (1,) will do.
    """
    share = tip.lost * time.share
    return float(share @ time.new), float(share @ _kept(dent, time))


@njit(cache=True, error_model="numpy", nogil=True)
def held(beta, past):
    """Force (mN) that the past takes off; see ``history``."""
    return past * beta**-REMEMBERED


def dented(dent: Array, time: Weights, law: Iterable[float], force: float) -> Array:
    """What the law (beta, relief, loss, held) remembers after a step that ends with a force."""
    beta, _, loss, held = law
    elastic = (force + held) / (1.0 - loss) * beta**REMEMBERED
    return np.append(_kept(dent, time) + time.new * elastic, elastic)


def _kept(dent: Array, time: Weights) -> Array:
    """Means (terms,) at the end of a step, but for what that adds to them."""
    means = dent[:-1] if len(dent) > 1 else 0.0
    return np.asarray(time.decay * means + time.old * dent[-1])


@njit(cache=True, error_model="numpy", nogil=True)
def squeeze(beta, relief, d):
    """Elastic force (mN), stiffness (mN/mm) and energy (mN mm) of the law at a penetration (mm)."""
    if not d > 0.0:
        return 0.0, 0.0, 0.0
    y = math.sqrt(d / beta)
    top = STEEPEST * 2.0 * beta / (3.0 * relief) if relief > 0.0 else math.inf
    beyond = d - (beta * top * top - relief * top**3) if relief > 0.0 else -1.0
    if beyond > 0.0:
        y = top
    else:
        for _ in range(30):
            step = (beta * y * y - relief * y**3 - d) / (2.0 * beta * y - 3.0 * relief * y * y)
            y = min(y - step, top)
            if abs(step) < 1e-13 * y:
                break
    force, stiffness = y**3, 3.0 * y / (2.0 * beta - 3.0 * relief * y)
    reached = min(d, d - beyond) if beyond > 0.0 else d
    energy = force * reached - force * (0.6 * beta * y * y - 0.5 * relief * force)
    if beyond > 0.0:
        energy += force * beyond + 0.5 * stiffness * beyond**2
        force += stiffness * beyond
    return force, stiffness, energy


def approach(beta: float, relief: float, force: float) -> float:
    """Penetration (mm) at an elastic force (mN): the inverse of ``squeeze``."""
    y = min(force, (STEEPEST * 2.0 * beta / (3.0 * relief)) ** 3) ** (1.0 / 3.0)
    slope = 2.0 * beta / (3.0 * y) - relief if y else 0.0
    return beta * y * y - relief * y**3 + (force - y**3) * slope


@njit(cache=True, error_model="numpy", nogil=True)
def push(beta, relief, loss, held, d):
    """Force, stiffness and energy of the law on tissue with a past; see above."""
    force, stiffness, energy = squeeze(beta, relief, d)
    if loss == 0.0 and held == 0.0:
        return force, stiffness, energy
    kept = 1.0 - loss
    whole = kept * force - held
    if whole <= 0.0:
        return 0.0, 0.0, 0.0
    elastic = held / kept  # where contact begins
    free, y = 0.0, max(elastic, 0.0) ** (1.0 / 3.0)
    if elastic > 0.0:
        free = beta * y * y - relief * elastic
        energy -= elastic * (free - 0.6 * beta * y * y + 0.5 * relief * elastic)
    return whole, kept * stiffness, kept * energy - held * (d - free)


@njit(cache=True, error_model="numpy", nogil=True)
def tangents_of(normal, tangents):
    """Write two unit tangents (2, 3) of a unit normal (3,)."""
    least = 0
    for i in range(1, 3):
        if abs(normal[i]) < abs(normal[least]):
            least = i
    length = math.sqrt(1.0 - normal[least] ** 2)
    for i in range(3):
        tangents[0, i] = ((1.0 if i == least else 0.0) - normal[least] * normal[i]) / length
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        tangents[1, i] = normal[j] * tangents[0, k] - normal[k] * tangents[0, j]


@njit(cache=True, error_model="numpy", nogil=True)
def bend(curvature, tangents, radius, bent):
    """Write the curvature (2, 2) along tangents; return the sharpness of the contact, 1/mm.

    ``curvature`` (6,) is the tensor xx, yy, zz, xy, xz, yz (1/mm), positive where convex.
    """
    for a in range(2):
        for b in range(2):
            total = 0.0
            for i in range(3):
                for j in range(3):
                    c = curvature[i] if i == j else curvature[2 + i + j]
                    total += tangents[a, i] * c * tangents[b, j]
            bent[a, b] = total
    mean = 0.5 * (bent[0, 0] + bent[1, 1])
    half = math.sqrt(max(mean * mean - bent[0, 0] * bent[1, 1] + bent[0, 1] ** 2, 0.0))
    least = FLATTEST / radius
    one, other = max(1.0 / radius + mean + half, least), max(1.0 / radius + mean - half, least)
    return math.sqrt(one * other)


@njit(cache=True, error_model="numpy", nogil=True)
def flatten(curved, most):
    """Lower the eigenvalues of a symmetric matrix (2, 2) to at most so much."""
    mean = 0.5 * (curved[0, 0] + curved[1, 1])
    a, b = 0.5 * (curved[0, 0] - curved[1, 1]), curved[0, 1]
    half = math.sqrt(a * a + b * b)
    one, other = min(mean + half, most), min(mean - half, most)
    share = 0.5 * (one - other) / half if half > 0.0 else 0.0
    mean = 0.5 * (one + other)
    curved[0, 0], curved[1, 1] = mean + share * a, mean - share * a
    curved[0, 1] = curved[1, 0] = share * b


@njit(cache=True, error_model="numpy", nogil=True)
def settle(M, force, stiffness, gap, normal, towards, slopes, curved, inwards, fading, g, H):
    """The energy to second order in place and centre of the tip, with the body in equilibrium.

    The body is in equilibrium with a force along ``normal``; that the tip pushes along ``towards``
    is made good to first order.

    Parameters
    ----------
    M : ndarray, shape (SEEN, SEEN), mm/mN
        Compliance of the body in what the contact sees: means of the displacement, and components
        along the normal of the derivatives of that mean along two tangents of the surface.
    force, stiffness, gap : float
        mN and mN/mm of the law; distance (mm) of the centre from the smoothed surface.
    normal, towards : ndarray, shape (3,)
        Unit vectors; the latter from the smoothed surface to the centre.
    slopes : ndarray, shape (2, 3)
        Of the smoothed surface ``m(X)`` along the two tangents.
    curved : ndarray, shape (2, 2), 1/mm
        Its second derivatives along the normal; in a hollow about as round as the tip, as a dent
        that the tip has left, it is made flatter, or the place would be anywhere.
    inwards : ndarray, shape (2,)
        Change of the distance from the edge along the two tangents.
    fading : ndarray, shape (3,)
        See ``Tip.fading``.
    g, H : ndarray, shape (SEEN,) mN, and (SEEN, SEEN) mN/mm, out
        Derivatives in the place (two) and in the centre (three).
    """
    G, Q, L = np.empty((3, 3)), np.zeros((SEEN, SEEN)), np.zeros((SEEN, SEEN + 1))
    soft, answer = np.eye(SEEN), np.empty((SEEN, SEEN + 1))
    flatten(curved, (1.0 - FLATTEST) / gap)
    for i in range(3):
        for j in range(3):
            along = normal[i] * normal[j]
            G[i, j] = stiffness * along - force / gap * ((1.0 if i == j else 0.0) - along)
    g[:] = 0.0
    H[:] = 0.0
    for a in range(2):
        L[3 + a, a] = force  # what turns the surface
        for i in range(3):
            L[i, a] = slopes[a, 0] * G[0, i] + slopes[a, 1] * G[1, i] + slopes[a, 2] * G[2, i]
            H[a, 2 + i] = H[2 + i, a] = -L[i, a]
            g[a] += force * towards[i] * slopes[a, i]
        for b in range(2):
            H[a, b] = force * curved[a, b]
            for i in range(3):
                H[a, b] += L[i, a] * slopes[b, i]
    fade(normal, slopes, inwards, fading, g, H, L)
    for i in range(3):
        g[2 + i] = -force * towards[i]
        L[i, SEEN] = force * (towards[i] - normal[i])
    Q[:3, :3] = G
    L[:3, 2:SEEN] = -G
    H[2:, 2:] = G
    soft += np.dot(M, Q)
    answer[:] = np.linalg.solve(soft, np.dot(M, L))
    for a in range(SEEN):
        for s in range(SEEN):
            g[a] -= L[s, a] * answer[s, SEEN]
            for b in range(SEEN):
                H[a, b] -= L[s, a] * answer[s, b]


@njit(cache=True, error_model="numpy", nogil=True)
def fade(normal, slopes, inwards, fading, g, H, L):
    """Add what changes as the place moves away from an edge; see ``settle``."""
    for a in range(2):
        g[a] += fading[0] * inwards[a]
        for i in range(3):
            turn = fading[1] * inwards[a] * normal[i]
            L[i, a] += turn
            H[a, 2 + i] -= turn
            H[2 + i, a] -= turn
            for b in range(2):
                H[a, b] += turn * slopes[b, i]
                H[b, a] += turn * slopes[b, i]
        for b in range(2):
            H[a, b] += fading[2] * inwards[a] * inwards[b]


@njit(cache=True, error_model="numpy", nogil=True)
def next_place(g, H, wall, least, moved):
    """Write Newton's step (2,) mm of the place along the two tangents; return its length.

    ``wall`` (2,) points out of the surface where the place lies on its rim, and is zero elsewhere:
    where the energy, largest at the place sought, grows that way or by a step that leads there, a
    step goes along the rim.  It is zeroed where it does not bar; a step out of the surface all the
    same, as where the energy curves upwards, is turned round and made at least ``least`` mm long,
    or the next would lead back.
    """
    a, b, c = H[0, 0], 0.5 * (H[0, 1] + H[1, 0]), H[1, 1]
    det = a * c - b * b
    moved[0] = -(c * g[0] - b * g[1]) / det
    moved[1] = -(a * g[1] - b * g[0]) / det
    rises = g[0] * moved[0] + g[1] * moved[1] > 0.0
    leaves = moved[0] * wall[0] + moved[1] * wall[1] > 0.0
    if g[0] * wall[0] + g[1] * wall[1] > 0.0 or (leaves and rises):
        x, y = -wall[1], wall[0]
        along = -(g[0] * x + g[1] * y) / (a * x * x + 2.0 * b * x * y + c * y * y)
        moved[0], moved[1] = along * x, along * y
    else:
        if leaves:
            moved *= -max(1.0, least / math.sqrt(moved[0] ** 2 + moved[1] ** 2))
        wall[:] = 0.0
    return math.sqrt(moved[0] ** 2 + moved[1] ** 2)


@njit(cache=True, error_model="numpy", nogil=True)
def meet_wall(wanted, moved, wall):
    """Write the ``wall`` (2,) that has kept a place from going as far as wanted, if one has."""
    x, y = wanted[0] - moved[0], wanted[1] - moved[1]
    lost = math.sqrt(x * x + y * y)
    if lost > BARRED * math.sqrt(wanted[0] ** 2 + wanted[1] ** 2) + ROUND_OFF:
        wall[0], wall[1] = x / lost, y / lost


@njit(cache=True, error_model="numpy", nogil=True)
def pushed(g, H, step, share, force):
    """Write the force (3,) mN on the tool after a share of a step (2,) mm; return its size.

    ``force`` on entry is that before.  Where contact just begins a step can end it: the force then
    stays.
    """
    size = same = before = 0.0
    for i in range(3):
        after = -g[2 + i] - H[2 + i, 0] * step[0] - H[2 + i, 1] * step[1]
        after = force[i] + share * (after - force[i])
        same += force[i] * after
        before += force[i] ** 2
    stays = same < LEAST_KEPT * before
    for i in range(3):
        if not stays:
            after = -g[2 + i] - H[2 + i, 0] * step[0] - H[2 + i, 1] * step[1]
            force[i] += share * (after - force[i])
        size += force[i] ** 2
    return math.sqrt(size)


@njit(cache=True, error_model="numpy", nogil=True)
def follow(H, wall, follows, tangent):
    """Write the derivatives in the centre of the place (2, 3) and of the force on the tool (3, 3).

    A place that a ``wall`` bars moves along that; see ``next_place``.
    """
    a, b, c = H[0, 0], 0.5 * (H[0, 1] + H[1, 0]), H[1, 1]
    det, x, y = a * c - b * b, -wall[1], wall[0]
    for j in range(3):
        if x != 0.0 or y != 0.0:
            along = -(x * H[0, 2 + j] + y * H[1, 2 + j])
            along /= a * x * x + 2.0 * b * x * y + c * y * y
            follows[0, j], follows[1, j] = along * x, along * y
        else:
            follows[0, j] = -(c * H[0, 2 + j] - b * H[1, 2 + j]) / det
            follows[1, j] = -(a * H[1, 2 + j] - b * H[0, 2 + j]) / det
        for i in range(3):
            tangent[i, j] = -H[2 + i, 2 + j]
            for p in range(2):
                tangent[i, j] -= H[2 + i, p] * follows[p, j]
