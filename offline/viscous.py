"""What local models of visco-elastic tissue need beyond elastic ones."""

from __future__ import annotations

import numpy as np

from offline.full_model import FullModel
from offline.overlaps import neighbours, overlaps, region_basis
from shared.atlas import LocalModels
from shared.history import ViscousModels

NEIGHBOURS = 2.0
"""Distance of centres, in extents of a patch, up to which a history follows the tool."""


def viscous_models(model: FullModel, models: LocalModels) -> ViscousModels:
    """Deviatoric stiffness of every patch, and the overlap of neighbours' wide spaces."""
    share = sum(g for g, _ in model.prony)
    # nothing but the deviatoric part relaxes
    deviatoric = (model.rest_stiffness - model.relaxed.rest_stiffness) / share
    pairs = neighbours(models, NEIGHBOURS * models.extent)
    count, _, r = models.modes.shape
    D = np.empty((count, r, r), np.float32)
    for number in range(len(models.basis)):
        basis = region_basis(model, models, number)
        gram = basis.T @ (deviatoric @ basis)
        for k in np.flatnonzero(models.region == number):
            D[k] = models.modes[k].T @ gram @ models.modes[k]
    return ViscousModels(D, pairs, overlaps(model, models, models.modes, pairs))
