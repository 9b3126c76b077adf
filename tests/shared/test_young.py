"""Tissue of another Young's modulus than the training's: exact, since stresses go with it."""

from dataclasses import replace

import numpy as np
import pytest

from palpate.offline.fem.problem import FullProblem, Load, TipPosition
from palpate.shared.errors import QueryError
from palpate.shared.query import MOST_YOUNG
from palpate.shared.reduced.transfer import REST

RATIOS = 0.2, 1.7, 11.0

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(params=RATIOS)
def ratio(request):
    """Return how many times as stiff the tissue is."""
    return request.param


def assert_stiffened(model, stiff, answer, ratio):
    """Twice the stiffness, twice the forces at the same displacement; errors are relative."""
    for name in ("force", "tangent", "energy", "pressure", "pressure_limit"):
        own, other = np.array(getattr(stiff, name)), np.array(getattr(answer, name))
        np.testing.assert_allclose(own, ratio * other, rtol=1e-12, atol=1e-12, err_msg=name)
    for name in ("contact_displacement", "depth_limit", "contact_point", "error_von_mises"):
        own, other = np.array(getattr(stiff, name)), np.array(getattr(answer, name))
        np.testing.assert_allclose(own, other, rtol=1e-12, atol=1e-12, err_msg=name)
    assert stiff.in_range == answer.in_range
    own, other = model.displacement(stiff), model.displacement(answer)
    np.testing.assert_allclose(own, other, atol=1e-6 * np.abs(other).max())
    stress, expected = model.von_mises(stiff), ratio * model.von_mises(answer)
    np.testing.assert_allclose(stress, expected, atol=1e-6 * expected.max())
    np.testing.assert_allclose(
        model.peaks(stiff, own), ratio * np.array(model.peaks(answer, other)), rtol=1e-6
    )


@pytest.mark.parametrize("share", [0.5, 1.2])
def test_a_load_grows_with_the_stiffness(atlas, ratio, share):
    """In the middle: beyond its range the rim folds, and round-off grows to 1e-5 there."""
    x, young = atlas.nodes.max(axis=0) * [0.5, 0.5, 1.0], atlas.scene.tissue.young
    pressure = share * atlas.press(x, 0.0).pressure_limit
    answer = atlas.press(x, pressure)
    stiff = atlas.press(x, ratio * pressure, young=ratio * young)
    assert_stiffened(atlas, stiff, answer, ratio)
    limit, beyond = atlas.check(x, ratio * pressure, young=ratio * young)
    assert limit == pytest.approx(ratio * answer.pressure_limit, rel=1e-12)
    assert beyond == answer.out_of_range


def test_the_force_of_the_tip_grows_with_the_stiffness(atlas, ratio):
    x = atlas.nodes.max(axis=0) * [0.5, 0.5, 1.0] + (atlas.body.tip.radius - 0.4) * UP
    answer = atlas.touch(x)
    assert answer.contact
    assert_stiffened(atlas, atlas.touch(x, young=ratio * atlas.scene.tissue.young), answer, ratio)


def test_the_past_is_that_of_tissue_of_any_stiffness(visco_atlas, ratio):
    """Young's modulus may change from one step to the next; the displacements are remembered."""
    x, young = visco_atlas.models.centres[0], ratio * visco_atlas.scene.tissue.young
    limit, past, pasts = visco_atlas.press(x, 0.0).pressure_limit, REST, REST
    for share in (0.3, 0.6):
        answer = visco_atlas.press(x, share * limit, past=past, dt=0.1)
        stiff = visco_atlas.press(x, ratio * share * limit, young=young, past=pasts, dt=0.1)
        past, pasts = answer.past, stiff.past
    assert_stiffened(visco_atlas, stiff, answer, ratio)


def test_many_are_as_stiff(atlas, rng):
    young, at = 3.0 * atlas.scene.tissue.young, rng.choice(atlas.surface.vertices, 8)
    pressures = rng.uniform(0.0, 3.0, 8) * atlas.pressure_max
    answers = atlas.solve_many(at, pressures, young=young)
    ones = [atlas.press(x, p, young=young) for x, p in zip(at, pressures, strict=True)]
    np.testing.assert_array_equal(answers.force, [one.force for one in ones])
    np.testing.assert_array_equal(answers.limit, [one.pressure_limit for one in ones])
    at = at + (atlas.body.tip.radius - 0.2) * UP
    touched = atlas.touch_many(at, young=young)
    np.testing.assert_array_equal(touched.force, [atlas.touch(x, young=young).force for x in at])


def test_the_full_model_of_that_tissue_agrees(artifact, atlas, ratio):
    problem, middle = FullProblem.of_artifact(artifact), atlas.nodes.max(axis=0) * [0.5, 0.5, 1.0]
    young = ratio * problem.scene.tissue.young
    stiff = FullProblem.of_artifact(artifact, young)
    load = Load(middle, np.array([0.0, 0.0, -1.0]), 0.5 * atlas.press(middle, 0.0).pressure_limit)
    one = problem.solve(load).displacement
    other = stiff.solve(replace(load, pressure=ratio * load.pressure)).displacement
    np.testing.assert_allclose(other, one, atol=1e-6 * np.abs(one).max())
    tip = TipPosition(middle + (atlas.body.tip.radius - 0.3) * UP)
    force = ratio * np.array(problem.solve(tip).force)
    np.testing.assert_allclose(stiff.solve(tip).force, force, atol=1e-5 * np.abs(force).max())


@pytest.mark.parametrize("young", [0.0, -1.0, np.nan, np.inf, 2.0 * MOST_YOUNG])
def test_what_is_no_modulus_is_refused(atlas, young):
    for ask in (
        lambda: atlas.press(atlas.models.centres[0], 1.0, young=young),
        lambda: atlas.touch(atlas.models.centres[0], young=young),
        lambda: atlas.solve_many([atlas.models.centres[0]], [1.0], young=young),
    ):
        with pytest.raises(QueryError, match="young"):
            ask()
