"""Local models under the rigid tip, as they are trained."""

import numpy as np

from palpate.offline.reduce.cubature import linear_forces
from palpate.shared.model import ReducedModel
from palpate.shared.reduced.points import LANES

STIFFEST = 5.0
"""Largest stiffness of the points over that of the tissue."""


def test_points_are_not_much_stiffer_than_the_tissue_in_any_direction(artifact):
    points = ReducedModel.load(artifact).touch_models.points
    for k, rows in enumerate(points.gradients):
        law, modes = (points.weights[k], points.law.at(k)), len(rows)
        tiles = rows.reshape(modes, -1, 9, LANES)
        gradients = np.ascontiguousarray(tiles.transpose(1, 3, 2, 0).reshape(-1, 9, modes))
        forces = linear_forces(gradients, *law, np.eye(modes)).sum(axis=0)
        stiffness = forces.reshape(modes, modes)
        np.testing.assert_allclose(stiffness, stiffness.T, atol=1e-3)
        assert np.linalg.eigvalsh(stiffness)[-1] < STIFFEST
