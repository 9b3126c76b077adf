"""The full model as a method: exact on its mesh, and slow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.model import FullModel, NoEquilibrium
from palpate.offline.methods.method import Answer, Case

Array = NDArray[np.float64]


class Full:
    """Newton's method on every free dof, in one jump from rest if that converges.

    Parameters
    ----------
    model : FullModel
    """

    family = label = "full"

    def __init__(self, model: FullModel) -> None:
        self.unknowns = len(model.free)
        self._model = model

    def solve(self, case: Case) -> Answer:
        """Solve from rest; the state is the nodal displacement."""
        load = np.zeros((len(self._model.mesh.nodes), 3))
        load[case.nodes] = case.forces
        try:
            found = self._model.solve(load)
        except NoEquilibrium:
            return Answer(np.zeros_like(load), False, False)
        return Answer(found.displacement, True, True, found.iterations)

    def displacement(self, answer: Answer) -> Array:
        """Nodal displacement (n, 3) mm."""
        return np.asarray(answer.state, dtype=float)
