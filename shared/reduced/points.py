"""Vector code: rows of modes, and the tissue law at many cubature points at a time.

Points lie in *tiles* of ``LANES``: the nine components of a gradient or stress one after the other,
``LANES`` points each, so that loops over the points of a tile compile to vector code.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from palpate.shared.arrays import Array, Field
from palpate.shared.compiled import methods
from palpate.shared.mechanics import tissue, viscosity
from palpate.shared.mechanics.tensors import (
    FAST,
    SYMMETRIC,
    add,
    add_identity,
    combine,
    constant,
    inline,
    isochoric,
    load,
    load_packed,
    packed,
    scale,
    store,
    store_packed,
    subtract,
    trace,
    twice_deviator,
    unpacked,
)
from palpate.shared.mechanics.tissue import Law

LANES = 16
"""Points in a tile: two vectors of single precision, so that their latencies overlap."""

TILE = 9 * LANES

STATE = 18
"""Numbers that describe the tangent at a point: see ``mechanics.tissue.Law``."""


@methods()
class Points(NamedTuple):
    """Cubature points of a local model, or of p of them, which comes first in all shapes.

    Points of no weight fill up the last tile.
    """

    gradients: Any  # (r, 9 c) in tiles, float32 or int16, in units of the steps
    steps: Field  # (r,) 1/mm
    weights: Array  # (c,) mm^3
    law: Law  # (c,)

    def of(self, k):
        """Points of local model k."""
        return Points(self.gradients[k], self.steps[k], self.weights[k], self.law.at(k))

    def strain(self, q, stepped, H):
        """Write the displacement gradient (9 c,) in the state q (r,); ``stepped`` is scratch."""
        for i in range(len(q)):
            stepped[i] = q[i] * self.steps[i]
        superpose(self.gradients, stepped, H)


@inline
def _tile(values, tile, components):
    """A tile of points with so many components each."""
    return values[components * LANES * tile : components * LANES * (tile + 1)]


# --- vector code ---------------------------------------------------------------------------------
# Rows of numbers, four at a time: a vector that is read serves four products.


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def superpose(rows, coefficients, out):
    """``out = coefficients @ rows`` in the precision of out (n,): rows (4 k, n) of any type."""
    for i in range(len(out)):
        out[i] = constant(0.0, out[i])
    for j in range(0, len(rows), 4):
        a, b = constant(coefficients[j], out[0]), constant(coefficients[j + 1], out[0])
        c, d = constant(coefficients[j + 2], out[0]), constant(coefficients[j + 3], out[0])
        p, q, r, s = rows[j], rows[j + 1], rows[j + 2], rows[j + 3]
        for i in range(len(out)):
            out[i] += (
                a * constant(p[i], out[i]) + b * constant(q[i], out[i])
                + c * constant(r[i], out[i]) + d * constant(s[i], out[i])
            )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def project(rows, vector, out):
    """``out = rows @ vector``: rows (4 k, n) int16 or float32, vector (n,) float32."""
    for j in range(0, len(rows), 4):
        p, q, r, s = rows[j], rows[j + 1], rows[j + 2], rows[j + 3]
        a = b = c = d = np.float32(0.0)
        for i in range(len(vector)):
            v = vector[i]
            a += np.float32(p[i]) * v
            b += np.float32(q[i]) * v
            c += np.float32(r[i]) * v
            d += np.float32(s[i]) * v
        out[j], out[j + 1], out[j + 2], out[j + 3] = a, b, c, d


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def nonlinear_stress(H, weights, law, J, part, linear, P):
    """What the stress adds to that of linear elasticity, times weight, at all points in tiles.

    ``H`` (9 c,) is the displacement gradient.  Also what ``Law.energy`` needs, and the energy
    density of linear elasticity, point by point.
    """
    for tile in range(len(weights) // LANES):
        h, p, w = _tile(H, tile, 9), _tile(P, tile, 9), _tile(weights, tile, 1)
        j, t, e = _tile(J, tile, 1), _tile(part, tile, 1), _tile(linear, tile, 1)
        tissues = law.at(slice(LANES * tile, LANES * (tile + 1)))
        for c in range(LANES):
            G, point = load(h, c, LANES), tissues.at(c)
            e[c], L = tissue.rest_stress(G, point.mu, point.lam)
            j[c], t[c], S = point.first_piola(add_identity(G, 1.0))
            store(scale(w[c], subtract(S, L)), p, c, LANES)


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def linearise(H, weights, law, state):
    """What ``increments`` needs, in tiles of ``STATE`` components; moduli times weight."""
    for tile in range(len(weights) // LANES):
        h, s, w = _tile(H, tile, 9), _tile(state, tile, STATE), _tile(weights, tile, 1)
        tissues = law.at(slice(LANES * tile, LANES * (tile + 1)))
        for c in range(LANES):
            tensor, moduli = tissues.at(c).linearise(add_identity(load(h, c, LANES), 1.0))
            store(tensor, s, c, LANES)
            store(scale(w[c], moduli), s, 9 * LANES + c, LANES)


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def increments(law, state, gradients, out):
    """Tangent less that at rest, times the gradient of every mode: (m, 9 c) in tiles."""
    for tile in range(gradients.shape[1] // TILE):
        s = _tile(state, tile, STATE)
        for mode in range(len(gradients)):
            h, d = _tile(gradients[mode], tile, 9), _tile(out[mode], tile, 9)
            for c in range(LANES):
                G, moduli = load(h, c, LANES), load(s, 9 * LANES + c, LANES)
                D = law.increment((load(s, c, LANES), moduli), G)
                store(subtract(D, tissue.rest_stress(G, moduli[0], moduli[1])[1]), d, c, LANES)


@njit(cache=True, error_model="numpy", nogil=True)
def added_energy(weights, law, J, part, linear):
    """Energy that the tissue law adds to linear elasticity's, after ``nonlinear_stress``."""
    energy = 0.0
    for c in range(len(weights)):
        energy += weights[c] * (law.at(c).energy(J[c], part[c]) - linear[c])
    return energy


@njit(cache=True, error_model="numpy", nogil=True)
def back_substitute(L, x):
    """Solve ``L L^T x = x`` in place: x (m,), or (m, n) for n right-hand sides."""
    m = len(x)
    for i in range(m):
        total = x[i]
        for k in range(i):
            total -= L[i, k] * x[k]
        x[i] = total / L[i, i]
    for i in range(m - 1, -1, -1):
        x[i] /= L[i, i]
        for k in range(i):
            x[k] -= L[i, k] * x[i]


@njit(cache=True, error_model="numpy", nogil=True)
def cholesky(K, shift, L):
    """Lower Cholesky factor of ``K + shift I``; False if a pivot is not positive.

    K, L (4 k, 4 k); of K only the lower triangle and the squares of 4 on the diagonal are read.
    ``I`` is the rest stiffness: the modes are orthonormal in its energy.
    """
    for at in range(0, len(K), 4):
        _reduce_columns(K, at, L)
        for j in range(at, at + 4):
            pivot = L[j, j] + shift
            for k in range(at, j):
                pivot -= L[j, k] * L[j, k]
            if not pivot > 0.0:
                return False
            L[j, j] = math.sqrt(pivot)
            for i in range(j + 1, at + 4):
                total = L[i, j]
                for k in range(at, j):
                    total -= L[i, k] * L[j, k]
                L[i, j] = total / L[j, j]
        p, q, r, s = L[at], L[at + 1], L[at + 2], L[at + 3]
        d0, d1, d2, d3 = 1.0 / p[at], 1.0 / q[at + 1], 1.0 / r[at + 2], 1.0 / s[at + 3]
        for i in range(at + 4, len(K)):
            row = L[i]
            w = row[at] * d0
            x = (row[at + 1] - q[at] * w) * d1
            y = (row[at + 2] - r[at] * w - r[at + 1] * x) * d2
            z = (row[at + 3] - s[at] * w - s[at + 1] * x - s[at + 2] * y) * d3
            row[at], row[at + 1], row[at + 2], row[at + 3] = w, x, y, z
    return True


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def _reduce_columns(K, at, L):
    """Four columns of K from the diagonal down, less what those of L before them account for."""
    p, q, r, s = L[at], L[at + 1], L[at + 2], L[at + 3]
    for i in range(at, len(K), 2):
        a, b = L[i], L[i + 1]
        ap = aq = ar = a_s = bp = bq = br = bs = 0.0
        for k in range(at):
            x, y = a[k], b[k]
            ap += x * p[k]
            aq += x * q[k]
            ar += x * r[k]
            a_s += x * s[k]
            bp += y * p[k]
            bq += y * q[k]
            br += y * r[k]
            bs += y * s[k]
        a[at], a[at + 1] = K[i, at] - ap, K[i, at + 1] - aq
        a[at + 2], a[at + 3] = K[i, at + 2] - ar, K[i, at + 3] - a_s
        b[at], b[at + 1] = K[i + 1, at] - bp, K[i + 1, at + 1] - bq
        b[at + 2], b[at + 3] = K[i + 1, at + 2] - br, K[i + 1, at + 3] - bs


# --- the law at many points ----------------------------------------------------------------------


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def predict_points(history, linear, weights, mu, B, S):
    """What is known of the end of a step before it is solved.

    Parameters
    ----------
    history, linear : ndarray, shape (terms + 1, 6 c)
        See ``Memory``.
    weights : Weights
    mu : ndarray, shape (c,), kPa
    B, S : ndarray, shape (6 c,), out
        ``B`` of ``mechanics.viscosity``, and minus the stress (kPa) that it leads to if linear.
    """
    loss = viscosity.predict(history, weights, B)
    viscosity.predict(linear, weights, S)
    for tile in range(len(mu) // LANES):
        b, s, m = _tile(B, tile, SYMMETRIC), _tile(S, tile, SYMMETRIC), _tile(mu, tile, 1)
        for c in range(3 * LANES):
            b[c] -= np.float32(loss)
        for i in range(SYMMETRIC):
            for c in range(LANES):
                s[LANES * i + c] *= m[c]
    return loss


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def add_past_stress(H, weights, mu, J, B, S, loss, energy, P):
    """Add what the past does beyond linear visco-elasticity, times weight, to the stress ``P``.

    ``energy`` (c,) is overwritten with its energy density (kPa), but for a constant.
    """
    for tile in range(len(weights) // LANES):
        h, p, w = _tile(H, tile, 9), _tile(P, tile, 9), _tile(weights, tile, 1)
        b, s, m = _tile(B, tile, SYMMETRIC), _tile(S, tile, SYMMETRIC), _tile(mu, tile, 1)
        j, e = _tile(J, tile, 1), _tile(energy, tile, 1)
        for c in range(LANES):
            G = load(h, c, LANES)
            past = unpacked(load_packed(b, c, LANES))
            modulus = m[c] * isochoric(j[c])
            contraction, Q = viscosity.overstress(add_identity(G, 1.0), past, j[c], modulus)
            # linear: -(S + 2 mu loss dev sym H)
            soft = scale(loss * m[c], twice_deviator(G, trace(G) / 3.0))
            known = unpacked(load_packed(s, c, LANES))
            L = combine(1.0, known, 0.5, soft)
            e[c] = (
                0.5 * (modulus * contraction - m[c] * trace(past))
                + L[0] * G[0] + L[4] * G[4] + L[8] * G[8]
                + L[5] * (G[5] + G[7]) + L[2] * (G[2] + G[6]) + L[1] * (G[1] + G[3])
            )  # fmt: skip
            Q = scale(w[c], add(Q, add(known, soft)))
            store(add(load(p, c, LANES), Q), p, c, LANES)


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def drive_points(H, m, linear):
    """``m - I`` of ``mechanics.viscosity`` (6 c,) in tiles, of displacement gradients (9 c,).

    ``linear`` (6 c,) is ``2 dev sym H``, minus its linear part.
    """
    for tile in range(len(H) // TILE):
        h, d, e = _tile(H, tile, 9), _tile(m, tile, SYMMETRIC), _tile(linear, tile, SYMMETRIC)
        for c in range(LANES):
            G = load(h, c, LANES)
            store_packed(viscosity.driven(add_identity(G, 1.0)), d, c, LANES)
            store_packed(packed(twice_deviator(G, trace(G) / np.float32(3.0))), e, c, LANES)


@njit(cache=True, error_model="numpy", nogil=True, fastmath={"contract", "reassoc"})
def expand(basis, coefficients, field):
    """Add ``coefficients @ basis`` to ``field``, eight rows at a time, each read end to end.

    basis (M, k) int16; coefficients (M,) and field (k,) float32.
    """
    eighths = len(coefficients) // 8 * 8
    for j in range(0, eighths, 8):
        a, b, c, d = coefficients[j], coefficients[j + 1], coefficients[j + 2], coefficients[j + 3]
        e, f, g, h = (
            coefficients[j + 4], coefficients[j + 5], coefficients[j + 6], coefficients[j + 7],
        )  # fmt: skip
        p, q, r, s = basis[j], basis[j + 1], basis[j + 2], basis[j + 3]
        t, u, v, w = basis[j + 4], basis[j + 5], basis[j + 6], basis[j + 7]
        for i in range(len(field)):
            field[i] += (
                a * np.float32(p[i]) + b * np.float32(q[i])
                + c * np.float32(r[i]) + d * np.float32(s[i])
                + e * np.float32(t[i]) + f * np.float32(u[i])
                + g * np.float32(v[i]) + h * np.float32(w[i])
            )  # fmt: skip
    for j in range(eighths, len(coefficients)):
        row, a = basis[j], coefficients[j]
        for i in range(len(field)):
            field[i] += a * np.float32(row[i])
