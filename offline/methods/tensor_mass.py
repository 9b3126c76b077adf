"""Tensor-mass models: linear tetrahedra whose stiffness is kept as tensors at points and edges.

Cotin, Delingette & Ayache (The Visual Computer 16, 2000): the force on a point is linear in its own
displacement and in those of the points it shares an edge with, through one 3 x 3 tensor each,

    K_ab = sum over tetrahedra of V (lambda g_a g_b^T + mu g_b g_a^T + mu (g_a . g_b) I),

``g_a`` the gradients of the shape functions.  That is the linear finite element method, organised
by points; cutting a tetrahedron out takes a few additions, which is what trainers want it for.
``LinearTetrahedra`` are those; ``NonlinearTetrahedra`` follow the St. Venant-Kirchhoff law, with
which Picinbono, Delingette & Ayache (Graphical Models 65, 2003) carried the idea to large
displacements.

Limits of the method, whatever its solver: linear tetrahedra are too stiff in bending, the more so
the closer the tissue is to incompressible; linear elasticity is good for small displacements only,
and St. Venant-Kirchhoff tissue collapses under compression.  The default elastic constants are the
best that were found: they compensate for the stiffness of the elements.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from palpate.offline.methods.calibration import stiffening
from palpate.offline.methods.lattice import Divisions, Ints
from palpate.offline.methods.relaxation import TOLERANCE, Relaxed, Stencil
from palpate.offline.methods.tetrahedra import Tetrahedra, edges_of, gradients
from palpate.offline.run.workshop import Workshop
from palpate.shared.mechanics.tissue import lame

Array = NDArray[np.float64]
Law = Literal["linear", "st-venant-kirchhoff"]

POISSON = 0.25
"""Poisson's ratio with which linear tetrahedra come nearest to nearly incompressible tissue."""

LINEAR_FORCING, FORCING = 1e-4, 0.1
"""See ``offline.methods.relaxation.Elastic``; single precision reaches no less than 1e-4."""


class TensorMass(Relaxed):
    """Tensor-mass model of a scene's body.

    Parameters
    ----------
    workshop : Workshop
    divisions : tuple of 3 int
        Cells along the axes of the scene's lattice, five tetrahedra each; see
        ``offline.methods.lattice``.
    law : {"linear", "st-venant-kirchhoff"}
    poisson : float
    young : float, optional
        kPa; if absent, such that small loads get the full model's answer in the mean.
    tolerance : float
        Residual of an answer relative to its load.
    """

    def __init__(
        self,
        workshop: Workshop,
        divisions: Divisions,
        law: Law = "linear",
        poisson: float = POISSON,
        young: float | None = None,
        tolerance: float = TOLERANCE,
    ) -> None:
        mesh = Tetrahedra.of(workshop, divisions)
        if young is None:
            trial = LinearTetrahedra(mesh, workshop.scene.tissue.young, poisson)
            young = workshop.scene.tissue.young * stiffening(workshop, mesh, trial)
        kind = LinearTetrahedra if law == "linear" else NonlinearTetrahedra
        label = f"{law}, {len(mesh.elements)} tetrahedra"
        super().__init__(workshop, mesh, kind(mesh, young, poisson), label, tolerance)


class LinearTetrahedra:
    """Linear elasticity of a tetrahedral mesh, as tensors at points and edges.

    Parameters
    ----------
    mesh : Tetrahedra
    young, poisson : float
        kPa and 1.
    """

    forcing = LINEAR_FORCING

    def __init__(self, mesh: Tetrahedra, young: float, poisson: float) -> None:
        body = NonlinearTetrahedra(mesh, young, poisson)
        body.linearise(np.zeros((3, len(mesh.nodes))))
        self.stencil = body.stencil

    def internal(self, displacement: Array, force: Array) -> float:
        """Internal force; see ``offline.methods.relaxation.Elastic``."""
        return self.stencil.apply(displacement, force)

    def linearise(self, displacement: Array) -> None:
        """Nothing to do: the tangent is the same everywhere."""


class NonlinearTetrahedra:
    """St. Venant-Kirchhoff elasticity of a tetrahedral mesh.

    With ``F = I + sum u_a g_a^T`` and ``E = (F^T F - I) / 2``, per volume: energy
    ``lambda/2 (tr E)^2 + mu E : E`` and stress ``P = F (lambda tr E I + 2 mu E)``.

    Parameters
    ----------
    mesh : Tetrahedra
    young, poisson : float
        kPa and 1.
    """

    forcing = FORCING

    def __init__(self, mesh: Tetrahedra, young: float, poisson: float) -> None:
        self.stencil = Stencil(edges_of(mesh.elements), len(mesh.nodes), mesh.free)
        self._elements = mesh.elements.astype(np.int32)
        self._gradients, self._volumes = gradients(mesh.nodes, mesh.elements)
        self._lame = lame(young, poisson)
        self._ranks = _ranks(self.stencil, mesh.elements)

    def internal(self, displacement: Array, force: Array) -> float:
        """Internal force; see ``offline.methods.relaxation.Elastic``."""
        force[:] = 0.0
        return _internal(
            self._elements, self._gradients, self._volumes, *self._lame, displacement, force
        )

    def linearise(self, displacement: Array) -> None:
        """Tangent; see ``offline.methods.relaxation.Elastic``."""
        tensors = self.stencil.tensors
        tensors[:] = 0.0
        mesh = self._elements, self._gradients, self._volumes
        _tangent(*mesh, *self._lame, displacement, self._ranks, tensors)
        self.stencil.prepare()


def _ranks(stencil: Stencil, elements: Ints) -> NDArray[np.int32]:
    """Rows of the stencil (t, 4, 4) that the pairs of an element's nodes belong to."""
    first, second = np.repeat(elements, 4, axis=1), np.tile(elements, (1, 4))
    pairs = np.stack([first, second], axis=-1).reshape(-1, 2)
    return stencil.ranks(pairs).reshape(-1, 4, 4)


@njit(cache=True, nogil=True, error_model="numpy")
def _strain(element, gradient, u, F, E):
    """Write deformation gradient and Green strain (3, 3); return the trace of the latter."""
    for i in range(3):
        for j in range(3):
            total = 1.0 if i == j else 0.0
            for a in range(4):
                total += u[i, element[a]] * gradient[a, j]
            F[i, j] = total
    for i in range(3):
        for j in range(3):
            total = F[0, i] * F[0, j] + F[1, i] * F[1, j] + F[2, i] * F[2, j]
            E[i, j] = 0.5 * (total - 1.0) if i == j else 0.5 * total
    return E[0, 0] + E[1, 1] + E[2, 2]


@njit(cache=True, nogil=True, error_model="numpy")
def _internal(elements, gradients, volumes, mu, lam, u, force):
    """Add the internal force of ``u`` (3, m) to ``force`` (3, m); return the energy."""
    F, E, P = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    energy = 0.0
    for e in range(len(elements)):
        element, gradient, volume = elements[e], gradients[e], volumes[e]
        trace = _strain(element, gradient, u, F, E)
        square = 0.0
        for i in range(3):
            for j in range(3):
                square += E[i, j] * E[i, j]
        energy += volume * (0.5 * lam * trace * trace + mu * square)
        for i in range(3):
            for j in range(3):
                total = lam * trace * F[i, j]
                for k in range(3):
                    total += 2.0 * mu * F[i, k] * E[k, j]
                P[i, j] = volume * total
        for a in range(4):
            for i in range(3):
                for j in range(3):
                    force[i, element[a]] += P[i, j] * gradient[a, j]
    return energy


@njit(cache=True, nogil=True, error_model="numpy")
def _tangent(elements, gradients, volumes, mu, lam, u, ranks, tensors):
    """Add the tangent at ``u`` (3, m) to a stencil's tensors; ranks (t, 4, 4) as in ``_ranks``.

    With ``h_a = F g_a`` and ``S = lambda tr E I + 2 mu E``, a pair of nodes has the tensor
    ``V (lambda h_a h_b^T + mu h_b h_a^T + mu (g_a . g_b) F F^T + (g_a . S g_b) I)``.
    """
    F, E, h = np.empty((3, 3)), np.empty((3, 3)), np.empty((4, 3))
    for e in range(len(elements)):
        element, gradient, volume = elements[e], gradients[e], volumes[e]
        trace = _strain(element, gradient, u, F, E)
        for a in range(4):
            for i in range(3):
                h[a, i] = (
                    F[i, 0] * gradient[a, 0] + F[i, 1] * gradient[a, 1] + F[i, 2] * gradient[a, 2]
                )
        for a in range(4):
            for b in range(4):
                rank = ranks[e, a, b]
                if rank < 0:
                    continue
                both, stressed = 0.0, 0.0
                for i in range(3):
                    both += gradient[a, i] * gradient[b, i]
                    for j in range(3):
                        stressed += 2.0 * mu * gradient[a, i] * E[i, j] * gradient[b, j]
                stressed += lam * trace * both
                for i in range(3):
                    for j in range(3):
                        stretch = F[i, 0] * F[j, 0] + F[i, 1] * F[j, 1] + F[i, 2] * F[j, 2]
                        value = lam * h[a, i] * h[b, j] + mu * (h[b, i] * h[a, j] + both * stretch)
                        if i == j:
                            value += stressed
                        tensors[rank, 3 * i + j, element[a]] += volume * value
