"""Laws at a point, in terms of NumPy; every law with the constants of a scene that comes along."""

import numpy as np

from palpate.offline.scenes import find_scene, shipped_scenes
from palpate.shared.mechanics import laws

TISSUES = {tissue.law: tissue for tissue in (find_scene(name).tissue for name in shipped_scenes())}


def law_of(name):
    """Parameters of a law, numbers."""
    return laws.law_of(TISSUES[name], np.zeros(1, np.int32)).at(0)


def stress(law, F):
    """Energy density and stress (3, 3) of a deformation gradient (3, 3)."""
    J, part, P = law.first_piola(tuple(F.ravel()))
    return law.energy(J, part), np.reshape(P, (3, 3))


def tangent(law, F):
    """Material tangent (9, 9)."""
    A = np.empty((9, 9))
    laws.tangent(law, tuple(F.ravel()), A)
    return A


def deformation(rng, size=0.4, least=0.2):
    """Deformation gradient of a size in each component, det F at least so large."""
    while True:
        F = np.eye(3) + rng.uniform(-size, size, (3, 3))
        if np.linalg.det(F) > least:
            return F


def rotation(rng):
    """Rotation (3, 3) at random."""
    Q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    return Q * np.linalg.det(Q)


def central_difference(function, at, step=1e-3):
    """Derivative of ``function`` with respect to the entries of ``at``, last axis."""
    columns = []
    for i in range(at.size):
        shift = np.zeros(at.size)
        shift[i] = step
        shift = shift.reshape(at.shape)
        # Fourth order, so that the truncation error is far below the 1e-7 asked for.
        near = function(at + shift) - function(at - shift)
        far = function(at + 2 * shift) - function(at - 2 * shift)
        columns.append((8 * near - far) / (12 * step))
    return np.stack(columns, axis=-1)
