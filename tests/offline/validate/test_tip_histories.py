"""Validation over histories of the rigid tip."""

import csv
import json

import numpy as np
import pytest
from click.testing import CliRunner

from palpate.offline.run.workshop import Workshop
from palpate.offline.validate.moments import errors_so_far
from palpate.offline.validate.tip_histories import (
    compare_course,
    play_course,
    random_courses,
    summarise_courses,
)
from palpate.shared.artifact import read_artifact
from palpate.shared.cli import main
from palpate.shared.model import ReducedModel


@pytest.fixture(scope="module")
def atlas(visco_artifact):
    return ReducedModel.load(visco_artifact)


def test_courses_move_like_a_tool(atlas, rng):
    courses = random_courses(atlas.surface, atlas.limits, atlas.scene, 8, rng)
    for course in courses:
        assert len(course.positions) == len(course.times)
        assert min(course.times) > 0.0
        answers = play_course(atlas, course)
        assert all(answer.converged and answer.in_range for answer in answers)
        assert any(answer.contact for answer in answers)
    assert len({tuple(course.positions[0]) for course in courses}) == 8


def test_moments_are_relative_to_the_largest_so_far():
    exact = np.array([[1.0, 0.0], [4.0, 0.0], [0.0, 0.0]])
    found = exact + np.array([[0.1, 0.0], [0.0, 0.2], [0.4, 0.0]])
    np.testing.assert_allclose(errors_so_far([(found, exact)]), [[0.1, 0.05, 0.1]])


def test_validation_over_histories_of_the_tip(visco_artifact, tmp_path):
    """On few unseen histories."""
    rows = tmp_path / "rows.csv"
    arguments = ["--tip", "--histories", "4", "--seed", "3", "--csv", str(rows), "--json"]
    result = CliRunner().invoke(main, ["validate", str(visco_artifact), *arguments])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert (found["histories"], found["unconverged"], found["other_equilibrium"]) == (4, 0, 0)
    assert found["displacement"]["mean"] <= 0.015
    assert found["von_mises"]["mean"] <= 0.02
    assert found["force"]["mean"] <= 0.01
    assert found["covered"] >= 0.8
    with rows.open(newline="") as file:
        assert [float(row["force"]) for row in csv.DictReader(file)]


def test_moments_in_different_equilibria_are_told_apart(atlas, visco_artifact, rng):
    (course,) = random_courses(atlas.surface, atlas.limits, atlas.scene, 1, rng)
    answers = play_course(atlas, course)
    u = np.array([atlas.displacement(answer) for answer in answers], float)
    full = [u.copy(), np.array([atlas.von_mises(a) for a in answers]), [a.force for a in answers]]
    at = np.argmax(np.linalg.norm(u.reshape(len(u), -1), axis=1))
    full[0][at] *= 1.2  # as if it had gone further there
    workshop = Workshop.of_artifact(read_artifact(visco_artifact))
    row = compare_course(workshop, atlas, course, [np.array(field) for field in full])
    assert row.apart == 1
    assert row.displacement > 0.01
    assert row.together_displacement <= 1e-6
    found = summarise_courses([row])
    assert found["apart"] == {"histories": 1, "moments": 1}
    assert found["together_displacement"]["max"] <= 1e-6 < found["displacement"]["max"]


def test_histories_of_the_tip_want_time(artifact):
    result = CliRunner().invoke(main, ["validate", str(artifact), "--tip", "--histories", "2"])
    assert result.exit_code != 0
    assert "no tip that knows of time" in result.stderr
