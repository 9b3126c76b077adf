"""Total errors: answers beside references on meshes graded towards the contact."""

import numpy as np
import pytest

from palpate.offline.fem.graded import Grading
from palpate.offline.fem.problem import FullProblem
from palpate.offline.scenes import find_scene
from palpate.offline.studies import truth


@pytest.fixture(scope="module")
def rows(artifact):
    """Return errors of one load and one position of the tip, beside a coarse reference."""
    with pytest.MonkeyPatch.context() as patch:
        coarse = Grading(finest=0.35, even=0.4, growth=0.9)
        patch.setattr(truth, "GRADINGS", dict.fromkeys(truth.KINDS, coarse))
        patch.setattr(truth, "LEVELS", (0.3,))
        patch.setattr(truth, "DEPTHS", (0.2,))
        problem = FullProblem.of_artifact(artifact)
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
    assert 0 < load["mesh_force"] < 0.1  # what the footprint moves
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
