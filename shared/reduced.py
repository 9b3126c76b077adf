"""The reduced model: an atlas of local Galerkin models over the accessible surface.

Theory.  Round each *patch centre* on the surface the displacement lives in a *wide* space
``u = B c`` of ``r`` modes, orthonormal in the energy of the rest state (``B^T K_0 B = I``).  A
query is not solved in all of it.  Its *narrow* space is chosen for the load at hand, within ``B``:

* the leading modes of the patch,
* the linear response to this very load, ``u_1 = B^T f``, and the second and third derivative of the
  equilibrium along the load path, ``u_2 = -R''[u_1, u_1]`` and ``u_3 = -R'''[u_1, u_1, u_1] -
  3 R''[u_1, u_2]`` (nonlinear load-dependent Ritz vectors; the rest stiffness is ``I``),
* what the solution in these leaves unbalanced in the wide space, the residual
  ``r = B^T (R(u) - f)``.

The equilibrium minimises the potential energy in the narrow space,

    min_q  sum_c w_c W(I + G_c V q) - f . V q,

summed over few *cubature points* ``c`` of positive weight ``w_c`` (Hernandez et al. 2017) with the
gradients ``G_c`` (9, r) of the wide modes.  With all points and their own weights, and all modes,
this is the Galerkin model; tissue law, load footprint and Newton's method are those of the full
model.  The norm of the residual in the wide space, relative to the load's, measures what the narrow
space misses.

Between patch centres the answers of the nearest patches are blended, so that the answer is a
continuous function of the contact point.  No array of mesh size is touched to solve a query.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, types
from numba.extending import overload
from numpy.typing import NDArray

from shared import equilibrium, tissue
from shared.endoscope import SurfaceQuadrature, footprint

Array = NDArray[np.float64]
Field = NDArray[np.float32]
Ints = NDArray[np.int64]

MAX_ACTIVE = 4
"""Patches blended at most; three meet at a corner of a Voronoi cell."""

TOLERANCE = 3e-4
"""Residual at equilibrium relative to the load in the wide space: in the energy norm of the rest
state both are displacements, so this is the solver's share of the error."""

LOOSE = 0.15
"""The same before the space is enriched: near enough for the residual to show what is missing."""

REUSE = 0.15
"""A tangent costs about six residuals here, so a factorised one serves while it still contracts."""

MAX_ITERATIONS = 30


LEADING, PATH = 12, 3
NARROW = LEADING + PATH + 1
"""Modes of the narrow space: leading ones, derivatives along the load path, and the residual.  A
constant, so that loops over it compile to whole vectors."""


# --- one local model as a system for shared.equilibrium ------------------------------------------


class LocalSystem(NamedTuple):
    """A patch under a load, with scratch memory for ``shared.equilibrium.newton``."""

    gradients: Array  # (9 c, m) 1/mm, point by point; a column of zeros is a mode not in use
    weights: Array  # (c,) mm^3
    mu: Array  # (c,) kPa
    lam: Array  # (c,) kPa
    load: Array  # (m,)
    F: Array  # (9 c,)
    P: Array  # (9 c,)
    AG: Array  # (9, m)
    tangent: Array  # (m, m)
    factor: Array  # (m, m) lower Cholesky factor
    point: Array  # (10, 9): inverse of F, and the material tangent


def _is_local_system(system: object) -> bool:
    return isinstance(system, types.NamedTuple) and system.instance_class is LocalSystem


@overload(equilibrium.potential, jit_options={"error_model": "numpy"})
def _potential(system, u, residual):
    if not _is_local_system(system):
        return None

    def potential(system, u, residual):
        np.dot(system.gradients, u, system.F)
        energy, smallest = 0.0, np.inf
        Finv = system.point[0]
        for c in range(len(system.weights)):
            F = system.F[9 * c : 9 * c + 9]
            P = system.P[9 * c : 9 * c + 9]
            F[0] += 1.0
            F[4] += 1.0
            F[8] += 1.0
            W, J = tissue.stress(F, system.mu[c], system.lam[c], Finv, P)
            smallest = min(smallest, J)
            if not J > 0.0:
                return tissue.INVERTED, smallest
            w = system.weights[c]
            energy += w * W
            for i in range(9):
                P[i] *= w
        np.dot(system.gradients.T, system.P, residual)
        np.subtract(residual, system.load, residual)
        return energy - np.dot(system.load, u), smallest

    return potential


@overload(
    equilibrium.factorise,
    jit_options={"error_model": "numpy", "fastmath": {"contract"}},
)
def _factorise(system, u, shift):
    if not _is_local_system(system):
        return None

    def factorise(system, u, shift):
        np.dot(system.gradients, u, system.F)
        Finv, A, AG, K = system.point[0], system.point[1:10], system.AG, system.tangent
        K[:] = 0.0
        for c in range(len(system.weights)):
            F = system.F[9 * c : 9 * c + 9]
            F[0] += 1.0
            F[4] += 1.0
            F[8] += 1.0
            tissue.tangent(F, system.mu[c], system.lam[c], Finv, A)
            w = system.weights[c]
            G = system.gradients[9 * c : 9 * c + 9]
            for i in range(9):
                a0, a1, a2 = w * A[i, 0], w * A[i, 1], w * A[i, 2]
                a3, a4, a5 = w * A[i, 3], w * A[i, 4], w * A[i, 5]
                a6, a7, a8 = w * A[i, 6], w * A[i, 7], w * A[i, 8]
                for k in range(NARROW):
                    AG[i, k] = (
                        a0 * G[0, k] + a1 * G[1, k] + a2 * G[2, k]
                        + a3 * G[3, k] + a4 * G[4, k] + a5 * G[5, k]
                        + a6 * G[6, k] + a7 * G[7, k] + a8 * G[8, k]
                    )  # fmt: skip
            # the point's share of G^T A G while it is in the first-level cache
            for i in range(NARROW):
                g0, g1, g2 = G[0, i], G[1, i], G[2, i]
                g3, g4, g5 = G[3, i], G[4, i], G[5, i]
                g6, g7, g8 = G[6, i], G[7, i], G[8, i]
                for k in range(NARROW):
                    K[i, k] += (
                        g0 * AG[0, k] + g1 * AG[1, k] + g2 * AG[2, k]
                        + g3 * AG[3, k] + g4 * AG[4, k] + g5 * AG[5, k]
                        + g6 * AG[6, k] + g7 * AG[7, k] + g8 * AG[8, k]
                    )  # fmt: skip
        return _cholesky(system.tangent, shift, system.factor)

    return factorise


@overload(equilibrium.correct, jit_options={"error_model": "numpy"})
def _correct(system, residual, step):
    if not _is_local_system(system):
        return None

    def correct(system, residual, step):
        L = system.factor
        m = len(step)
        for i in range(m):
            total = -residual[i]
            for k in range(i):
                total -= L[i, k] * step[k]
            step[i] = total / L[i, i]
        for i in range(m - 1, -1, -1):
            step[i] /= L[i, i]
            for k in range(i):
                step[k] -= L[i, k] * step[i]

    return correct


@njit(cache=True, error_model="numpy", nogil=True)
def _cholesky(K, shift, L):
    """Lower Cholesky factor of ``K + shift I``, row by row; False if a pivot is not positive.

    ``I`` is the rest stiffness: the modes are orthonormal in its energy.
    """
    m = len(K)
    for i in range(m):
        for j in range(i):
            total = K[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = total / L[j, j]
        pivot = K[i, i] + shift
        for k in range(i):
            pivot -= L[i, k] * L[i, k]
        if pivot == shift and K[i, i] == 0.0:
            pivot = 1.0  # a mode not in use: held
        if not pivot > 0.0:
            return False
        L[i, i] = math.sqrt(pivot)
    return True


newton = njit(equilibrium.newton, error_model="numpy", nogil=True, cache=True)


# --- the atlas -----------------------------------------------------------------------------------


class Patches(NamedTuple):
    """All local models, one after the other; ``*_from[k] : *_from[k + 1]`` are patch k's rows."""

    centres: Array  # (p, 3) mm
    frames: Array  # (p, 3, 3) rows: outward normal and two tangents at the centre
    pressures: Array  # (p,) kPa, scale of the load there
    point_from: Ints  # (p + 1,)
    gradients: Field  # (9 c, r) 1/mm
    weights: Array  # (c,) mm^3
    mu: Array  # (c,) kPa
    lam: Array  # (c,) kPa
    node_from: Ints  # (p + 1,)
    modes: Field  # (s, 3, r) wide modes at the nodes that a footprint can load
    face_from: Ints  # (p + 1,)
    face_points: Array  # (g, 3)
    face_normals: Array  # (g, 3)
    face_areas: Array  # (g,)
    face_nodes: NDArray[np.int32]  # (g, k), counted from the patch's first node
    face_shape: Array  # (g, k)
    guess: Field  # (p, features, LEADING + PATH)
    blend: float  # mm, excess distance over the nearest centre at which a patch fades out


GUESS_POSITION = 6
GUESS_LOAD = 31
GUESS_FEATURES = GUESS_POSITION * GUESS_LOAD


@njit(cache=True, error_model="numpy", nogil=True)
def guess_features(frame, centre, x, load, out):
    """Features of the first guess beyond the linear response.

    Monomials of degree 0-2 in the position along the surface (mm from the centre) times monomials
    of degree 2-4 in the load (pressure times direction over the patch's pressure), both in its
    frame.
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
                k += 6


class Memory(NamedTuple):
    """Last answers of the patches in use, to start the next from; patch < 0 is an empty slot."""

    patch: Ints  # (MAX_ACTIVE,)
    wide: Array  # (MAX_ACTIVE, r) answer in the wide space
    guess: Array  # (MAX_ACTIVE, r) first guess it started from
    factor: Array  # (MAX_ACTIVE, m, m)
    factorised: Ints  # (MAX_ACTIVE,) whether ``factor`` holds a tangent near the answer


class Scratch(NamedTuple):
    """Working memory of one query."""

    F: Array  # (9 most points,)
    P: Array
    H: Array  # (3, 9 most points) gradients of the path derivatives
    AG: Array  # (9, m)
    G: Array  # (9 most points, m) gradients of the narrow modes
    vectors: Array  # (m - LEADING, r) narrow modes beyond the leading ones
    single: Field  # (9 most points,)
    tangent: Array  # (m, m)
    point: Array  # (10, 9)
    newton: Array  # (4, m)
    q: Array  # (m,)
    load: Array  # (m,)
    overlap: Array  # (m,)
    wide_load: Array  # (r,)
    derivative: Array  # (r,)
    wide_single: Field  # (r,)
    features: Array
    nodal: Array  # (most nodes of a patch,)
    distance: Array  # (p,)


class Outcome(NamedTuple):
    """What a query writes: weights of the patches in memory's slots, scalars by the names below."""

    weight: Array  # (MAX_ACTIVE,), 0 for a slot not used
    scalars: Array  # (SCALARS,)
    displacement: Array  # (3,) mean displacement under the footprint, weighted by pressure


STATUS, ITERATIONS, SMALLEST_J, AREA, MISSED = range(5)
SCALARS = 5


@njit(cache=True, error_model="numpy", nogil=True)
def activate(patches, x, memory, distance, weight):
    """Choose the patches that answer at ``x`` and their weights; keep what memory has of them.

    A patch counts while its centre is less than ``blend`` farther than the nearest one; weights are
    cubic in that excess, so that they fade with zero slope.
    """
    count = len(patches.centres)
    nearest = np.inf
    for k in range(count):
        d = 0.0
        for i in range(3):
            d += (patches.centres[k, i] - x[i]) ** 2
        distance[k] = d
        nearest = min(nearest, d)
    nearest = math.sqrt(nearest)
    reach = (nearest + patches.blend) ** 2
    weight[:] = 0.0
    for slot in range(MAX_ACTIVE):
        k = memory.patch[slot]
        if k >= 0:
            if distance[k] < reach:
                weight[slot] = _fade((math.sqrt(distance[k]) - nearest) / patches.blend)
            else:
                memory.patch[slot] = -1
    for k in range(count):
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


@njit(cache=True, error_model="numpy")
def _fade(excess):
    return (1.0 - excess) ** 2 * (1.0 + 2.0 * excess)


@njit(cache=True, error_model="numpy", nogil=True)
def _wide_load(patches, k, x, normal, direction, pressure, radius, scratch):
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
    load = scratch.wide_load
    load[:] = 0.0
    for node in range(last - first):
        force = pressure * nodal[node]
        if force != 0.0:
            fx, fy, fz = force * direction[0], force * direction[1], force * direction[2]
            rows = patches.modes[first + node]
            for j in range(len(load)):
                load[j] += fx * rows[0, j] + fy * rows[1, j] + fz * rows[2, j]
    return area


@njit(cache=True, error_model="numpy", nogil=True)
def _gradient(G, vector, scratch, out):
    """``out = G vector`` through single precision: (9 c, r) times (r,)."""
    scratch.wide_single[:] = vector
    single = scratch.single[: len(out)]
    np.dot(G, scratch.wide_single, single)
    out[:] = single


@njit(cache=True, error_model="numpy", nogil=True)
def _force(G, P, scratch, out):
    """``out = G^T P``: (9 c, r) transposed times (9 c,)."""
    single = scratch.single[: len(P)]
    single[:] = P
    np.dot(G.T, single, scratch.wide_single)
    out[:] = scratch.wide_single


@njit(cache=True, error_model="numpy", nogil=True)
def _append(number, vector, gradient, G, vectors, scratch):
    """Orthonormalise ``vector`` against the narrow space and add it as mode ``LEADING + number``.

    ``gradient`` (9 c,) is its gradient.  What lies in the space already leaves a mode not in use.
    Returns the norm of what does not.
    """
    rows = len(gradient)
    column = LEADING + number
    overlap = scratch.overlap
    overlap[:] = 0.0
    overlap[:LEADING] = vector[:LEADING]
    target = vectors[number]
    target[:] = vector
    target[:LEADING] = 0.0
    whole = math.sqrt(np.dot(vector, vector))
    for _ in range(2):
        for j in range(number):
            product = np.dot(vectors[j], target)
            overlap[LEADING + j] += product
            for i in range(len(target)):
                target[i] -= product * vectors[j, i]
    norm = math.sqrt(np.dot(target, target))
    if norm > 1e-6 * whole:
        target /= norm
        along = scratch.F[:rows]
        np.dot(G, overlap, along)
        for i in range(rows):
            G[i, column] = (gradient[i] - along[i]) / norm
    else:
        target[:] = 0.0
        G[:, column] = 0.0
    scratch.load[column] = np.dot(target, scratch.wide_load)
    return norm


@njit(cache=True, error_model="numpy", nogil=True)
def path_stress(order, H, mu, lam, weights, P):
    """Second or third derivative of the stress along the load path, times the points' weights.

    H (>= 2, 9 c) holds the gradients of ``u_1`` and ``u_2``; P (9 c,) is overwritten.
    """
    for c in range(len(weights)):
        i, j = 9 * c, 9 * c + 9
        if order == 2:
            tissue.second_derivative(H[0, i:j], mu[c], lam[c], P[i:j])
        else:
            tissue.third_derivative(H[0, i:j], H[1, i:j], mu[c], lam[c], P[i:j])
        for n in range(i, j):
            P[n] *= weights[c]


@njit(cache=True, error_model="numpy", nogil=True)
def _narrow_space(patches, k, G, vectors, scratch):
    """Set up the narrow space of patch k for ``scratch.wide_load``."""
    a, b = patches.point_from[k], patches.point_from[k + 1]
    rows = 9 * (b - a)
    wide = patches.gradients[9 * a : 9 * b]
    for i in range(rows):
        for j in range(LEADING):
            G[i, j] = wide[i, j]
        for j in range(LEADING, G.shape[1]):
            G[i, j] = 0.0
    vectors[:] = 0.0
    scratch.load[:] = 0.0
    scratch.load[:LEADING] = scratch.wide_load[:LEADING]
    P = scratch.P[:rows]
    mu, lam, weights = patches.mu[a:b], patches.lam[a:b], patches.weights[a:b]
    H = scratch.H[:, :rows]
    _gradient(wide, scratch.wide_load, scratch, H[0])
    _append(0, scratch.wide_load, H[0], G, vectors, scratch)
    for order in range(2, PATH + 1):
        path_stress(order, H, mu, lam, weights, P)
        _force(wide, P, scratch, scratch.derivative)
        np.negative(scratch.derivative, scratch.derivative)
        _gradient(wide, scratch.derivative, scratch, H[order - 1])
        _append(order - 1, scratch.derivative, H[order - 1], G, vectors, scratch)


@njit(cache=True, error_model="numpy", nogil=True)
def _first_guess(patches, k, x, direction, pressure, scratch):
    """First guess in the narrow space, into ``scratch.q``: linear response and fitted remainder."""
    q = scratch.q
    q[:] = scratch.load
    load = scratch.overlap[:3]
    for i in range(3):
        load[i] = direction[i] * pressure / patches.pressures[k]
    guess_features(patches.frames[k], patches.centres[k], x, load, scratch.features)
    table = patches.guess[k]
    for f in range(GUESS_FEATURES):
        value = scratch.features[f]
        for j in range(table.shape[1]):
            q[j] += value * table[f, j]


@njit(cache=True, error_model="numpy", nogil=True)
def _to_wide(q, vectors, wide):
    wide[:] = 0.0
    wide[:LEADING] = q[:LEADING]
    for j in range(len(vectors)):
        for i in range(len(wide)):
            wide[i] += q[LEADING + j] * vectors[j, i]


@njit(cache=True, error_model="numpy", nogil=True)
def _solve_patch(patches, k, slot, warm, x, direction, pressure, memory, scratch, scalars):
    """Equilibrium of patch k under ``scratch.wide_load``; its answer goes to memory's slot."""
    a, b = patches.point_from[k], patches.point_from[k + 1]
    rows = 9 * (b - a)
    wide_gradients = patches.gradients[9 * a : 9 * b]
    G, vectors = scratch.G[:rows], scratch.vectors
    _narrow_space(patches, k, G, vectors, scratch)
    _first_guess(patches, k, x, direction, pressure, scratch)
    q = scratch.q
    if warm:
        # the last answer differs from its guess much as this one will from its own
        departure = scratch.derivative
        np.subtract(memory.wide[slot], memory.guess[slot], departure)
        _to_wide(q, vectors, memory.guess[slot])
        q[:LEADING] += departure[:LEADING]
        for j in range(len(vectors)):
            q[LEADING + j] += np.dot(vectors[j], departure)
    else:
        _to_wide(q, vectors, memory.guess[slot])
    system = LocalSystem(
        G,
        patches.weights[a:b],
        patches.mu[a:b],
        patches.lam[a:b],
        scratch.load,
        scratch.F[:rows],
        scratch.P[:rows],
        scratch.AG,
        scratch.tangent,
        memory.factor[slot],
        scratch.point,
    )
    size = math.sqrt(np.dot(scratch.wide_load, scratch.wide_load))
    loose, target = max(LOOSE * size, 1e-12), max(TOLERANCE * size, 1e-12)
    factorised = warm and memory.factorised[slot] == 1
    status, iterations, _, smallest = newton(
        system, q, scratch.newton, loose, REUSE, MAX_ITERATIONS, factorised
    )
    if status != equilibrium.CONVERGED:
        # once more from rest: a guess can lie beyond a fold of the load path
        q[:] = 0.0
        status, more, _, smallest = newton(
            system, q, scratch.newton, loose, REUSE, MAX_ITERATIONS, False
        )
        iterations += more
    if status == equilibrium.CONVERGED:
        # the residual of the wide space; system.P holds the weighted stress of the state
        _force(wide_gradients, system.P, scratch, scratch.derivative)
        np.subtract(scratch.derivative, scratch.wide_load, scratch.derivative)
        H = scratch.H[2, :rows]
        _gradient(wide_gradients, scratch.derivative, scratch, H)
        missed = _append(PATH, scratch.derivative, H, G, vectors, scratch)
        scalars[MISSED] = max(scalars[MISSED], missed / max(size, 1e-12))
        status, more, _, smallest = newton(
            system, q, scratch.newton, target, REUSE, MAX_ITERATIONS, factorised or iterations > 0
        )
        iterations += more
    _to_wide(q, vectors, memory.wide[slot])
    memory.factorised[slot] = factorised or iterations > 0
    memory.patch[slot] = k if status == equilibrium.CONVERGED else -2 - k
    scalars[STATUS] = max(scalars[STATUS], float(status))
    scalars[ITERATIONS] = max(scalars[ITERATIONS], float(iterations))
    scalars[SMALLEST_J] = min(scalars[SMALLEST_J], smallest)


@njit(cache=True, error_model="numpy", nogil=True)
def answer(patches, x, normal, direction, pressure, radius, memory, scratch, outcome):
    """Equilibrium of every active patch under a pressed footprint.

    Parameters
    ----------
    patches : Patches
    x, normal, direction : ndarray, shape (3,)
        Contact point (mm), outward normal and unit direction of the load.
    pressure, radius : float
        kPa and mm.
    memory : Memory
        Starting point on entry; on return the answers of the slots that have weight.
    scratch : Scratch
    outcome : Outcome
        Overwritten; the scalars are the worst of the active patches.
    """
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
            memory.factorised[slot] = 0
        area = _wide_load(patches, k, x, normal, direction, pressure, radius, scratch)
        scalars[AREA] = area
        _solve_patch(patches, k, slot, warm, x, direction, pressure, memory, scratch, scalars)
        if area > 0.0:
            first = patches.node_from[k]
            wide = memory.wide[slot]
            for node in range(patches.node_from[k + 1] - first):
                nodal = share * scratch.nodal[node] / area
                if nodal != 0.0:
                    for i in range(3):
                        moved = 0.0
                        row = patches.modes[first + node, i]
                        for j in range(len(wide)):
                            moved += row[j] * wide[j]
                        outcome.displacement[i] += nodal * moved


@njit(cache=True, error_model="numpy", nogil=True, fastmath={"contract", "reassoc"})
def expand(basis, coefficients, field):
    """Add ``coefficients @ basis`` to ``field``, in blocks that stay in the first-level cache.

    basis (M, k) int16; coefficients (M,) and field (k,) float32.
    """
    block = 2048
    for start in range(0, len(field), block):
        stop = min(start + block, len(field))
        target = field[start:stop]
        for j in range(0, len(coefficients)):
            row, c = basis[j, start:stop], coefficients[j]
            for i in range(len(target)):
                target[i] += c * np.float32(row[i])
