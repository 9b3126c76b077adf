"""What the spaces of neighbouring local models have in common, in the energy of the rest state."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.offline.fem.model import FullModel
from palpate.shared.local_models import LocalModels

Array = NDArray[np.float64]

NEXT, FOLLOWED = 1.6, 2.0
"""Distance of centres, in extents of a patch, up to which one takes over the other's answer, and
its history."""
Field = NDArray[np.float32]


def neighbours(models: LocalModels, reach: float) -> NDArray[np.int32]:
    """Pairs (n, 2) of patches whose centres are at most ``reach`` mm apart, the smaller first."""
    pairs = cKDTree(models.centres).query_pairs(reach, output_type="ndarray")
    pairs = np.sort(pairs, axis=1)[np.lexsort((pairs.max(axis=1), pairs.min(axis=1)))]
    return pairs.astype(np.int32)


def overlaps(
    model: FullModel, models: LocalModels, modes: Field, pairs: NDArray[np.int32]
) -> Field:
    """Products (n, r, r) of the modes (p, M, r) of both patches of each pair.

    In half precision: products of orthonormal modes are at most one.
    """
    found = np.empty((len(pairs), modes.shape[2], modes.shape[2]), np.float16)
    regions = models.region[pairs]
    for number in np.unique(regions[:, 0]):
        stiffened = model.rest_stiffness @ region_basis(model, models, number)
        for other in np.unique(regions[regions[:, 0] == number, 1]):
            cross = stiffened.T @ region_basis(model, models, other)
            for i in np.flatnonzero((regions == (number, other)).all(axis=1)):
                k, n = pairs[i]
                found[i] = modes[k].T @ cross @ modes[n]
    return found.astype(np.float32)


def region_basis(model: FullModel, models: LocalModels, region: int) -> Array:
    """Modes (free dofs, M) mm of a region."""
    rows = models.basis[region][:, model.free] * models.steps[region][:, None]
    return np.ascontiguousarray(rows.T, dtype=float)
