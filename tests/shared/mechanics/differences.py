"""Derivatives by finite differences, to judge analytical ones by."""

import numpy as np


def central_difference(function, at, step=1e-3):
    """Derivative of ``function`` with respect to the entries of ``at``, last axis."""
    columns = []
    for i in range(at.size):
        shift = np.zeros(at.size)
        shift[i] = step
        shift = shift.reshape(at.shape)
        # Fourth order, so that the truncation error is far below the 1e-7 asked for.
        near = function(at + shift) - function(at - shift)
        far = function(at + 2 * shift) - function(at - 2 * shift)
        columns.append((8 * near - far) / (12 * step))
    return np.stack(columns, axis=-1)
