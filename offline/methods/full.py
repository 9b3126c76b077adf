"""The full model as a method, on the scene's mesh and on others: exact on its mesh, and slow."""

import numpy as np
from scipy.sparse import csr_matrix

from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.problem import FullProblem
from palpate.offline.fem.terms import Past
from palpate.offline.methods.method import Answer, Case, Method
from palpate.shared.arrays import Array
from palpate.shared.geometry.elements import hexahedron, shape
from palpate.shared.scene import ElementName, Extrusion, Scene, divisions_of

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
    multiplied by the factor and rounded up.
    """

    def __init__(
        self, problem: FullProblem, factor: float, element: ElementName | None = None
    ) -> None:
        geometry = problem.scene.geometry
        divisions = tuple(int(np.ceil(factor * n - SAME)) for n in divisions_of(geometry))
        changed = {"divisions": divisions, "element": element or geometry.element}
        geometry = geometry.model_copy(update=changed)
        self.other = FullProblem(problem.scene.model_copy(update={"geometry": geometry}))
        label = f"mesh of {' x '.join(map(str, divisions))}"
        super().__init__(problem, len(self.other.model.free), label)
        self.to_scene = _interpolation(self.other, problem)

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


def lattice(scene: Scene) -> tuple[int, int, int]:
    """Hexahedra of a scene along the axes of its mesh's lattice (see ``fem.mesh``)."""
    along, second, third = divisions_of(scene.geometry)
    return (
        (along, third, second) if isinstance(scene.geometry, Extrusion) else (along, second, third)
    )


def _interpolation(source: FullProblem, target: FullProblem) -> csr_matrix:
    """Matrix (n, m) that interpolates nodal values of one mesh of a body at another's nodes.

    Both meshes map a lattice of the unit cube onto the body, so that a node of one is found in the
    other by its coordinates in the cube.
    """
    mesh, elements = target.mesh, source.mesh.elements
    own, divisions = lattice(target.scene), lattice(source.scene)
    corner = np.moveaxis(np.indices(own), 0, -1).reshape(-1, 1, 3)
    at = np.empty_like(mesh.nodes)
    at[mesh.elements] = (corner + (hexahedron(mesh.elements.shape[1]) + 1) / 2) / own
    cell = np.minimum((at * divisions + SAME).astype(int), np.array(divisions) - 1)
    N, _ = shape(hexahedron(elements.shape[1]), 2.0 * (at * divisions - cell) - 1.0)
    N[abs(N) < SAME] = 0.0
    nodes = elements[np.ravel_multi_index(tuple(cell.T), divisions)]
    rows = np.repeat(np.arange(len(at)), N.shape[1])
    return csr_matrix((N.ravel(), (rows, nodes.ravel())), (len(at), len(source.mesh.nodes)))
