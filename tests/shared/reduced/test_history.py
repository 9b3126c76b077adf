"""Histories of the reduced model: mechanics of the full one, and memories that follow the tool."""

from dataclasses import replace

import numpy as np
import pytest

from palpate.offline.fem import assembly
from palpate.offline.run.workshop import Load, Workshop
from palpate.shared.artifact import read_artifact
from palpate.shared.errors import QueryError
from palpate.shared.mechanics.viscosity import step_weights
from palpate.shared.model import ReducedModel, State, assemble_patches
from palpate.shared.reduced.history import History, Remains
from palpate.shared.reduced.press import load_patch
from palpate.shared.reduced.press_in_time import (
    ACCURATE,
    KNOTS,
    new_record,
    new_scratch,
    opened,
    recall_points,
    step_patch,
)

DOWN = np.array([0.0, 0.0, -1.0])


@pytest.fixture(scope="module")
def atlas(visco_artifact):
    return ReducedModel.load(visco_artifact)


@pytest.fixture(scope="module")
def workshop(visco_artifact):
    return Workshop.of_artifact(read_artifact(visco_artifact))


@pytest.fixture(scope="module")
def prony(atlas):
    return atlas.scene.tissue.prony


@pytest.fixture(scope="module")
def middle(atlas):
    """Return a contact point amid the surface and its largest pressure."""
    x = atlas.nodes.max(axis=0) * [0.5, 0.5, 1.0]
    return x, float(atlas.surface.locate(x, atlas.limits)[3][0])


class OnePatch:
    """A local model by itself, stepped through loads."""

    def __init__(self, atlas, prony, models, x, limit):
        self.patches = assemble_patches(atlas.body, models, atlas.scene)
        self.state = State(self.patches, atlas.surface.clusters)
        _, r, _ = self.patches.gradients.shape
        points = self.patches.weights.shape[1]
        self.sizes = len(prony), r, points
        self.record = new_record(*self.sizes)
        self.memory = opened(self.record, *self.sizes)
        self.scratch = new_scratch(r, points)
        self.D = models.viscous.deviatoric[0]
        self.prony, self.x, self.limit = prony, x, limit

    def step(self, share, dt):
        """Press; return the load (r,) and the status."""
        radius = 2.0
        load_patch(
            self.patches, 0, self.x, -DOWN, DOWN, share * self.limit, radius, self.state.scratch
        )
        load = self.state.scratch.wide_load.copy()
        status, _, _ = step_patch(
            self.patches, 0, self.D, step_weights(self.prony, dt), load, self.memory, self.scratch
        )
        return load, status


@pytest.fixture
def one_patch(atlas, prony, workshop, middle):
    """Return the patch nearest to the middle, with all points or its own."""
    models = atlas.models
    k = int(np.argmin(np.linalg.norm(models.centres - middle[0], axis=1)))

    def make(every_point):
        own = slice(models.point_from[k], models.point_from[k + 1])
        weights = workshop.model.weights.ravel()
        points, weights = (
            (np.arange(len(weights), dtype=np.int32), weights)
            if every_point
            else (models.points[own], models.weights[own])
        )
        single = replace(
            models,
            **{
                name: getattr(models, name)[[k]]
                for name in (
                    "centres",
                    "frames",
                    "pressures",
                    "whole",
                    "mix",
                    "path",
                    "defect",
                    "guess",
                    "residuals",
                )
            },
            basis=models.basis[models.region[[k]]],
            steps=models.steps[models.region[[k]]],
            region=np.zeros(1, np.int32),
            point_from=np.array([0, len(points)]),
            points=points,
            weights=weights,
            viscous=replace(models.viscous, deviatoric=models.viscous.deviatoric[[k]]),
        )
        made = OnePatch(atlas, prony, single, *middle)
        made.modes = (single.basis[0].T.astype(float) * single.steps[0]) @ single.modes[0]
        return made

    return make


COURSE = ((0.4, 0.02), (0.9, 0.05), (0.9, 0.3), (0.9, 1.0), (0.2, 0.01), (0.0, 0.02), (0.7, 0.1))


def test_with_every_point_a_step_is_an_equilibrium_of_the_full_model(one_patch, workshop):
    """The full model's internal force, after its own history of the same displacements."""
    patch, model = one_patch(every_point=True), workshop.model
    history, past = model.at_rest.points, np.zeros((*model.weights.shape, 7))
    force = np.zeros(patch.modes.shape[0])
    args = (model.connectivity, model.gradients, model.weights)
    for share, dt in COURSE:
        load, status = patch.step(share, dt)
        assert status == 0
        u = patch.modes @ patch.memory.wide
        weights = step_weights(patch.prony, dt)
        assembly.predict(history, weights, past)
        model.internal(u, force)
        elastic = patch.modes.T @ force
        assembly.viscous_residual(*args, model.mu, past, u, force)
        residual = patch.modes.T @ force - load
        # gradients of the modes are stored in 16 bits
        assert np.linalg.norm(residual) <= 4 * ACCURATE * np.linalg.norm(elastic)
        assembly.advance(model.connectivity, model.gradients, u, weights, history)


def test_few_points_do_the_work_of_all(one_patch):
    few, all_points = one_patch(every_point=False), one_patch(every_point=True)
    for share, dt in COURSE:
        few.step(share, dt)
        all_points.step(share, dt)
        error = np.linalg.norm(few.memory.wide - all_points.memory.wide)
        assert error <= 0.02 * np.linalg.norm(all_points.memory.wide)


def test_deviatoric_stiffness_is_between_none_and_all(atlas):
    for D in atlas.models.viscous.deviatoric.astype(float):
        values = np.linalg.eigvalsh(D)
        assert values[0] > 0.0
        assert values[-1] < 1.001


def test_overlap_of_neighbours_is_the_product_of_their_modes(atlas, workshop):
    models, viscous = atlas.models, atlas.models.viscous
    stiff, free = workshop.model.rest_stiffness, workshop.model.free

    def modes(k):
        region = models.region[k]
        basis = models.basis[region].T[free] * models.steps[region].astype(float)
        return basis @ models.modes[k]

    assert len(viscous.pairs) > len(models.centres)
    for i in range(0, len(viscous.pairs), 7):
        k, n = viscous.pairs[i]
        np.testing.assert_allclose(viscous.overlap[i], modes(k).T @ (stiff @ modes(n)), atol=2e-3)


def test_knots_keep_the_weight_and_about_the_mean_of_the_path(one_patch):
    patch = one_patch(every_point=False)
    for number in range(60):
        patch.step(0.5 + 0.4 * np.sin(0.3 * number), 0.03)
    memory = patch.memory
    assert len(memory.knots) == KNOTS
    np.testing.assert_allclose(memory.share.sum(axis=0), 1.0, rtol=1e-12)
    assert np.all(memory.share >= 0)
    np.testing.assert_array_equal(memory.knots[-1], memory.wide)
    mean = memory.share.T @ memory.knots
    assert np.linalg.norm(mean - memory.mean) <= 0.05 * np.linalg.norm(memory.mean)


def test_points_recalled_from_the_knots_are_about_those_that_were_there(one_patch):
    patch = one_patch(every_point=False)
    for number in range(60):
        patch.step(0.5 + 0.4 * np.sin(0.3 * number), 0.03)
    recalled = opened(patch.record.copy(), *patch.sizes)
    recall_points(patch.state.bound, 0, recalled, patch.scratch)
    exact = patch.memory.points
    assert np.linalg.norm(recalled.points - exact) <= 0.02 * np.linalg.norm(exact)


def test_what_remains_recovers_like_a_patch_under_small_loads(one_patch, atlas):
    patch = one_patch(every_point=True)
    patch.limit *= 1e-3
    for share, dt in ((1.0, 0.01), (1.0, 0.2), (1.0, 0.5)):
        patch.step(share, dt)
    load, _ = patch.step(0.0, 0.0)
    assert not load.any()
    start = Remains.of(patch.memory.mean.copy(), 0.0)
    for _ in range(200):
        patch.step(0.0, 0.005)
    k = int(np.argmin(np.linalg.norm(atlas.models.centres - patch.x, axis=1)))
    recovered = atlas._stepper._recover(k, start, 1.0)
    expected = patch.memory.mean
    assert np.linalg.norm(expected) < 0.7 * np.linalg.norm(start.mean)
    assert np.linalg.norm(recovered - expected) <= 0.01 * np.linalg.norm(expected)


# --- the atlas -----------------------------------------------------------------------------------


def test_what_is_pressed_and_lifted_in_no_time_has_an_answer(atlas, rng):
    """Nothing is left then that the residual could be small beside."""
    for _ in range(20):
        x = atlas.nodes.max(axis=0) * [*rng.random(2), 1.0]
        limit, history = float(atlas.surface.locate(x, atlas.limits)[3][0]), History()
        for share in (0.8, 0.0, 0.8, 0.4, 0.0, 0.0):
            moment, history = atlas.step(history, 0.0, x, share * limit)
            assert moment.converged
        assert np.linalg.norm(moment.contact_displacement) < 1e-5


def follow(atlas, history, course, x, limit):
    for share, dt in course:
        moment, history = atlas.step(history, dt, x, share * limit)
        assert moment.converged
    return moment, history


def test_at_once_tissue_answers_as_without_time(atlas, middle):
    x, limit = middle
    moment, _ = atlas.step(History(), 0.0, x, 0.8 * limit)
    elastic = atlas.solve(x, 0.8 * limit)
    moved = elastic.contact_displacement
    assert np.linalg.norm(moment.contact_displacement - moved) <= 5e-3 * np.linalg.norm(moved)
    u, v = atlas.displacement(moment), atlas.displacement(elastic)
    assert np.linalg.norm(u - v) <= 0.01 * np.linalg.norm(v)
    s, t = atlas.von_mises(moment), atlas.von_mises(elastic)
    assert np.linalg.norm(s - t) <= 0.02 * np.linalg.norm(t)


def test_a_history_is_its_own_snapshot(atlas, middle):
    x, limit = middle
    _, history = follow(atlas, History(), COURSE, x, limit)
    first, _ = follow(atlas, history, COURSE, x + 0.4 * np.eye(3)[0], limit)
    again, _ = follow(atlas, history, COURSE, x + 0.4 * np.eye(3)[0], limit)
    np.testing.assert_array_equal(first.contact_displacement, again.contact_displacement)
    np.testing.assert_array_equal(atlas.displacement(first), atlas.displacement(again))
    np.testing.assert_array_equal(atlas.von_mises(first), atlas.von_mises(again))


def test_a_dent_stays_behind_the_tool_and_recovers(atlas, workshop, middle):
    """A tool that presses, hops to the other side and is lifted, beside the full model."""
    x, limit = middle
    model, full = workshop.model, workshop.model.at_rest
    history, size, stressed = History(), 0.0, 0.0
    hop = np.array([2.5, 0.0, 0.0])
    places = [(x - hop, 0.7), (x - hop, 0.7), (x + hop, 0.7), (x + hop, 0.7), (None, 0), (None, 0)]
    for (place, share), dt in zip(places, (0.05, 1.0, 0.05, 0.2, 0.01, 0.3), strict=True):
        moment, history = atlas.step(history, dt, place, share * limit)
        at = history.position
        _, full = model.step(full, workshop.load_vector(Load(at, DOWN, share * limit)), dt)
        exact, stress = full.displacement, workshop.von_mises_after(full)
        size = max(size, np.linalg.norm(exact))
        assert np.linalg.norm(atlas.displacement(moment) - exact) <= 0.03 * size
        kept = workshop.beyond_clamped_layer
        stressed = max(stressed, np.linalg.norm(stress[kept]))
        assert np.linalg.norm((atlas.von_mises(moment) - stress)[kept]) <= 0.05 * stressed
    assert np.linalg.norm(exact) > 0.1 * size


def test_sliding_from_patch_to_patch_does_not_lose_the_past(atlas, workshop, middle):
    x, limit = middle
    model, full = workshop.model, workshop.model.at_rest
    history, mains = History(), set()
    way = np.linspace(-2, 2, 13)[:, None] * [1.0, 0.05, 0.0]
    course = [(x + way[0], 0.5), *((x + offset, 0.05) for offset in way)]
    for place, dt in course:
        moment, history = atlas.step(history, dt, place, 0.6 * limit)
        _, full = model.step(
            full, workshop.load_vector(Load(history.position, DOWN, 0.6 * limit)), dt
        )
        mains.add(history.main)
        off = np.linalg.norm(atlas.displacement(moment) - full.displacement)
        assert off <= 0.03 * np.linalg.norm(full.displacement)
    assert len(mains) > 1


def test_ten_thousand_steps_end_where_few_do(atlas, middle):
    """Periodic loading leads to a periodic answer: rounding does not add up."""
    x, limit = middle
    history, seen = History(), []
    for number in range(10_000):
        share = 0.4 + 0.3 * np.sin(2 * np.pi * number / 100)
        moment, history = atlas.step(history, 0.02, x, share * limit)
        if number % 100 == 99:
            seen.append(moment.contact_displacement[2])
    late = np.array(seen[20:])
    assert np.ptp(late) <= 2e-3 * abs(late.mean())


def test_a_long_rest_leaves_nothing(atlas, middle):
    x, limit = middle
    first, history = follow(atlas, History(), ((0.8, 0.1), (0.8, 2.0)), x, limit)
    for _ in range(30):
        moment, history = atlas.step(history, 1.0)
    assert moment.force.tolist() == [0.0, 0.0, 0.0]
    left, dent = atlas.displacement(moment), atlas.displacement(first)
    assert np.linalg.norm(left) <= 2e-3 * np.linalg.norm(dent)


def test_sudden_reversal_and_extreme_steps_have_answers(atlas, middle):
    x, limit = middle
    history = History()
    for share, dt in ((1.0, 0.0), (0.0, 0.0), (1.0, 1e-9), (1.0, 1e9), (0.0, 1e-3)):
        moment, history = atlas.step(history, dt, x, share * limit)
        assert moment.converged
        assert np.all(np.isfinite(atlas.displacement(moment)))
        assert np.all(np.isfinite(atlas.von_mises(moment)))


def test_beyond_the_range_is_flagged_and_never_nan(atlas, middle):
    x, limit = middle
    history = History()
    for factor in (2.0, 8.0, 30.0):
        moment, after = atlas.step(history, 0.1, x, factor * limit)
        assert moment.out_of_range == ("pressure",)
        if not moment.converged:
            assert after is history
        history = after
        assert np.all(np.isfinite(atlas.displacement(moment)))


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ({"dt": -1.0}, "time"),
        ({"dt": float("nan")}, "time"),
        ({"dt": float("inf")}, "time"),
        ({"dt": 0.1, "position": [5.0, 5.0, 99.0], "pressure": 1.0}, "position"),
        ({"dt": 0.1, "position": [5.0, 5.0, 8.0], "pressure": -1.0}, "pressure"),
        ({"dt": 0.1, "position": [5.0, 5.0, 8.0], "direction": [0.0, 0.0, 1.0]}, "direction"),
    ],
)
def test_what_is_wrong_is_named(atlas, arguments, field):
    with pytest.raises(QueryError) as caught:
        atlas.step(History(), **arguments)
    assert caught.value.field == field


def test_elastic_tissue_has_no_time(artifact):
    with pytest.raises(QueryError, match="is elastic"):
        ReducedModel.load(artifact).step(History(), 0.1)
