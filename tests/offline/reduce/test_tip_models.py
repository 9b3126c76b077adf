"""Local models under the rigid tip, as they are trained."""

import numpy as np

from palpate.offline.fem.problem import FullProblem
from palpate.offline.reduce.cubature import linear_forces
from palpate.offline.reduce.queries import random_positions
from palpate.offline.reduce.tip_models import residuals_left
from palpate.shared.artifact import read_artifact
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


def test_patches_know_what_their_answers_leave_in_the_full_model(artifact):
    model, rng = ReducedModel.load(artifact), np.random.default_rng(5)
    problem = FullProblem.of_artifact(read_artifact(artifact))
    positions = np.array([step.position for step in random_positions(model, 40, rng)])
    answers = [model.touch(position) for position in positions]
    moved = np.array([model.displacement(answer).ravel() for answer in answers], float)
    left = np.log(residuals_left(problem, moved, positions))
    foretold = np.array([answer.features[-1] for answer in answers])
    assert np.median(np.abs(left - foretold)) < 0.4
    assert np.corrcoef(left, foretold)[0, 1] > 0.5
