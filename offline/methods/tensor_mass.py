"""Tensor-mass models: linear tetrahedra whose stiffness is kept as tensors at points and edges.

Cotin, Delingette & Ayache (The Visual Computer 16, 2000): the force on a point is linear in its own
displacement and in those of the points it shares an edge with, through one 3 x 3 tensor each.  That
is the linear finite element method (``tetrahedra.stiffness``), organised by points; cutting a
tetrahedron out takes a few additions, which is what trainers want it for.

Limits of the method, whatever its solver: linear tetrahedra are too stiff in bending, the more so
the closer the tissue is to incompressible, and linear elasticity is good for small displacements
only.  The elastic constants are the best that were found: they compensate for the stiffness of the
elements.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.problem import FullProblem
from palpate.offline.methods.lattice import Divisions
from palpate.offline.methods.relaxation import Relaxed
from palpate.offline.methods.tetrahedra import Tetrahedra, stiffness

Array = NDArray[np.float64]

POISSON = 0.25
"""Poisson's ratio with which linear tetrahedra come nearest to nearly incompressible tissue."""


class TensorMass(Relaxed):
    """Tensor-mass model of a scene's body; small loads get the full model's answer in the mean.

    Parameters
    ----------
    divisions : tuple of 3 int
        Cells along the axes of the scene's lattice, five tetrahedra each; see
        ``offline.methods.lattice``.

    Attributes
    ----------
    factor : float
        By which the tensors are more than those of the scene's Young's modulus and ``POISSON``.
    """

    forcing = 1e-4  # single precision reaches no less

    def __init__(self, problem: FullProblem, divisions: Divisions) -> None:
        mesh = Tetrahedra.of(problem, divisions)
        label = f"linear, {len(mesh.elements)} tetrahedra"
        super().__init__(problem, mesh, mesh.elements, label)
        K = stiffness(mesh.nodes, mesh.elements, problem.scene.tissue.young, POISSON)
        blocks = K.tobsr((3, 3))
        a, b = np.repeat(np.arange(len(mesh.nodes)), np.diff(blocks.indptr)), blocks.indices
        rank = self.stencil.ranks(np.stack([a, b], axis=1))
        kept = rank >= 0
        self.stencil.tensors[rank[kept], :, a[kept]] = blocks.data[kept].reshape(-1, 9)
        self.stencil.prepare()
        self.factor = self.stiffening()
        self.stencil.tensors *= np.float32(self.factor)
        self.stencil.prepare()

    def internal(self, displacement: Array, force: Array) -> float:
        """See ``Relaxed``."""
        return self.stencil.apply(displacement, force)

    def linearise(self, displacement: Array) -> None:
        """Nothing to do: the tangent is the same everywhere."""
