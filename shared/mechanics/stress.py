"""Von Mises stress at the nodes, recovered from the displacement.

Its gradients are taken at the Gauss points, where they converge fastest, and carried to the nodes
by quadratic fields through those around each (``geometry.recovery``).  The law makes a stress of
what comes out.  Under a contact the gradients recovered are those that a near field leaves of the
displacement; see ``shared.near_field``.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from palpate.shared.arrays import Array, Ints, Numbers
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
    """What recovery needs of a mesh: 2x2x2 points per element, point index last.

    See ``geometry.recovery.Patches`` for what carries values to the nodes.
    """

    connectivity: Numbers  # (e, n)
    gradients: NDArray[np.floating]  # (e, n, 3, 8) 1/mm, at the points
    corners: Ints  # (k,)
    around: Ints  # (k, 8) elements
    weights: NDArray[np.floating]  # (k, 8, 8)
    midsides: Ints  # (m,)
    lines: Ints  # (m, 4)
    shares: NDArray[np.floating]  # (m, 4)
    law: Law  # (nodes,)


class NearField(NamedTuple):
    """A displacement that a mesh does not follow, at the nodes or other points that it reaches."""

    points: Ints  # (k,)
    displacement: Array  # (k, 3) mm
    gradient: Array  # (k, 3, 3)


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def nodal_von_mises(mesh, u, B, near, out):
    """Write the von Mises stress (nodes,) kPa of the displacement ``u`` (nodes, 3) mm to ``out``.

    ``B`` (e, 6, 8) is that of ``mechanics.viscosity`` at the points; None without a past.  ``near``
    is a part of ``u``.  Gradients are summed in the precision of ``mesh.gradients``, which ``u``
    shares.
    """
    count, own = len(out), _without(u, near)
    flat = mesh.gradients.reshape(len(mesh.connectivity), -1)
    H = np.empty((len(flat), 72), flat.dtype)
    for e in range(len(flat)):
        _gradients(mesh.connectivity[e], flat[e], own, H[e])
    nodal = _carried(mesh, H)
    for k in range(len(near.points)):
        node = near.points[k]
        for i in range(9):
            nodal[i * count + node] += near.gradient[k, i // 3, i % 3]
    if B is None:
        for n in range(count):
            out[n] = laws.von_mises(mesh.law.at(n), add_identity(load(nodal, n, count), 1.0))
    else:
        past = _carried(mesh, B.reshape(len(B), -1))
        for n in range(count):
            F = add_identity(load(nodal, n, count), 1.0)
            out[n] = viscosity.von_mises(mesh.law.at(n), F, unpacked(load_packed(past, n, count)))


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def point_von_mises(mesh, u, B, near, exact, out):
    """Write the von Mises stress (8 e,) kPa at the points; ``exact`` is the near field there.

    The others are those of ``nodal_von_mises``.
    """
    added, own = np.zeros((len(out) // 8, 72)), _without(u, near)
    for k in range(len(exact.points)):
        e, q = divmod(exact.points[k], 8)
        for i in range(9):
            added[e, 8 * i + q] = exact.gradient[k, i // 3, i % 3]
    flat = mesh.gradients.reshape(len(mesh.connectivity), -1)
    H = np.empty(72, flat.dtype)
    for e in range(len(mesh.connectivity)):
        _gradients(mesh.connectivity[e], flat[e], own, H)
        law, found = mesh.law.at(mesh.connectivity[e, 0]), out[8 * e : 8 * e + 8]
        for k in range(72):
            H[k] += added[e, k]
        if B is None:
            for q in range(8):
                found[q] = laws.von_mises(law, add_identity(load(H, q, 8), 1.0))
        else:
            b = B[e].reshape(-1)
            for q in range(8):
                past = unpacked(load_packed(b, q, 8))
                found[q] = viscosity.von_mises(law, add_identity(load(H, q, 8), 1.0), past)


@njit(cache=True, error_model="numpy", nogil=True)
def _without(u, near):
    """Displacement of the nodes without a near field."""
    own = u.copy()
    for k in range(len(near.points)):
        for i in range(3):
            own[near.points[k], i] -= near.displacement[k, i]
    return own


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


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def _carried(mesh, values):
    """Components (k nodes,) at the nodes of those at the points of elements (e, 8 k)."""
    count, components = len(mesh.law.mu), values.shape[1] // 8
    nodal = np.zeros(components * count, values.dtype)
    for n in range(len(mesh.corners)):
        node = np.uint64(mesh.corners[n])
        for a in range(8):
            own, weights = values[mesh.around[n, a]], mesh.weights[n, a]
            for k in range(components):
                value = weights[0] * own[8 * k]
                for q in range(1, 8):
                    value += weights[q] * own[8 * k + q]
                nodal[k * count + node] += value
    for first in range(0, len(nodal), count):
        own = nodal[first : first + count]
        for m in range(len(mesh.midsides)):
            line, shares = mesh.lines[m], mesh.shares[m]
            value = shares[0] * own[line[0]]
            for j in range(1, 4):
                value += shares[j] * own[line[j]]
            own[mesh.midsides[m]] = value
    return nodal
