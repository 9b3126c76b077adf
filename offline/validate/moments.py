"""Moments of histories whose errors are known, and the error estimate fitted to them.

What is estimated at a moment is the largest error since rest over the largest norm since rest,
which does not vanish where an error changes its sign.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.offline.validate.loads import calibrate, coverage
from palpate.offline.validate.tip import OTHER_EQUILIBRIUM
from palpate.shared.answer import Answer
from palpate.shared.local_models import Estimator

Array = NDArray[np.float64]

COVERAGE, DAMPING = 0.97, 30.0
"""Of the error estimate: moments of one history err alike, so that few errors are known."""

Fields = Sequence[tuple[NDArray[Any], NDArray[Any]]]
"""Reduced and full (t, ...) of each quantity."""


@dataclass
class KnownMoment:
    """A history until one of its moments, answered by both models.

    Attributes
    ----------
    displacement, von_mises, force : float
        Largest errors until then over all nodes, over all nodes outside the clamped layer, and of
        the force, relative to the largest norms until then.  A load's force is given.
    converged : bool
    features : ndarray
    estimated_displacement, estimated_von_mises, estimated_force : float
    """

    displacement: float
    von_mises: float
    force: float
    converged: bool
    features: Array
    estimated_displacement: float
    estimated_von_mises: float
    estimated_force: float

    @property
    def typical(self) -> bool:
        """Whether it counts for the error estimate: both models rest in the same equilibrium."""
        return self.converged and self.displacement <= OTHER_EQUILIBRIUM

    def estimate(self, estimator: Estimator) -> None:
        """Fill in the estimated errors."""
        self.estimated_displacement, self.estimated_von_mises, *force = estimator(self.features)
        self.estimated_force = force[0] if force else 0.0


def errors_so_far(fields: Fields) -> Array:
    """Largest errors (quantities, t) until each moment, over the largest norms until then."""
    return np.array([_largest_so_far(a, b) for a, b in fields])


def _largest_so_far(a: NDArray[Any], b: NDArray[Any]) -> Array:
    away, size = (
        np.maximum.accumulate(np.linalg.norm(x.reshape(len(x), -1), axis=1)) for x in (a - b, b)
    )
    return np.asarray(away / np.maximum(size, 1e-9 * max(float(size[-1]), 1e-300)))


def known_moments(errors: Array, answers: Sequence[Answer]) -> list[KnownMoment]:
    """Answers whose errors (quantities, t) are known."""
    return [
        KnownMoment(
            displacement=own[0],
            von_mises=own[1],
            force=own[2] if len(own) > 2 else 0.0,
            converged=answer.converged,
            features=answer.features,
            estimated_displacement=answer.error_displacement,
            estimated_von_mises=answer.error_von_mises,
            estimated_force=answer.error_force,
        )
        for own, answer in zip(errors.T.tolist(), answers, strict=True)
    ]


def calibrate_moments(rows: Sequence[Any], quantities: Sequence[str]) -> Estimator:
    """Fit the error estimate of histories to the known moments of rows."""
    moments = [moment for row in rows for moment in row.moments]
    return calibrate(moments, quantities, COVERAGE, DAMPING)


def covered_moments(rows: Sequence[Any], quantities: Sequence[str]) -> dict[str, Any]:
    """Share of all converged moments that are within their estimates; see ``coverage``."""
    moments = [moment for row in rows for moment in row.moments if moment.converged]
    covered, ratios = coverage(moments, quantities)
    return {"covered": covered, "estimate_over_error_median": ratios}
