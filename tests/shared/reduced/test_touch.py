"""The rigid tip on the reduced model: what is answered, what is flagged, what is refused."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from palpate.offline.fem.problem import TipPosition
from palpate.shared.errors import QueryError
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.sphere import tip_of
from palpate.shared.reduced import contact_search, touch
from palpate.shared.reduced.past import Elastic
from palpate.shared.reduced.workspace import Workspace


def above(atlas, depth, at=(0.5, 0.5)):
    """A tip's centre over the flat top, so deep in it."""
    top = atlas.nodes.max(axis=0)
    return np.array([at[0] * top[0], at[1] * top[1], top[2] + atlas.scene.endoscope.radius - depth])


def test_a_tip_above_or_beside_the_body_feels_nothing(atlas):
    over, beside = (atlas.touch(x) for x in (above(atlas, -0.5), [-5.0, 5.0, 5.0]))
    for answer in (over, beside):
        assert not answer.contact
        assert answer.converged
        assert not answer.force.any()
        assert not answer.tangent.any()
        assert answer.parts == ()
        assert not atlas.displacement(answer).any()
    assert over.depth == pytest.approx(-0.5)
    assert beside.depth < 0.0


def test_the_tool_is_pushed_back(atlas):
    answer = atlas.touch(above(atlas, 0.4))
    assert answer.contact
    assert answer.converged
    assert answer.depth == pytest.approx(0.4)
    assert answer.force[2] > 0.0
    assert answer.tangent[2, 2] < 0.0
    assert abs(answer.force[:2]).max() < 0.05 * answer.force[2]
    assert 0 < answer.penetration < 0.02 * answer.depth
    assert atlas.displacement(answer)[:, 2].min() == pytest.approx(-0.4, abs=0.1)


def test_what_is_no_position_or_inside_the_body_is_refused(atlas):
    for position in ([math.nan, 0, 0], [0, math.inf, 0], [1.0, 2.0], "here", above(atlas, 2.1)):
        with pytest.raises(QueryError) as refused:
            atlas.touch(position)
        assert refused.value.field == "position"
    assert "below the accessible surface" in str(refused.value)


def path(atlas, depth, points):
    """Answers along positions (k, 2), fractions of the top, each from the last."""
    warm = atlas.new_warm()
    return [atlas.touch(above(atlas, depth, at), warm=warm) for at in points]


def test_the_tangent_is_the_derivative_of_the_force(atlas):
    h = 0.005
    for at in ((0.5, 0.5), (0.31, 0.62), (0.7, 0.44)):
        x = above(atlas, 0.6, at)
        tangent = atlas.touch(x).tangent
        for axis in range(3):
            step = h * np.eye(3)[axis]
            forces = [atlas.touch(x + s * step).force for s in (1, -1)]
            slope = (forces[0] - forces[1]) / (2 * h)
            assert np.abs(tangent[:, axis] - slope).max() <= 0.01 * np.abs(tangent).max()


def test_energy_put_in_comes_out_again(atlas):
    """Work of the force along a closed path in, aside and out, over the energy put in."""
    deep = np.concatenate(
        [np.linspace(-0.1, 0.8, 60), np.full(60, 0.8), np.linspace(0.8, -0.1, 60)]
    )
    aside = np.concatenate([np.full(60, 0.35), np.linspace(0.35, 0.65, 60), np.full(60, 0.65)])
    back = np.linspace(0.65, 0.35, 60)
    positions = [above(atlas, d, (a, 0.5)) for d, a in zip(deep, aside, strict=True)]
    positions += [above(atlas, -0.1, (a, 0.5)) for a in back]
    warm = atlas.new_warm()
    answers = [atlas.touch(x, warm=warm) for x in positions]
    x, force = np.array(positions), np.array([a.force for a in answers])
    work = -np.sum((force[1:] + force[:-1]) / 2 * np.diff(x, axis=0), axis=1)
    assert abs(work.sum()) <= 0.01 * work[:60].sum()
    assert work[:59].sum() == pytest.approx(answers[59].energy, rel=0.02)


def jumps(answers):
    """Change of the force from answer to answer that their tangents do not foretell, (k - 1,)."""
    x, force, tangent = (
        np.array([getattr(a, name) for a in answers]) for name in ("position", "force", "tangent")
    )
    foretold = np.einsum("kij,kj->ki", (tangent[1:] + tangent[:-1]) / 2, np.diff(x, axis=0))
    return np.linalg.norm(np.diff(force, axis=0) - foretold, axis=1)


def test_the_force_has_no_jumps_on_a_path(atlas, problem):
    """In steps of 0.05 mm across all local models, in and out of contact."""
    width = atlas.nodes[:, 0].max()
    count = int(0.6 * width / 0.05)
    across = np.linspace(0.2, 0.8, count)
    glide = path(atlas, 0.7, [(a, 0.37 + 0.2 * a) for a in across])
    force = np.array([a.force for a in glide])
    largest = np.linalg.norm(force, axis=1).max()
    assert len({k for a in glide for k, _, _ in a.parts}) >= 3
    assert jumps(glide).max() <= 0.01 * largest
    steepest = int(np.argmax(np.linalg.norm(np.diff(force, axis=0), axis=1)))
    here, there = (
        problem.solve(TipPosition(a.position)).force for a in glide[steepest : steepest + 2]
    )
    change = force[steepest + 1] - force[steepest]
    assert np.linalg.norm(change - (there - here)) <= 0.01 * largest
    warm = atlas.new_warm()
    fading = [atlas.touch(above(atlas, d), warm=warm) for d in np.arange(0.4, -0.1, -0.02)]
    assert not fading[-1].force.any()
    assert jumps(fading).max() <= 0.01 * largest


def same_force(answer, atlas):
    """Whether a fresh search at this position ends in the same force."""
    cold = atlas.touch(answer.position).force
    return np.abs(answer.force - cold).max() <= 1e-3 * np.linalg.norm(cold)


def test_where_it_came_from_does_not_matter(atlas):
    warm = atlas.new_warm()
    for depth in (0.1, 0.9, 0.5):
        atlas.touch(above(atlas, depth), warm=warm)
    assert same_force(atlas.touch(above(atlas, 0.6, (0.55, 0.45)), warm=warm), atlas)


def test_a_model_that_joins_in_starts_from_its_neighbours_answer(atlas):
    warm, joined, cold, numbers = atlas.new_warm(), [], [], set()
    for a in np.arange(0.2, 0.8, 0.005):
        x = above(atlas, 0.7, (a, 0.4))
        answer = atlas.touch(x, warm=warm)
        new = {k for k, _, _ in answer.parts} - numbers
        if numbers and new:
            joined.append(answer.iterations)
            cold.append(atlas.touch(x).iterations)
        numbers = {k for k, _, _ in answer.parts}
    assert len(joined) >= 3
    assert np.mean(joined) < 0.6 * np.mean(cold)


def test_a_search_cut_short_has_no_force_and_can_go_on_at_the_next_position(atlas):
    """Iteration by iteration, while the tip goes on."""
    warm, depths = atlas.new_warm(), iter(np.arange(0.7, 0.8, 0.005))
    answer = atlas.touch(above(atlas, next(depths)), warm=warm, most=3)
    assert not answer.converged
    while not answer.converged:
        assert not answer.force.any()
        assert answer.iterations <= 5
        warm.resume()
        answer = atlas.touch(above(atlas, next(depths)), warm=warm, most=3)
    assert same_force(answer, atlas)


def test_what_is_no_equilibrium_is_not_gone_on_from(atlas):
    warm = atlas.new_warm()
    before = atlas.touch(above(atlas, 0.6), warm=warm)
    assert not atlas.touch(above(atlas, 0.7), warm=warm, most=0).converged
    again = atlas.touch(above(atlas, 0.6), warm=warm, most=0)
    assert again.converged
    np.testing.assert_allclose(again.force, before.force, rtol=1e-4, atol=1e-3)


def test_what_is_outside_the_range_is_flagged(atlas):
    inside = atlas.touch(above(atlas, 0.3))
    assert inside.in_range
    assert inside.depth_limit > 0.3
    assert 0 < inside.error_displacement < 0.2
    assert 0 < inside.error_force < 0.3
    deep = atlas.touch(above(atlas, 1.02 * inside.depth_limit))
    assert deep.out_of_range == ("depth",)
    assert deep.error_displacement == deep.error_von_mises == deep.error_force == np.inf
    beside = np.add(above(atlas, 1.9, (1.0, 0.5)), [0.5, 0, 0])
    assert "position" in atlas.touch(beside).out_of_range


def test_contact_begins_where_the_surface_is_cut_short(atlas):
    # triangles cut the curves of a surface: contact can begin a little above them
    ground = atlas.surface.ground(atlas.limits)
    lower = ground._replace(vertices=ground.vertices - [0.0, 0.0, 0.01])
    coefficients = atlas.estimators.touches
    radius, low = atlas.scene.endoscope.radius, atlas.nodes[:, 2].max() - 0.01
    for depth in (0.0085, 0.005, 0.002):
        own = Workspace(atlas.touch_models, lower, coefficients, Elastic())
        x = above(atlas, 0.0, (0.4, 0.6))
        x[2] = low + radius - (depth - 0.01)
        touch.place(own.solver, x, x)
        touch.touch(own.solver, x, touch.MAX_ITERATIONS)
        answer = own.outcome
        assert -touch.SKIN * radius < answer.depth <= 0.0
        assert answer.touched > 0
        assert answer.status == newton.CONVERGED
        assert answer.force[2] > 0.0


class Ridge:
    """Two valleys at (-1, 3) and (1, 3), and a saddle between them."""

    def __init__(self):
        self.load = SimpleNamespace(tip=tip_of(1.0, 1.0))
        self.correction = SimpleNamespace(work=SimpleNamespace(whole=np.zeros((2, 2))))

    def potential(self, u, residual):
        residual[:] = u[0] * (u[0] ** 2 - 1.0), u[1] - 3.0
        return 0.25 * (u[0] ** 2 - 1.0) ** 2 + 0.5 * (u[1] - 3.0) ** 2, 1.0

    def factorise(self, u, shift):
        self.correction.work.whole[:] = np.diag([3.0 * u[0] ** 2 - 1.0, 1.0])
        self.shifted = self.correction.work.whole + shift * np.eye(2)
        return np.linalg.eigvalsh(self.shifted)[0] > 0.0

    def correct(self, residual, step):
        step[:] = -np.linalg.solve(self.shifted, residual)


def test_a_search_does_not_end_in_a_saddle(monkeypatch):
    for name in ("solve_contact", "_leave_saddle", "_response"):
        monkeypatch.setattr(contact_search, name, getattr(contact_search, name).py_func)
    monkeypatch.setattr(contact_search, "newton_method", newton.newton)
    problem, q, work = Ridge(), np.array([0.0, 2.0]), np.zeros((4, 2))
    search = problem, q, work, 0.1, 1e-6, 100
    assert contact_search.solve_contact(*search)[0] == newton.CONVERGED
    np.testing.assert_allclose(q, [0.0, 3.0], atol=1e-4)  # by symmetry
    assert contact_search.to_minimum.py_func(*search)[0] == newton.CONVERGED
    np.testing.assert_allclose(np.abs(q), [1.0, 3.0], atol=1e-4)
