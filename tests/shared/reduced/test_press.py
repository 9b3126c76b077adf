"""The local models: what makes their answers good and quick, and answers that are continuous."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from palpate.offline.fem.problem import Load
from palpate.offline.reduce.footprint_models import LocalTrainer
from palpate.shared.reduced.press import TOLERANCE
from palpate.shared.scene import Tolerance

INWARD = np.zeros(3)


def first_alone(models, points, weights):
    """Return the first local model by itself, with some quadrature points."""
    names = (
        "centres", "frames", "pressures", "whole", "mix", "defect", "guess", "directions", "change"
    )  # fmt: skip
    nodes, basis = models.window(models.region[0])
    return replace(
        models,
        **{name: getattr(models, name)[:1] for name in names},
        node_from=np.array([0, len(nodes)]),
        nodes=nodes,
        basis=basis.ravel(),
        shares=models.shares[models.region[:1]],
        share_steps=models.share_steps[models.region[:1]],
        steps=models.steps[models.region[:1]],
        region=np.zeros(1, np.int32),
        point_from=np.array([0, len(points)]),
        points=points,
        weights=weights,
    )


@pytest.fixture(scope="module")
def single(atlas):
    """Return the first local model as it is."""
    own = slice(*atlas.models.point_from[:2])
    return first_alone(atlas.models, atlas.models.points[own], atlas.models.weights[own])


@pytest.fixture(scope="module")
def loads(atlas, single):
    """Return pressures at the centre of the first local model, up to the limit there."""
    return np.linspace(0.3, 1.0, 8) * atlas.press(single.centres[0], 1.0).pressure_limit


def solved(problem, models, pressures):
    """Iterations and answers (k, r) of the first local model under loads at its centre."""
    trainer, iterations, answers = LocalTrainer(problem, models), 0, []
    for pressure in pressures:
        answers.append(trainer.solve(Load(models.centres[0], INWARD, pressure)).q)
        iterations += trainer._workspace.outcome.iterations.item()
    return iterations, np.array(answers)


def off(found, exact):
    """Relative errors (k,); of coefficients (k, r) in the norm of energy."""
    return np.linalg.norm(found - exact, axis=-1) / np.linalg.norm(exact, axis=-1)


# --- what makes it good and quick ----------------------------------------------------------------


def test_points_and_defect_together_answer_as_all_points(atlas, problem, single, loads):
    weights = problem.model.weights.ravel()
    every = first_alone(atlas.models, np.arange(len(weights), dtype=np.int32), weights)
    every, few = (replace(models, defect=0 * models.defect) for models in (every, single))
    exact, without, fitted = (solved(problem, own, loads)[1] for own in (every, few, single))
    assert off(fitted, exact).mean() < 0.5 * off(without, exact).mean()


def test_beyond_the_range_the_defect_stays_what_it_is_at_its_end(atlas, single, loads):
    def load(share):
        warm = atlas.new_warm()
        assert len(atlas.press(single.centres[0], share * loads[-1], warm=warm).parts) == 1
        return warm.workspace(tip=False, in_time=False).scratch.load.copy()

    def bend(*shares):
        first, middle, last = (load(share) for share in shares)
        return off(first + last, 2 * middle)

    assert bend(1.0, 1.25, 1.5) < 6e-7
    assert bend(0.5, 0.75, 1.0) > 1e-5


def test_first_guess_and_first_tangent_each_save_iterations(problem, single, loads):
    no_tangent = replace(single, change=np.zeros_like(single.change))
    no_guess = replace(no_tangent, guess=np.zeros_like(single.guess))
    full, plain, bare = (solved(problem, own, loads)[0] for own in (single, no_tangent, no_guess))
    assert full < 0.8 * plain < 0.8 * bare


@pytest.mark.parametrize("wrong", ["guess", "change"])
def test_where_the_start_is_no_good_the_answer_is_found_from_rest(problem, single, loads, wrong):
    far = {"guess": 100.0 * single.guess, "change": -100.0 * np.abs(single.change)}[wrong]
    some = loads[3:4]  # at the limit tissue is so soft that tolerances, in energy at rest, are more
    expected = solved(problem, single, some)[1]
    iterations, found = solved(problem, replace(single, **{wrong: far}), some)
    assert iterations > 4
    assert off(found, expected) <= 4 * TOLERANCE


def test_a_loose_tolerance_is_answered_in_fewer_iterations_and_well_within_it(
    problem, single, loads
):
    tolerance, other = Tolerance(displacement=0.15, von_mises=0.6), copy(problem)
    other.scene = problem.scene.model_copy(update={"tolerance": tolerance})
    (strict, exact), (loose, near) = (solved(own, single, loads) for own in (problem, other))
    # stresses follow the norm of energy: the solver's share is half at most
    assert off(near, exact).max() < 0.5 * tolerance.reduction.von_mises
    assert loose < strict


# --- between models ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def border(atlas):
    """Return two neighbouring centres and the contact pressure used between them."""
    centres = atlas.models.centres
    inside = np.argsort(np.linalg.norm(centres - centres.mean(axis=0), axis=1))
    first = inside[0]
    second = np.argsort(np.linalg.norm(centres - centres[first], axis=1))[1]
    limit = atlas.press(centres[first], 1.0).pressure_limit
    return centres[first], centres[second], 0.8 * limit


def test_cold_answers_repeat_to_the_bit(atlas, border):
    first, second, pressure = border
    x = 0.5 * (first + second)
    once = atlas.press(x, pressure)
    atlas.press(first, 0.3 * pressure)
    again = atlas.press(x, pressure)
    assert [k for k, _, _ in once.parts] == [k for k, _, _ in again.parts]
    np.testing.assert_array_equal(once.contact_displacement, again.contact_displacement)
    np.testing.assert_array_equal(atlas.displacement(once), atlas.displacement(again))


def test_a_warm_answer_is_as_good_as_the_cold_one(atlas, problem, border):
    first, second, pressure = border
    memory = atlas.new_warm()
    for share in np.linspace(0.0, 0.8, 9):
        x, force = first + share * (second - first), (0.5 + share / 2) * pressure
        warm, cold = atlas.press(x, force, warm=memory), atlas.press(x, force)
        u = problem.solve(Load(x, warm.direction, force)).displacement.ravel()
        errors = [off(atlas.displacement(answer).ravel(), u) for answer in (warm, cold)]
        assert errors[0] <= errors[1] + TOLERANCE


@pytest.fixture(scope="module")
def path(problem, border):
    """Return contact points 0.05 mm apart across a border and the full model's answers there."""
    first, second, pressure = border
    along = (second - first) / np.linalg.norm(second - first)
    points = (first + second) / 2 + 0.05 * np.arange(-8, 9)[:, None] * along
    answers, u = [], None
    for x in points:
        nodal, normal = problem.unit_load(x)
        u = problem.solve(Load(x, -normal, pressure), start=u).displacement
        answers.append(np.vstack([u, nodal @ u / nodal.sum()]))
    return points, answers


@pytest.mark.parametrize("is_warm", [False, True], ids=["cold", "warm"])
def test_across_a_border_it_jumps_no_more_than_the_full_model(atlas, path, border, is_warm):
    """At no node and not at the contact, in mm."""
    answers, active, warm = [], set(), atlas.new_warm() if is_warm else None
    for x in path[0]:
        solution = atlas.press(x, border[2], warm=warm)
        assert solution.converged
        active |= {k for k, _, _ in solution.parts}
        answers.append(np.vstack([atlas.displacement(solution), solution.contact_displacement]))
    assert len(active) > 1
    excess = np.diff(answers, axis=0) - np.diff(path[1], axis=0)
    assert np.linalg.norm(excess, axis=2).max() <= 0.01
