"""What local models, on their patches of the surface, are trained from, and what comes of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.offline.reduce.ritz import Footprint
from palpate.shared.local_models import LocalModels
from palpate.shared.reduced.features import (
    CHANGES,
    CHANGING,
    LOAD_FEATURES,
    RESIDUAL_FEATURES,
    TANGENT_FEATURES,
)
from palpate.shared.scene import Size

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RegionResult:
    """Basis of a region, (M, 3 n) int16 in steps (M,), and what patches learn from.

    ``orthonormal`` (M, M) holds, as columns in the basis, modes orthonormal in the energy of the
    rest state; ``ritz`` (k, M, 19 or more) are Ritz vectors in those, of the relaxed tissue last.
    """

    basis: NDArray[np.int16]
    steps: NDArray[np.float32]
    orthonormal: NDArray[np.float32]
    ritz: NDArray[np.float32]

    def truncate(self, modes: int) -> RegionResult:
        """The leading modes; ``orthonormal`` is triangular, so its leading block stays right."""
        return RegionResult(
            self.basis[:modes],
            self.steps[:modes],
            self.orthonormal[:modes, :modes],
            self.ritz[:, :modes],
        )


@dataclass(frozen=True)
class PatchTask:
    """What a patch is trained from.

    Attributes
    ----------
    centre, normal : ndarray, shape (3,)
    pressure : float, kPa
        Scale of the load.
    footprints : list of Footprint
        In and round the patch; it learns from their Ritz vectors.
    contacts, normals : ndarray, shape (c, 3)
        Contact points the patch answers for.
    ranges : ndarray, shape (c, LIMIT_FIELDS)
        Load range there.
    extent, blend : float, mm
    size : Size
    seed : int
    """

    centre: Array
    normal: Array
    pressure: float
    footprints: list[Footprint]
    contacts: Array
    normals: Array
    ranges: Array
    extent: float
    blend: float
    size: Size
    seed: int


@dataclass(frozen=True)
class TipResult:
    """A trained local model of the tip; shapes as in ``reduced.touch.LocalTips``."""

    modes: NDArray[np.float32]
    points: NDArray[np.int32]
    weights: Array
    guess: NDArray[np.float16]
    residual: Array


@dataclass(frozen=True)
class PatchResult:
    """A trained patch; shapes as in ``shared.local_models.LocalModels``."""

    frame: Array
    whole: NDArray[np.int16]
    mix: NDArray[np.float32]
    points: NDArray[np.int32]
    weights: Array
    defect: NDArray[np.float16]
    guess: NDArray[np.float16]
    directions: NDArray[np.float16]
    change: NDArray[np.float16]
    residual: Array
    tip: TipResult | None = None

    @classmethod
    def untrained(
        cls,
        frame: Array,
        whole: NDArray[np.int16],
        mix: NDArray[np.float32],
        points: NDArray[np.int32],
        weights: Array,
    ) -> PatchResult:
        """A patch that knows its modes and points alone."""
        modes = whole.shape[1]
        return cls(
            frame,
            whole,
            mix,
            points,
            weights,
            defect=np.zeros((LOAD_FEATURES, modes), np.float16),
            guess=np.zeros((LOAD_FEATURES, modes), np.float16),
            directions=np.zeros((CHANGING, modes), np.float16),
            change=np.zeros((TANGENT_FEATURES, CHANGES), np.float16),
            residual=np.zeros(RESIDUAL_FEATURES),
        )


def local_models(
    bases: Sequence[RegionResult],
    region: NDArray[np.int32],
    centres: Array,
    pressures: Array,
    results: Sequence[PatchResult],
    extent: float,
    blend: float,
) -> LocalModels:
    """Trained patches, for footprints, in the tables of ``shared.local_models.LocalModels``."""
    return LocalModels(
        basis=np.stack([basis.basis for basis in bases]),
        steps=np.stack([basis.steps for basis in bases]),
        region=region,
        centres=centres,
        frames=np.stack([r.frame for r in results]),
        pressures=pressures,
        whole=np.stack([r.whole for r in results]),
        mix=np.stack([r.mix for r in results]),
        point_from=np.concatenate([[0], np.cumsum([len(r.points) for r in results])]),
        points=np.concatenate([r.points for r in results]),
        weights=np.concatenate([r.weights for r in results]),
        defect=np.stack([r.defect for r in results]).astype(np.float32),
        guess=np.stack([r.guess for r in results]).astype(np.float32),
        directions=np.stack([r.directions for r in results]).astype(np.float32),
        change=np.stack([r.change for r in results]).astype(np.float32),
        residuals=np.stack([r.residual for r in results]),
        extent=extent,
        blend=blend,
        tips=None,
    )
