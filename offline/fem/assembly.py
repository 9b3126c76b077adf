"""Compiled element loops: energy, residual and tangent of the full model.

Two kernels: ``standard`` elements, whose quadrature points stand alone, and ``dilatation``
elements, whose points share one dilatation theta through ``Fbar = (theta / J)^(1/3) F``:

* Q1P0 (Simo, Taylor & Pister 1985): theta is the element's mean of J; the theta-points are the
  Gauss points;
* variational F-bar: theta is det of the element's mean of F, given as one theta-point with the
  mean gradients. (The centroid's gradients, the usual choice, fail the patch test on distorted
  hexahedra: Flanagan & Belytschko 1981.)

Both derive from ``sum_q w_q W(Fbar_q)``, hence symmetric tangents.

``viscous`` loops add what the past does to the stress, to either kind of element: it is isochoric,
so F and Fbar are the same to it.
"""

import numpy as np
from numba import njit

from palpate.shared.mechanics import laws, tissue, viscosity
from palpate.shared.mechanics.tensors import (
    add,
    cofactor,
    combine,
    ddot,
    det,
    dot,
    isochoric,
    load_packed,
    scale,
    store,
    store_packed,
    transposed,
    unit,
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
def standard_residual(conn, grad, weight, law, u, r):
    """Add the internal force of ``u`` to ``r``; return (energy, smallest J).

    conn (e, n) int32; grad (e, q, n, 3) 1/mm; weight (e, q) mm^3; law (e,);
    u, r (3 nodes,) mm and mN.
    """
    energy, smallest = 0.0, np.inf
    for e in range(len(conn)):
        for q in range(weight.shape[1]):
            F = _deformation_gradient(conn[e], grad[e, q], u)
            J, part, P = law.at(e).first_piola(F)
            smallest = min(smallest, J)
            if not J > 0.0:
                return tissue.INVERTED, smallest
            energy += weight[e, q] * law.at(e).energy(J, part)
            _add_point_force(conn[e], grad[e, q], weight[e, q], P, r)
    return energy, smallest


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
def standard_tangent(conn, grad, weight, law, u, slots, data):
    """Add the tangent stiffness at ``u`` to CSR ``data`` (mN/mm); slots (e, 3n, 3n) int32."""
    n = conn.shape[1]
    A, G, C, K = np.empty((9, 9)), np.empty((3, n)), np.empty((9, n)), np.empty((3, 3, n, n))
    for e in range(len(conn)):
        K[:] = 0.0
        for q in range(weight.shape[1]):
            F = _deformation_gradient(conn[e], grad[e, q], u)
            laws.tangent(law.at(e), F, A)
            _add_point_tangent(grad[e, q], A, weight[e, q], G, C, K)
        _scatter(K, slots[e], data)


@njit(cache=True, error_model="numpy")
def _dilatation(conn, theta_grad, theta_weight, u, g):
    """Element dilatation theta = sum c_r J_r and its gradient g = d theta / du (3n,)."""
    theta = 0.0
    g[:] = 0.0
    own = np.arange(len(conn))
    for r in range(len(theta_weight)):
        F = _deformation_gradient(conn, theta_grad[r], u)
        C = cofactor(F)
        theta += theta_weight[r] * det(F, C)
        _add_point_force(own, theta_grad[r], theta_weight[r], C, g)
    return theta


@njit(cache=True, error_model="numpy", nogil=True)
def dilatation_residual(conn, grad, weight, theta_grad, theta_weight, law, u, r):
    """As ``standard_residual`` for elements with one dilatation; theta_grad (e, t, n, 3)."""
    n = conn.shape[1]
    g, f, own = np.empty(3 * n), np.empty(3 * n), np.arange(n)
    energy, smallest = 0.0, np.inf
    for e in range(len(conn)):
        theta = _dilatation(conn[e], theta_grad[e], theta_weight[e], u, g)
        smallest = min(smallest, theta)
        if not theta > 0.0:
            return tissue.INVERTED, smallest
        f[:] = 0.0
        by_theta = 0.0
        for q in range(weight.shape[1]):
            F = _deformation_gradient(conn[e], grad[e, q], u)
            C = cofactor(F)
            J = det(F, C)
            smallest = min(smallest, J)
            if not J > 0.0:
                return tissue.INVERTED, smallest
            alpha, w = (theta / J) ** (1.0 / 3.0), weight[e, q]
            bar, part, P = law.at(e).first_piola(scale(alpha, F))
            energy += w * law.at(e).energy(bar, part)
            p = ddot(P, F) / 3.0
            by_theta += w * alpha * p / theta
            _add_point_force(own, grad[e, q], w * alpha, combine(1.0, P, -p / J, C), f)
        for a in range(n):
            for i in range(3):
                r[3 * conn[e, a] + i] += f[3 * a + i] + by_theta * g[3 * a + i]
    return energy, smallest


@njit(cache=True, error_model="numpy")
def _fixed_dilatation_tangent(law, F, alpha, A):
    """Write the tangent ``psi_FF`` of ``dilatation_tangent`` (9, 9) kPa to ``A``.

    Returns the stress ``P`` at ``alpha F``, its derivative along ``alpha F``, and ``F^-T``.
    """
    Fbar, cofactors = scale(alpha, F), cofactor(F)
    _, _, P = law.first_piola(Fbar)
    state = law.linearise(Fbar)
    T, once = scale(1.0 / det(F, cofactors), cofactors), ddot(P, F)
    for k in range(9):
        H = unit(k)
        third = ddot(T, H) / 3.0
        # of alpha (P - P:F/3 T), with dalpha = -alpha third and dT = -T H^T T
        dP = law.increment(state, scale(alpha, combine(1.0, H, -third, F)))
        along = third * once / 3.0 - (ddot(dP, F) + ddot(P, H)) / 3.0
        D = add(
            combine(1.0, dP, -third, P),
            combine(along, T, once / 3.0, dot(T, dot(transposed(H), T))),
        )
        store(scale(alpha, D), A[k], 0, 1)
    return P, law.increment(state, Fbar), T


@njit(cache=True, error_model="numpy", nogil=True)
def dilatation_tangent(conn, grad, weight, theta_grad, theta_weight, law, u, slots, data):
    """As ``standard_tangent`` for elements with one dilatation.

    With ``psi(F, theta) = W(alpha F)``: K = sum w [B^T psi_FF B + B^T psi_Ft g^T + g psi_tF B +
    psi_tt g g^T] + (sum w psi_t) d2 theta/du2.
    """
    n = conn.shape[1]
    g, mixed, own = np.empty(3 * n), np.empty(3 * n), np.arange(n)
    A, G, C, K = np.empty((9, 9)), np.empty((3, n)), np.empty((9, n)), np.empty((3, 3, n, n))
    for e in range(len(conn)):
        K[:] = 0.0
        theta = _dilatation(conn[e], theta_grad[e], theta_weight[e], u, g)
        by_theta, by_theta2 = 0.0, 0.0
        mixed[:] = 0.0
        for q in range(weight.shape[1]):
            F, w = _deformation_gradient(conn[e], grad[e, q], u), weight[e, q]
            alpha = (theta / det(F, cofactor(F))) ** (1.0 / 3.0)
            P, by_scale, T = _fixed_dilatation_tangent(law.at(e), F, alpha, A)
            _add_point_tangent(grad[e, q], A, w, G, C, K)
            once, twice = ddot(P, F), ddot(by_scale, F)
            by_theta += w * alpha * once / (3.0 * theta)
            by_theta2 += w * alpha * (twice - 2.0 * once) / (9.0 * theta**2)
            both = combine(1.0, add(P, by_scale), -(once + twice) / 3.0, T)
            _add_point_force(own, grad[e, q], w * alpha / (3.0 * theta), both, mixed)
        for r in range(theta_weight.shape[1]):
            F = _deformation_gradient(conn[e], theta_grad[e, r], u)
            cofactors = cofactor(F)
            J = det(F, cofactors)
            T = scale(1.0 / J, cofactors)
            for k in range(9):
                H = unit(k)
                store(combine(ddot(T, H), T, -1.0, dot(T, dot(transposed(H), T))), A[k], 0, 1)
            _add_point_tangent(theta_grad[e, r], A, by_theta * theta_weight[e, r] * J, G, C, K)
        for i in range(3):
            for k in range(i, 3):
                for a in range(n):
                    p, r = 3 * a + i, by_theta2 * g[3 * a + i]
                    for b in range(n):
                        s = 3 * b + k
                        K[i, k, a, b] += mixed[p] * g[s] + g[p] * mixed[s] + r * g[s]
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

    B (e, q, 6), see ``mechanics.viscosity``; else as ``standard_residual``.
    """
    energy = 0.0
    for e in range(len(conn)):
        for q in range(weight.shape[1]):
            F = _deformation_gradient(conn[e], grad[e, q], u)
            J = det(F, cofactor(F))
            modulus = mu[e] * isochoric(J)
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
            viscosity.add_tangent(F, unpacked(load_packed(B[e, q], 0, 1)), mu[e], A)
            _add_point_tangent(grad[e, q], A, weight[e, q], G, C, K)
        _scatter(K, slots[e], data)
