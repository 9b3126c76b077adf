"""Stored energy and dissipation of tissue that remembers, by ``shared.mechanics.viscosity``.

They need one number more than stress does: the means of ``c = tr Cbar / 3``.  Kept as ``c - 1``, it
is the seventh component of a history here, which the recurrence treats like the others.
"""

import numpy as np

from palpate.shared.mechanics import viscosity


def driving(F):
    """``m - I``, packed, and ``c - 1`` (..., 7) of deformation gradients (..., 3, 3)."""
    c = np.linalg.det(F) ** (-2 / 3) * np.sum(F**2, axis=(-1, -2)) / 3
    m = [viscosity.driven(tuple(G)) for G in F.reshape(-1, 9)]
    return np.concatenate([np.reshape(m, (*c.shape, 6)), c[..., None] - 1], axis=-1)


def advance(F, weights, history):
    """Go to the end of a step at deformation gradients (..., 3, 3); history (terms + 1, ..., 7)."""
    viscosity.advance(driving(F).ravel(), weights, history.reshape(len(history), -1))


def past_energy_and_power(F, history, prony, mu):
    """What the past adds to the energy density (kPa), and dissipated power (kPa/s), of points.

    F (..., 3, 3), history (terms + 1, ..., 7), mu kPa.
    """
    C = np.linalg.det(F)[..., None, None] ** (-2 / 3) * np.swapaxes(F, -1, -2) @ F
    energy = power = 0.0
    for (share, tau), term in zip(prony, history[:-1], strict=True):
        H = term[..., [0, 5, 4, 5, 1, 3, 4, 3, 2]].reshape(C.shape)  # less the identity
        excess = np.sum(C * H, axis=(-1, -2)) - 3 * term[..., 6]
        energy = energy + mu * share / 2 * excess
        power = power + (mu * share / (2 * tau) * (excess + np.trace(C, axis1=-2, axis2=-1) - 3))
    return energy, power
