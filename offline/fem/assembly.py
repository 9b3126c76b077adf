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

from palpate.shared.mechanics import tissue, viscosity


@njit(cache=True, error_model="numpy")
def _deformation_gradient(conn, grad, u, F):
    F[:] = 0.0
    F[0] = F[4] = F[8] = 1.0
    for a in range(len(conn)):
        for i in range(3):
            ui = u[3 * conn[a] + i]
            for j in range(3):
                F[3 * i + j] += ui * grad[a, j]


@njit(cache=True, error_model="numpy", nogil=True)
def standard_residual(conn, grad, weight, mu, lam, u, r):
    """Add the internal force of ``u`` to ``r``; return (energy, smallest J).

    conn (e, n) int32; grad (e, q, n, 3) 1/mm; weight (e, q) mm^3; mu, lam (e,) kPa;
    u, r (3 nodes,) mm and mN.
    """
    F, P = np.empty(9), np.empty(9)
    energy, smallest = 0.0, np.inf
    for e in range(len(conn)):
        for q in range(weight.shape[1]):
            _deformation_gradient(conn[e], grad[e, q], u, F)
            W, J = tissue.stress(F, mu[e], lam[e], P)
            smallest = min(smallest, J)
            if not J > 0.0:
                return tissue.INVERTED, smallest
            w = weight[e, q]
            energy += w * W
            for a in range(conn.shape[1]):
                for i in range(3):
                    f = 0.0
                    for j in range(3):
                        f += P[3 * i + j] * grad[e, q, a, j]
                    r[3 * conn[e, a] + i] += w * f
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
def standard_tangent(conn, grad, weight, mu, lam, u, slots, data):
    """Add the tangent stiffness at ``u`` to CSR ``data`` (mN/mm); slots (e, 3n, 3n) int32."""
    n = conn.shape[1]
    F, Finv, A = np.empty(9), np.empty(9), np.empty((9, 9))
    G, C, K = np.empty((3, n)), np.empty((9, n)), np.empty((3, 3, n, n))
    for e in range(len(conn)):
        K[:] = 0.0
        for q in range(weight.shape[1]):
            _deformation_gradient(conn[e], grad[e, q], u, F)
            tissue.tangent(F, mu[e], lam[e], Finv, A)
            _add_point_tangent(grad[e, q], A, weight[e, q], G, C, K)
        _scatter(K, slots[e], data)


@njit(cache=True, error_model="numpy")
def _dilatation(conn, theta_grad, theta_weight, u, g):
    """Element dilatation theta = sum c_r J_r and its gradient g = d theta / du (3n,)."""
    F, Finv = np.empty(9), np.empty(9)
    theta = 0.0
    g[:] = 0.0
    for r in range(len(theta_weight)):
        _deformation_gradient(conn, theta_grad[r], u, F)
        J = tissue.inverse_and_jacobian(F, Finv)
        theta += theta_weight[r] * J
        for a in range(len(conn)):
            for i in range(3):
                for j in range(3):
                    g[3 * a + i] += theta_weight[r] * J * Finv[3 * j + i] * theta_grad[r, a, j]
    return theta


@njit(cache=True, error_model="numpy", nogil=True)
def dilatation_residual(conn, grad, weight, theta_grad, theta_weight, mu, lam, u, r):
    """As ``standard_residual`` for elements with one dilatation; theta_grad (e, t, n, 3)."""
    n = conn.shape[1]
    F, Finv, P, g, f = np.empty(9), np.empty(9), np.empty(9), np.empty(3 * n), np.empty(3 * n)
    Fbar = np.empty(9)
    energy, smallest = 0.0, np.inf
    for e in range(len(conn)):
        theta = _dilatation(conn[e], theta_grad[e], theta_weight[e], u, g)
        smallest = min(smallest, theta)
        if not theta > 0.0:
            return tissue.INVERTED, smallest
        f[:] = 0.0
        by_theta = 0.0
        for q in range(weight.shape[1]):
            _deformation_gradient(conn[e], grad[e, q], u, F)
            J = tissue.inverse_and_jacobian(F, Finv)
            smallest = min(smallest, J)
            if not J > 0.0:
                return tissue.INVERTED, smallest
            alpha = (theta / J) ** (1.0 / 3.0)
            for i in range(9):
                Fbar[i] = alpha * F[i]
            W, _ = tissue.stress(Fbar, mu[e], lam[e], P)
            w = weight[e, q]
            energy += w * W
            p = 0.0  # P : F / 3
            for i in range(9):
                p += P[i] * F[i] / 3.0
            by_theta += w * alpha * p / theta
            for i in range(3):
                for j in range(3):
                    stress = w * alpha * (P[3 * i + j] - p * Finv[3 * j + i])
                    for a in range(n):
                        f[3 * a + i] += stress * grad[e, q, a, j]
        for a in range(n):
            for i in range(3):
                r[3 * conn[e, a] + i] += f[3 * a + i] + by_theta * g[3 * a + i]
    return energy, smallest


@njit(cache=True, error_model="numpy", nogil=True)
def dilatation_tangent(conn, grad, weight, theta_grad, theta_weight, mu, lam, u, slots, data):
    """As ``standard_tangent`` for elements with one dilatation.

    With ``psi(F, theta) = W(alpha F)``: K = sum w [B^T psi_FF B + B^T psi_Ft g^T + g psi_tF B +
    psi_tt g g^T] + (sum w psi_t) d2 theta/du2.
    """
    n = conn.shape[1]
    F, Finv, P, Fbar = np.empty(9), np.empty(9), np.empty(9), np.empty(9)
    A, H = np.empty((9, 9)), np.empty((9, 9))
    AF, mixed, g, Bm = np.empty(9), np.empty(9), np.empty(3 * n), np.empty(3 * n)
    G, C, K = np.empty((3, n)), np.empty((9, n)), np.empty((3, 3, n, n))
    for e in range(len(conn)):
        K[:] = 0.0
        theta = _dilatation(conn[e], theta_grad[e], theta_weight[e], u, g)
        by_theta, by_theta2 = 0.0, 0.0
        Bm[:] = 0.0
        for q in range(weight.shape[1]):
            _deformation_gradient(conn[e], grad[e, q], u, F)
            J = tissue.inverse_and_jacobian(F, Finv)
            alpha = (theta / J) ** (1.0 / 3.0)
            for i in range(9):
                Fbar[i] = alpha * F[i]
            tissue.stress(Fbar, mu[e], lam[e], P)
            tissue.tangent(Fbar, mu[e], lam[e], Finv, A)
            for i in range(9):
                Finv[i] *= alpha  # back to F^-1
            w = weight[e, q]
            PF, FAF = 0.0, 0.0
            for i in range(9):
                AF[i] = 0.0
                for j in range(9):
                    AF[i] += A[i, j] * F[j]
            for i in range(9):
                PF += P[i] * F[i]
                FAF += F[i] * AF[i]
            # dFbar = alpha dF + alpha/3 (dtheta/theta - L) F,  L = F^-T : dF
            a2 = alpha * alpha
            for i in range(9):
                li = Finv[3 * (i % 3) + i // 3]
                mixed[i] = (
                    a2 / 3.0 * (AF[i] - FAF / 3.0 * li) + alpha / 3.0 * (P[i] - PF / 3.0 * li)
                ) / theta
                for j in range(9):
                    lj = Finv[3 * (j % 3) + j // 3]
                    swap = Finv[3 * (i % 3) + j // 3] * Finv[3 * (j % 3) + i // 3]
                    H[i, j] = (
                        a2 * (A[i, j] - (AF[i] * lj + li * AF[j]) / 3.0 + FAF / 9.0 * li * lj)
                        - alpha / 3.0 * (P[i] * lj + li * P[j])
                        + alpha * PF * (li * lj / 9.0 + swap / 3.0)
                    )
            _add_point_tangent(grad[e, q], H, w, G, C, K)
            by_theta += w * alpha * PF / (3.0 * theta)
            by_theta2 += w * (a2 * FAF / 9.0 + alpha * PF * (1.0 / 9.0 - 1.0 / 3.0)) / theta**2
            for a in range(n):
                for i in range(3):
                    for j in range(3):
                        Bm[3 * a + i] += w * mixed[3 * i + j] * grad[e, q, a, j]
        for r in range(theta_weight.shape[1]):
            _deformation_gradient(conn[e], theta_grad[e, r], u, F)
            J = tissue.inverse_and_jacobian(F, Finv)
            for i in range(9):
                for j in range(9):
                    H[i, j] = (
                        Finv[3 * (i % 3) + i // 3] * Finv[3 * (j % 3) + j // 3]
                        - Finv[3 * (i % 3) + j // 3] * Finv[3 * (j % 3) + i // 3]
                    )
            _add_point_tangent(theta_grad[e, r], H, by_theta * theta_weight[e, r] * J, G, C, K)
        for i in range(3):
            for k in range(i, 3):
                for a in range(n):
                    p, r = 3 * a + i, by_theta2 * g[3 * a + i]
                    for b in range(n):
                        s = 3 * b + k
                        K[i, k, a, b] += Bm[p] * g[s] + g[p] * Bm[s] + r * g[s]
        _scatter(K, slots[e], data)


@njit(cache=True, error_model="numpy", nogil=True)
def predict(history, weights, B):
    """``viscosity.predict`` at every point: history (e, q, terms + 1, 7), B (e, q, 7)."""
    for e in range(len(B)):
        for q in range(B.shape[1]):
            viscosity.predict(history[e, q], weights, B[e, q])


@njit(cache=True, error_model="numpy", nogil=True)
def advance(conn, grad, u, weights, history):
    """``viscosity.advance`` to the displacement ``u`` at every point, in place."""
    F, Finv, m = np.empty(9), np.empty(9), np.empty(viscosity.COMPONENTS)
    for e in range(len(conn)):
        for q in range(grad.shape[1]):
            _deformation_gradient(conn[e], grad[e, q], u, F)
            viscosity.driving(F, Finv, m)
            viscosity.advance(history[e, q], m, weights)


@njit(cache=True, error_model="numpy", nogil=True)
def viscous_residual(conn, grad, weight, mu, B, u, r):
    """Add the force of the past at ``u``, where nothing is inverted, to ``r``; return its energy.

    B (e, q, 7), see ``mechanics.viscosity``; else as ``standard_residual``.
    """
    F, Finv, P = np.empty(9), np.empty(9), np.empty(9)
    energy = 0.0
    for e in range(len(conn)):
        for q in range(weight.shape[1]):
            _deformation_gradient(conn[e], grad[e, q], u, F)
            J = tissue.inverse_and_jacobian(F, Finv)
            P[:] = 0.0
            w = weight[e, q]
            energy += w * viscosity.add_stress(F, B[e, q], mu[e], J, P)
            for a in range(conn.shape[1]):
                for i in range(3):
                    f = 0.0
                    for j in range(3):
                        f += P[3 * i + j] * grad[e, q, a, j]
                    r[3 * conn[e, a] + i] += w * f
    return energy


@njit(cache=True, error_model="numpy", nogil=True)
def viscous_tangent(conn, grad, weight, mu, B, u, slots, data):
    """Add the tangent of ``viscous_residual`` to CSR ``data`` (mN/mm)."""
    n = conn.shape[1]
    F, Finv, FB, A = np.empty(9), np.empty(9), np.empty(9), np.empty((9, 9))
    G, C, K = np.empty((3, n)), np.empty((9, n)), np.empty((3, 3, n, n))
    for e in range(len(conn)):
        K[:] = 0.0
        for q in range(weight.shape[1]):
            _deformation_gradient(conn[e], grad[e, q], u, F)
            A[:] = 0.0
            viscosity.add_tangent(F, B[e, q], mu[e], Finv, FB, A)
            _add_point_tangent(grad[e, q], A, weight[e, q], G, C, K)
        _scatter(K, slots[e], data)


@njit(cache=True, error_model="numpy", nogil=True)
def dissipated_power(conn, grad, weight, mu, u, history, weights, tau):
    """Integral (mN mm/s) of ``viscosity.dissipation``; history (e, q, terms + 1, 7)."""
    F = np.empty(9)
    power = 0.0
    for e in range(len(conn)):
        for q in range(weight.shape[1]):
            _deformation_gradient(conn[e], grad[e, q], u, F)
            power += weight[e, q] * viscosity.dissipation(F, history[e, q], weights, tau, mu[e])
    return power
