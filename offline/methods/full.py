"""The full model as a method, on the scene's mesh and on others: exact on its mesh, and slow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.fem.terms import Past
from palpate.offline.methods.lattice import coordinates, interpolation, lattice
from palpate.offline.methods.method import Answer, Case, Method
from palpate.shared.scene import Scene, divisions_of

Array = NDArray[np.float64]


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
        return Answer(found.past, True, found.iterations)

    def field(self, state: Past) -> Array:
        """See ``Method``."""
        return state.displacement

    def von_mises(self, state: Past) -> Array:
        """See ``Method``."""
        return self.problem.von_mises(state.displacement, state)


def divided(scene: Scene, factor: float) -> Scene:
    """A scene with the divisions of its mesh times a factor, rounded up."""
    divisions = tuple(int(np.ceil(factor * n)) for n in divisions_of(scene.geometry))
    geometry = scene.geometry.model_copy(update={"divisions": divisions})
    return scene.model_copy(update={"geometry": geometry})


class Remeshed(Method):
    """Full model of a scene in another mesh, compared at the nodes of the scene's own.

    It finds the nodes that a contact loads by itself; other methods are given them.  The state is
    the displacement of the other mesh's nodes.

    Parameters
    ----------
    scene : Scene
        With its own mesh.
    factor : float
        By which the divisions of the mesh are multiplied.
    """

    def __init__(self, scene: Scene, factor: float) -> None:
        other = divided(scene, factor)
        self._other = FullProblem(other)
        label = f"mesh of {' x '.join(map(str, divisions_of(other.geometry)))}"
        super().__init__(FullProblem(scene), len(self._other.model.free), label)
        at = coordinates(self.problem.mesh, lattice(scene))
        self._to_scene = interpolation(at, lattice(other), self._other.mesh.elements)

    def step(self, state: Array | None, case: Case, dt: float = 0.0) -> Answer:
        """See ``Method``."""
        load = np.sum([self._load(contact) for contact in case.contacts], axis=0)
        try:
            found = self._other.model.solve(load)
        except NoEquilibrium:
            return Answer(state, False)
        return Answer(found.displacement, True, found.iterations)

    def _load(self, contact: Load) -> Array:
        """Nodal forces (m, 3) mN on the other mesh, pressed where the scene's own mesh is.

        The accessible surface of the other mesh ends at other faces: projected onto that, a
        contact on the rim would move.
        """
        x, normal, _ = self.problem.surface.project(contact.position)
        nodal = self._other.unit_load_at(x, normal)
        return contact.pressure * nodal[:, None] * contact.direction

    def field(self, state: Array) -> Array:
        """See ``Method``."""
        return np.asarray(self._to_scene @ state)
