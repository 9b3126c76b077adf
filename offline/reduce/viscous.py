"""What local models of visco-elastic tissue need beyond elastic ones."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from palpate.offline.fem.model import FullModel
from palpate.offline.reduce.transfer import FOLLOWED, neighbours, overlaps, region_basis
from palpate.shared.local_models import LocalModels, ViscousModels

Array = NDArray[np.float64]


def with_time(model: FullModel, models: LocalModels) -> LocalModels:
    """The local models with what they need to remember, if the tissue does."""
    if not model.prony:
        return models
    pairs = neighbours(models, FOLLOWED * models.extent)
    soft = deviatoric_of_all(model, models, models.modes)
    viscous = ViscousModels(soft, pairs, overlaps(model, models, models.modes, pairs))
    if models.tips is None:
        return replace(models, viscous=viscous)
    tips = models.tips
    tips = replace(tips, deviatoric=deviatoric_of_all(model, models, tips.modes))
    return replace(models, viscous=viscous, tips=tips)


def deviatoric_of_all(
    model: FullModel, models: LocalModels, modes: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Deviatoric stiffness (p, r, r) of every patch in its modes (p, M, r), those of its region."""
    soft = deviatoric_stiffness(model)
    count, _, r = modes.shape
    D = np.empty((count, r, r), np.float32)
    for number in range(len(models.basis)):
        basis = region_basis(model, models, number)
        gram = basis.T @ (soft @ basis)
        for k in np.flatnonzero(models.region == number):
            D[k] = modes[k].T @ gram @ modes[k]
    return D


def deviatoric_stiffness(model: FullModel) -> csr_matrix:
    """Part of the rest stiffness (mN/mm) of the free dofs that relaxes: nothing else does."""
    share = sum(g for g, _ in model.prony)
    return (model.rest_stiffness - model.relaxed.rest_stiffness) / share


def deviatoric_of(model: FullModel, models: LocalModels, modes: NDArray[np.floating[Any]]) -> Array:
    """The same (m, m) in some modes (M, m) of the first region."""
    u = region_basis(model, models, 0) @ modes
    return np.asarray(u.T @ (deviatoric_stiffness(model) @ u))
