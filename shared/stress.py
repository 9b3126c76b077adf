"""Von Mises stress at the nodes, recovered from the displacement.

The equivalent stress is taken at the Gauss points, where it converges fastest, extrapolated to the
corners of each element by the trilinear field through its 2x2x2 points, averaged over the elements
that share a corner, and interpolated to midside nodes.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from shared import tissue


class StressRecovery(NamedTuple):
    """What recovery needs of a mesh: 2x2x2 points per element."""

    connectivity: NDArray[np.int32]  # (e, n)
    gradients: NDArray[np.floating]  # (e, n, 3, 8) 1/mm: point index last, for vector arithmetic
    extrapolation: NDArray[np.float64]  # (8, 8) corner from point
    mu: NDArray[np.float64]  # (e,) kPa
    lam: NDArray[np.float64]  # (e,) kPa
    elements_at: NDArray[np.float64]  # (nodes,) number of elements that share a corner node
    midsides: NDArray[np.int32]  # (k, 3) midside node and the corners either side of it


@njit(cache=True, error_model="numpy", nogil=True, fastmath={"contract", "reassoc", "nsz"})
def nodal_von_mises(mesh, u, out):
    """Write the von Mises stress (nodes,) kPa of the displacement ``u`` (nodes, 3) mm to ``out``.

    Displacement gradients are summed in the precision of ``mesh.gradients``, which ``u`` shares.
    Never negative: extrapolation may undershoot near steep gradients, which is cut at zero.
    """
    connectivity = mesh.connectivity
    nodes = connectivity.shape[1]
    flat = mesh.gradients.reshape(len(connectivity), nodes * 24)
    H, at_points = np.empty(72, flat.dtype), np.empty(8)
    extrapolation = mesh.extrapolation
    out[:] = 0.0
    for e in range(len(connectivity)):
        H[:] = 0.0
        for a in range(nodes):
            node = connectivity[e, a]
            x, y, z = u[node, 0], u[node, 1], u[node, 2]
            gradients = flat[e, 24 * a : 24 * a + 24]
            for k in range(24):
                H[k] += x * gradients[k]
                H[24 + k] += y * gradients[k]
                H[48 + k] += z * gradients[k]
        mu, lam = mesh.mu[e], mesh.lam[e]
        for q in range(8):
            at_points[q] = tissue.von_mises(
                1.0 + H[q], H[8 + q], H[16 + q],
                H[24 + q], 1.0 + H[32 + q], H[40 + q],
                H[48 + q], H[56 + q], 1.0 + H[64 + q],
                mu, lam,
            )  # fmt: skip
        for corner in range(8):
            value = 0.0
            for q in range(8):
                value += extrapolation[corner, q] * at_points[q]
            out[connectivity[e, corner]] += max(value, 0.0)
    for node in range(len(mesh.elements_at)):
        if mesh.elements_at[node] > 0.0:
            out[node] /= mesh.elements_at[node]
    for k in range(len(mesh.midsides)):
        out[mesh.midsides[k, 0]] = 0.5 * (out[mesh.midsides[k, 1]] + out[mesh.midsides[k, 2]])
