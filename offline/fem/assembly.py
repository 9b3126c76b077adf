"""Compiled element loops: energy, residual and tangent of the full model.

``viscous`` loops add what the past does to the stress.
"""

import numpy as np
from numba import njit

from palpate.shared.mechanics import laws, tissue, viscosity
from palpate.shared.mechanics.tensors import (
    FAST,
    add_identity,
    cofactor,
    combine,
    det,
    isochoric,
    load,
    load_packed,
    store,
    store_packed,
    unpacked,
)


@njit(cache=True, error_model="numpy")
def _deformation_gradient(conn, grad, u):
    """Deformation gradient at a point, a tensor."""
    f0 = f4 = f8 = 1.0
    f1 = f2 = f3 = f5 = f6 = f7 = 0.0
    for a in range(len(conn)):
        x, y, z = u[3 * conn[a]], u[3 * conn[a] + 1], u[3 * conn[a] + 2]
        g, h, k = grad[a, 0], grad[a, 1], grad[a, 2]
        f0, f1, f2 = f0 + x * g, f1 + x * h, f2 + x * k
        f3, f4, f5 = f3 + y * g, f4 + y * h, f5 + y * k
        f6, f7, f8 = f6 + z * g, f7 + z * h, f8 + z * k
    return f0, f1, f2, f3, f4, f5, f6, f7, f8


@njit(cache=True, error_model="numpy")
def _add_point_force(conn, grad, w, P, r):
    """``r += w B^T P`` for one point."""
    for a in range(len(conn)):
        g, h, k, dof = grad[a, 0], grad[a, 1], grad[a, 2], 3 * conn[a]
        r[dof] += w * (P[0] * g + P[1] * h + P[2] * k)
        r[dof + 1] += w * (P[3] * g + P[4] * h + P[5] * k)
        r[dof + 2] += w * (P[6] * g + P[7] * h + P[8] * k)


@njit(cache=True, error_model="numpy", nogil=True)
def elastic_residual(conn, grad, weight, law, u, r):
    """Add the internal force of ``u`` to ``r``; return (energy, smallest J).

    conn (e, n) int32; grad (e, q, n, 3) 1/mm; weight (e, q) mm^3; law (e, q);
    u, r (3 nodes,) mm and mN.
    """
    energy, smallest = 0.0, np.inf
    for e in range(len(conn)):
        for q in range(weight.shape[1]):
            F = _deformation_gradient(conn[e], grad[e, q], u)
            J, part, P = law.at((e, q)).first_piola(F)
            smallest = min(smallest, J)
            if not J > 0.0:
                return tissue.INVERTED, smallest
            energy += weight[e, q] * law.at((e, q)).energy(J, part)
            _add_point_force(conn[e], grad[e, q], weight[e, q], P, r)
    return energy, smallest


@njit(cache=True, error_model="numpy", nogil=True, fastmath=FAST)
def paired_residuals(conn, grad, weight, law, u, combined, sign, r):
    """Add internal forces of superposed displacements, two by two, to ``r`` (3 nodes, k) mN.

    Displacements u (3 nodes, m) mm are superposed by combined (m, 2 k); the force of the j-th and
    ``sign`` times that of the (k + j)-th make column j.  Gradients are taken once, and all goes on
    side by side.  Nothing may be inverted.
    """
    m, k = u.shape[1], r.shape[1]
    H, F, P = np.empty((9, m)), np.empty((9, 2 * k)), np.empty((9, k))
    tensors, pairs = F.reshape(-1), P.reshape(-1)
    for e in range(len(conn)):
        for q in range(weight.shape[1]):
            point = law.at((e, q))
            H[:] = 0.0
            for a in range(conn.shape[1]):
                x, y, z = grad[e, q, a, 0], grad[e, q, a, 1], grad[e, q, a, 2]
                for i in range(3):
                    row = u[3 * conn[e, a] + i]
                    for j in range(m):
                        H[3 * i, j] += row[j] * x
                        H[3 * i + 1, j] += row[j] * y
                        H[3 * i + 2, j] += row[j] * z
            for i in range(9):
                for j in range(2 * k):
                    F[i, j] = 0.0
                for n in range(m):
                    for j in range(2 * k):
                        F[i, j] += H[i, n] * combined[n, j]
            for j in range(2 * k):
                _, _, S = point.first_piola(add_identity(load(tensors, j, 2 * k), 1.0))
                store(S, tensors, j, 2 * k)
            for j in range(k):
                one, other = load(tensors, j, 2 * k), load(tensors, k + j, 2 * k)
                store(combine(weight[e, q], one, sign * weight[e, q], other), pairs, j, k)
            for a in range(conn.shape[1]):
                x, y, z = grad[e, q, a, 0], grad[e, q, a, 1], grad[e, q, a, 2]
                for i in range(3):
                    row = r[3 * conn[e, a] + i]
                    for j in range(k):
                        row[j] += P[3 * i, j] * x + P[3 * i + 1, j] * y + P[3 * i + 2, j] * z


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _add_point_tangent(grad, A, w, G, C, K):
    """K += w B^T A B for one point, with scratch G (3, n) and C (9, n).

    An element matrix is held as (3, 3, n, n): axis by axis, then node by node, so that the inner
    loop runs over neighbouring numbers; blocks below the diagonal of the first two are left out.
    """
    n = grad.shape[0]
    for j in range(3):
        for b in range(n):
            G[j, b] = w * grad[b, j]
    for k in range(3):
        for i in range(3 * k + 3):
            a0, a1, a2 = A[i, 3 * k], A[i, 3 * k + 1], A[i, 3 * k + 2]
            for b in range(n):
                C[i, b] = a0 * G[0, b] + a1 * G[1, b] + a2 * G[2, b]
        for i in range(k + 1):
            c0, c1, c2, block = C[3 * i], C[3 * i + 1], C[3 * i + 2], K[i, k]
            for a in range(n):
                g0, g1, g2, row = grad[a, 0], grad[a, 1], grad[a, 2], block[a]
                for b in range(n):
                    row[b] += g0 * c0[b] + g1 * c1[b] + g2 * c2[b]


@njit(cache=True, error_model="numpy")
def _scatter(K, slots, data):
    """Add the element matrix to the CSR ``data``; slot -1 is a clamped dof."""
    n = K.shape[2]
    for a in range(n):
        for i in range(3):
            for b in range(n):
                for k in range(3):
                    slot = slots[3 * a + i, 3 * b + k]
                    if slot >= 0:
                        data[slot] += K[i, k, a, b] if i <= k else K[k, i, b, a]


@njit(cache=True, error_model="numpy", nogil=True)
def scatter_faces(K, slots, data):
    """Add face matrices K (f, 3, 3, k, k) to the CSR ``data``; slots (f, 3k, 3k) int32."""
    for f in range(len(K)):
        _scatter(K[f], slots[f], data)


@njit(cache=True, error_model="numpy", nogil=True)
def elastic_tangent(conn, grad, weight, law, u, slots, data):
    """Add the tangent stiffness at ``u`` to CSR ``data`` (mN/mm); slots (e, 3n, 3n) int32."""
    n = conn.shape[1]
    A, G, C, K = np.empty((9, 9)), np.empty((3, n)), np.empty((9, n)), np.empty((3, 3, n, n))
    for e in range(len(conn)):
        K[:] = 0.0
        for q in range(weight.shape[1]):
            F = _deformation_gradient(conn[e], grad[e, q], u)
            laws.tangent(law.at((e, q)), F, A)
            _add_point_tangent(grad[e, q], A, weight[e, q], G, C, K)
        _scatter(K, slots[e], data)


@njit(cache=True, error_model="numpy", nogil=True)
def drive(conn, grad, u, m):
    """Write ``viscosity.driven`` at every point (e, q, 6) of the displacement ``u``."""
    for e in range(len(conn)):
        for q in range(grad.shape[1]):
            F = _deformation_gradient(conn[e], grad[e, q], u)
            store_packed(viscosity.driven(F), m[e, q], 0, 1)


@njit(cache=True, error_model="numpy", nogil=True)
def viscous_residual(conn, grad, weight, mu, B, u, r):
    """Add the force of the past at ``u``, where nothing is inverted, to ``r``; return its energy.

    B (e, q, 6), see ``mechanics.viscosity``; else as ``elastic_residual``.
    """
    energy = 0.0
    for e in range(len(conn)):
        for q in range(weight.shape[1]):
            F = _deformation_gradient(conn[e], grad[e, q], u)
            J = det(F, cofactor(F))
            modulus = mu[e, q] * isochoric(J)
            past = unpacked(load_packed(B[e, q], 0, 1))
            contraction, P = viscosity.overstress(F, past, J, modulus)
            energy += weight[e, q] * 0.5 * modulus * contraction
            _add_point_force(conn[e], grad[e, q], weight[e, q], P, r)
    return energy


@njit(cache=True, error_model="numpy", nogil=True)
def viscous_tangent(conn, grad, weight, mu, B, u, slots, data):
    """Add the tangent of ``viscous_residual`` to CSR ``data`` (mN/mm)."""
    n = conn.shape[1]
    A, G, C, K = np.empty((9, 9)), np.empty((3, n)), np.empty((9, n)), np.empty((3, 3, n, n))
    for e in range(len(conn)):
        K[:] = 0.0
        for q in range(weight.shape[1]):
            F = _deformation_gradient(conn[e], grad[e, q], u)
            A[:] = 0.0
            viscosity.add_tangent(F, unpacked(load_packed(B[e, q], 0, 1)), mu[e, q], A)
            _add_point_tangent(grad[e, q], A, weight[e, q], G, C, K)
        _scatter(K, slots[e], data)
