"""Von Mises stress at the nodes, recovered from the displacement.

The equivalent stress is taken at the Gauss points, where it converges fastest, extrapolated to the
corners of each element by the trilinear field through its 2x2x2 points, averaged over the elements
that share a corner, and interpolated to midside nodes.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from palpate.shared.arrays import Array, Numbers
from palpate.shared.mechanics import laws, viscosity
from palpate.shared.mechanics.tensors import (
    FAST,
    add_identity,
    add_to_packed,
    load,
    load_packed,
    packed,
    trace,
    twice_deviator,
    unpacked,
)
from palpate.shared.mechanics.tissue import Law


class StressRecovery(NamedTuple):
    """What recovery needs of a mesh: 2x2x2 points per element."""

    connectivity: Numbers  # (e, n)
    gradients: NDArray[np.floating]  # (e, n, 3, 8) 1/mm: point index last, for vector arithmetic
    extrapolation: Array  # (8, 8) corner from point
    law: Law  # (e,)
    elements_at: Array  # (nodes,) number of elements that share a corner node
    midsides: Numbers  # (k, 3) midside node and the corners either side of it


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def nodal_von_mises(mesh, u, B, out):
    """Write the von Mises stress (nodes,) kPa of the displacement ``u`` (nodes, 3) mm to ``out``.

    ``B`` (e, 6, 8) is that of ``mechanics.viscosity``, point index last; None without a past.
    Displacement gradients are summed in the precision of ``mesh.gradients``, which ``u`` shares.
    Never negative: extrapolation may undershoot near steep gradients, which is cut at zero.
    """
    flat = mesh.gradients.reshape(len(mesh.connectivity), -1)
    H, at_points = np.empty(72, flat.dtype), np.empty(8)
    out[:] = 0.0
    for e in range(len(mesh.connectivity)):
        _gradients(mesh.connectivity[e], flat[e], u, H)
        law = mesh.law.at(e)
        if B is None:
            for q in range(8):
                at_points[q] = laws.von_mises(law, add_identity(load(H, q, 8), 1.0))
        else:
            b = B[e].reshape(-1)
            for q in range(8):
                past = unpacked(load_packed(b, q, 8))
                at_points[q] = viscosity.von_mises(law, add_identity(load(H, q, 8), 1.0), past)
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


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def remember(mesh, u, share, B):
    """Add to ``B`` (e, 6, 8) what a displacement ``u`` (nodes, 3) mm of the past drives it to.

    See ``mechanics.viscosity``: ``share (m - I)`` at the points, or, where ``share`` is None, the
    linear part of a small displacement that stands for all shares; point index last.
    """
    flat = mesh.gradients.reshape(len(mesh.connectivity), -1)
    H = np.empty(72)
    for e in range(len(mesh.connectivity)):
        _gradients(mesh.connectivity[e], flat[e], u, H)
        b = B[e].reshape(-1)
        for q in range(8):
            G = load(H, q, 8)
            if share is None:
                add_to_packed(-1.0, packed(twice_deviator(G, trace(G) / 3.0)), b, q, 8)
            else:
                add_to_packed(share, viscosity.driven(add_identity(G, 1.0)), b, q, 8)


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def _gradients(connectivity, flat, u, H):
    """Displacement gradients (72,) at the points of an element."""
    H[:] = 0.0
    for a in range(len(connectivity)):
        node = connectivity[a]
        x, y, z = u[node, 0], u[node, 1], u[node, 2]
        gradients = flat[24 * a : 24 * a + 24]
        for k in range(24):
            H[k] += x * gradients[k]
            H[24 + k] += y * gradients[k]
            H[48 + k] += z * gradients[k]
