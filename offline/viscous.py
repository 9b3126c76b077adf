"""What local models of visco-elastic tissue need beyond elastic ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from offline.full_model import FullModel
from shared.atlas import LocalModels
from shared.history import ViscousModels

Array = NDArray[np.float64]

NEIGHBOURS = 2.0
"""Distance of centres, in extents of a patch, up to which a history follows the tool."""


def viscous_models(model: FullModel, models: LocalModels) -> ViscousModels:
    """Deviatoric stiffness of every patch, and the overlap of neighbours' wide spaces.

    The overlap is stored in half precision: products of orthonormal modes are at most one.
    """
    share = sum(g for g, _ in model.prony)
    stiff = model.rest_stiffness
    # nothing but the deviatoric part relaxes
    deviatoric = (stiff - model.relaxed.rest_stiffness) / share
    tree = cKDTree(models.centres)
    pairs = tree.query_pairs(NEIGHBOURS * models.extent, output_type="ndarray")
    pairs = np.sort(pairs, axis=1)[np.lexsort((pairs.max(axis=1), pairs.min(axis=1)))]
    count, _, r = models.modes.shape
    D = np.empty((count, r, r), np.float32)
    overlap = np.empty((len(pairs), r, r), np.float16)
    regions = models.region[pairs]
    for number in range(len(models.basis)):
        basis = _basis(model, models, number)
        spread, stiffened = deviatoric @ basis, stiff @ basis
        gram = basis.T @ spread
        for k in np.flatnonzero(models.region == number):
            D[k] = models.modes[k].T @ gram @ models.modes[k]
        for other in np.unique(regions[regions[:, 0] == number, 1]):
            cross = stiffened.T @ _basis(model, models, other)
            for i in np.flatnonzero((regions == (number, other)).all(axis=1)):
                k, n = pairs[i]
                overlap[i] = models.modes[k].T @ cross @ models.modes[n]
    return ViscousModels(D, pairs.astype(np.int32), overlap.astype(np.float32))


def _basis(model: FullModel, models: LocalModels, region: int) -> Array:
    """Modes (free dofs, M) mm of a region."""
    rows = models.basis[region][:, model.free] * models.steps[region][:, None]
    return np.ascontiguousarray(rows.T, dtype=float)
