"""What an elastic half-space does under the footprint of the endoscope, and how that is local.

With the Hankel transform ``P(k) = int p(r) J0(k r) r dr`` of a pressure ``p(r)`` that acts on the
surface of the half-space ``z >= 0``, into it or along ``x``, the displacement times ``2 mu`` is

    into it:  u_r = int P (kz + 2 nu - 1) e J1(kr) dk,   u_z = int P (kz + 2 - 2 nu) e J0(kr) dk
    along x:  u_x = a + b cos 2t,   u_y = b sin 2t,   u_z = c cos t,
              a = int P (2 - nu - kz / 2) e J0(kr) dk,   b = int P (nu + kz / 2) e J2(kr) dk,
              c = int P (1 - 2 nu + kz) e J1(kr) dk

with ``e = exp(-k z)`` and the angle ``t`` from ``x`` (Sneddon, Fourier Transforms, 1951, ch. 10;
Johnson, Contact Mechanics, 1985, ch. 3).  ``u_r / r``, ``u_z``, ``a``, ``b / r^2`` and ``c / r``
are smooth in ``r^2`` and ``z``; tables hold them and their derivatives, in lengths of the
footprint's radius and for a pressure of 1 at its centre.

Of that field only what a mesh cannot follow is wanted.  A footprint ``WIDE`` times as large with
the same force is taken away, after which the rest falls off with the third power of the distance,
and is faded out on the way to ``REACH``.

Hertz's pressure of a sphere, ``P(k) = 4/5 (sin ka - ka cos ka) / (ka)^3`` for the force of such a
footprint, has a field in closed form: with ``s = z - ia`` every integral is the imaginary part of
an ``I_n(s) = int J0(kr) exp(-ks) / k^n dk`` less ``a`` times the real part of the next, and these
are sums of ``log(s + S)`` and ``S = sqrt(r^2 + s^2)`` times polynomials.
"""

import cmath
import math
from functools import lru_cache

import numpy as np
from numba import njit
from scipy.special import jv

from palpate.shared.arrays import Array

WIDE = 2.0
"""Radius of the footprint that is taken away."""

REACH, FADES_FROM = 2.5, 1.0
"""Distance from the contact at which the local field ends, and where it begins to fade."""

DENT_ENDS = 2.0
"""Distance at which a dent, which falls off with the third power, has faded out likewise."""

ABOVE = 1.0
"""Height at which the field ends that goes on above the surface, which is not quite flat."""

CELL = 0.05
"""Step of the tables."""

HIGHEST, WAVES = 80.0, 600
"""Of the integrals: highest wave number, and how many."""

FUNCTIONS = 5


def half_space(poisson: float, at: Array) -> Array:
    """Tables (n, n, FUNCTIONS, 3) at distances ``at`` (n,) from the axis and at such depths.

    Of every function: the value, the derivative in the distance over that, and in the depth.
    """
    x, w = np.polynomial.legendre.leggauss(WAVES)
    k = HIGHEST * (x + 1) / 2
    r, wr = np.polynomial.legendre.leggauss(200)
    r = (r + 1) / 2
    P = HIGHEST * w / 2 * (jv(0, np.outer(k, r)) @ (wr / 2 * r * (1 - r**4) ** 2))
    bessel, kz = [_over(m, k, at) for m in range(4)], np.outer(at, k)
    e = np.exp(-kz)
    table = np.empty((len(at), len(at), FUNCTIONS, 3))
    for n, (alpha, beta, m) in enumerate(_integrands(poisson)):
        value, slope = e * (alpha + beta * kz), e * (beta - alpha - beta * kz)
        table[..., n, 0] = (P * bessel[m]) @ value.T
        table[..., n, 1] = -(P * k * bessel[m + 1]) @ value.T
        table[..., n, 2] = (P * k * bessel[m]) @ slope.T
    return table


def _integrands(poisson: float) -> tuple[tuple[float, float, int], ...]:
    """``alpha``, ``beta`` and ``m`` of the integrals ``int P (alpha + beta kz) e J_m / r^m dk``."""
    return (
        (2 * poisson - 1, 1.0, 1),
        (2 - 2 * poisson, 1.0, 0),
        (2 - poisson, -0.5, 0),
        (poisson, 0.5, 2),
        (1 - 2 * poisson, 1.0, 1),
    )


def _over(m: int, k: Array, r: Array) -> Array:
    """``J_m(kr) / r^m``, (r, k)."""
    kr = np.outer(r, k)
    small = kr < 1e-3
    limit = (1.0, 1 / 2, 1 / 8, 1 / 48)[m]
    return np.asarray(k**m * np.where(small, limit, jv(m, kr) / np.where(small, 1.0, kr) ** m))


@lru_cache(maxsize=4)
def local_field(poisson: float) -> Array:
    """Tables (i, j FUNCTIONS 3) of the local field, from the axis and from ``ABOVE`` the surface.

    Above the surface the field goes on as it is there, and fades.
    """
    at = np.arange(0.0, REACH + CELL / 2, CELL)
    order = np.array([m for *_, m in _integrands(poisson)])
    powers = 1 + order[:, None] + np.array([0, 2, 1])
    field = half_space(poisson, at) - half_space(poisson, at / WIDE) / WIDE**powers
    away = np.hypot(at[:, None], at)
    t = np.clip((away - FADES_FROM) / (REACH - FADES_FROM), 0, 1)
    fade, slope = 1 - t * t * (3 - 2 * t), -6 * t * (1 - t) / (REACH - FADES_FROM)
    slope /= np.maximum(away, CELL)
    field[..., 1] = fade[..., None] * field[..., 1] + slope[..., None] * field[..., 0]
    field[..., 2] = fade[..., None] * field[..., 2] + (slope * at)[..., None] * field[..., 0]
    field[..., 0] *= fade[..., None]
    z = np.arange(-ABOVE, -CELL / 2, CELL)[:, None]
    fade, slope = (1 - z**2) ** 2, -4 * z * (1 - z**2)
    surface = field[:, :1]
    above = surface * fade[..., None]
    above[..., 0] += z * fade * surface[..., 2]
    above[..., 2] += slope * (surface[..., 0] + z * surface[..., 2])
    return np.concatenate([above, field], axis=1).reshape(len(at), -1)


@lru_cache(maxsize=4)
def whole_field(poisson: float) -> Array:
    """Tables like those of ``local_field`` of all of the field, zero above the surface."""
    at = np.arange(0.0, REACH + CELL / 2, CELL)
    above = np.zeros((len(at), round(ABOVE / CELL), FUNCTIONS, 3))
    return np.concatenate([above, half_space(poisson, at)], axis=1).reshape(len(at), -1)


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def _between(one, other, at, p, q, r, s, load):
    """A function and its derivatives, times a load, between four places of the tables."""
    row = 3 * FUNCTIONS
    f = p * one[at] + q * one[at + row] + r * other[at] + s * other[at + row]
    at += 1
    f_r = p * one[at] + q * one[at + row] + r * other[at] + s * other[at + row]
    at += 1
    f_z = p * one[at] + q * one[at + row] + r * other[at] + s * other[at + row]
    return load * f, load * f_r, load * f_z


@njit(cache=True, error_model="numpy", nogil=True)
def pressed(table, x, y, z, into, along, u, H):
    """Write displacement (3,) and gradient (3, 3) at a point of the local field.

    ``into`` and ``along`` are the tractions along ``z`` and ``x``; lengths are in radii,
    displacements in radius times pressure over ``2 mu``.
    """
    a, b = np.sqrt(x * x + y * y) / CELL, (z + ABOVE) / CELL
    i, j = int(a), int(max(b, 0.0))
    if b < 0.0 or i > len(table) - 2 or j > table.shape[1] // (3 * FUNCTIONS) - 2:
        u[:] = 0.0
        H[:] = 0.0
        return
    a, b = a - i, b - j
    p, q, r, s = (1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b
    one, other, base = table[i], table[i + 1], 3 * FUNCTIONS * j
    f, f_r, f_z = _between(one, other, base, p, q, r, s, into)
    g, g_r, g_z = _between(one, other, base + 3, p, q, r, s, into)
    a, a_r, a_z = _between(one, other, base + 6, p, q, r, s, along)
    b, b_r, b_z = _between(one, other, base + 9, p, q, r, s, along)
    c, c_r, c_z = _between(one, other, base + 12, p, q, r, s, along)
    p, q = x * x - y * y, 2.0 * x * y  # r^2 cos 2t, r^2 sin 2t
    u[0] = f * x + a + b * p
    u[1] = f * y + b * q
    u[2] = g + c * x
    H[0, 0] = f + (f_r * x + a_r + b_r * p + 2.0 * b) * x
    H[0, 1] = (f_r * x + a_r + b_r * p - 2.0 * b) * y
    H[0, 2] = f_z * x + a_z + b_z * p
    H[1, 0] = (f_r * x + 2.0 * b) * y + b_r * q * x
    H[1, 1] = f + f_r * y * y + b_r * q * y + 2.0 * b * x
    H[1, 2] = f_z * y + b_z * q
    H[2, 0] = (g_r + c_r * x) * x + c
    H[2, 1] = (g_r + c_r * x) * y
    H[2, 2] = g_z + c_z * x


@njit(cache=True, error_model="numpy", nogil=True)
def dented(a, poisson, x, y, z, u, H):
    """Write displacement (3,) and gradient (3, 3) under Hertz's pressure within a radius ``a``.

    It acts into the half-space with the force of a footprint of pressure 1 at its centre.  Units
    are those of ``pressed``; the point is not above the surface.
    """
    r2, s = x * x + y * y, complex(max(z, 1e-9), -a)
    S = cmath.sqrt(r2 + s * s)
    L, T = cmath.log(s + S), 1.0 / (S * (s + S))
    i2 = s * L - S
    i3 = 0.75 * s * S - (0.5 * s * s - 0.25 * r2) * L
    # derivatives in r over r
    d1, d2, d3 = -T, -S * T, 0.5 * L - (0.5 * s * s - 0.25 * r2) * T + 0.75 * s / S
    d4 = s * (s * s / 6.0 - 0.25 * r2) * T - 0.5 * s * L + 2.0 * S / 9.0
    d4 += (r2 / 9.0 - 11.0 * s * s / 36.0) / S
    p = 0.8 / a**3
    g0, g1 = p * (i3.imag - a * i2.real), p * (i2.imag + a * L.real)
    g2 = -p * (L.imag + a * (1.0 / S).real)
    j0, j1 = -p * (d4.imag - a * d3.real), -p * (d3.imag - a * d2.real)
    j2 = -p * (d2.imag - a * d1.real)
    k, m = 1.0 - 2.0 * poisson, 2.0 - 2.0 * poisson
    f, f_z = z * j1 - k * j0, m * j1 - z * j2
    u[0], u[1], u[2] = f * x, f * y, z * g1 + m * g0
    # of the two in-plane stretches, the one along r less the other, over r^2
    apart = (z * g2 - k * g1 - 2.0 * f) / max(r2, 1e-12)
    H[0, 0], H[1, 1] = f + apart * x * x, f + apart * y * y
    H[0, 1] = H[1, 0] = apart * x * y
    H[0, 2], H[1, 2] = f_z * x, f_z * y
    across = -z * j2 - m * j1
    H[2, 0], H[2, 1], H[2, 2] = across * x, across * y, -k * g1 - z * g2


@njit(cache=True, error_model="numpy", nogil=True)
def dent(whole, a, poisson, x, y, z, into, u, H):
    """Add what Hertz's pressure within ``a`` does more than a footprint of the same force.

    ``whole`` is of ``whole_field``; ``u`` and ``H`` are as in ``pressed``.  Above the surface it is
    as there.
    """
    away, z = math.sqrt(x * x + y * y + z * z), max(z, 0.0)
    if away > DENT_ENDS:
        return
    t = max((away - FADES_FROM) / (DENT_ENDS - FADES_FROM), 0.0)
    fade = 1.0 - t * t * (3.0 - 2.0 * t)
    slope = -6.0 * t * (1.0 - t) / (DENT_ENDS - FADES_FROM) / max(away, CELL)
    one, other, at = np.empty((2, 3)), np.empty((2, 3, 3)), (x, y, z)
    dented(a, poisson, x, y, z, one[0], other[0])
    pressed(whole, x, y, z, 1.0, 0.0, one[1], other[1])
    for i in range(3):
        more = into * (one[0, i] - one[1, i])
        u[i] += fade * more
        for j in range(3):
            H[i, j] += fade * into * (other[0, i, j] - other[1, i, j]) + slope * at[j] * more
