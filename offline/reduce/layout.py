"""Where local models, their regions and the footprints that they learn from lie on the surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.offline.reduce.ritz import Footprint
from palpate.offline.reduce.sampling import (
    centred_points,
    neighbours,
    random_points,
    spacing_count,
    spread_points,
)
from palpate.offline.run.streams import Stage, stream
from palpate.shared.geometry.surface import Surface
from palpate.shared.scene import Scene, Size

Array = NDArray[np.float64]

RITZ_SPACING = 0.455
"""Of the footprints whose Ritz vectors are taken, in units of the patch spacing."""

RITZ_REACH = 0.8
"""How far from its centre a local model learns from footprints, in units of the patch spacing."""

CONTACTS_PER_PATCH = 400


@dataclass(frozen=True)
class Patch:
    """What a local model is trained from."""

    at: Footprint  # at its centre
    footprints: list[Footprint]  # in and round the patch; it learns from their Ritz vectors
    contacts: Array  # (c, 3) mm, contact points it answers for
    normals: Array  # (c, 3)
    ranges: Array  # (c, LIMIT_FIELDS), load range there
    extent: float  # mm
    size: Size
    seed: int


@dataclass(frozen=True)
class Layout:
    """Local models of a size spread over the surface."""

    scene: Scene
    surface: Surface
    limits: Array  # (v, LIMIT_FIELDS), load range at the vertices
    size: Size
    centres: Array  # (p, 3) mm
    region: NDArray[np.int32]  # (p,)
    footprints: list[Footprint]
    learns_from: list[NDArray[np.int64]]  # footprints of each local model, ascending
    contacts: Array  # (c, 3) mm
    answers: list[NDArray[np.int64]]  # contacts of each local model
    extent: float  # mm

    @classmethod
    def of(cls, scene: Scene, surface: Surface, limits: Array, size: Size) -> Layout:
        """Lay out a scene."""
        rng, blend = stream(scene.seed, Stage.LAYOUT), scene.training.blend
        centres = centred_points(surface, spacing_count(surface, size.patch_spacing), rng)
        count = spacing_count(surface, scene.training.region_spacing)
        region = cKDTree(centred_points(surface, count, rng)).query(centres)[1]
        count = spacing_count(surface, RITZ_SPACING * size.patch_spacing)
        ritz = spread_points(surface, count, rng)
        contacts = np.vstack(
            [surface.vertices, random_points(surface, CONTACTS_PER_PATCH * len(centres), rng)]
        )
        near, _ = cKDTree(centres).query(contacts)
        reached = neighbours(contacts, centres, near.max() + blend)
        return cls(
            scene, surface, limits, size,
            centres=centres,
            region=np.unique(region, return_inverse=True)[1].astype(np.int32),
            footprints=[Footprint.of(surface, x, limits) for x in ritz],
            learns_from=neighbours(ritz, centres, RITZ_REACH * size.patch_spacing),
            contacts=contacts,
            answers=[
                hits[np.linalg.norm(contacts[hits] - x, axis=1) < near[hits] + blend]
                for x, hits in zip(centres, reached, strict=True)
            ],
            extent=1.02 * near.max() + blend,
        )  # fmt: skip

    def patch(self, k: int) -> Patch:
        """What local model k is trained from."""
        contacts = self.contacts[self.answers[k]]
        _, normals, _, ranges = zip(
            *(self.surface.locate(x, self.limits) for x in contacts), strict=True
        )
        return Patch(
            at=Footprint.of(self.surface, self.centres[k], self.limits),
            footprints=[self.footprints[i] for i in self.learns_from[k]],
            contacts=contacts,
            normals=np.array(normals),
            ranges=np.array(ranges),
            extent=self.extent,
            size=self.size,
            seed=self.scene.seed + k,
        )

    def footprints_of(self, region: int) -> NDArray[np.int64]:
        """Indices of the footprints that the local models of a region learn from, ascending."""
        own = np.flatnonzero(self.region == region)
        return np.unique(np.concatenate([self.learns_from[k] for k in own]))
