"""Total errors: answers beside references on meshes graded towards the contact."""

import numpy as np
import pytest

from palpate.offline.fem.graded import Grading
from palpate.offline.fem.problem import FullProblem, TipPosition
from palpate.offline.scenes import find_scene
from palpate.offline.studies import truth
from palpate.shared.artifact import read_artifact


@pytest.fixture(scope="module")
def rows(artifact):
    """Return errors of one load and one position of the tip, beside a coarse reference."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(truth, "FIT_FOR_THE_TIP", Grading(finest=0.35, even=0.4, growth=0.9))
        patch.setattr(truth, "LEVELS", (0.3,))
        patch.setattr(truth, "DEPTHS", (0.2,))
        problem = FullProblem.of_artifact(read_artifact(artifact))
        at = problem.surface.project(np.array([5.6, 4.7, 8.0]))[0]
        return truth.at_place(problem, artifact, find_scene("quick").folder, at)


def test_a_total_error_is_at_most_the_sum_of_its_parts(rows):
    assert [row["kind"] for row in rows] == ["load", "tip"]
    for row in rows:
        for key in ("displacement", "von_mises", "force"):
            total, mesh, own = (row[f"{part}_{key}"] for part in ("total", "mesh", "reduction"))
            # each is relative to what it is compared with
            assert total <= 1.1 * (mesh + own) + 1e-9
    load, tip = rows
    assert load["total_force"] < 5e-3  # it is given
    assert max(load["total_displacement"], load["total_von_mises"]) < 0.3
    assert 0 < tip["reduction_force"] < tip["mesh_force"] < 0.1


def test_a_summary_counts_what_estimates_cover(rows):
    found = truth._summary(rows[:1], ("displacement", "von_mises"))
    assert found["answers"] == 1
    assert found["total"]["displacement"]["max"] == rows[0]["total_displacement"]
    assert found["covered"] == {
        key: float(rows[0][f"total_{key}"] <= rows[0][f"estimated_{key}"])
        for key in ("displacement", "von_mises")
    }
    assert truth._summary([], ()) == {}


def test_a_sphere_pressed_deeper_and_deeper_is_where_one_pressed_at_once_is():
    """From the last state, grown, it is found in fewer steps and to the tolerance."""
    problem = FullProblem(find_scene("quick"))
    pressed = truth.Pressed(problem, integrated=True)
    place = np.array([5.0, 5.0, 8.0 + problem.scene.endoscope.radius])
    for depth in (0.2, 0.4):
        centre = place - [0.0, 0.0, depth]
        found = pressed.harder("tip", depth, TipPosition(centre))
    exact = problem.model.solve(problem.sphere_at(centre))
    np.testing.assert_allclose(found.force, exact.force, atol=1e-3 * exact.force[2])
    np.testing.assert_allclose(found.displacement, exact.displacement, atol=2e-4)
