"""Linear tetrahedra, and tensor-mass models: bodies whose stiffness trainers keep at points.

Each hexahedron of a mesh is cut into five tetrahedra, alternately one way and the other, so that
they fit together.

Cotin, Delingette & Ayache (The Visual Computer 16, 2000): the force on a point is linear in its own
displacement and in those of the points it shares an edge with, through one 3 x 3 tensor each.  That
is the linear finite element method, organised by points; cutting a tetrahedron out takes a few
additions, which is what trainers want it for.  At rest it answers as its factorised stiffness does.

Limits of the method, whatever its solver: linear tetrahedra are too stiff in bending, the more so
the closer the tissue is to incompressible, and linear elasticity is good for small displacements
only.  The elastic constants are the best that were found; they make up for the former.
"""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix

from palpate.offline.fem.linear_solver import sparse_solver
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.methods.full import Remeshed, lattice
from palpate.offline.methods.method import Answer, Case
from palpate.offline.reduce.sampling import random_points
from palpate.shared.errors import PalpateError
from palpate.shared.local_models import Mesh
from palpate.shared.mechanics.tissue import lame

Array = NDArray[np.float64]
Ints = NDArray[np.integer]

EVEN = ((0, 1, 2, 5), (0, 2, 3, 7), (0, 5, 7, 4), (2, 7, 5, 6), (0, 2, 7, 5))
"""Corners of the five tetrahedra of a hexahedron, by the right-hand rule; the last is central."""
ODD = ((1, 3, 0, 4), (1, 2, 3, 6), (1, 6, 4, 5), (3, 4, 6, 7), (1, 3, 4, 6))
"""The mirror image: its face diagonals are the other ones."""

POISSON = 0.25
"""Poisson's ratio with which linear tetrahedra come nearest to nearly incompressible tissue, and
that of every network of springs."""

LOADS = 24  # small loads by which a body's stiffness is fitted


def cut(mesh: Mesh, mirrored: NDArray[np.bool_]) -> Ints:
    """Tetrahedra (5 c, 4) of a mesh of hex8 elements, those that are mirrored (c,) cut as ``ODD``.

    Raises
    ------
    PalpateError
        If one is inside out or flat.
    """
    local = np.where(mirrored[:, None, None], np.array(ODD), np.array(EVEN))
    elements = np.take_along_axis(mesh.elements, local.reshape(len(mirrored), -1), axis=1)
    elements = elements.reshape(-1, 4)
    if not np.linalg.det(np.diff(mesh.nodes[elements], axis=1)).min() > 0.0:
        raise PalpateError("divisions: tetrahedra of this mesh are inside out or flat")
    return elements


def gradients(nodes: Array, elements: Ints) -> tuple[Array, Array]:
    """Gradients (t, 4, 3) 1/mm of the linear shape functions, and signed volumes (t,) mm^3."""
    corners = nodes[elements]
    edges = corners[:, 1:] - corners[:, :1]
    others = np.swapaxes(np.linalg.inv(edges), 1, 2)
    first = -others.sum(axis=1, keepdims=True)
    return np.concatenate([first, others], axis=1), np.linalg.det(edges) / 6.0


def stiffness(nodes: Array, elements: Ints, young: float, poisson: float) -> csr_matrix:
    """Stiffness matrix (3 m, 3 m) mN/mm of linear elastic tetrahedra.

    A pair of nodes has ``V (lambda g_a g_b^T + mu g_b g_a^T + mu (g_a . g_b) I)``, summed over the
    tetrahedra, with the gradients ``g_a`` of shape functions.
    """
    mu, lam = lame(young, poisson)
    g, volume = gradients(nodes, elements)
    outer = np.einsum("t,tai,tbj->taibj", volume, g, g)
    blocks = lam * outer + mu * outer.transpose(0, 1, 4, 3, 2)
    blocks += mu * np.einsum("taibi,kl->takbl", outer, np.eye(3))
    dofs = (3 * elements[:, :, None] + np.arange(3)).reshape(len(elements), 12)
    rows, columns = np.repeat(dofs, 12, axis=1).ravel(), np.tile(dofs, (1, 12)).ravel()
    return coo_matrix((blocks.ravel(), (rows, columns)), (nodes.size, nodes.size)).tocsr()


class Fitted(Remeshed):
    """A body at the corners of another mesh that gets the full model's answer to small loads.

    It is stiffer than its own constants say by ``factor``.
    """

    factor = 1.0

    def __init__(self, problem: FullProblem, factor: float) -> None:
        super().__init__(problem, factor, "hex8")

    @abstractmethod
    def linear(self, load: Array) -> Array:
        """Displacement (free dofs,) mm under small forces (free dofs,) mN, without the factor."""

    def load(self, case: Case) -> Array:
        """See ``Remeshed``: a stiffer body answers a load as a softer one does less of it."""
        return super().load(case) / self.factor

    def fit(self) -> None:
        """Set the factor with which differences to the full model under loads all over are least.

        The sum of their squares is over loads and nodes.
        """
        model, other = self.problem.model, self.other.model
        rng = np.random.default_rng(self.problem.scene.seed)
        both, square = 0.0, 0.0
        for point in random_points(self.problem.surface, LOADS, rng):
            x, normal, _ = self.problem.surface.project(point)
            case = Case.of(self.problem, Load(x, -normal, 1.0))
            wanted = model.solve_linear(case.load(len(self.problem.mesh.nodes)).ravel()[model.free])
            own = other.filled(self.linear(self.load(case).ravel()[other.free]))
            found = self.field(own.reshape(-1, 3)).ravel()
            both += float(found @ model.filled(wanted))
            square += float(found @ found)
        self.factor = square / both


class TensorMass(Fitted):
    """Tensor-mass model of a scene's body, five tetrahedra to a cell of the other mesh."""

    def __init__(self, problem: FullProblem, factor: float) -> None:
        super().__init__(problem, factor)
        mesh, free = self.other.mesh, self.other.model.free
        elements = cut(mesh, np.indices(lattice(self.other.scene)).sum(axis=0).ravel() % 2 == 1)
        self.label = f"linear, {len(elements)} tetrahedra"
        K = stiffness(mesh.nodes, elements, problem.scene.tissue.young, POISSON)[free][:, free]
        self._solver = sparse_solver(K)
        self._solver.factorise(K.data)
        self.fit()

    def linear(self, load: Array) -> Array:
        """See ``Fitted``."""
        return self._solver.solve(load)

    def step(self, state: Array | None, case: Case, dt: float = 0.0) -> Answer:
        """See ``Method``."""
        model = self.other.model
        return Answer(model.filled(self.linear(self.load(case).ravel()[model.free])).reshape(-1, 3))
