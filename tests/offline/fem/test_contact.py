"""The full model under a rigid sphere that is integrated over its faces, at once and in time."""

import numpy as np
import pytest

from palpate.offline.fem.contact import SphereLoad
from palpate.offline.studies.layer import ball_on_a_layer

from .bodies import POISSON, YOUNG, body, sphere_contact

PRONY = ((0.25, 0.1), (0.25, 1.0))
RADIUS = 2.0


@pytest.fixture(scope="module")
def block():
    """Return a block of visco-elastic tissue, the middle of its top, and contact with a tip."""
    model = body("hex20", (3, 3, 2), (8.0, 8.0, 6.0), prony=PRONY)
    return model, np.array([4.0, 4.0, 6.0]), sphere_contact(model, RADIUS)


def tip(block, depth, aside=(0.0, 0.0), more=(0.0, 0.0, 0.0)):
    """Load of the tip at a depth and beside the middle, moved a little more."""
    _, top, contact = block
    position = np.add(top, [*aside, contact.sphere.radius - depth]) + more
    return SphereLoad(contact, position, np.array([0.0, 0.0, -max(depth, 0.0)]))


def touch(block, *place, **how):
    return block[0].solve(tip(block, *place), **how)


def follow(block, course, past=None):
    """Answers along a course of depths (mm), places aside (mm) and time steps (s)."""
    answers = []
    for depth, aside, dt in course:
        answers.append(touch(block, depth, (aside, 0.0), past=past, dt=dt))
        past = answers[-1].past
    return answers


def test_a_sphere_off_the_block_moves_nothing_whatever_it_did_before(block):
    touch(block, 0.5)
    found = touch(block, -0.01)
    assert not found.displacement.any()
    assert not found.force.any()
    assert not block[0].solve(np.zeros_like(found.displacement)).displacement.any()


@pytest.mark.parametrize("in_time", [False, True])
def test_the_force_is_the_derivative_of_the_energy_in_the_tips_position(block, in_time):
    """Of what is stored; in time over a step, after a past."""
    course = [(0.5, 0.0, 0.05), (0.5, 0.3, 0.1), (0.3, 0.3, 0.02)]
    how = {"past": follow(block, course)[-1].past, "dt": 0.02} if in_time else {}
    place = 0.6, (0.3, -0.2)
    found = touch(block, *place, **how)
    assert found.force[2] > 0
    h = 1e-4
    for axis, step in enumerate(np.eye(3)):
        ahead, behind = (
            touch(block, *place, s * step, start=found.displacement, **how) for s in (h, -h)
        )
        slope = (ahead.energy - behind.energy) / (2 * h)
        assert -found.force[axis] == pytest.approx(slope, abs=1e-4 * found.force[2])


def test_the_way_in_does_not_matter_and_penetration_is_small(block):
    jump = touch(block, 0.5)
    step = touch(block, 0.5, start=touch(block, 0.4).displacement)
    assert np.abs(jump.displacement - step.displacement).max() <= 1e-6
    for depth in (0.2, 0.5, 1.0):
        assert 0 < touch(block, depth).penetration < 0.02 * depth


def test_a_ball_on_a_layer_is_that_of_hertz():
    radius, depth, height = 10.0, 0.4, 10.0
    model = body("hex20", (10, 10, 4), (20.0, 20.0, height))
    found = touch((model, np.array([10.0, 10.0, height]), sphere_contact(model, radius)), depth)
    theory = ball_on_a_layer(depth, radius, height, YOUNG, POISSON)
    assert found.force[2] == pytest.approx(theory, rel=0.1)


def test_at_once_and_after_long_it_feels_elastic_tissue_that_relaxes_in_between(block):
    model, place = block[0], (0.5, (0.2, 0.0))
    answers = follow(block, [(0.5, 0.2, 0.0), *[(0.5, 0.2, 5.0)] * 4])
    sudden, elastic = touch(block, *place, past=model.at_rest), touch(block, *place)
    np.testing.assert_allclose(sudden.displacement, elastic.displacement, atol=1e-9)
    np.testing.assert_allclose(sudden.force, elastic.force, rtol=1e-9)
    np.testing.assert_allclose(sudden.tangent, elastic.tangent, rtol=1e-6, atol=1e-6)
    relaxed = model.relaxed.solve(tip(block, *place))
    forces = [np.linalg.norm(answer.force) for answer in answers]
    assert np.all(np.diff(forces) < 1e-9)
    np.testing.assert_allclose(answers[-1].force, relaxed.force, rtol=1e-4, atol=1e-4)
    assert 0.5 < forces[-1] / forces[0] < 0.7  # half of what is isochoric relaxes


def test_a_held_tip_relaxes_as_the_law_says(block):
    """For a small dent: what relaxes is ``sum g (1 - exp(-t / tau))`` of the isochoric part."""
    held = [(0.02, 0.0, 0.0), *[(0.02, 0.0, 0.05)] * 20, (0.02, 0.0, 1e9)]
    forces = np.array([answer.force[2] for answer in follow(block, held)])
    times = 0.05 * np.arange(21)
    lost = sum(g * (1 - np.exp(-times / tau)) for g, tau in PRONY) / sum(g for g, _ in PRONY)
    shown = (forces[0] - forces[:-1]) / (forces[0] - forces[-1])
    # not exact: the ratio of moduli changes, and with it a little of the shape
    np.testing.assert_allclose(shown, lost, atol=0.04)


def test_a_closed_path_dissipates(block, rng):
    """Work on the tool over random closed paths: never more comes out than was put in."""
    for dt in (0.003, 0.05, 1.0):
        ends = np.zeros((5, 2))
        ends[1:4] = rng.uniform([0.1, -0.6], [0.7, 0.6], (3, 2))
        ticks = np.linspace(0, 4, 25)
        course = np.column_stack([np.interp(ticks, np.arange(5), end) for end in ends.T])
        answers = follow(block, [(*row, dt) for row in course])
        force = np.array([answer.force for answer in answers])
        moves = np.diff(course, axis=0) @ [[0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]
        work = -np.sum((force[1:] + force[:-1]) / 2 * moves, axis=1)
        assert work.sum() > 0.0
        assert work.sum() < work[work > 0].sum()


def test_a_lifted_tip_leaves_a_dent_that_recovers(block):
    lifted = follow(block, [(0.6, 0.0, 0.0), (0.6, 0.0, 2.0), (-0.1, 0.0, 0.0)])[-1]
    assert not lifted.force.any()
    dent = np.abs(lifted.displacement).max()
    assert 0.01 < dent < 0.6
    later = follow(block, [(-0.1, 0.0, 4.0)] * 6, lifted.past)[-1]
    assert np.abs(later.displacement).max() < 0.01 * dent
