"""The rigid tip on visco-elastic tissue, reduced: mechanics of the full model, memory, refusals."""

import numpy as np
import pytest

from palpate.offline.run.workshop import Workshop
from palpate.shared.artifact import read_artifact
from palpate.shared.errors import QueryError
from palpate.shared.model import ReducedModel
from palpate.shared.reduced.history import History

HOLD = ((0.5, 0.0, 0.0), (0.5, 0.0, 0.05), (0.5, 0.0, 0.3), (0.5, 0.0, 1.0))
"""Depths and places aside (mm), time steps (s)."""


@pytest.fixture(scope="module")
def atlas(visco_artifact):
    return ReducedModel.load(visco_artifact)


@pytest.fixture(scope="module")
def workshop(visco_artifact):
    return Workshop.of_artifact(read_artifact(visco_artifact))


def place(atlas, depth, aside=0.0):
    """Centre of a tip over the flat top, so deep in it."""
    x, y, z = atlas.nodes.max(axis=0)
    return np.array([0.42 * x + aside, 0.46 * y, z + atlas.scene.endoscope.radius - depth])


def follow(atlas, course, history=None):
    history, answers = history or History(), []
    for depth, aside, dt in course:
        answer, history = atlas.touch_step(history, dt, place(atlas, depth, aside))
        assert answer.converged
        answers.append(answer)
    return answers, history


def off(a, b):
    return np.linalg.norm(np.subtract(a, b)) / np.linalg.norm(b)


def test_at_once_tissue_answers_as_without_time(atlas):
    (sudden,), _ = follow(atlas, [(0.6, 0.0, 0.0)])
    elastic = atlas.touch(place(atlas, 0.6))
    assert off(sudden.force, elastic.force) <= 1e-3
    assert off(sudden.tangent, elastic.tangent) <= 0.01
    assert off(atlas.displacement(sudden), atlas.displacement(elastic)) <= 1e-3
    assert off(atlas.von_mises(sudden), atlas.von_mises(elastic)) <= 1e-3


def compare(atlas, workshop, course):
    """Errors of displacement, stress and force of each moment over the largest so far."""
    positions = np.array([place(atlas, depth, aside) for depth, aside, _ in course])
    full = workshop.follow_tip(positions, [dt for *_, dt in course])
    answers, _ = follow(atlas, course)
    kept = workshop.beyond_clamped_layer
    found = (
        [atlas.displacement(a) for a in answers],
        [atlas.von_mises(a)[kept] for a in answers],
        [a.force for a in answers],
    )
    errors = []
    for a, b in zip(found, (full[0], full[1][:, kept], full[2]), strict=True):
        largest = np.maximum.accumulate([np.linalg.norm(x) for x in b])
        errors.append([np.linalg.norm(x - y) for x, y in zip(a, b, strict=True)] / largest)
    return np.array(errors).T


def test_a_held_tip_relaxes_as_the_full_model_does(atlas, workshop):
    answers, _ = follow(atlas, HOLD)
    forces = [answer.force[2] for answer in answers]
    assert forces[-1] < 0.75 * forces[0]
    assert np.all(compare(atlas, workshop, HOLD) <= [0.03, 0.04, 0.02])


def test_over_several_patches_the_past_follows(atlas, workshop):
    way = [(0.5, s, 0.03) for s in np.linspace(0.0, 3.0, 9)]
    course = [*HOLD[:3], *way, (-0.05, 3.0, 0.02), (-0.05, 3.0, 0.3), (0.3, 0.5, 0.02)]
    answers, history = follow(atlas, course)
    assert len({k for answer in answers for k, _, _ in answer.patches}) > 1
    assert history.main >= 0
    assert np.all(compare(atlas, workshop, course) <= [0.04, 0.05, 0.03])


def test_the_tangent_is_the_derivative_of_the_force_of_a_step(atlas):
    _, history = follow(atlas, [(0.6, 0.0, 0.02), (0.6, 0.0, 0.4), (0.4, 0.2, 0.02)])
    x, h = place(atlas, 0.5, 0.25), 0.005
    tangent = atlas.touch_step(history, 0.01, x)[0].tangent
    for axis, step in enumerate(h * np.eye(3)):
        ahead, behind = (atlas.touch_step(history, 0.01, x + s * step)[0].force for s in (1, -1))
        slope = (ahead - behind) / (2 * h)
        assert np.abs(tangent[:, axis] - slope).max() <= 0.015 * np.abs(tangent).max()


def test_a_search_cut_short_goes_on_where_it_ended(atlas):
    _, history = follow(atlas, HOLD)
    x = place(atlas, 0.2, 1.0)
    whole, _ = atlas.touch_step(history, 0.01, x)
    assert whole.iterations > 1
    answer, after = atlas.touch_step(history, 0.01, x, 1)
    assert not answer.converged
    assert after is history
    for _ in range(whole.iterations):
        if not answer.converged:
            answer, after = atlas.touch_step(history, 0.01, x, 1, answer)
    assert answer.converged
    assert after.time == history.time + 0.01
    np.testing.assert_allclose(answer.force, whole.force, atol=1e-3 * np.abs(whole.force).max())


def test_a_history_is_its_own_snapshot(atlas):
    _, history = follow(atlas, HOLD)
    onward = [(0.3, 0.4, 0.01), (0.6, 2.0, 0.05), (-0.1, 2.0, 0.02)]
    first, _ = follow(atlas, onward, history)
    follow(atlas, [(0.7, -2.0, 0.5)])  # something else in between
    again, _ = follow(atlas, onward, history)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.force, b.force)
        np.testing.assert_array_equal(a.tangent, b.tangent)
        np.testing.assert_array_equal(atlas.displacement(a), atlas.displacement(b))
        np.testing.assert_array_equal(atlas.von_mises(a), atlas.von_mises(b))


def test_a_closed_path_costs_work(atlas):
    """In small steps, in, aside, out and back, at several speeds."""
    ticks = np.linspace(0, 3, 61)
    for dt in (1e-3, 1e-2, 0.1):
        depths = np.interp(ticks, (0, 1, 2, 3), (-0.02, 0.6, 0.6, -0.02))
        asides = np.interp(ticks, (0, 1, 2, 3), (0.0, 0.0, 0.8, 0.8))
        answers, _ = follow(atlas, [(d, a, dt) for d, a in zip(depths, asides, strict=True)])
        x, force = (np.array([getattr(a, name) for a in answers]) for name in ("position", "force"))
        work = -np.sum((force[1:] + force[:-1]) / 2 * np.diff(x, axis=0), axis=1)
        assert 0.02 * work[:20].sum() < work.sum() < work[work > 0].sum()


def test_a_lifted_tip_feels_nothing_and_the_dent_recovers(atlas):
    _, history = follow(atlas, [*HOLD, (-0.1, 0.0, 0.0)])
    sizes = []
    for _ in range(40):
        answer, history = atlas.touch_step(history, 0.25, place(atlas, -5.0, 30.0))
        assert answer.converged
        assert not answer.contact
        assert not answer.force.any()
        sizes.append(np.linalg.norm(atlas.displacement(answer)))
    assert sizes[0] > 0.0
    assert np.all(np.diff(sizes) < 1e-6 * sizes[0])
    assert sizes[-1] < 1e-2 * sizes[0]


def test_a_tip_that_never_touched_leaves_rest(atlas):
    answer, history = atlas.touch_step(History(), 0.1, place(atlas, -3.0))
    assert answer.converged
    assert answer.patches == ()
    assert history.time == 0.1
    assert not atlas.displacement(answer).any()


def test_many_steps_end_where_few_do(atlas):
    """Periodic movement leads to a periodic force: rounding does not add up."""
    history, seen = History(), []
    for number in range(4000):
        depth = 0.4 + 0.2 * np.sin(2 * np.pi * number / 100)
        answer, history = atlas.touch_step(history, 0.02, place(atlas, depth))
        if number % 100 == 99:
            seen.append(answer.force[2])
    late = np.array(seen[10:])
    assert np.ptp(late) <= 1e-3 * abs(late.mean())


def test_extreme_steps_have_answers(atlas):
    history = History()
    for depth, dt in ((0.6, 0.0), (0.1, 0.0), (0.6, 1e-9), (0.6, 1e9), (-0.1, 1e-3), (0.6, 0.0)):
        answer, history = atlas.touch_step(history, dt, place(atlas, depth))
        assert answer.converged
        assert np.all(np.isfinite(answer.tangent))
        assert np.all(np.isfinite(atlas.von_mises(answer)))


def test_the_estimate_covers_most_and_is_of_all_that_was(atlas):
    answers, _ = follow(atlas, HOLD)
    for answer in answers:
        estimates = answer.error_displacement, answer.error_von_mises, answer.error_force
        assert all(0.0 < estimate < 0.3 for estimate in estimates)


@pytest.mark.parametrize(
    ("dt", "depth", "field"),
    [(-0.1, 0.1, "time"), (float("nan"), 0.1, "time"), (0.1, 5.0, "position")],
)
def test_what_is_wrong_is_named(atlas, dt, depth, field):
    with pytest.raises(QueryError) as caught:
        atlas.touch_step(History(), dt, place(atlas, depth))
    assert caught.value.field == field


def test_elastic_tissue_has_no_time(artifact):
    elastic = ReducedModel.load(artifact)
    with pytest.raises(QueryError, match="is elastic"):
        elastic.touch_step(History(), 0.1, place(elastic, 0.1))
