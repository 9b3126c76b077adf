"""Queries: which are answered, which are flagged as outside the range, which are refused."""

import math

import numpy as np
import pytest

from palpate.shared.answer import describe
from palpate.shared.errors import QueryError
from palpate.shared.query import ABSURD
from palpate.shared.reduced import press
from palpate.shared.reduced.transfer import REST

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def contact(atlas):
    """Return a contact point and half the pressure allowed there."""
    x = atlas.models.centres[0]
    return x, 0.5 * atlas.press(x, 0.0).pressure_limit


def tilted(atlas, degrees):
    """A direction so far from the inward normal of the flat top."""
    angle = math.radians(degrees)
    return [math.sin(angle), 0.0, -math.cos(angle)]


def test_an_answer_within_the_range_says_so(atlas, contact):
    solution = atlas.press(*contact)
    assert solution.converged
    assert solution.in_range
    assert solution.out_of_range == ()
    assert solution.distance == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(solution.direction, -solution.normal)
    assert 0 < solution.min_jacobian < 1
    reduction, most = solution.error_reduction, (0.1, 0.2)
    for own, total, bound in zip(
        reduction, (solution.error_displacement, solution.error_von_mises), most, strict=False
    ):
        assert 0 < own < bound
        assert own < total < 0.5  # with the mesh's part, which is large on so coarse a mesh
    assert solution.contact_displacement @ solution.normal < 0


def test_an_answer_is_doubted_for_what_its_estimates_of_mesh_and_reduction_exceed(atlas, contact):
    answer = atlas.press(*contact)
    total = np.hypot(answer.error_reduction, answer.error_mesh)
    assert total[0] == pytest.approx(answer.error_displacement)
    assert total[1] == pytest.approx(answer.error_von_mises)
    assert (answer.error_mesh > 0).all()
    most = atlas.scene.tolerance
    good = answer._replace(error_displacement=most.displacement, error_von_mises=most.von_mises)
    assert atlas.doubts(good) == ()
    assert atlas.doubts(good._replace(error_von_mises=1.01 * most.von_mises)) == ("von_mises",)
    assert atlas.doubts(good._replace(error_force=1.01 * most.force)) == ("force",)
    assert atlas.doubts(good._replace(tip=True, error_von_mises=2 * most.von_mises)) == ()
    assert atlas.doubts(good._replace(converged=False)) == ("convergence",)
    assert atlas.doubts(atlas.press(contact[0], 2.5 * contact[1])) == ("pressure",)


def test_the_estimate_knows_whether_the_contact_is_near_the_rim(atlas, contact):
    high, radius = atlas.nodes.max(axis=0), atlas.scene.endoscope.radius
    for away in (0.0, 0.9, 1.1, 2.0):
        x = high * [0.0, 0.5, 1.0] + [away * radius, 0.0, 0.0]
        assert atlas.press(x, 0.2).features[-1] == (away < 1.0)
        assert atlas.touch([*x[:2], x[2] + radius - 0.1]).features[-1] == (away < 1.0)


def test_force_on_the_tool_is_pressure_times_the_projected_footprint(atlas):
    middle = atlas.nodes.max(axis=0) * [0.5, 0.5, 1.0]
    solution = atlas.press(middle, 2.0)
    radius = atlas.scene.endoscope.radius
    # the integral of (1 - rho^4)^2 over the disc, all of which lies on the top
    area = math.pi * radius**2 * 8 / 15
    np.testing.assert_allclose(solution.force, -2.0 * area * solution.direction, rtol=1e-2)


@pytest.mark.parametrize(
    ("offset", "flags"),
    [((0, 0, 1), ()), ((0, 0, -1), ()), ((-0.05, 0, 0), ()), ((-1, 0, 0), ("position",))],
)
def test_a_position_beside_the_surface_is_out_of_range_one_above_it_is_not(atlas, offset, flags):
    edge = atlas.nodes.max(axis=0) * [0.0, 0.5, 1.0]
    solution = atlas.press(edge + offset, 0.1)
    np.testing.assert_allclose(solution.contact_point, edge, atol=1e-9)
    assert solution.out_of_range == flags


@pytest.mark.parametrize(
    ("changes", "flags"),
    [
        ({"pressure": 1.01}, ("pressure",)),
        ({"tilt": 1.05}, ("direction",)),
        ({"radius": 0.9}, ("radius",)),
        ({"tilt": 1.05, "radius": 0.9}, ("direction", "radius")),
        ({"pressure": 0.999, "tilt": 0.99}, ()),
    ],
)
def test_what_is_outside_the_range_is_flagged(atlas, contact, changes, flags):
    """Changes are relative to the largest values trained."""
    endoscope = atlas.scene.endoscope
    x, _ = contact
    direction = tilted(atlas, changes.get("tilt", 0.0) * endoscope.max_tilt)
    limit = atlas.press(x, 0.0, direction).pressure_limit
    radius = changes.get("radius", 1.0) * endoscope.radius
    solution = atlas.press(x, changes.get("pressure", 0.3) * limit, direction, radius)
    assert solution.out_of_range == flags
    assert solution.in_range == (not flags)
    # nothing is known of the error there
    assert math.isinf(solution.error_displacement) == bool(flags)
    assert math.isinf(solution.error_von_mises) == bool(flags)
    estimate = describe(solution)["trust"]["error_estimate"]
    assert (estimate["von_mises"] is None) == bool(flags)


def test_pressures_are_refused_from_ten_times_the_largest_on(atlas, contact):
    assert atlas.press(contact[0], ABSURD * atlas.pressure_max).out_of_range == ("pressure",)
    with pytest.raises(QueryError, match="must be at most 10 times"):
        atlas.press(contact[0], 1.001 * ABSURD * atlas.pressure_max)


def test_no_pressure_moves_nothing_and_the_length_of_a_direction_means_nothing(atlas, contact):
    solution = atlas.press(contact[0], 0.0)
    assert solution.converged
    assert np.abs(atlas.displacement(solution)).max() <= 1e-9
    assert np.abs(atlas.von_mises(solution)).max() <= 1e-6
    usual, *others = (
        atlas.press(*contact, scale * np.array([0.9, 0.8, -1.0]))
        for scale in (7, 2e-162, 1e200, 1.79e308)
    )
    assert np.linalg.norm(usual.direction) == pytest.approx(1)
    for other in others:
        np.testing.assert_allclose(other.force, usual.force, rtol=1e-12)


def test_whole_numbers_are_answered_by_the_kernel_that_is_there(atlas, contact):
    atlas.press(contact[0], 1.0)
    compiled = len(press.press.signatures)
    atlas.press(contact[0], 1, radius=2)
    assert len(press.press.signatures) == compiled


NONSENSE = {
    "pressure": (math.nan, math.inf, -1e-9),
    "position": (
        [math.nan, 0, 0],
        [0, math.inf, 0],
        [1.0, 2.0],
        "here",
        [5.0, 5.0, 500.0],
        3 * [1.7e308],
    ),
    "direction": ([0, 0, 0], [0, math.nan, -1], [0, -1], [0, 0, 1], [1, 0, 0]),
    "radius": (0.0, -1.0, 2.001, math.nan),
}


@pytest.mark.parametrize(
    ("field", "value"), [(field, value) for field in NONSENSE for value in NONSENSE[field]]
)
def test_what_makes_no_sense_is_refused_by_name(atlas, contact, field, value):
    query = {"position": contact[0], "pressure": contact[1], field: value}
    with pytest.raises(QueryError) as refused:
        atlas.press(**query)
    assert refused.value.field == field
    assert str(refused.value)


def test_a_position_off_the_surface_is_moved_to_it_within_reach(atlas, contact):
    x, pressure = contact
    reach = atlas.scene.endoscope.reach
    solution = atlas.press(x + 0.99 * reach * UP, pressure)
    assert solution.distance == pytest.approx(0.99 * reach)
    np.testing.assert_allclose(solution.contact_point, x, atol=1e-9)
    with pytest.raises(QueryError, match=f"at most {reach} mm") as refused:
        atlas.press(x + 1.01 * reach * UP, pressure)
    near = ", ".join(f"{value:.2f}" for value in x)
    assert f"nearest is ({near}), and it lies within (" in str(refused.value)


def test_the_surface_is_part_of_the_whole(atlas, contact):
    solution = atlas.press(*contact)
    whole = atlas.displacement(solution, "all")
    assert (whole[atlas.clamped] == 0).all()
    np.testing.assert_allclose(
        atlas.displacement(solution, "surface"), whole[atlas.surface_nodes], atol=1e-6
    )
    stress = atlas.von_mises(solution, "all", whole)
    np.testing.assert_array_equal(atlas.von_mises(solution, "surface"), stress[atlas.surface_nodes])


def test_a_refused_query_leaves_the_last_answers_as_they_were(atlas, contact):
    x, pressure = contact
    touched, untouched = atlas.new_warm(), atlas.new_warm()
    for warm in (touched, untouched):
        atlas.press(x, pressure, warm=warm)
    with pytest.raises(QueryError):
        atlas.press(x, pressure, [0.0, 0.0, 1.0], warm=touched)
    answers = [atlas.press(x, 0.9 * pressure, warm=warm) for warm in (touched, untouched)]
    np.testing.assert_array_equal(*[atlas.displacement(answer) for answer in answers])


def test_elastic_tissue_has_no_time(atlas):
    for ask, query in ((atlas.press, (None, 0.0)), (atlas.touch, ([5.0, 5.0, 12.0],))):
        with pytest.raises(QueryError, match="is elastic"):
            ask(*query, past=REST, dt=0.1)


def test_under_the_tip_estimates_hold_what_the_mesh_errs_by_there(atlas):
    middle = atlas.nodes.max(axis=0) * [0.5, 0.5, 1.0]
    found = atlas.touch(middle + np.array([0.0, 0.0, 0.85 * atlas.scene.endoscope.radius]))
    share = min(found.depth / found.depth_limit, 1.0)
    mesh = np.exp(atlas.estimators.mesh_tip @ [1.0, share, 0.0])
    total = found.error_displacement, found.error_von_mises, found.error_force
    np.testing.assert_allclose(total, np.hypot(found.error_reduction, mesh), rtol=1e-12)
    assert (found.error_reduction < total).all()
    # its mesh is coarse: faces of 2.5 mm under a tip of 2 mm
    assert found.error_displacement < 0.4
    assert found.error_force < 0.2


def test_under_the_tip_the_surface_has_its_dent(atlas):
    """At the deepest point it is where the sphere is, which the mesh alone would not follow."""
    top = atlas.nodes[np.argmin(np.linalg.norm(atlas.nodes - [5.0, 5.0, 8.0], axis=1))]
    radius = atlas.scene.endoscope.radius
    found = atlas.touch(top + np.array([0.0, 0.0, radius - 0.2]))
    node = np.argmin(np.linalg.norm(atlas.nodes - top, axis=1))
    assert atlas.displacement(found)[node, 2] == pytest.approx(-0.2, rel=0.03)
    assert atlas.fields.of_mesh(found)[node, 2] > -0.15


def made_again(model, answer):
    """Return the displacement of the surface, made of what it says it is made of."""
    models, states, dented, dent = model.composition(answer)
    displacement = np.zeros((len(model.surface_nodes), 3))
    for number, state in zip(models.tolist(), states, strict=True):
        displacement += np.einsum("srx,r->sx", model.surface_modes(number), state)
    displacement[dented] += dent
    return displacement


def test_the_surface_is_made_of_local_models_and_the_dent(atlas, visco_atlas):
    """At once, and in time, where it holds what is left behind far from the tip as well."""
    radius = atlas.scene.endoscope.radius
    tip = [5.0, 4.2, 8.0 + radius - 0.5]
    answers = [(atlas, atlas.touch(tip)), (atlas, atlas.press([5.0, 5.0, 8.0], 1.0))]
    past = REST
    for x in np.linspace(2.0, 8.0, 13):
        answer = visco_atlas.touch([x, *tip[1:]], past=past, dt=0.02)
        past = answer.past
    assert len(visco_atlas.composition(answer).models) > len(answer.parts)
    for model, found in (*answers, (visco_atlas, answer)):
        assert found.converged
        displacement = model.displacement(found, "surface")
        largest = np.abs(displacement).max()
        assert np.abs(made_again(model, found) - displacement).max() < 1e-5 * largest
