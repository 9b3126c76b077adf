"""The body of a scene in other meshes, whose answers are compared at the nodes of the scene's own.

Every mesh is a lattice mapped onto the same body, so that a node of one is found in another by its
coordinates in the unit cube.  With divisions doubled all nodes of the scene are among the others.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.methods.method import Answer, Case
from palpate.offline.methods.tetrahedra import Divisions, lattice
from palpate.offline.run.workshop import Load, Workshop
from palpate.shared.geometry.elements import hexahedron, shape
from palpate.shared.scene import Scene, divisions_of

Array = NDArray[np.float64]


def divided(scene: Scene, factor: float) -> Scene:
    """A scene with the divisions of its mesh times a factor, rounded up."""
    divisions = tuple(int(np.ceil(factor * n)) for n in divisions_of(scene.geometry))
    geometry = scene.geometry.model_copy(update={"divisions": divisions})
    return scene.model_copy(update={"geometry": geometry})


class Remeshed:
    """Full model of a scene in a mesh of its own, as a method; see ``offline.methods.method``.

    It finds the nodes that a contact loads by itself, which other methods are given.

    Parameters
    ----------
    scene : Scene
        In its own mesh.
    factor : float
        Of the divisions.
    """

    family = "full"

    def __init__(self, scene: Scene, factor: float) -> None:
        other = divided(scene, factor)
        self.workshop = Workshop(other)
        self.unknowns = len(self.workshop.model.free)
        self.label = f"mesh of {' x '.join(map(str, divisions_of(other.geometry)))}"
        own = Workshop(scene)
        self._surface = own.surface
        self._to_scene = interpolation(own, self.workshop)

    def solve(self, case: Case) -> Answer:
        """Solve from rest; the state is the displacement of the mesh's own nodes."""
        load = np.sum([self._load(contact) for contact in case.contacts], axis=0)
        try:
            found = self.workshop.model.solve(load)
        except NoEquilibrium:
            return Answer(np.zeros_like(load), False, False)
        return Answer(found.displacement, True, True, found.iterations)

    def _load(self, contact: Load) -> Array:
        """Nodal forces (m, 3) mN, pressed where the scene's own mesh is.

        Its accessible surface ends at other faces: a contact on the rim would be moved by it.
        """
        x, normal, _ = self._surface.project(contact.position)
        nodal = self.workshop.unit_load_at(x, normal)
        return contact.pressure * nodal[:, None] * contact.direction

    def displacement(self, answer: Answer) -> Array:
        """Displacement (n, 3) mm of the scene's nodes."""
        return np.asarray(self._to_scene @ answer.state)


def interpolation(scene: Workshop, other: Workshop) -> csr_matrix:
    """Matrix (n, m) that interpolates nodal values of another mesh at the nodes of a scene's."""
    cells, local = _located(_coordinates(scene), lattice(other.scene))
    elements = other.mesh.elements[np.ravel_multi_index(tuple(cells.T), lattice(other.scene))]
    N, _ = shape(hexahedron(elements.shape[1]), local)
    rows = np.repeat(np.arange(len(N)), N.shape[1])
    size = len(scene.mesh.nodes), len(other.mesh.nodes)
    return csr_matrix((N.ravel(), (rows, elements.ravel())), size)


def _coordinates(workshop: Workshop) -> Array:
    """Coordinates (n, 3) of the nodes in the unit cube."""
    mesh, divisions = workshop.mesh, lattice(workshop.scene)
    cells = np.moveaxis(np.indices(divisions), 0, -1).reshape(-1, 3)
    at = np.empty_like(mesh.nodes)
    reference = hexahedron(mesh.elements.shape[1])
    at[mesh.elements] = (cells[:, None] + (reference + 1) / 2) / divisions
    return at


def _located(at: Array, divisions: Divisions) -> tuple[NDArray[np.int64], Array]:
    """Cells (q, 3) that hold points (q, 3) of the unit cube, and where in [-1, 1]^3 they do."""
    cells = np.minimum((at * divisions).astype(int), np.array(divisions) - 1)
    return cells, 2.0 * (at * divisions - cells) - 1.0


_kept: dict[float, Remeshed] = {}
"""In a worker process, from one task to the next."""


def refined(workshop: Workshop, scene: Scene, factor: float, load: Load) -> Array:
    """Displacement (n, 3) mm of a scene's nodes in a finer mesh, nan without an equilibrium.

    A task for ``run.workers``, all of one scene.
    """
    if factor not in _kept:
        _kept[factor] = Remeshed(scene, factor)
    finer = _kept[factor]
    answer = finer.solve(Case.of(workshop, load))
    return (
        finer.displacement(answer)
        if answer.converged
        else np.full((len(workshop.mesh.nodes), 3), np.nan)
    )
