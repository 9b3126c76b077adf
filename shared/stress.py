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
    gradients: NDArray[np.float64]  # (e, n, 3, 8) 1/mm: point index last, for vector arithmetic
    extrapolation: NDArray[np.float64]  # (8, 8) corner from point
    mu: NDArray[np.float64]  # (e,) kPa
    lam: NDArray[np.float64]  # (e,) kPa
    elements_at: NDArray[np.float64]  # (nodes,) number of elements that share a corner node
    midsides: NDArray[np.int32]  # (k, 3) midside node and the corners either side of it


@njit(cache=True, error_model="numpy", nogil=True)
def nodal_von_mises(mesh, u, out):
    """Write the von Mises stress (nodes,) kPa of the displacement ``u`` (nodes, 3) mm to ``out``.

    Never negative: extrapolation may undershoot near steep gradients, which is cut at zero.
    """
    n = mesh.connectivity.shape[1]
    F = np.empty((9, 8))
    f, Finv, P, at_points = np.empty(9), np.empty(9), np.empty(9), np.empty(8)
    out[:] = 0.0
    for e in range(len(mesh.connectivity)):
        F[:] = 0.0
        for a in range(n):
            node = mesh.connectivity[e, a]
            for i in range(3):
                ui = u[node, i]
                for j in range(3):
                    for q in range(8):
                        F[3 * i + j, q] += ui * mesh.gradients[e, a, j, q]
        for q in range(8):
            for i in range(9):
                f[i] = F[i, q]
            f[0] += 1.0
            f[4] += 1.0
            f[8] += 1.0
            _, J = tissue.stress(f, mesh.mu[e], mesh.lam[e], Finv, P)
            at_points[q] = tissue.von_mises(f, P, J)
        for corner in range(8):
            value = 0.0
            for q in range(8):
                value += mesh.extrapolation[corner, q] * at_points[q]
            out[mesh.connectivity[e, corner]] += max(value, 0.0)
    for node in range(len(mesh.elements_at)):
        if mesh.elements_at[node] > 0.0:
            out[node] /= mesh.elements_at[node]
    for k in range(len(mesh.midsides)):
        out[mesh.midsides[k, 0]] = 0.5 * (out[mesh.midsides[k, 1]] + out[mesh.midsides[k, 2]])
