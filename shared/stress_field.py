"""Von Mises stress of a body at its nodes, its largest value and its 99th percentile."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from palpate.shared.arrays import Array, Flags
from palpate.shared.geometry.elements import POINTS, kind_of
from palpate.shared.geometry.quadrature import stress_recovery, volume_quadrature
from palpate.shared.local_models import Body
from palpate.shared.mechanics.stress import NearField, nodal_von_mises, point_von_mises, remember
from palpate.shared.near_field import Contact, NearFields

HIGHEST = 0.01
"""Share of the volume with stress above the 99th percentile."""

Displacement = NDArray[np.floating]
Peaks = tuple[float, float]


class StressField:
    """Recovers stress from displacements (n, 3) mm; not to be shared between threads.

    ``B`` (e, 6, q) is the past at the points of all elements, see ``mechanics.viscosity``; a
    contact is what presses, and has a near field; that of a tip is in ``u`` by ``add_dent``.
    """

    def __init__(self, body: Body, precision: type = np.float64) -> None:
        self._body = body
        self._recovery = stress_recovery(
            body.nodes, body.elements, body.law, body.region, precision
        )
        self._near = NearFields(body)

    def dent(self, points: Array, contact: Contact | None) -> NearField:
        """What the mesh does not follow of a tip at points (n, 3) mm."""
        return self._near.dent(points, contact)

    def add_dent(self, u: Displacement, contact: Contact | None) -> None:
        """Add to displacements of the mesh what it does not follow of a tip."""
        near = self.dent(self._body.nodes, contact)
        u[near.points] += near.displacement

    def von_mises(self, u: Displacement, B: Array | None, contact: Contact | None) -> Array:
        """Nodal stress (n,) kPa."""
        out, near = np.empty(len(self._body.nodes)), self._near.at(self._body.nodes, contact)
        nodal_von_mises(self._recovery, u, B, near, out)
        return out

    def peaks(self, u: Displacement, B: Array | None, contact: Contact | None) -> Peaks:
        """Those of the tissue that is in no region; see ``peaks_by_region``."""
        return self.peaks_by_region(u, B, contact)[0]

    def peaks_by_region(
        self, u: Displacement, B: Array | None, contact: Contact | None
    ) -> list[Peaks]:
        """Largest stress and 99th percentile by volume (kPa), outside the clamped layer.

        First of the elements that are in no region, then of each region; of all of them where all
        are in the layer.  Both are of the integration points: under a contact there are more of
        them than of nodes, and stress at the nodes is carried there.
        """
        points, volumes, counted = self._points
        near, exact = (self._near.at(at, contact) for at in (self._body.nodes, points))
        stress = np.empty(len(points))
        point_von_mises(self._recovery, u, B, near, exact, stress)
        region = np.repeat(self._body.region, len(points) // len(volumes))
        owns = (region == number for number in range(region.max() + 1))
        flat = volumes.reshape(-1)
        counts = (own & counted if (own & counted).any() else own for own in owns)
        return [_peaks(stress[own], flat[own]) for own in counts]

    def remember(self, u: Displacement, share: float | None, B: Array) -> None:
        """See ``stress.remember``."""
        remember(self._recovery, u, share, B)

    @cached_property
    def _points(self) -> tuple[Array, Array, Flags]:
        """Integration points (q e, 3) mm, their volumes (e, q) mm^3, and which count."""
        body = self._body
        kind = kind_of(body.elements)
        N, _ = kind.shape(kind.rule(POINTS)[0])
        points = np.ascontiguousarray((N @ body.nodes[body.elements]).reshape(-1, 3))
        counts = body.beyond_clamped_layer(points)
        _, volumes = volume_quadrature(body.nodes, body.elements, POINTS)
        return points, volumes, counts


def _peaks(stress: Array, volumes: Array) -> Peaks:
    order = np.argsort(-stress)
    above = np.searchsorted(np.cumsum(volumes[order]), HIGHEST * volumes.sum())
    return float(stress[order[0]]), float(stress[order[above]])
