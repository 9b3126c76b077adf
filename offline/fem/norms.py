"""Relative errors and what is said of many."""

from collections.abc import Sequence

import numpy as np

from palpate.shared.arrays import Array


def relative(approximation: Array, reference: Array, volumes: Array | None = None) -> float:
    """Relative L2 error; 0 where there is nothing to approximate.

    Of fields at nodes (n, ...), each of which stands for a volume (n,) if these are given.
    """
    if volumes is not None:
        root = np.sqrt(volumes).reshape(-1, *[1] * (reference.ndim - 1))
        approximation, reference = root * approximation, root * reference
    scale = np.linalg.norm(reference)
    return float(np.linalg.norm(approximation - reference) / scale) if scale else 0.0


def statistics(errors: Sequence[float] | Array) -> dict[str, float]:
    """Mean, 95th percentile and maximum."""
    return {
        "mean": float(np.mean(errors)),
        "p95": float(np.percentile(errors, 95)),
        "max": float(np.max(errors)),
    }
