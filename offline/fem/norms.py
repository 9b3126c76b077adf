"""Relative errors and what is said of many."""

from collections.abc import Sequence

import numpy as np

from palpate.shared.arrays import Array


def relative(approximation: Array, reference: Array) -> float:
    """Relative L2 error; 0 where there is nothing to approximate."""
    scale = np.linalg.norm(reference)
    return float(np.linalg.norm(approximation - reference) / scale) if scale else 0.0


def statistics(errors: Sequence[float] | Array) -> dict[str, float]:
    """Mean, 95th percentile and maximum."""
    return {
        "mean": float(np.mean(errors)),
        "p95": float(np.percentile(errors, 95)),
        "max": float(np.max(errors)),
    }
