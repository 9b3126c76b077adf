"""The rigid tip on the reduced model: what is answered, what is flagged, what is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest

from palpate.offline.fem.problem import TipPosition
from palpate.shared.errors import QueryError
from palpate.shared.geometry.surface import Surface
from palpate.shared.mechanics.footprint import TIP_DEPTH
from palpate.shared.model import ReducedModel


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
    assert 0 < answer.penetration < answer.depth
    assert atlas.displacement(answer)[:, 2].min() == pytest.approx(-0.4, rel=0.05)  # its dent


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
    for at in ((0.5, 0.5), (0.31, 0.62), (0.7, 0.44), (0.02, 0.52)):
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


def test_what_is_outside_the_range_is_flagged(atlas):
    inside = atlas.touch(above(atlas, 0.3))
    assert inside.in_range
    assert inside.depth_limit > 0.3
    assert 0 < inside.error_displacement < 0.35  # with that of so coarse a mesh
    assert 0 < inside.error_force < 0.3
    deep = atlas.touch(above(atlas, 1.02 * inside.depth_limit))
    assert deep.out_of_range == ("depth",)
    assert deep.error_displacement == deep.error_von_mises == deep.error_force == np.inf
    beside = np.add(above(atlas, 1.9, (1.0, 0.5)), [0.5, 0, 0])
    assert "position" in atlas.touch(beside).out_of_range


def test_what_a_tip_feels_does_not_depend_on_the_range_of_its_depth(atlas):
    """The cubature's defect is known up to the largest pressure, however deep the tip may go."""
    limits = atlas.limits.copy()
    limits[:, TIP_DEPTH] *= 0.1
    known = atlas.body, atlas.surface, limits, atlas.models, atlas.estimators
    narrow = ReducedModel("narrow", atlas.scene, {}, *known)
    position = above(atlas, 0.9 * atlas.touch(above(atlas, 0.3)).depth_limit)
    wide, other = atlas.touch(position), narrow.touch(position)
    assert wide.in_range
    assert not other.in_range
    np.testing.assert_array_equal(other.force, wide.force)


def test_a_tip_that_would_go_on_over_the_rim_is_out_of_range(atlas):
    """Half of the top is accessible: beside it the tip presses the other half."""
    whole, (x, y, z) = atlas.surface, above(atlas, 0.4)
    inside = whole.vertices[:, 0] < x + 1e-9
    number = np.cumsum(inside) - 1
    triangles = whole.triangles[inside[whole.triangles].all(axis=1)]
    half = Surface(
        whole.vertices[inside], number[triangles].astype(np.int32), whole.normals[inside]
    )
    centres = atlas.body.nodes[atlas.body.faces].mean(axis=1)
    body = replace(atlas.body, accessible=atlas.body.accessible & (centres[:, 0] < x))
    known = atlas.limits[inside], atlas.models, atlas.estimators
    model = ReducedModel("half", atlas.scene, {}, body, half, *known)
    for beside, flags in ((-0.5, ()), (0.1, ()), (0.5, ("position",))):
        found = model.touch([x + beside, y, z])
        assert found.converged
        assert found.out_of_range == flags
    sideways = abs(found.force[0]), abs(atlas.touch([x + 0.5, y, z]).force[0])
    assert sideways[0] > 0.1 * found.force[2] > sideways[1]


@pytest.mark.parametrize("depth", [1e-6, 1e-4, 5e-3, 9e-3, 0.02])
def test_the_lightest_touch_has_the_force_of_hertz(atlas, depth):
    """Less than 1 % of it is the layer's, but for the deepest."""
    endoscope, tissue = atlas.scene.endoscope, atlas.scene.tissue
    hertz = 4 / 3 * tissue.young / (1 - tissue.poisson**2) * np.sqrt(endoscope.radius) * depth**1.5
    answer = atlas.touch(above(atlas, depth))
    assert answer.converged
    assert answer.force[2] == pytest.approx(hertz, rel=0.01 + np.sqrt(depth) / 3)


def test_no_answer_is_where_contact_just_begins(atlas):
    """There the energy is stationary, too; a contact far stiffer than the body leads to it."""
    tip = atlas.body.tip._replace(modulus=20.0 * atlas.body.tip.modulus)
    body = replace(atlas.body, tip=tip)
    known = body, atlas.surface, atlas.limits, atlas.models, atlas.estimators
    stiff = ReducedModel("stiff", atlas.scene, {}, *known)
    at = [(x, y) for x in np.linspace(0.925, 0.975, 11) for y in np.linspace(0.75, 0.95, 5)]
    answers = [stiff.touch(above(stiff, 1.4, place)) for place in at]
    forces = [np.linalg.norm(answer.force) for answer in answers if answer.converged]
    assert len(forces) > len(at) / 2
    assert min(forces) > 0.1 * max(forces)
