"""How the endoscope loads the tissue: a pressure over a smooth circular footprint.

The tip at surface point ``x`` with outward normal ``n`` exerts the dead traction

    t(X) dA = p (1 - rho^4)^2 max(N(X) . n, 0) d dA,     rho = |X - x| / R <= 1,

with pressure ``p`` (kPa, at the footprint's centre), unit direction ``d`` and footprint radius
``R``. The cosine turns surface into projected area, so the force on a curved or cut-off surface
stays that of the flat disc the tip really covers; it is zero on surfaces that face away.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from palpate.shared.arrays import Array, Numbers
from palpate.shared.compiled import methods


@methods()
class SurfaceQuadrature(NamedTuple):
    """Integration points of a surface, fine enough that the load is smooth in the contact point."""

    points: Array  # (g, 3) mm
    normals: Array  # (g, 3) outward unit normals
    areas: Array  # (g,) mm^2
    nodes: Numbers  # (g, k) rows of the nodal vector that a point feeds
    shape: Array  # (g, k) shape functions

    def between(self, a, b):
        """Points a to b."""
        return SurfaceQuadrature(
            self.points[a:b], self.normals[a:b], self.areas[a:b], self.nodes[a:b], self.shape[a:b]
        )


@njit(cache=True, error_model="numpy", nogil=True)
def footprint(surface, x, normal, radius, nodal):
    """Nodal weights (mm^2) of a unit pressure at ``x``: the load vector is ``p * nodal * d``.

    Parameters
    ----------
    surface : SurfaceQuadrature
    x, normal : ndarray, shape (3,)
        Contact point (mm) and outward unit normal there.
    radius : float, mm
    nodal : ndarray, shape (n,), out
        Overwritten.

    Returns
    -------
    area : float, mm^2
        Sum of ``nodal``: force per pressure.
    """
    nodal[:] = 0.0
    area = 0.0
    inverse = 1.0 / (radius * radius)
    for g in range(len(surface.areas)):
        rho2 = facing = 0.0
        for i in range(3):
            rho2 += (surface.points[g, i] - x[i]) ** 2 * inverse
        if rho2 < 1.0:
            for i in range(3):
                facing += surface.normals[g, i] * normal[i]
            if facing > 0.0:
                profile = 1.0 - rho2 * rho2
                weight = surface.areas[g] * facing * profile * profile
                area += weight
                for k in range(surface.nodes.shape[1]):
                    nodal[surface.nodes[g, k]] += weight * surface.shape[g, k]
    return area


MEANS = 6
"""Weights of nodes that ``means`` writes: of the mean, and of its derivatives 1, 2, 11, 12, 22."""


@njit(cache=True, error_model="numpy", nogil=True)
def means(surface, x, normal, tangents, bent, radius, nodal):
    """Nodal weights of the mean of a field under a footprint, and of its change with the place.

    Parameters
    ----------
    surface, x, normal, radius
        As of ``footprint``.
    tangents : ndarray, shape (2, 3)
        Unit vectors along which the footprint is moved.
    bent : ndarray, shape (2, 2), 1/mm
        Curvature along them, by which the footprint turns.
    nodal : ndarray, shape (MEANS, n), out
        The mean is ``sum nodal[0] field``; the others are 1/mm and 1/mm^2.

    Returns
    -------
    area : float, mm^2
        Force per pressure.
    """
    nodal[:] = 0.0
    inverse, total = 1.0 / (radius * radius), np.zeros(MEANS)
    weights = np.empty(MEANS)
    for g in range(len(surface.areas)):
        s = facing = 0.0
        for i in range(3):
            s += (surface.points[g, i] - x[i]) ** 2 * inverse
        if s < 1.0:
            for i in range(3):
                facing += surface.normals[g, i] * normal[i]
            if facing > 0.0:
                # derivatives of s and of what faces the footprint, which turns as it moves
                a = b = height = one = two = 0.0
                for i in range(3):
                    away = surface.points[g, i] - x[i]
                    a -= 2.0 * inverse * away * tangents[0, i]
                    b -= 2.0 * inverse * away * tangents[1, i]
                    height += away * normal[i]
                    one += surface.normals[g, i] * tangents[0, i]
                    two += surface.normals[g, i] * tangents[1, i]
                one, two = bent[0, 0] * one + bent[0, 1] * two, bent[1, 0] * one + bent[1, 1] * two
                area, rest = surface.areas[g], 1.0 - s * s
                profile, first, second = rest * rest, -4.0 * s * rest, 12.0 * s * s - 4.0
                second, plane = second * facing, 2.0 * inverse * first * facing
                weights[0] = area * profile * facing
                weights[1] = area * (first * facing * a + profile * one)
                weights[2] = area * (first * facing * b + profile * two)
                weights[3] = area * (second * a * a + 2.0 * first * a * one)
                weights[3] += area * plane * (1.0 + bent[0, 0] * height)
                weights[4] = area * (second * a * b + first * (a * two + b * one))
                weights[4] += area * plane * bent[0, 1] * height
                weights[5] = area * (second * b * b + 2.0 * first * b * two)
                weights[5] += area * plane * (1.0 + bent[1, 1] * height)
                for m in range(MEANS):
                    total[m] += weights[m]
                    for k in range(surface.nodes.shape[1]):
                        nodal[m, surface.nodes[g, k]] += weights[m] * surface.shape[g, k]
    area = total[0]
    total /= max(area, 1e-12)
    _, a, b, aa, ab, bb = total
    for n in range(nodal.shape[1]):
        if nodal[0, n] != 0.0:
            for m in range(MEANS):
                nodal[m, n] /= area
            # derivatives of a quotient
            mean = nodal[0, n]
            nodal[1, n] -= a * mean
            nodal[2, n] -= b * mean
            one, two = nodal[1, n], nodal[2, n]
            nodal[3, n] -= aa * mean + 2.0 * a * one
            nodal[4, n] -= ab * mean + a * two + b * one
            nodal[5, n] -= bb * mean + 2.0 * b * two
    return area


LIMIT_FIELDS = 8
"""Values that describe the load range at a surface point: see ``pressure_limit``."""

TIP_DEPTH = 7
"""Which of them is the largest trained depth of the rigid tip, mm."""


@njit(cache=True, error_model="numpy")
def pressure_limit(fields, normal, direction):
    """Largest trained pressure (kPa) at a surface point, for a load along ``direction``.

    ``fields`` (8,) holds the limit along the inward normal and the compliance of the contact
    (xx, yy, zz, xy, xz, yz: mm/kPa), the mean displacement under the footprint per pressure at
    rest; the last value is the tip's.  A direction in which the tissue is more compliant than along
    the normal has a limit lower in proportion, so that the tissue moves about as far.
    """
    along = across = 0.0
    for i in range(3):
        n = d = 0.0
        for j in range(3):
            # 3, 4, 5 are xy, xz, yz
            c = fields[1 + i] if i == j else fields[3 + i + j]
            n += c * normal[j]
            d += c * direction[j]
        along += n * n
        across += d * d
    return fields[0] * min(1.0, np.sqrt(along / across))
