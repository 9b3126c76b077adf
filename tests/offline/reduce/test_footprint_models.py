"""One local model: what its modes are made for."""

from dataclasses import replace

import numpy as np

from palpate.offline.reduce.footprint_models import RandomLoads, train_patch
from palpate.offline.reduce.layout import Layout
from palpate.offline.reduce.ritz import region
from palpate.shared.mechanics.footprint import LIMIT_FIELDS


def test_modes_answer_to_loads_beside_the_footprints_that_they_learn_from(problem, rng):
    """Nearly as well as all modes of the region, where one footprint in a corner is learnt from."""
    limits = np.ones((len(problem.surface.vertices), LIMIT_FIELDS))
    layout = Layout(problem.scene, problem.surface, limits, problem.scene.training.size)
    patch, model = layout.patch(0), problem.model
    known = region(problem, patch.footprints, patch.size.region_modes)
    one = replace(known, ritz=known.ritz[:1]), replace(patch, footprints=patch.footprints[:1])
    found = train_patch(problem, *one)
    loads = RandomLoads(problem.scene, patch, rng)
    forces = [problem.load_vector(loads.limit()).ravel()[model.free] for _ in range(12)]
    loaded = np.transpose(forces)
    exact, states = model.solve_linear(loaded), known.states(model)

    def missed(modes):
        rest = exact - modes @ (modes.T @ loaded)
        energies = [np.sum(u * (model.rest_stiffness @ u), axis=0) for u in (rest, exact)]
        return float(np.sqrt(np.divide(*energies)).mean())

    own, most = missed(states @ found.modes[0]), missed(states @ known.orthonormal)
    print(f"missed by the local model {own:.1%}, by its region {most:.1%} of the energy norm")
    assert own < 1.5 * most
