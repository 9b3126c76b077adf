"""The full model as a method, on the scene's mesh and on others."""

import numpy as np
import pytest

from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.methods.full import Full, Remeshed, divided
from palpate.offline.methods.lattice import coordinates, interpolation, lattice
from palpate.offline.methods.method import Case
from palpate.offline.scenes import find_scene

LOAD = Load(np.array([4.0, 5.5, 8.0]), np.array([0.0, 0.6, -0.8]), 1.5)


@pytest.fixture(scope="module")
def problem():
    return FullProblem(find_scene("quick"))


@pytest.mark.parametrize("factor", [0.5, 1.5, 2])
def test_other_meshes_give_linear_fields_at_the_nodes_of_the_scene(problem, factor):
    other = FullProblem(divided(problem.scene, factor))
    field = np.arange(9.0).reshape(3, 3)
    at = coordinates(problem.mesh, lattice(problem.scene))
    to_scene = interpolation(at, lattice(other.scene), other.mesh.elements)
    found = to_scene @ (other.mesh.nodes @ field)
    np.testing.assert_allclose(found, problem.mesh.nodes @ field, atol=1e-9)


def test_a_mesh_of_its_own_answers_like_the_scene_s(problem):
    method, case = Remeshed(problem.scene, 1), Case.of(problem, LOAD)
    found = method.displacement(method.solve(case).state)
    np.testing.assert_allclose(found, problem.solve(LOAD).displacement, atol=1e-9)


def test_a_step_of_no_time_is_the_instantaneous_answer(problem):
    """Tissue with and without time answer alike at once, and not after a while."""
    elastic, case = Full(problem), Case.of(problem, LOAD)
    visco = FullProblem(find_scene("quick-visco"), problem.mesh)
    in_time = Full(visco)
    answers = [elastic.solve(case), in_time.solve(case)]
    fields = [
        (method.displacement(answer.state), method.von_mises(answer.state))
        for method, answer in zip((elastic, in_time), answers, strict=True)
    ]
    for one, other in zip(*fields, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5 * np.abs(one).max())
    later = in_time.step(answers[1].state, case, 1.0)
    assert np.abs(in_time.displacement(later.state) - fields[0][0]).max() > 0.01
