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
    """What recovery needs of a mesh: q points per element, point index last.

    See ``geometry.recovery.Patches`` for what carries values to the nodes.
    """

    points: tuple[int, ...]  # (q,) numbers of the points: how many there are, compiled code knows
    connectivity: Numbers  # (e, n)
    gradients: NDArray[np.floating]  # (e, n, 3, q) 1/mm, at the points
    corners: Ints  # (k,)
    around: Ints  # (k, a) elements
    weights: NDArray[np.floating]  # (k, a, q)
    midsides: Ints  # (m,)
    line: tuple[int, ...]  # (l,) numbers of a midside's corners, as ``points``
    lines: Ints  # (m, l)
    shares: NDArray[np.floating]  # (m, l)
    tissue_of: Numbers  # (m,) elements, of whose tissue nodes and what else is carried to are
    law: Law  # (e,)


class NearField(NamedTuple):
    """A displacement that a mesh does not follow, at the nodes or other points that it reaches."""

    points: Ints  # (k,)
    displacement: Array  # (k, 3) mm
    gradient: Array  # (k, 3, 3)


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def nodal_von_mises(mesh, u, B, near, out):
    """Write the von Mises stress (nodes,) kPa of the displacement ``u`` (nodes, 3) mm to ``out``.

    ``B`` (e, 6, q) is that of ``mechanics.viscosity`` at the points; None without a past.  ``near``
    is a part of ``u``.  Gradients are summed in the precision of ``mesh.gradients``, which ``u``
    shares.
    """
    count, own = len(mesh.tissue_of), _without(u, near)
    flat = mesh.gradients.reshape(len(mesh.connectivity), -1)
    H = np.empty((len(flat), 9 * len(mesh.points)), flat.dtype)
    for e in range(len(flat)):
        _gradients(mesh.points, mesh.connectivity[e], flat[e], own, H[e])
    nodal = _carried(mesh, H)
    for k in range(len(near.points)):
        node = near.points[k]
        for i in range(9):
            nodal[i * count + node] += near.gradient[k, i // 3, i % 3]
    if B is None:
        for n in range(len(out)):
            law = mesh.law.at(mesh.tissue_of[n])
            out[n] = laws.von_mises(law, add_identity(load(nodal, n, count), 1.0))
    else:
        past = _carried(mesh, B.reshape(len(B), -1))
        for n in range(len(out)):
            law, F = mesh.law.at(mesh.tissue_of[n]), add_identity(load(nodal, n, count), 1.0)
            out[n] = viscosity.von_mises(law, F, unpacked(load_packed(past, n, count)))


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def point_von_mises(mesh, u, B, near, exact, out):
    """Write the von Mises stress (q e,) kPa at the points; ``exact`` is the near field there.

    The others are those of ``nodal_von_mises``.
    """
    count = len(mesh.points)
    added, own = np.zeros((len(mesh.connectivity), 9 * count)), _without(u, near)
    for k in range(len(exact.points)):
        e, q = divmod(exact.points[k], count)
        for i in range(9):
            added[e, count * i + q] = exact.gradient[k, i // 3, i % 3]
    flat = mesh.gradients.reshape(len(mesh.connectivity), -1)
    H = np.empty(9 * count, flat.dtype)
    for e in range(len(mesh.connectivity)):
        _gradients(mesh.points, mesh.connectivity[e], flat[e], own, H)
        law, found = mesh.law.at(e), out[count * e : count * (e + 1)]
        for k in range(9 * count):
            H[k] += added[e, k]
        if B is None:
            for q in range(count):
                found[q] = laws.von_mises(law, add_identity(load(H, q, count), 1.0))
        else:
            b = B[e].reshape(-1)
            for q in range(count):
                past = unpacked(load_packed(b, q, count))
                found[q] = viscosity.von_mises(law, add_identity(load(H, q, count), 1.0), past)


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
    """Add to ``B`` (e, 6, q) what a displacement ``u`` (nodes, 3) mm of the past drives it to.

    See ``mechanics.viscosity``: ``share (m - I)`` at the points, or, where ``share`` is None, the
    linear part of a small displacement that stands for all shares; point index last.
    """
    flat = mesh.gradients.reshape(len(mesh.connectivity), -1)
    count = len(mesh.points)
    H = np.empty(9 * count)
    for e in range(len(mesh.connectivity)):
        _gradients(mesh.points, mesh.connectivity[e], flat[e], u, H)
        b = B[e].reshape(-1)
        for q in range(count):
            G = load(H, q, count)
            if share is None:
                add_to_packed(-1.0, packed(twice_deviator(G, trace(G) / 3.0)), b, q, count)
            else:
                add_to_packed(share, viscosity.driven(add_identity(G, 1.0)), b, q, count)


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def _gradients(points, connectivity, flat, u, H):
    """Displacement gradients (9 q,) at the points of an element."""
    H[:] = 0.0
    row = 3 * len(points)
    for a in range(len(connectivity)):
        node = connectivity[a]
        x, y, z = u[node, 0], u[node, 1], u[node, 2]
        gradients = flat[row * a : row * (a + 1)]
        for k in range(row):
            H[k] += x * gradients[k]
            H[row + k] += y * gradients[k]
            H[2 * row + k] += z * gradients[k]


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def _carried(mesh, values):
    """Components (k nodes,) at the nodes of those at the points of elements (e, q k)."""
    points = len(mesh.points)
    count, components = len(mesh.tissue_of), values.shape[1] // points
    nodal = np.zeros(components * count, values.dtype)
    for n in range(len(mesh.corners)):
        node = np.uint64(mesh.corners[n])
        for a in range(mesh.around.shape[1]):
            own, weights = values[mesh.around[n, a]], mesh.weights[n, a]
            for k in range(components):
                value = weights[0] * own[points * k]
                for q in range(1, points):
                    value += weights[q] * own[points * k + q]
                nodal[k * count + node] += value
    for first in range(0, len(nodal), count):
        own = nodal[first : first + count]
        for m in range(len(mesh.midsides)):
            line, shares = mesh.lines[m], mesh.shares[m]
            value = shares[0] * own[line[0]]
            for j in range(1, len(mesh.line)):
                value += shares[j] * own[line[j]]
            own[mesh.midsides[m]] = value
    return nodal
