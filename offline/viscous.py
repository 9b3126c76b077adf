"""What local models of visco-elastic tissue need beyond elastic ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from offline.full_model import FullModel
from shared.atlas import LocalModels
from shared.history import ViscousModels

Array = NDArray[np.float64]

NEIGHBOURS = 2.0
"""Distance of centres, in extents of a patch, up to which a history follows the tool."""


def viscous_models(
    model: FullModel, models: LocalModels, modes: NDArray[np.float32]
) -> ViscousModels:
    """Deviatoric stiffness of every patch, and the overlap of neighbours' spaces.

    ``modes`` (p, M, r) are those of the patches in the bases of their regions.  Stored in half
    precision: products of orthonormal modes are at most one.
    """
    stiff, soft = model.rest_stiffness, deviatoric_stiffness(model)
    tree = cKDTree(models.centres)
    pairs = tree.query_pairs(NEIGHBOURS * models.extent, output_type="ndarray")
    pairs = np.sort(pairs, axis=1)[np.lexsort((pairs.max(axis=1), pairs.min(axis=1)))]
    count, _, r = modes.shape
    D = np.empty((count, r, r), np.float16)
    overlap = np.empty((len(pairs), r, r), np.float16)
    regions = models.region[pairs]
    for number in range(len(models.basis)):
        basis = _basis(model, models, number)
        spread, stiffened = soft @ basis, stiff @ basis
        gram = basis.T @ spread
        for k in np.flatnonzero(models.region == number):
            D[k] = modes[k].T @ gram @ modes[k]
        for other in np.unique(regions[regions[:, 0] == number, 1]):
            cross = stiffened.T @ _basis(model, models, other)
            for i in np.flatnonzero((regions == (number, other)).all(axis=1)):
                k, n = pairs[i]
                overlap[i] = modes[k].T @ cross @ modes[n]
    return ViscousModels(D.astype(np.float32), pairs.astype(np.int32), overlap.astype(np.float32))


def deviatoric_stiffness(model: FullModel) -> csr_matrix:
    """Part of the rest stiffness (mN/mm) of the free dofs that relaxes: nothing else does."""
    share = sum(g for g, _ in model.prony)
    return (model.rest_stiffness - model.relaxed.rest_stiffness) / share


def deviatoric_of(model: FullModel, models: LocalModels, modes: NDArray[np.floating[Any]]) -> Array:
    """The same (m, m) in some modes (M, m) of the first region."""
    u = _basis(model, models, 0) @ modes
    return np.asarray(u.T @ (deviatoric_stiffness(model) @ u))


def _basis(model: FullModel, models: LocalModels, region: int) -> Array:
    """Modes (free dofs, M) mm of a region."""
    rows = models.basis[region][:, model.free] * models.steps[region][:, None]
    return np.ascontiguousarray(rows.T, dtype=float)
