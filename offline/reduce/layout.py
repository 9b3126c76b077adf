"""Where local models, their regions and the footprints that they learn from lie on the surface."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from palpate.offline.reduce.ritz import Footprint
from palpate.offline.reduce.sampling import random_points, spacing_count, spread_points
from palpate.offline.run.streams import Stage, stream
from palpate.shared.arrays import Array, Ints
from palpate.shared.geometry.surface import Surface
from palpate.shared.scene import Scene, Size

PATCHES = "training.size.patch_spacing"
"""Key of the spacing of local models."""

RITZ_SPACING = 0.455
"""Of the footprints whose Ritz vectors are taken, in units of the patch spacing."""

CONTACTS_PER_PATCH = 400

LLOYD_SAMPLE, LLOYD_STEPS = 100, 40


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


class Layout:
    """Local models of a size all over a surface with a load range (v, LIMIT_FIELDS) at vertices."""

    def __init__(self, scene: Scene, surface: Surface, limits: Array, size: Size) -> None:
        rng, blend = stream(scene.seed, Stage.LAYOUT), scene.training.blend
        self._scene, self._surface, self._limits, self.size = scene, surface, limits, size
        count = spacing_count(surface, size.patch_spacing, PATCHES)
        self.centres = centred_points(surface, count, rng)  # (p, 3) mm
        count = spacing_count(surface, scene.training.region_spacing, "training.region_spacing")
        region = cKDTree(centred_points(surface, count, rng)).query(self.centres)[1]
        region = np.unique(region, return_inverse=True)[1].astype(np.int32)
        order = np.argsort(region, kind="stable")
        self.centres, self.region = self.centres[order], region[order]  # (p,), ascending
        count = spacing_count(surface, RITZ_SPACING * size.patch_spacing, PATCHES)
        ritz = spread_points(surface, count, rng)
        self.footprints = [Footprint.of(surface, x, limits) for x in ritz]
        count = CONTACTS_PER_PATCH * len(self.centres)
        contacts = np.vstack([surface.vertices, random_points(surface, count, rng)])
        near, _ = cKDTree(self.centres).query(contacts)
        self._extent = 1.02 * near.max() + blend
        reached = cKDTree(contacts).query_ball_point(
            self.centres, near.max() + blend, return_sorted=True
        )
        # contacts (c, 3) mm of each local model
        self._contacts = [
            contacts[hits][np.linalg.norm(contacts[hits] - x, axis=1) < near[hits] + blend]
            for x, hits in zip(self.centres, reached, strict=True)
        ]
        # the footprints nearest to these, ascending
        nearest = cKDTree(ritz)
        self.learns_from = [np.unique(nearest.query(own)[1]) for own in self._contacts]

    def patch(self, k: int) -> Patch:
        """What local model k is trained from."""
        contacts = self._contacts[k]
        located = [self._surface.locate(x, self._limits) for x in contacts]
        _, normals, _, ranges = zip(*located, strict=True)
        return Patch(
            at=Footprint.of(self._surface, self.centres[k], self._limits),
            footprints=[self.footprints[i] for i in self.learns_from[k]],
            contacts=contacts,
            normals=np.array(normals),
            ranges=np.array(ranges),
            extent=self._extent,
            size=self.size,
            seed=self._scene.seed + k,
        )

    def footprints_of(self, region: int) -> Ints:
        """Indices of the footprints that the local models of a region learn from, ascending."""
        own = np.flatnonzero(self.region == region)
        return np.unique(np.concatenate([self.learns_from[k] for k in own]))


def centred_points(surface: Surface, count: int, rng: np.random.Generator) -> Array:
    """Points (count, 3) mm by Lloyd's relaxation of evenly spread ones: none is left on the rim."""
    points = spread_points(surface, count, rng)
    sample = random_points(surface, LLOYD_SAMPLE * count, rng)
    for _ in range(LLOYD_STEPS):
        _, nearest = cKDTree(points).query(sample)
        members = np.bincount(nearest, minlength=count)
        sums = np.stack([np.bincount(nearest, x, minlength=count) for x in sample.T], axis=1)
        points = np.where(members[:, None] > 0, sums / np.maximum(members, 1)[:, None], points)
        points = np.array([surface.project(x)[0] for x in points])
    return points


def centred_points_and_rim(
    surface: Surface, count: int, rim: int, rng: np.random.Generator
) -> Array:
    """As ``centred_points``, but one in ``rim``, the first among them, is on the rim."""
    points = centred_points(surface, count, rng)
    points[::rim] = surface.vertices[rng.choice(surface.rim(), len(points[::rim]))]
    return points
