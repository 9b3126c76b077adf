"""Where local models, their regions and the footprints that they learn from lie on the surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

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
class Layout:
    """Where patches, regions and Ritz vectors lie.

    Attributes
    ----------
    centres, normals : ndarray, shape (p, 3)
    region : ndarray, shape (p,), int
    ritz : ndarray, shape (r, 3), mm
    ritz_of_patch : list of ndarray
        Indices of the footprints a patch learns from.
    contacts : ndarray, shape (c, 3), mm
    contacts_of_patch : list of ndarray
    extent : float, mm
    size : Size
    """

    centres: Array
    normals: Array
    region: NDArray[np.int32]
    ritz: Array
    ritz_of_patch: list[NDArray[np.int64]]
    contacts: Array
    contacts_of_patch: list[NDArray[np.int64]]
    extent: float
    size: Size

    @classmethod
    def of(cls, scene: Scene, surface: Surface, size: Size) -> Layout:
        """Spread local models of a size over the surface."""
        rng, blend = stream(scene.seed, Stage.LAYOUT), scene.training.blend
        centres = centred_points(surface, spacing_count(surface, size.patch_spacing), rng)
        normals = np.array([surface.project(x)[1] for x in centres])
        count = spacing_count(surface, scene.training.region_spacing)
        region = cKDTree(centred_points(surface, count, rng)).query(centres)[1]
        count = spacing_count(surface, RITZ_SPACING * size.patch_spacing)
        ritz = spread_points(surface, count, rng)
        contacts = np.vstack(
            [surface.vertices, random_points(surface, CONTACTS_PER_PATCH * len(centres), rng)]
        )
        near, _ = cKDTree(centres).query(contacts)
        contacts_of_patch = [
            hits[np.linalg.norm(contacts[hits] - centres[k], axis=1) < near[hits] + blend]
            for k, hits in enumerate(neighbours(contacts, centres, near.max() + blend))
        ]
        return cls(
            centres=centres,
            normals=normals,
            region=np.unique(region, return_inverse=True)[1].astype(np.int32),
            ritz=ritz,
            ritz_of_patch=neighbours(ritz, centres, RITZ_REACH * size.patch_spacing),
            contacts=contacts,
            contacts_of_patch=contacts_of_patch,
            extent=1.02 * near.max() + blend,
            size=size,
        )
