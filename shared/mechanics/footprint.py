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
