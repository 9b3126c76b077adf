"""The reduced model: an atlas of local Galerkin models over the accessible surface.

Theory.  Round each *patch centre* on the surface the displacement lives in a *wide* space
``u = B c`` of ``r`` modes, orthonormal in the energy of the rest state (``B^T K_0 B = I``).  A
query is not solved in all of it.  Its *narrow* space is chosen for the load at hand, within ``B``:

* the leading modes of the patch,
* the linear response to this very load, ``u_1 = B^T f``, and the second and third derivative of the
  equilibrium along the load path, ``u_2`` and ``u_3`` (nonlinear load-dependent Ritz vectors),
  which are forms of second and third degree in the load and polynomials in its place on the patch,
* what the solution in these leaves unbalanced in the wide space, the residual
  ``r = B^T (R(u) - f)``.

The equilibrium minimises the potential energy in the narrow space,

    min_q  int W(I + G V q) dV - f . V q,

with ``G`` (9, r) the gradients of the wide modes.  Linear elasticity needs no integration: its
energy is ``q . q / 2``, since the modes are orthonormal in it.  Only what ``W`` adds to the energy
``W_0`` of linear elasticity is summed over few *cubature points* ``c`` of positive weight ``w_c``
(Hernandez et al. 2017),

    min_q  q . q / 2 + sum_c w_c (W - W_0)(G_c V q) - f . V q;

that is small where the load is small, and lives near the contact, where the points are.  With all
points and their own weights, and all modes, this is the Galerkin model; tissue law, load footprint
and Newton's method are those of the full model.

What the points still miss of the internal force in equilibrium, the *defect* of the cubature, is a
smooth function of the load.  It is fitted by polynomials on each patch and taken off ``f``: the
state at which the points are in equilibrium with the rest is that of the Galerkin model.

A *warm* query, whose patch answered the last one too, is *followed* in the wide space itself: the
rest stiffness there is the identity, and each residual shows a direction of the tangent, so a few
secants (BFGS) make up for a tangent that is never formed.

Between patch centres the answers of the nearest patches are blended, so that the answer is a
continuous function of the contact point.  No array of mesh size is touched to solve a query.

Points lie in *tiles* of ``LANES``: the nine components of a gradient or stress one after the other,
``LANES`` points each, so that loops over the points of a tile compile to vector code.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, types
from numba.extending import overload
from numpy.typing import NDArray

from palpate.shared.geometry.surface import SurfaceIndex, locate
from palpate.shared.mechanics import newton, tissue
from palpate.shared.mechanics.footprint import SurfaceQuadrature, footprint, pressure_limit

Array = NDArray[np.float64]
Field = NDArray[np.float32]
Ints = NDArray[np.int64]

MAX_ACTIVE = 4
"""Patches blended at most; three meet at a corner of a Voronoi cell."""

TOLERANCE = 3e-4
"""Residual at equilibrium relative to the load in the wide space: in the energy norm of the rest
state both are displacements, so this is the solver's share of the error.  Where a scene's tolerance
is looser than the usual, so are this, ``WARM_TOLERANCE`` and ``MISSED_MOST``: ``Patches.slack``."""

WARM_TOLERANCE = 2e-3
"""The same of a warm answer; a cold one misses as much in the wide space (median 4e-3)."""

COARSE_TOLERANCE = 0.15
"""The same before the space is enriched: near enough for the residual to show what is missing."""

KEEP_TANGENT = 0.15
"""A tangent costs about three residuals here, so a factorised one serves while it contracts."""

MAX_ITERATIONS = 30

MAX_SECANTS = 10
"""Iterations after which a warm query is solved as a cold one."""

LEAST_CURVATURE = 1e-2
"""Cosine between a step and the change of force it causes, below which it is not a secant."""

MISSED_MOST = 0.03
"""Residual in the wide space, relative to the load, that asks for one more mode."""

ROUND_OFF = 1e-6
"""Of the energy: gradients are summed in single precision."""

LEADING, PATH = 12, 3
NARROW = LEADING + PATH + 1
"""Modes of the narrow space: leading ones, derivatives along the load path, and the residual."""

LANES = 16
"""Points in a tile: two vectors of single precision, so that their latencies overlap."""

TILE = 9 * LANES

STATE = 13
"""Numbers that describe the tangent at a point: F^-T and four moduli."""

FAST = {"contract", "reassoc", "nsz"}


# --- vector code ---------------------------------------------------------------------------------
# Rows of numbers, four at a time: a vector that is read serves four products.


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def superpose(rows, coefficients, out):
    """``out = coefficients @ rows``: rows (4 k, n) int16 or float32, out (n,) float32."""
    for i in range(len(out)):
        out[i] = np.float32(0.0)
    for j in range(0, len(rows), 4):
        a, b = np.float32(coefficients[j]), np.float32(coefficients[j + 1])
        c, d = np.float32(coefficients[j + 2]), np.float32(coefficients[j + 3])
        p, q, r, s = rows[j], rows[j + 1], rows[j + 2], rows[j + 3]
        for i in range(len(out)):
            out[i] += (
                a * np.float32(p[i]) + b * np.float32(q[i])
                + c * np.float32(r[i]) + d * np.float32(s[i])
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
def multiply(A, x, out):
    """``out = A x``: A (4 k, 4 k), symmetric; x, out (4 k,)."""
    for i in range(len(out)):
        out[i] = 0.0
    for j in range(0, len(A), 4):
        a, b, c, d = x[j], x[j + 1], x[j + 2], x[j + 3]
        p, q, r, s = A[j], A[j + 1], A[j + 2], A[j + 3]
        for i in range(len(out)):
            out[i] += a * p[i] + b * q[i] + c * r[i] + d * s[i]


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def _narrow_gradients(rows, steps, vectors, out):
    """Gradients of the narrow modes but the last: ``out[:LEADING + 3]``, in one pass over ``rows``.

    rows (4 k, n) int16 in steps (4 k,); vectors (3, 4 k), steps included; out (NARROW, n).
    """
    for start in range(0, out.shape[1], 512):  # a block stays in the first-level cache
        stop = min(start + 512, out.shape[1])
        for j in range(LEADING):
            row, target, step = rows[j, start:stop], out[j, start:stop], steps[j]
            for i in range(len(target)):
                target[i] = step * np.float32(row[i])
        x, y = out[LEADING, start:stop], out[LEADING + 1, start:stop]
        z = out[LEADING + 2, start:stop]
        for i in range(len(x)):
            x[i] = y[i] = z[i] = np.float32(0.0)
        for j in range(0, len(rows), 4):
            p, q = rows[j, start:stop], rows[j + 1, start:stop]
            r, s = rows[j + 2, start:stop], rows[j + 3, start:stop]
            xp, xq, xr, xs = vectors[0, j], vectors[0, j + 1], vectors[0, j + 2], vectors[0, j + 3]
            yp, yq, yr, ys = vectors[1, j], vectors[1, j + 1], vectors[1, j + 2], vectors[1, j + 3]
            zp, zq, zr, zs = vectors[2, j], vectors[2, j + 1], vectors[2, j + 2], vectors[2, j + 3]
            for i in range(len(x)):
                a, b = np.float32(p[i]), np.float32(q[i])
                c, d = np.float32(r[i]), np.float32(s[i])
                x[i] += xp * a + xq * b + xr * c + xs * d
                y[i] += yp * a + yq * b + yr * c + ys * d
                z[i] += zp * a + zq * b + zr * c + zs * d


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def nonlinear_stress(H, weights, mu, lam, J, trace, linear, P):
    """What the stress adds to that of linear elasticity, times weight, at all points in tiles.

    ``H`` (9 c,) is the displacement gradient.  Also det F, tr(F^T F) and the energy density of
    linear elasticity, point by point.
    """
    for tile in range(len(weights) // LANES):
        h, p = H[TILE * tile : TILE * (tile + 1)], P[TILE * tile : TILE * (tile + 1)]
        at = LANES * tile
        w, m, n = weights[at : at + LANES], mu[at : at + LANES], lam[at : at + LANES]
        j, t, e = J[at : at + LANES], trace[at : at + LANES], linear[at : at + LANES]
        for c in range(LANES):
            h0, h1, h2 = float(h[c]), float(h[LANES + c]), float(h[2 * LANES + c])
            h3, h4, h5 = float(h[3 * LANES + c]), float(h[4 * LANES + c]), float(h[5 * LANES + c])
            h6, h7, h8 = float(h[6 * LANES + c]), float(h[7 * LANES + c]), float(h[8 * LANES + c])
            e[c], l0, l1, l2, l3, l4, l5, l6, l7, l8 = tissue.rest_stress(
                h0, h1, h2, h3, h4, h5, h6, h7, h8, m[c], n[c]
            )
            j[c], t[c], p0, p1, p2, p3, p4, p5, p6, p7, p8 = tissue.first_piola(
                1.0 + h0, h1, h2, h3, 1.0 + h4, h5, h6, h7, 1.0 + h8, m[c], n[c]
            )
            p[c], p[LANES + c] = w[c] * (p0 - l0), w[c] * (p1 - l1)
            p[2 * LANES + c], p[3 * LANES + c] = w[c] * (p2 - l2), w[c] * (p3 - l3)
            p[4 * LANES + c], p[5 * LANES + c] = w[c] * (p4 - l4), w[c] * (p5 - l5)
            p[6 * LANES + c], p[7 * LANES + c] = w[c] * (p6 - l6), w[c] * (p7 - l7)
            p[8 * LANES + c] = w[c] * (p8 - l8)


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def linearise(H, weights, mu, lam, state):
    """What ``increments`` needs, in tiles of ``STATE`` components; moduli times weight."""
    for tile in range(len(weights) // LANES):
        h = H[TILE * tile : TILE * (tile + 1)]
        s = state[STATE * LANES * tile : STATE * LANES * (tile + 1)]
        at = LANES * tile
        w, m, n = weights[at : at + LANES], mu[at : at + LANES], lam[at : at + LANES]
        for c in range(LANES):
            t0, t1, t2, t3, t4, t5, t6, t7, t8, geometric, bulk = tissue.linearise(
                1.0 + h[c], h[LANES + c], h[2 * LANES + c],
                h[3 * LANES + c], 1.0 + h[4 * LANES + c], h[5 * LANES + c],
                h[6 * LANES + c], h[7 * LANES + c], 1.0 + h[8 * LANES + c],
                m[c], n[c],
            )  # fmt: skip
            s[c], s[LANES + c], s[2 * LANES + c], s[3 * LANES + c] = t0, t1, t2, t3
            s[4 * LANES + c], s[5 * LANES + c], s[6 * LANES + c] = t4, t5, t6
            s[7 * LANES + c], s[8 * LANES + c] = t7, t8
            s[9 * LANES + c], s[10 * LANES + c] = w[c] * geometric, w[c] * bulk
            s[11 * LANES + c], s[12 * LANES + c] = w[c] * m[c], w[c] * n[c]


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def increments(state, gradients, out):
    """Tangent less that at rest, times the gradient of every mode: (m, 9 c) in tiles."""
    for tile in range(gradients.shape[1] // TILE):
        s = state[STATE * LANES * tile : STATE * LANES * (tile + 1)]
        for mode in range(len(gradients)):
            h = gradients[mode, TILE * tile : TILE * (tile + 1)]
            d = out[mode, TILE * tile : TILE * (tile + 1)]
            for c in range(LANES):
                h0, h1, h2 = h[c], h[LANES + c], h[2 * LANES + c]
                h3, h4, h5 = h[3 * LANES + c], h[4 * LANES + c], h[5 * LANES + c]
                h6, h7, h8 = h[6 * LANES + c], h[7 * LANES + c], h[8 * LANES + c]
                mu, lam = s[11 * LANES + c], s[12 * LANES + c]
                d0, d1, d2, d3, d4, d5, d6, d7, d8 = tissue.increment(
                    s[c], s[LANES + c], s[2 * LANES + c],
                    s[3 * LANES + c], s[4 * LANES + c], s[5 * LANES + c],
                    s[6 * LANES + c], s[7 * LANES + c], s[8 * LANES + c],
                    s[9 * LANES + c], s[10 * LANES + c], mu,
                    h0, h1, h2, h3, h4, h5, h6, h7, h8,
                )  # fmt: skip
                _, l0, l1, l2, l3, l4, l5, l6, l7, l8 = tissue.rest_stress(
                    h0, h1, h2, h3, h4, h5, h6, h7, h8, mu, lam
                )
                d[c], d[LANES + c], d[2 * LANES + c] = d0 - l0, d1 - l1, d2 - l2
                d[3 * LANES + c], d[4 * LANES + c], d[5 * LANES + c] = d3 - l3, d4 - l4, d5 - l5
                d[6 * LANES + c], d[7 * LANES + c], d[8 * LANES + c] = d6 - l6, d7 - l7, d8 - l8


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def lower_products(A, B, K):
    """Lower triangle of ``K = A B^T``: A, B (4 k, n) float32; some entries above it as well."""
    for k in range(0, len(A), 4):
        p, q, r, s = B[k], B[k + 1], B[k + 2], B[k + 3]  # these stay in the first-level cache
        for i in range(k, len(A), 2):
            a, b = A[i], A[i + 1]
            ap = aq = ar = a_s = bp = bq = br = bs = np.float32(0.0)
            for n in range(len(a)):
                x, y = a[n], b[n]
                ap += x * p[n]
                aq += x * q[n]
                ar += x * r[n]
                a_s += x * s[n]
                bp += y * p[n]
                bq += y * q[n]
                br += y * r[n]
                bs += y * s[n]
            K[i, k], K[i, k + 1], K[i, k + 2], K[i, k + 3] = ap, aq, ar, a_s
            K[i + 1, k], K[i + 1, k + 1], K[i + 1, k + 2], K[i + 1, k + 3] = bp, bq, br, bs


# --- one local model as a system for mechanics.newton ------------------------------------------


class LocalSystem(NamedTuple):
    """A patch under a load, with scratch memory for ``mechanics.newton.descend``."""

    gradients: Field  # (m, 9 c) 1/mm in tiles; a row of zeros is a mode not in use
    weights: Array  # (c,) mm^3
    mu: Array  # (c,) kPa
    lam: Array  # (c,) kPa
    load: Array  # (m,)
    H: Field  # (9 c,) displacement gradient in tiles
    P: Field  # (9 c,) in tiles, see nonlinear_stress
    J: Array  # (c,)
    trace: Array  # (c,)
    linear: Array  # (c,)
    state: Field  # (13 c,) in tiles, see linearise
    increments: Field  # (m, 9 c) in tiles
    tangent: Array  # (m, m), lower triangle
    factor: Array  # (m, m) lower Cholesky factor


class WideSystem(NamedTuple):
    """A patch under a load in all its wide modes, with scratch memory and what it has learnt."""

    gradients: NDArray[np.int16]  # (r, 9 c) in tiles
    steps: Field  # (r,) 1/mm, of the gradients
    weights: Array  # (c,) mm^3
    mu: Array  # (c,) kPa
    lam: Array  # (c,) kPa
    load: Array  # (r,)
    H: Field  # (9 c,) in tiles
    P: Field  # (9 c,) in tiles
    J: Array  # (c,)
    trace: Array  # (c,)
    linear: Array  # (c,)
    stepped: Field  # (r,) state times steps
    secants: Array  # (r, r) inverse tangent, from the secants met so far
    origin: Array  # (2, r) state and internal force that the next secant starts from
    latest: Array  # (r,) state of the last evaluation
    change: Array  # (r,)


def is_system(kind: type[NamedTuple], system: object) -> bool:
    """Whether ``system`` is a named tuple of this kind to the compiler, bound or not."""
    if isinstance(system, types.StructRef):  # bound
        return tuple(system.field_dict) == kind._fields
    return isinstance(system, types.NamedTuple) and system.instance_class is kind


@njit(cache=True, error_model="numpy", nogil=True)
def added_energy(weights, mu, lam, J, trace, linear):
    """Energy that the tissue law adds to linear elasticity's, after ``nonlinear_stress``."""
    energy = 0.0
    for c in range(len(weights)):
        energy += weights[c] * (tissue.energy(J[c], trace[c], mu[c], lam[c]) - linear[c])
    return energy


@overload(newton.potential, jit_options={"error_model": "numpy"})
def _potential(system, u, residual):
    if not is_system(LocalSystem, system):
        return None

    def potential(system, u, residual):
        superpose(system.gradients, u, system.H)
        J, trace, linear = system.J, system.trace, system.linear
        weights, mu, lam = system.weights, system.mu, system.lam
        nonlinear_stress(system.H, weights, mu, lam, J, trace, linear, system.P)
        smallest = J.min()
        if not smallest > 0.0:
            return tissue.INVERTED, smallest
        energy = added_energy(weights, mu, lam, J, trace, linear)
        project(system.gradients, system.P, residual)
        for i in range(len(u)):
            residual[i] += u[i] - system.load[i]
            energy += (0.5 * u[i] - system.load[i]) * u[i]
        return energy, smallest

    return potential


@overload(newton.factorise, jit_options={"error_model": "numpy"})
def _factorise(system, u, shift):
    if not is_system(LocalSystem, system):
        return None

    def factorise(system, u, shift):
        superpose(system.gradients, u, system.H)
        linearise(system.H, system.weights, system.mu, system.lam, system.state)
        increments(system.state, system.gradients, system.increments)
        lower_products(system.gradients, system.increments, system.tangent)
        for i in range(len(u)):
            system.tangent[i, i] += 1.0
        return cholesky(system.tangent, shift, system.factor)

    return factorise


@overload(newton.correct, jit_options={"error_model": "numpy"})
def _correct(system, residual, step):
    if not is_system(LocalSystem, system):
        return None

    def correct(system, residual, step):
        for i in range(len(step)):
            step[i] = -residual[i]
        back_substitute(system.factor, step)

    return correct


@njit(cache=True, error_model="numpy", nogil=True)
def back_substitute(L, x):
    """Solve ``L L^T x = x`` in place."""
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


@overload(newton.potential, jit_options={"error_model": "numpy"})
def _wide_potential(system, u, residual):
    if not is_system(WideSystem, system):
        return None

    def potential(system, u, residual):
        steps, stepped = system.steps, system.stepped
        for i in range(len(u)):
            stepped[i] = u[i] * steps[i]
        superpose(system.gradients, stepped, system.H)
        J, trace, linear = system.J, system.trace, system.linear
        weights, mu, lam = system.weights, system.mu, system.lam
        nonlinear_stress(system.H, weights, mu, lam, J, trace, linear, system.P)
        smallest = J.min()
        if not smallest > 0.0:
            return tissue.INVERTED, smallest
        energy = added_energy(weights, mu, lam, J, trace, linear)
        project(system.gradients, system.P, residual)
        for i in range(len(u)):
            system.latest[i] = u[i]
            residual[i] = residual[i] * steps[i] + u[i] - system.load[i]
            energy += (0.5 * u[i] - system.load[i]) * u[i]
        return energy, smallest

    return potential


@overload(newton.factorise, jit_options={"error_model": "numpy"})
def _wide_factorise(system, u, shift):
    if not is_system(WideSystem, system):
        return None
    # the secants are always those of the last steps
    return lambda system, u, shift: True


@overload(newton.correct, jit_options={"error_model": "numpy"})
def _wide_correct(system, residual, step):
    if not is_system(WideSystem, system):
        return None
    return lambda system, residual, step: correct_by_secants(system, residual, step)


@njit(cache=True, error_model="numpy", nogil=True)
def correct_by_secants(system, residual, step):
    """Newton step of a system with the inverse tangent that its secants make up."""
    learn_secant(system.secants, system.origin, system.latest, residual, system.load, system.change)
    multiply(system.secants, residual, step)
    for i in range(len(step)):
        step[i] = -step[i]


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def learn_secant(inverse, origin, state, residual, load, product):
    """Update the inverse tangent with the secant to a new state (BFGS), which is the next origin.

    Nocedal & Wright, Numerical Optimization, eq. 6.17.  The origin may stem from another query:
    internal forces do not know the load.  From an origin of NaN no secant is drawn.
    """
    step, change = origin[0], origin[1]
    curvature = length = force = 0.0
    for i in range(len(step)):
        step[i] = state[i] - step[i]
        change[i] = residual[i] + load[i] - change[i]
        curvature += step[i] * change[i]
        length += step[i] * step[i]
        force += change[i] * change[i]
    if curvature > LEAST_CURVATURE * math.sqrt(length * force):
        scale = 1.0 / curvature
        multiply(inverse, change, product)
        whole = 0.0
        for i in range(len(step)):
            whole += product[i] * change[i]
        whole = (1.0 + whole * scale) * scale
        for i in range(len(step)):
            row, a, b = inverse[i], whole * step[i] - scale * product[i], scale * step[i]
            for j in range(len(step)):
                row[j] += a * step[j] - b * product[j]
    for i in range(len(step)):
        step[i] = state[i]
        change[i] = residual[i] + load[i]


descend = njit(newton.descend, error_model="numpy", nogil=True, cache=True)


# --- the atlas -----------------------------------------------------------------------------------


class Patches(NamedTuple):
    """All local models; ``*_from[k] : *_from[k + 1]`` are patch k's rows."""

    centres: Array  # (3, p) mm
    frames: Array  # (p, 3, 3) rows: outward normal and two tangents at the centre
    pressures: Array  # (p,) kPa, scale of the load there
    gradients: NDArray[np.int16]  # (p, r, 9 c) of the wide modes, in tiles
    steps: Field  # (p, r) 1/mm, of the gradients
    weights: Array  # (p, c) mm^3, 0 for a point that fills up a tile
    mu: Array  # (p, c) kPa
    lam: Array  # (p, c) kPa
    node_from: Ints  # (p + 1,)
    modes: Field  # (s, 3 r) wide modes, axis by axis, at the nodes that a footprint can load
    face_from: Ints  # (p + 1,)
    face_points: Array  # (g, 3)
    face_normals: Array  # (g, 3)
    face_areas: Array  # (g,)
    face_nodes: NDArray[np.int32]  # (g, k), counted from the patch's first node
    face_shape: Array  # (g, k)
    path: Field  # (p, PATH_FEATURES, r) second and third derivative along the load path
    defect: Field  # (p, PATH_FEATURES, r) force that the points miss, by load_features
    guess: Field  # (p, FEATURES, NARROW), the last column zero
    blend: float  # mm, excess distance over the nearest centre at which a patch fades out
    slack: float  # times the solver's tolerances


POSITION_FEATURES = 6
SECOND_FEATURES = 6 * POSITION_FEATURES
PATH_FEATURES = SECOND_FEATURES + 10 * POSITION_FEATURES
FEATURES = PATH_FEATURES + 15 * POSITION_FEATURES


@njit(cache=True, error_model="numpy", nogil=True)
def load_features(frame, centre, x, load, out):
    """Polynomials in a load and its place on a patch, (FEATURES,).

    Monomials of degree 2, 3, 4 in the load (pressure times direction over the patch's pressure)
    times monomials of degree 0-2 in the position along the surface (mm from the centre), both in
    the patch's frame.
    """
    s = t = 0.0
    for i in range(3):
        s += frame[1, i] * (x[i] - centre[i])
        t += frame[2, i] * (x[i] - centre[i])
    a = frame[0, 0] * load[0] + frame[0, 1] * load[1] + frame[0, 2] * load[2]
    b = frame[1, 0] * load[0] + frame[1, 1] * load[1] + frame[1, 2] * load[2]
    c = frame[2, 0] * load[0] + frame[2, 1] * load[1] + frame[2, 2] * load[2]
    k = 0
    for degree in range(2, 5):
        for i in range(degree + 1):
            for j in range(degree + 1 - i):
                monomial = b**i * c**j * a ** (degree - i - j)
                out[k] = monomial
                out[k + 1] = monomial * s
                out[k + 2] = monomial * t
                out[k + 3] = monomial * s * s
                out[k + 4] = monomial * s * t
                out[k + 5] = monomial * t * t
                k += POSITION_FEATURES


RESIDUAL_FEATURES = 16

LEAST_LOAD = 1e-2
"""Share of the largest trained pressure below which residuals are taken for those there."""


@njit(cache=True, error_model="numpy", nogil=True)
def residual_features(frame, centre, x, direction, share, out):
    """What the residual of an answer depends on, (RESIDUAL_FEATURES,).

    Monomials up to degree 2 in the position on the patch (mm from the centre) and in the two
    tangential components of the unit direction, and the load's share of the largest trained
    pressure, as it is and its log.
    """
    s = t = b = c = 0.0
    for i in range(3):
        s += frame[1, i] * (x[i] - centre[i])
        t += frame[2, i] * (x[i] - centre[i])
        b += frame[1, i] * direction[i]
        c += frame[2, i] * direction[i]
    share = min(max(share, LEAST_LOAD), 1.0)
    log = math.log(share)
    out[0], out[1], out[2], out[3], out[4], out[5] = 1.0, s, t, s * s, s * t, t * t
    out[6], out[7], out[8], out[9], out[10] = b, c, b * b, b * c, c * c
    out[11], out[12], out[13], out[14], out[15] = share, share**2, log, log * b, log * c


class Memory(NamedTuple):
    """Last answers of the patches in use, to start the next from; patch < 0 is an empty slot."""

    patch: Ints  # (MAX_ACTIVE,)
    wide: Array  # (MAX_ACTIVE, r) answer in the wide space
    guess: Array  # (MAX_ACTIVE, r) its first guess
    secants: Array  # (MAX_ACTIVE, r, r) inverse tangent, see WideSystem
    origin: Array  # (MAX_ACTIVE, 2, r)


class Scratch(NamedTuple):
    """Working memory of one query."""

    gradients: Field  # (m, 9 c) of the narrow modes, in tiles
    increments: Field  # (m, 9 c)
    H: Field  # (9 c,)
    P: Field  # (9 c,)
    J: Array  # (c,)
    trace: Array  # (c,)
    linear: Array  # (c,)
    state: Field  # (13 c,)
    vectors: Array  # (m - LEADING, r) narrow modes beyond the leading ones
    stepped: Field  # (m - LEADING, r) times the steps of the wide gradients
    tangent: Array  # (m, m)
    factor: Array  # (m, m)
    newton: Array  # (4, m)
    wide_newton: Array  # (4, r)
    q: Array  # (m,)
    guess: Field  # (m,)
    load: Array  # (m,)
    scaled_load: Array  # (3,)
    unit_loads: Field  # (3 r,) of a unit pressure along each axis
    wide_load: Array  # (r,)
    residual: Array  # (r,)
    start: Array  # (r,)
    stepped_state: Field  # (r,)
    latest: Array  # (r,)
    features: Array  # (FEATURES,)
    residual_features: Array  # (RESIDUAL_FEATURES,)
    nodal: Array  # (most nodes of a patch,)
    distance: Array  # (p,)
    surface: Array  # (clusters of triangles + 3,)


class Outcome(NamedTuple):
    """What a query writes."""

    weight: Array  # (MAX_ACTIVE,) of the patches in memory's slots, 0 for a slot not used
    point: Array  # (3,) mm, contact point
    normal: Array  # (3,) outward
    direction: Array  # (3,) unit direction of the load
    force: Array  # (3,) mN
    displacement: Array  # (3,) mm, mean under the footprint, weighted by pressure
    range: Array  # (7,) load range at the contact point
    features: Array  # (ERROR_FEATURES,) of the error estimate
    scalars: Array  # (SCALARS,), by the names below


ERROR_FEATURES = 11

(
    STATUS,
    ITERATIONS,
    SMALLEST_J,
    AREA,
    DEPARTURE,
    RESIDUAL,
    ENERGY,
    DISTANCE,
    TILT,
    LIMIT,
    ERROR_DISPLACEMENT,
    ERROR_VON_MISES,
) = range(12)
SCALARS = 12


class Solver(NamedTuple):
    """All that a query reads of the local models, and all that it writes."""

    patches: Patches
    memory: Memory
    scratch: Scratch
    outcome: Outcome


class Terms(NamedTuple):
    """Where and how hard may be pressed, and how far to trust the answer."""

    ground: SurfaceIndex  # values at its vertices: the load range
    reach: float  # mm, farthest position from the surface
    max_tilt: float  # degrees
    residuals: Array  # (p, RESIDUAL_FEATURES) log of the residual, by residual_features
    coefficients: Array  # (2, ERROR_FEATURES): displacement, von Mises


@njit(cache=True, error_model="numpy", nogil=True)
def activate(patches, x, memory, distance, weight):
    """Choose the patches that answer at ``x`` and their weights; keep what memory has of them.

    A patch counts while its centre is less than ``blend`` farther than the nearest one; weights are
    cubic in that excess, so that they fade with zero slope.
    """
    centres = patches.centres
    for k in range(len(distance)):
        a, b, c = centres[0, k] - x[0], centres[1, k] - x[1], centres[2, k] - x[2]
        distance[k] = a * a + b * b + c * c
    nearest = math.sqrt(distance.min())
    reach = (nearest + patches.blend) ** 2
    weight[:] = 0.0
    for slot in range(MAX_ACTIVE):
        k = memory.patch[slot]
        if k >= 0:
            if distance[k] < reach:
                weight[slot] = _fade((math.sqrt(distance[k]) - nearest) / patches.blend)
            else:
                memory.patch[slot] = -1
    for k in range(len(distance)):
        if distance[k] < reach:
            free, known = -1, False
            for slot in range(MAX_ACTIVE):
                if memory.patch[slot] == k:
                    known = True
                elif memory.patch[slot] < 0 and weight[slot] == 0.0 and free < 0:
                    free = slot
            if not known and free >= 0:
                memory.patch[free] = -2 - k  # new: no answer yet
                weight[free] = _fade((math.sqrt(distance[k]) - nearest) / patches.blend)
    weight /= weight.sum()


@njit(cache=True, error_model="numpy", nogil=True)
def _fade(excess):
    return (1.0 - excess) ** 2 * (1.0 + 2.0 * excess)


@njit(cache=True, error_model="numpy", nogil=True)
def load_patch(patches, k, x, normal, direction, pressure, radius, scratch):
    """Load of patch k in its wide space into ``scratch.wide_load``; returns force over pressure."""
    first, last = patches.node_from[k], patches.node_from[k + 1]
    a, b = patches.face_from[k], patches.face_from[k + 1]
    nodal = scratch.nodal[: last - first]
    surface = SurfaceQuadrature(
        patches.face_points[a:b],
        patches.face_normals[a:b],
        patches.face_areas[a:b],
        patches.face_nodes[a:b],
        patches.face_shape[a:b],
    )
    area = footprint(surface, x, normal, radius, nodal)
    unit = scratch.unit_loads
    unit[:] = np.float32(0.0)
    for node in range(last - first):
        if nodal[node] != 0.0:
            weight, row = np.float32(nodal[node]), patches.modes[first + node]
            for j in range(len(unit)):
                unit[j] += weight * row[j]
    load = scratch.wide_load
    r = len(load)
    for j in range(r):
        load[j] = pressure * (
            direction[0] * unit[j] + direction[1] * unit[r + j] + direction[2] * unit[2 * r + j]
        )
    return area


@njit(cache=True, error_model="numpy", nogil=True)
def _append(number, steps, scratch):
    """Orthonormalise ``scratch.vectors[number]`` against the narrow space: mode LEADING + number.

    What lies in the space already leaves a mode not in use, of zeros.  Returns the norm of what
    does not.
    """
    vectors, stepped = scratch.vectors, scratch.stepped
    target = vectors[number]
    whole = math.sqrt(np.dot(target, target))
    target[:LEADING] = 0.0
    for _ in range(2):
        for j in range(number):
            product = np.dot(vectors[j], target)
            for i in range(len(target)):
                target[i] -= product * vectors[j, i]
    norm = math.sqrt(np.dot(target, target))
    scale = 1.0 / norm if norm > 1e-6 * whole else 0.0
    for i in range(len(target)):
        target[i] *= scale
        stepped[number, i] = target[i] * steps[i]
    scratch.load[LEADING + number] = np.dot(target, scratch.wide_load)
    return norm


@njit(cache=True, error_model="numpy", nogil=True)
def _balance(defect, inside, features, load):
    """Take the cubature's defect off a load (r,) mN.

    ``inside`` is the largest trained pressure over that of the load, at most 1: beyond the range
    the defect stays what it is at its end.
    """
    second, third = inside**2, inside**3
    for f in range(PATH_FEATURES):
        feature = np.float32(features[f] * (second if f < SECOND_FEATURES else third))
        row = defect[f]
        for i in range(len(load)):
            load[i] -= feature * row[i]


@njit(cache=True, error_model="numpy", nogil=True)
def _path_modes(patches, k, scratch):
    """Modes of the narrow space of patch k for ``scratch.wide_load``, but the residual."""
    scratch.load[:] = 0.0
    scratch.load[:LEADING] = scratch.wide_load[:LEADING]
    first, second, third = scratch.vectors[0], scratch.vectors[1], scratch.vectors[2]
    first[:] = scratch.wide_load
    second[:] = 0.0
    third[:] = 0.0
    scratch.vectors[PATH] = 0.0
    path = patches.path[k]
    for f in range(SECOND_FEATURES):
        feature = np.float32(scratch.features[f])
        for i in range(len(second)):
            second[i] += feature * path[f, i]
    for f in range(SECOND_FEATURES, PATH_FEATURES):
        feature = np.float32(scratch.features[f])
        for i in range(len(third)):
            third[i] += feature * path[f, i]
    for number in range(PATH):
        _append(number, patches.steps[k], scratch)


@njit(cache=True, error_model="numpy", nogil=True)
def _first_guess(table, scratch):
    """First guess in the narrow space, into ``scratch.q``: linear response and fitted remainder."""
    q = scratch.q
    q[:] = scratch.load
    guess = scratch.guess
    guess[:] = np.float32(0.0)
    for f in range(FEATURES):
        feature, row = np.float32(scratch.features[f]), table[f]
        for j in range(NARROW):
            guess[j] += feature * row[j]
    for j in range(NARROW):
        q[j] += guess[j]


@njit(cache=True, error_model="numpy", nogil=True)
def _to_wide(q, vectors, wide):
    wide[:] = 0.0
    wide[:LEADING] = q[:LEADING]
    for j in range(len(vectors)):
        for i in range(len(wide)):
            wide[i] += q[LEADING + j] * vectors[j, i]


@njit(cache=True, error_model="numpy", nogil=True)
def _enrich(patches, k, wide, scratch):
    """Make the residual in the wide space the last mode of the narrow one.

    For the state ``scratch.q`` and the stress there; ``wide`` is scratch.  Writes the residual of
    the new mode beside those of the others and returns the norm of what the narrow space missed.
    """
    gradients, steps, residual = patches.gradients[k], patches.steps[k], scratch.residual
    vectors = scratch.vectors
    project(gradients, scratch.P, residual)
    _to_wide(scratch.q, vectors, wide)
    for i in range(len(residual)):
        residual[i] = residual[i] * steps[i] + wide[i] - scratch.wide_load[i]
    vectors[PATH] = residual
    missed = _append(PATH, steps, scratch)
    superpose(gradients, scratch.stepped[PATH], scratch.gradients[NARROW - 1])
    scratch.newton[0, NARROW - 1] = np.dot(vectors[PATH], residual)
    return missed


@njit(cache=True, error_model="numpy", nogil=True)
def _merge(scratch):
    """Join the last two modes into the one that the state has of them, and free the last."""
    q, vectors, gradients = scratch.q, scratch.vectors, scratch.gradients
    length = math.hypot(q[NARROW - 2], q[NARROW - 1])
    if length > 0.0:
        a, b = q[NARROW - 2] / length, q[NARROW - 1] / length
        for i in range(vectors.shape[1]):
            vectors[PATH - 1, i] = a * vectors[PATH - 1, i] + b * vectors[PATH, i]
        for i in range(gradients.shape[1]):
            gradients[NARROW - 2, i] = (
                np.float32(a) * gradients[NARROW - 2, i]
                + np.float32(b) * (gradients[NARROW - 1, i])
            )
        residual = scratch.newton[0]
        residual[NARROW - 2] = a * residual[NARROW - 2] + b * residual[NARROW - 1]
        scratch.load[NARROW - 2] = np.dot(vectors[PATH - 1], scratch.wide_load)
    q[NARROW - 2], q[NARROW - 1] = length, 0.0


@njit(inline="always")
def _solve_patch(patches, k, slot, warm, x, direction, pressure, limit, memory, scratch, scalars):
    """Equilibrium of patch k under ``scratch.wide_load``; its answer goes to memory's slot."""
    for i in range(3):
        scratch.scaled_load[i] = direction[i] * pressure / patches.pressures[k]
    frame, centre = patches.frames[k], patches.centres[:, k]
    load_features(frame, centre, x, scratch.scaled_load, scratch.features)
    inside = limit / pressure if pressure > limit else 1.0
    _balance(patches.defect[k], inside, scratch.features, scratch.wide_load)
    _path_modes(patches, k, scratch)
    _first_guess(patches.guess[k], scratch)
    wide, guess, start, load = (
        memory.wide[slot],
        memory.guess[slot],
        scratch.start,
        scratch.wide_load,
    )
    # the last answer differs from its guess much as this one will from its own
    np.subtract(wide, guess, start)
    _to_wide(scratch.q, scratch.vectors, guess)
    start += guess
    size = max(math.sqrt(np.dot(load, load)), 1e-9)
    status, iterations, smallest = newton.STALLED, 0, 0.0
    if warm:
        secants, origin = memory.secants[slot], memory.origin[slot]
        status, iterations, smallest = _follow(patches, k, size, secants, origin, scratch)
    if status == newton.CONVERGED:
        wide[:] = start
    else:
        status, more, smallest = _solve_narrow(patches, k, size, wide, scratch)
        iterations += more
        forget_secants(memory.secants[slot], memory.origin[slot])
    memory.patch[slot] = k if status == newton.CONVERGED else -2 - k
    length = departure = 0.0
    for i in range(len(wide)):
        length += wide[i] ** 2
        departure += (wide[i] - load[i]) ** 2
    scalars[STATUS] = max(scalars[STATUS], float(status))
    scalars[ENERGY] = max(scalars[ENERGY], math.sqrt(length))
    scalars[DEPARTURE] = max(scalars[DEPARTURE], math.sqrt(departure) / size)
    scalars[ITERATIONS] = max(scalars[ITERATIONS], float(iterations))
    scalars[SMALLEST_J] = min(scalars[SMALLEST_J], smallest)


@njit(cache=True, error_model="numpy", nogil=True)
def forget_secants(inverse, origin):
    """Start anew with the rest stiffness; the next state is the first origin."""
    origin[:] = np.nan
    inverse[:] = 0.0
    for i in range(len(inverse)):
        inverse[i, i] = 1.0


@njit(cache=True, error_model="numpy", nogil=True)
def _follow(patches, k, size, secants, origin, scratch):
    """Equilibrium of patch k near ``scratch.start``, in place, in the wide space."""
    system = WideSystem(
        patches.gradients[k],
        patches.steps[k],
        patches.weights[k],
        patches.mu[k],
        patches.lam[k],
        scratch.wide_load,
        scratch.H,
        scratch.P,
        scratch.J,
        scratch.trace,
        scratch.linear,
        scratch.stepped_state,
        secants,
        origin,
        scratch.latest,
        scratch.residual,
    )
    start, work = scratch.start, scratch.wide_newton
    energy, smallest = newton.potential(system, start, work[0])
    status, iterations, energy, smallest = descend(
        system, start, work, energy, smallest, patches.slack * WARM_TOLERANCE * size, np.inf,
        MAX_SECANTS, True, ROUND_OFF,
    )  # fmt: skip
    return status, iterations, smallest


@njit(cache=True, error_model="numpy", nogil=True)
def _solve_narrow(patches, k, size, wide, scratch):
    """Equilibrium of patch k in its narrow space, from ``scratch.q``; writes it to ``wide``."""
    _narrow_gradients(patches.gradients[k], patches.steps[k], scratch.stepped, scratch.gradients)
    scratch.gradients[NARROW - 1] = 0.0
    q, vectors, work = scratch.q, scratch.vectors, scratch.newton
    system = LocalSystem(
        scratch.gradients,
        patches.weights[k],
        patches.mu[k],
        patches.lam[k],
        scratch.load,
        scratch.H,
        scratch.P,
        scratch.J,
        scratch.trace,
        scratch.linear,
        scratch.state,
        scratch.increments,
        scratch.tangent,
        scratch.factor,
    )
    status, iterations, energy, smallest = newton.STALLED, 0, 0.0, 0.0
    for attempt in range(2):
        if attempt == 1:  # once more from rest: a guess can lie beyond a fold of the load path
            q[:] = 0.0
        energy, smallest = newton.potential(system, q, work[0])
        status, more, energy, smallest = descend(
            system, q, work, energy, smallest, COARSE_TOLERANCE * size, KEEP_TANGENT,
            MAX_ITERATIONS, False, ROUND_OFF,
        )  # fmt: skip
        iterations += more
        if status == newton.CONVERGED:
            break
    missed = np.inf
    while status == newton.CONVERGED:
        again = _enrich(patches, k, wide, scratch) / size
        if again > 0.8 * missed:
            break
        missed = again
        status, more, energy, smallest = descend(
            system, q, work, energy, smallest, patches.slack * TOLERANCE * size, KEEP_TANGENT,
            MAX_ITERATIONS, iterations > 0, ROUND_OFF,
        )  # fmt: skip
        iterations += more
        if missed <= patches.slack * MISSED_MOST:
            break
        _merge(scratch)
    _to_wide(q, vectors, wide)
    return status, iterations, smallest


@njit(inline="always")
def _answer(solver, x, normal, direction, pressure, limit, radius):
    patches, memory, scratch, outcome = (
        solver.patches, solver.memory, solver.scratch, solver.outcome,
    )  # fmt: skip
    activate(patches, x, memory, scratch.distance, outcome.weight)
    scalars = outcome.scalars
    scalars[:] = 0.0
    scalars[SMALLEST_J] = np.inf
    outcome.displacement[:] = 0.0
    for slot in range(MAX_ACTIVE):
        share = outcome.weight[slot]
        if share == 0.0:
            continue
        k = memory.patch[slot]
        warm = k >= 0
        if not warm:
            k = -2 - k
        area = load_patch(patches, k, x, normal, direction, pressure, radius, scratch)
        scalars[AREA] = area
        _solve_patch(
            patches, k, slot, warm, x, direction, pressure, limit, memory, scratch, scalars
        )
        if area > 0.0:
            wide, unit = memory.wide[slot], scratch.unit_loads
            for i in range(3):
                moved = 0.0
                for j in range(len(wide)):
                    moved += unit[len(wide) * i + j] * wide[j]
                outcome.displacement[i] += share / area * moved


@njit(cache=True, error_model="numpy", nogil=True)
def aim(terms, solver, position, direction):
    """Contact point nearest to ``position``, normal, load range and unit direction there.

    They go to the outcome; returns the distance (mm), the tilt (degrees) and the largest trained
    pressure (kPa).
    """
    outcome = solver.outcome
    x, normal, towards = outcome.point, outcome.normal, outcome.direction
    distance = locate(terms.ground, position, solver.scratch.surface, x, normal, outcome.range)
    length = math.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
    cosine = 0.0
    for i in range(3):
        towards[i] = direction[i] / length if length > 0.0 else -normal[i]
        cosine -= towards[i] * normal[i]
    tilt = math.degrees(math.acos(min(1.0, max(-1.0, cosine))))
    return distance, tilt, pressure_limit(outcome.range, normal, towards)


@njit(cache=True, error_model="numpy", nogil=True)
def query(terms, solver, position, direction, pressure, radius):
    """Find the contact point nearest to ``position``, press there, and estimate the error.

    A position beyond reach, or a direction out of the tissue, is not solved: distance and tilt in
    the outcome tell.

    Parameters
    ----------
    terms : Bound of Terms
    solver : Bound of Solver
        Its memory is the starting point on entry; on return the answers of the slots that have
        weight.  The outcome is overwritten; its scalars are the worst of the active patches.
    position : ndarray, shape (3,), mm
    direction : ndarray, shape (3,)
        Of any length; zero stands for the inward normal.
    pressure, radius : float
        kPa and mm.
    """
    outcome = solver.outcome
    x, normal, towards, scalars = outcome.point, outcome.normal, outcome.direction, outcome.scalars
    distance, tilt, limit = aim(terms, solver, position, direction)
    if distance <= terms.reach and tilt < 90.0:
        _answer(solver, x, normal, towards, pressure, limit, radius)
        _estimate(terms, solver, pressure / limit, tilt / max(terms.max_tilt, 1.0), pressure)
    scalars[DISTANCE], scalars[TILT], scalars[LIMIT] = distance, tilt, limit


@njit(cache=True, error_model="numpy", nogil=True)
def _estimate(terms, solver, load, tilt, pressure):
    """Force and estimated errors of an answer: ``log error = c . features``.

    The features: 1, tilt over the largest, smallest det F, the normal (where on the body), and the
    logs of the pressure over its limit, of the departure from the linear response, of the residual
    that such answers leave in the full model, of the contact's displacement over pressure (mm/kPa)
    and of the displacement in the energy norm.
    """
    outcome, patch = solver.outcome, solver.memory.patch
    scalars, features = outcome.scalars, outcome.features
    patches, looked_at = solver.patches, solver.scratch.residual_features
    moved = residual = 0.0
    for i in range(3):
        outcome.force[i] = pressure * scalars[AREA] * outcome.direction[i]
        moved += outcome.displacement[i] ** 2
    for slot in range(MAX_ACTIVE):
        if outcome.weight[slot] > 0.0:
            k = patch[slot] if patch[slot] >= 0 else -2 - patch[slot]
            residual_features(
                patches.frames[k], patches.centres[:, k], outcome.point, outcome.direction, load,
                looked_at,
            )  # fmt: skip
            residual += outcome.weight[slot] * np.dot(terms.residuals[k], looked_at)
    compliance = math.sqrt(moved) / max(pressure, 1e-6)
    scalars[RESIDUAL] = math.exp(residual)
    features[0], features[1], features[2] = 1.0, tilt, scalars[SMALLEST_J]
    features[3:6] = outcome.normal
    features[6], features[7] = math.log(max(load, 1e-6)), math.log(max(scalars[DEPARTURE], 1e-6))
    features[8], features[9] = residual, math.log(max(compliance, 1e-6))
    features[10] = math.log(max(scalars[ENERGY], 1e-6))
    scalars[ERROR_DISPLACEMENT] = math.exp(np.dot(terms.coefficients[0], features))
    scalars[ERROR_VON_MISES] = math.exp(np.dot(terms.coefficients[1], features))


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
