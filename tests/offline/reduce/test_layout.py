"""Where local models lie, and what they learn from."""

import numpy as np
from scipy.spatial import cKDTree

from palpate.offline.reduce.layout import Layout
from palpate.shared.mechanics.footprint import LIMIT_FIELDS


def test_each_contact_has_the_footprint_nearest_to_it_in_its_local_model(problem):
    """Beyond the footprints that a local model learns from its answers err by ten percent."""
    limits = np.ones((len(problem.surface.vertices), LIMIT_FIELDS))
    layout = Layout(problem.scene, problem.surface, limits, problem.scene.training.size)
    pressed = np.array([footprint.point for footprint in layout.footprints])
    far, _ = cKDTree(layout.centres).query(problem.surface.vertices)
    for x in problem.surface.vertices[np.argsort(far)[::-10]]:
        k = int(np.linalg.norm(layout.centres - x, axis=1).argmin())
        learnt = [footprint.point for footprint in layout.patch(k).footprints]
        nearest = np.linalg.norm(pressed - x, axis=1).min()
        assert np.linalg.norm(np.array(learnt) - x, axis=1).min() == nearest
