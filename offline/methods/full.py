"""The full model as a method, on the scene's mesh and on others: exact on its mesh, and slow."""

import numpy as np
from scipy.sparse import csr_matrix

from palpate.offline.fem.mesh import Ticks, build_mesh, cells_of, divided, in_order, ticks_of
from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.problem import FullProblem
from palpate.offline.fem.terms import Past
from palpate.offline.methods.method import Answer, Case, Method
from palpate.shared.arrays import Array, Ints
from palpate.shared.geometry.elements import kind_of
from palpate.shared.local_models import Mesh
from palpate.shared.scene import ElementName

SAME = 1e-9  # coordinates in the unit cube that differ by less are equal


class Full(Method):
    """Newton's method on every free degree of freedom, from the last answer."""

    def __init__(self, problem: FullProblem) -> None:
        super().__init__(problem, len(problem.model.free), "full")

    def at_rest(self) -> Past:
        """See ``Method``."""
        return self.problem.model.at_rest

    def step(self, state: Past, case: Case, dt: float = 0.0) -> Answer:
        """See ``Method``."""
        load = case.load(len(state.displacement))
        try:
            found = self.problem.model.solve(load, state, dt)
        except NoEquilibrium:
            return Answer(state, False)
        return Answer(found.past)

    def field(self, state: Past) -> Array:
        """See ``Method``."""
        return state.displacement

    def past(self, state: Past) -> Past:
        """See ``Method``."""
        return state


class Remeshed(Method):
    """Full model of a scene in another mesh, compared at the nodes of the scene's own.

    It finds the nodes that a contact loads by itself; other methods are given them.  The state is
    the displacement (m, 3) mm of the other mesh's nodes, from which ``to_scene`` (n, m)
    interpolates.  The problem's scene comes with its files; the divisions of its mesh are
    multiplied by the factor and rounded up, and its ticks spread alike.
    """

    def __init__(
        self, problem: FullProblem, factor: float, element: ElementName | None = None
    ) -> None:
        own = ticks_of(problem.scene.lattice)
        a, b, c = (int(np.ceil(factor * n - SAME)) for n in cells_of(own))
        ticks = divided(own, (a, b, c))
        geometry = problem.scene.lattice
        divisions = in_order(geometry, (a, b, c))
        geometry = geometry.model_copy(update={"element": element or geometry.element})
        scene = problem.scene.model_copy(update={"geometry": geometry})
        self.cells = a, b, c
        """Of the other mesh along the axes of its lattice."""
        self.other = FullProblem(scene, build_mesh(scene, ticks))
        label = f"mesh of {' x '.join(map(str, divisions))}"
        super().__init__(problem, len(self.other.model.free), label)
        self.to_scene = _interpolation(self.other.mesh, ticks, problem.mesh, own)

    def step(self, state: Array | None, case: Case, dt: float = 0.0) -> Answer:
        """See ``Method``."""
        try:
            found = self.other.model.solve(self.load(case))
        except NoEquilibrium:
            return Answer(state, False)
        return Answer(found.displacement)

    def load(self, case: Case) -> Array:
        """Nodal forces (m, 3) mN on the other mesh, pressed where the scene's own mesh is.

        The accessible surface of the other mesh ends at other faces: projected onto that, a
        contact on the rim would move.
        """
        own = Case.of(self.other, *case.contacts, feet=case.feet, radius=case.radius)
        return own.load(len(self.other.mesh.nodes))

    def field(self, state: Array) -> Array:
        """See ``Method``."""
        return np.asarray(self.to_scene @ state)


def _interpolation(source: Mesh, its_ticks: Ticks, target: Mesh, own: Ticks) -> csr_matrix:
    """Matrix (n, m) that interpolates nodal values of one mesh of a body at another's nodes.

    Both meshes map a lattice of the unit cube onto the body, so that a node of one is found in the
    other by its parameters.
    """
    a, b, c = cells_of(own)
    u, v, w = divided(own, (2 * a, 2 * b, 2 * c))
    corners = np.moveaxis(np.indices((a, b, c)), 0, -1).reshape(-1, 1, 3)
    places = np.empty((len(target.nodes), 3), int)
    places[target.elements] = 2 * corners + (kind_of(target.elements).nodes + 1).astype(int)
    i, j, k = places.T
    first, second, third = its_ticks
    row, along = _within(u[i], first)
    third = np.broadcast_to(third, (len(first), third.shape[-1]))
    share = (1.0 + along[:, None]) / 2.0
    layers = (1.0 - share) * third[row] + share * third[row + 1]
    column, across = _within(v[j], second)
    layer, through = _within(np.broadcast_to(w, (len(u), w.shape[-1]))[i, k], layers)
    local = np.column_stack([along, across, through])
    N, _ = kind_of(source.elements).shape(local)
    N[abs(N) < SAME] = 0.0
    nodes = source.elements[np.ravel_multi_index((row, column, layer), cells_of(its_ticks))]
    rows = np.repeat(np.arange(len(N)), N.shape[1])
    return csr_matrix((N.ravel(), (rows, nodes.ravel())), (len(N), len(source.nodes)))


def _within(at: Array, ticks: Array) -> tuple[Ints, Array]:
    """Cells (n,) that hold parameters (n,), and where in them these lie, from -1 to 1.

    The ticks are (m,), or (n, m) for each parameter its own.
    """
    ticks = np.broadcast_to(ticks, (len(at), ticks.shape[-1]))
    cell = np.sum(ticks[:, 1:-1] <= at[:, None] + SAME, axis=1)
    low, high = (ticks[np.arange(len(at)), cell + end] for end in (0, 1))
    return cell, 2.0 * (at - low) / (high - low) - 1.0
