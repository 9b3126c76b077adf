"""What local models of visco-elastic tissue need beyond elastic ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from palpate.offline.fem.model import FullModel
from palpate.offline.reduce.transfer import neighbours, overlaps, region_basis
from palpate.shared.model import LocalModels
from palpate.shared.reduced.history import ViscousModels

Array = NDArray[np.float64]

NEIGHBOURS = 2.0
"""Distance of centres, in extents of a patch, up to which a history follows the tool."""


def viscous_models(
    model: FullModel, models: LocalModels, modes: NDArray[np.float32]
) -> ViscousModels:
    """Deviatoric stiffness of every patch, and the overlap of neighbours' spaces.

    ``modes`` (p, M, r) are those of the patches in the bases of their regions.
    """
    soft = deviatoric_stiffness(model)
    pairs = neighbours(models, NEIGHBOURS * models.extent)
    count, _, r = modes.shape
    D = np.empty((count, r, r), np.float32)
    for number in range(len(models.basis)):
        basis = region_basis(model, models, number)
        gram = basis.T @ (soft @ basis)
        for k in np.flatnonzero(models.region == number):
            D[k] = modes[k].T @ gram @ modes[k]
    return ViscousModels(D, pairs, overlaps(model, models, modes, pairs))


def deviatoric_stiffness(model: FullModel) -> csr_matrix:
    """Part of the rest stiffness (mN/mm) of the free dofs that relaxes: nothing else does."""
    share = sum(g for g, _ in model.prony)
    return (model.rest_stiffness - model.relaxed.rest_stiffness) / share


def deviatoric_of(model: FullModel, models: LocalModels, modes: NDArray[np.floating[Any]]) -> Array:
    """The same (m, m) in some modes (M, m) of the first region."""
    u = region_basis(model, models, 0) @ modes
    return np.asarray(u.T @ (deviatoric_stiffness(model) @ u))
