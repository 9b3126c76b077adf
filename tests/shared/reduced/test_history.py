"""Visco-elastic tissue under loads and the tip: answers of the full model, and what is kept."""

import numpy as np
import pytest

from palpate.offline.fem.problem import Load, TipPosition
from palpate.shared.errors import QueryError
from palpate.shared.reduced.transfer import REST

DOWN = np.array([0.0, 0.0, -1.0])

HOLD = ((0.8, 0.0, 0.0), (0.8, 0.0, 0.05), (0.8, 0.0, 0.3), (0.8, 0.0, 1.0))
"""Shares of the limit, places aside (mm) and time steps (s)."""

LIFTED = -0.2
"""Share that stands for no contact."""


@pytest.fixture(scope="module")
def artifact(visco_artifact):
    return visco_artifact


@pytest.fixture(scope="module")
def atlas(visco_atlas):
    return visco_atlas


def off(a, b):
    return np.linalg.norm(np.subtract(a, b)) / np.linalg.norm(b)


class Pressing:
    """Loads down on the flat top."""

    limit_name = "pressure"

    def __init__(self, atlas):
        self.atlas = atlas
        self.middle = atlas.nodes.max(axis=0) * [0.5, 0.5, 1.0]
        self.limit = atlas.press(self.middle, 0.0).pressure_limit

    def __call__(self, share, aside=0.0, past=None, dt=0.0):
        """Answer to a share of the limit, so many mm aside."""
        at = None if share < 0.0 else np.add(self.middle, [aside, 0.05 * aside, 0.0])
        return self.atlas.press(at, max(share, 0.0) * self.limit, past=past, dt=dt)

    def response(self, answer):
        """What the answer says of the contact."""
        return answer.contact_displacement

    def same(self, answer, dt):
        """The same query of the full model."""
        return Load(answer.contact_point, DOWN, answer.pressure, dt)


class Touching:
    """The rigid tip over the flat top."""

    limit_name = "depth"

    def __init__(self, atlas):
        self.atlas = atlas
        x, y, z = atlas.nodes.max(axis=0)
        self.top = np.array([0.42 * x, 0.46 * y, z + atlas.scene.endoscope.radius])
        self.limit = atlas.touch(self.top).depth_limit

    def place(self, share, aside=0.0):
        """Centre of the tip."""
        return np.add(self.top, [aside, 0.0, -share * self.limit])

    def __call__(self, share, aside=0.0, past=None, dt=0.0):
        return self.atlas.touch(self.place(share, aside), past=past, dt=dt)

    def response(self, answer):
        return answer.force

    def same(self, answer, dt):
        return TipPosition(answer.position, dt)


@pytest.fixture(scope="module", params=[Pressing, Touching], ids=["load", "tip"])
def tool(request, atlas):
    return request.param(atlas)


@pytest.fixture(scope="module")
def tip(atlas):
    return Touching(atlas)


def follow(tool, course, past=REST):
    """Answers along a course."""
    answers = []
    for share, aside, dt in course:
        answers.append(tool(share, aside, past, dt))
        assert answers[-1].converged
        past = answers[-1].past
    return answers


# --- beside the full model -----------------------------------------------------------------------


def errors(tool, problem, course):
    """Of displacement, stress and the tip's force in each moment, over the largest so far."""
    atlas, answers = tool.atlas, follow(tool, course)
    full = problem.reference(
        [tool.same(a, dt) for a, (*_, dt) in zip(answers, course, strict=True)]
    )
    kept = problem.beyond_clamped_layer
    found = (
        [atlas.displacement(a) for a in answers],
        [atlas.von_mises(a)[kept] for a in answers],
        [a.force for a in answers],
    )
    exact = full.u, full.s[:, kept], *([full.f] if tool.limit_name == "depth" else [])
    columns = []
    for a, b in zip(found, exact, strict=False):
        largest = np.maximum.accumulate([np.linalg.norm(x) for x in b])
        columns.append([np.linalg.norm(x - y) for x, y in zip(a, b, strict=True)] / largest)
    return answers, full, np.array(columns).T


def test_what_is_held_relaxes_or_creeps_as_the_full_model_does(tool, problem):
    answers, _, found = errors(tool, problem, HOLD)
    first, *_, last = (np.linalg.norm(tool.response(answer)) for answer in answers)
    assert last < 0.75 * first if tool.limit_name == "depth" else last > 1.2 * first
    assert np.all(found <= ([0.03, 0.04, 0.02] if tool.limit_name == "depth" else [0.03, 0.05]))
    if tool.limit_name == "depth":
        assert all(0.0 < answer.error_reduction[2] < 0.3 for answer in answers)
        assert all(answer.error_reduction[2] < answer.error_force < 1.0 for answer in answers)


SLIDE = [(0.6, -2.0, 0.5), *((0.6, aside, 0.05) for aside in np.linspace(-2, 2, 13))]
SLIDE += [(LIFTED, 2.0, 0.02), (LIFTED, 2.0, 0.3), (0.4, 0.5, 0.02)]
HOP = [(0.7, -2.5, 0.05), (0.7, -2.5, 1.0), (0.7, 2.5, 0.05), (0.7, 2.5, 0.2)]
HOP += [(LIFTED, 2.5, 0.01), (LIFTED, 2.5, 0.3)]


@pytest.mark.parametrize(
    ("tool", "course"),
    [(Pressing, SLIDE), (Touching, SLIDE), (Pressing, HOP)],
    indirect=["tool"],
    ids=["load-slides", "tip-slides", "load-hops"],
)
def test_from_model_to_model_the_past_is_not_lost_and_a_dent_stays_behind(tool, problem, course):
    answers, full, found = errors(tool, problem, course)
    assert len({answer.past.main for answer in answers}) > 1
    assert np.all(found <= [0.035, 0.05, 0.03][: found.shape[1]])
    sizes = np.linalg.norm(full.u, axis=(1, 2))
    assert sizes[-1] > 0.1 * sizes.max()


def test_at_once_tissue_answers_as_without_time(tool, atlas):
    sudden, elastic = tool(0.8, past=REST), tool(0.8)
    assert elastic.past is None
    assert off(tool.response(sudden), tool.response(elastic)) <= 5e-3
    # in time no cubature defect is taken off: neither of loads nor of the tip
    displacement, von_mises = (4e-3, 3e-3) if tool.limit_name == "depth" else (0.01, 0.02)
    assert off(atlas.displacement(sudden), atlas.displacement(elastic)) <= displacement
    assert off(atlas.von_mises(sudden), atlas.von_mises(elastic)) <= von_mises
    if tool.limit_name == "depth":
        assert off(sudden.force, elastic.force) <= 1e-3
        assert off(sudden.tangent, elastic.tangent) <= 0.01


# --- what is remembered --------------------------------------------------------------------------


def test_a_past_is_its_own_snapshot(tool, atlas):
    past = follow(tool, HOLD)[-1].past
    onward = [(0.4, 0.4, 0.01), (0.8, 2.0, 0.05), (LIFTED, 2.0, 0.02)]
    first = follow(tool, onward, past)
    follow(tool, [(0.9, -2.0, 0.5)])  # something else in between
    again = follow(tool, onward, past)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(tool.response(a), tool.response(b))
        np.testing.assert_array_equal(a.tangent, b.tangent)
        np.testing.assert_array_equal(atlas.displacement(a), atlas.displacement(b))
        np.testing.assert_array_equal(atlas.von_mises(a), atlas.von_mises(b))


def test_thousands_of_steps_end_where_few_do(tool):
    """Periodic movement leads to a periodic response: rounding does not add up."""
    past, seen = REST, []
    for number in range(4000):
        answer = tool(0.4 + 0.3 * np.sin(2 * np.pi * number / 100), past=past, dt=0.02)
        past = answer.past
        if number % 100 == 99:
            seen.append(tool.response(answer)[2])
    late = np.array(seen[20:])
    assert np.ptp(late) <= 2e-3 * abs(late.mean())


def test_lifted_from_it_the_tissue_recovers(tool, atlas):
    untouched = tool(LIFTED, past=REST, dt=0.1)
    assert untouched.past.time == 0.1
    assert not atlas.displacement(untouched).any()
    *_, held, lifted = follow(tool, [*HOLD, (LIFTED, 0.0, 0.0)])
    past, sizes = lifted.past, [np.linalg.norm(atlas.displacement(lifted))]
    for _ in range(60):
        answer = tool(LIFTED, past=past, dt=0.5)
        past = answer.past
        assert answer.converged
        assert not answer.contact
        assert not answer.force.any()
        sizes.append(np.linalg.norm(atlas.displacement(answer)))
    assert np.all(np.diff(sizes) < 1e-6 * sizes[0])
    assert sizes[-1] <= 2e-3 * np.linalg.norm(atlas.displacement(held))


def test_extreme_steps_have_answers(tool, atlas):
    course = ((1.0, 0.0), (0.0, 0.0), (1.0, 1e-9), (1.0, 1e9), (LIFTED, 1e-3), (1.0, 0.0))
    for answer in follow(tool, [(share, 0.0, dt) for share, dt in course]):
        for numbers in (answer.tangent, atlas.displacement(answer), atlas.von_mises(answer)):
            assert np.all(np.isfinite(numbers))


def test_what_is_pressed_and_lifted_in_no_time_has_an_answer(atlas, rng):
    """Nothing is left then that the residual could be small beside."""
    for _ in range(20):
        x, past = atlas.nodes.max(axis=0) * [*rng.random(2), 1.0], REST
        limit = atlas.press(x, 0.0).pressure_limit
        for share in (0.8, 0.0, 0.8, 0.4, 0.0, 0.0):
            answer = atlas.press(x, share * limit, past=past)
            past = answer.past
            assert answer.converged
        assert np.linalg.norm(answer.contact_displacement) < 1e-5


# --- the tip's force -----------------------------------------------------------------------------


def test_the_tangent_is_the_derivative_of_the_force_of_a_step(tip):
    deep = 0.6 / tip.limit
    past = follow(tip, [(deep, 0.0, 0.02), (deep, 0.0, 0.4), (deep / 1.5, 0.2, 0.02)])[-1].past
    x, h = tip.place(deep / 1.2, 0.25), 0.005

    def touch(position):
        return tip.atlas.touch(position, past=past, dt=0.01)

    tangent = touch(x).tangent
    for axis, step in enumerate(h * np.eye(3)):
        slope = (touch(x + step).force - touch(x - step).force) / (2 * h)
        assert np.abs(tangent[:, axis] - slope).max() <= 0.015 * np.abs(tangent).max()


# --- trust and refusals --------------------------------------------------------------------------


def test_the_error_stays_unknown_once_a_history_has_left_the_range(tool):
    past = REST
    for share, known in ((0.5, True), (1.05, False), (0.5, False)):
        answer = tool(share, past=past, dt=0.1)
        past = answer.past
        assert answer.out_of_range == ((tool.limit_name,) if share > 1.0 else ())
        for error in answer.error_reduction[:2]:
            assert 0.0 < error < 0.3 if known else error == np.inf
        for error in (answer.error_displacement, answer.error_von_mises):
            assert np.isfinite(error) == known


def test_a_load_out_of_range_in_other_ways_leaves_the_error_unknown_too(atlas):
    load = Pressing(atlas)
    small = 0.9 * atlas.scene.endoscope.radius
    past = atlas.press(load.middle, 1.0, radius=small, past=REST, dt=0.1).past
    answer = load(0.3, past=past, dt=0.1)
    assert answer.in_range
    assert answer.error_displacement == answer.error_von_mises == np.inf


def test_a_tool_that_waits_first_has_gone_no_way(atlas):
    load = Pressing(atlas)
    waited = load(LIFTED, past=REST, dt=0.1)
    assert waited.past.position is None
    late, soon = (load(0.5, past=past, dt=0.1) for past in (waited.past, REST))
    assert late.error_displacement == pytest.approx(soon.error_displacement, rel=1e-3)


def test_the_past_of_one_tool_is_not_that_of_the_other(atlas, tip):
    pressed = Pressing(atlas)(0.5, past=REST, dt=0.1).past
    with pytest.raises(QueryError, match="is of loads, the query of the tip"):
        tip(0.5, past=pressed, dt=0.1)
    assert tip(0.5, past=REST, dt=0.1).converged


def test_beyond_the_range_is_flagged_and_never_nan(atlas):
    load, past = Pressing(atlas), REST
    for factor in (2.0, 5.0, 9.0):
        answer = load(factor, past=past, dt=0.1)
        assert answer.out_of_range == ("pressure",)
        if not answer.converged:
            assert answer.past is past
        past = answer.past
        assert np.all(np.isfinite(atlas.displacement(answer)))
        assert answer.error_displacement == answer.error_von_mises == np.inf


@pytest.mark.parametrize(
    ("wrong", "field"),
    [
        ({"dt": -1.0}, "time"),
        ({"dt": float("nan")}, "time"),
        ({"dt": float("inf")}, "time"),
        ({"aside": float("nan")}, "position"),
    ],
)
def test_what_is_wrong_is_named(tool, wrong, field):
    with pytest.raises(QueryError) as refused:
        tool(0.5, **{"past": REST, "dt": 0.1} | wrong)
    assert refused.value.field == field


def test_deviatoric_stiffness_is_between_none_and_all(atlas):
    for viscous in (atlas.models.viscous,):
        for D in viscous.deviatoric.astype(float):
            values = np.linalg.eigvalsh(D)
            assert values[0] > 0.0
            assert values[-1] < 1.001
