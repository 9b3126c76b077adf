"""The full model as a method, on the scene's mesh and on others."""

import numpy as np
import pytest

from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.methods.full import Full, Remeshed
from palpate.offline.methods.method import Case
from palpate.offline.scenes import find_scene

LOAD = Load(np.array([4.0, 5.5, 8.0]), np.array([0.0, 0.6, -0.8]), 1.5)


@pytest.mark.parametrize("factor", [0.5, 1.5, 2])
def test_other_meshes_give_linear_fields_at_the_nodes_of_the_scene(problem, factor):
    method, slope = Remeshed(problem, factor), np.arange(9.0).reshape(3, 3)
    found = method.field(method.other.mesh.nodes @ slope)
    np.testing.assert_allclose(found, problem.mesh.nodes @ slope, atol=1e-9)


@pytest.mark.parametrize("lip_rows", [0, 2])
def test_a_mesh_twice_as_fine_has_the_nodes_of_a_section_s_mesh(lip_rows):
    scene = find_scene("turbinate-paper")
    changed = {"divisions": (7, 3, 2), "lip_rows": lip_rows}
    geometry = scene.geometry.model_copy(update=changed)
    body = FullProblem(scene.model_copy(update={"geometry": geometry}))
    finer = Remeshed(body, 2)
    assert finer.cells == (2 * (7 + lip_rows), 4, 6)
    np.testing.assert_allclose(finer.field(finer.other.mesh.nodes), body.mesh.nodes, atol=1e-9)
    # a mesh that is not nested interpolates the body's shape, which is curved
    other = Remeshed(body, 1.5)
    np.testing.assert_allclose(other.field(other.other.mesh.nodes), body.mesh.nodes, atol=0.3)


def test_a_mesh_of_its_own_answers_like_the_scene_s(problem):
    method, case = Remeshed(problem, 1), Case.of(problem, LOAD)
    found = method.displacement(method.solve(case).state)
    np.testing.assert_allclose(found, problem.solve(LOAD).displacement, atol=1e-9)


def test_a_step_of_no_time_is_the_instantaneous_answer(problem, visco_problem):
    """Tissue with and without time answer alike at once, and not after a while."""
    case, in_time = Case.of(problem, LOAD), Full(visco_problem)
    answers = {method: method.solve(case) for method in (Full(problem), in_time)}
    for field in ("displacement", "von_mises"):
        one, other = (getattr(method, field)(found.state) for method, found in answers.items())
        np.testing.assert_allclose(one, other, atol=1e-5 * np.abs(one).max())
    later = in_time.step(answers[in_time].state, case, 1.0).state
    moved = in_time.displacement(later) - in_time.displacement(answers[in_time].state)
    assert np.abs(moved).max() > 0.01
