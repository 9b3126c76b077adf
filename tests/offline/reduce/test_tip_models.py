"""Local models under the rigid tip, as they are trained."""

import numpy as np

from palpate.offline.reduce.cubature import by_point, linear_forces, residuals_left
from palpate.offline.validate.queries import random_positions

STIFFEST = 5.0
"""Largest stiffness of the points over that of the tissue."""


def test_points_are_not_much_stiffer_than_the_tissue_in_any_direction(atlas):
    points = atlas.touch_models.points
    for k, rows in enumerate(points.gradients):
        law, modes = (points.weights[k], points.law.at(k)), len(rows)
        forces = linear_forces(by_point(rows), *law, np.eye(modes)).sum(axis=0)
        stiffness = forces.reshape(modes, modes)
        np.testing.assert_allclose(stiffness, stiffness.T, atol=1e-3)
        assert np.linalg.eigvalsh(stiffness)[-1] < STIFFEST


def test_patches_know_what_their_answers_leave_in_the_full_model(atlas, problem):
    steps = random_positions(atlas, 40, np.random.default_rng(5))
    answers = [atlas.touch(step.position) for step in steps]
    moved = np.array([atlas.displacement(answer).ravel() for answer in answers], float)
    left = np.log(residuals_left(problem, moved, steps))
    foretold = np.array([answer.features[-1] for answer in answers])
    assert np.median(np.abs(left - foretold)) < 0.4
    assert np.corrcoef(left, foretold)[0, 1] > 0.5
