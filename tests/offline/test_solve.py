import json

import meshio
import numpy as np
import pytest

from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.problem import FullProblem
from palpate.offline.scenes import find_scene
from palpate.offline.solve import solve
from palpate.shared import query
from palpate.shared.artifact import read_artifact
from palpate.shared.errors import QueryError
from palpate.shared.model import ReducedModel
from palpate.shared.query import ABSURD

POSITION = (4.0, 5.5, find_scene("quick").geometry.size[2] + 0.2)
DIRECTION = (0.2, 0.1, -1.0)


@pytest.fixture(scope="module")
def problem(artifact):
    return FullProblem.of_artifact(read_artifact(artifact))


@pytest.fixture(scope="module")
def pressure(artifact):
    return 0.4 * float(ReducedModel.load(artifact).limits[:, 0].min())


@pytest.fixture(scope="module")
def solved(artifact, pressure, tmp_path_factory):
    """Return the report of a load solved by both models and the mesh with its fields."""
    path = tmp_path_factory.mktemp("solved") / "out.vtu"
    report = solve(artifact, POSITION, pressure, DIRECTION, full_model=True, vtu=path)
    return report, meshio.read(path)


def test_the_report_is_that_of_the_atlas(artifact, pressure):
    report = solve(artifact, POSITION, pressure, DIRECTION)
    solution = ReducedModel.load(artifact).press(POSITION, pressure, DIRECTION)
    assert report["scene"] == "quick"
    assert report["contact"]["distance"] == pytest.approx(0.2)
    assert report["force"] == pytest.approx(solution.force.tolist())
    assert report["trust"]["converged"]
    assert report["trust"]["in_range"]
    assert report["peak"]["displacement"] > 0
    assert report["timing"]["solve_us"] > 0
    assert "full_model" not in report
    json.dumps(report, allow_nan=False)


def test_the_full_model_is_in_equilibrium_on_the_written_mesh(problem, solved):
    _, mesh = solved
    np.testing.assert_array_equal(mesh.points, problem.mesh.nodes)
    np.testing.assert_array_equal(mesh.point_data["clamped"] != 0, problem.mesh.clamped)
    force, load = np.zeros(mesh.points.size), mesh.point_data["load"]
    displacement = mesh.point_data["displacement"]
    problem.model.internal(displacement.ravel(), force)
    free = problem.model.free
    residual = (force - load.ravel())[free]
    assert np.linalg.norm(residual) < 1e-8 * np.linalg.norm(load)
    assert np.abs(displacement[problem.mesh.clamped]).max() == 0.0
    np.testing.assert_allclose(mesh.point_data["von_mises"], problem.von_mises(displacement))


def test_load_and_force_agree(solved):
    report, mesh = solved
    pushed = mesh.point_data["load"].sum(axis=0)
    np.testing.assert_allclose(report["force"], -pushed, rtol=1e-9)  # on the tool


def test_the_errors_are_those_of_the_written_fields(problem, solved):
    report, mesh = solved
    kept = problem.beyond_clamped_layer
    for name, nodes in (("displacement", slice(None)), ("von_mises", kept)):
        exact, off = mesh.point_data[name][nodes], mesh.point_data[f"{name}_error"][nodes]
        error = np.linalg.norm(off) / np.linalg.norm(exact)
        assert report["full_model"]["error"][name] == pytest.approx(error)
        assert 0 < error < 0.5
    assert report["full_model"]["timing"]["solve_us"] > report["timing"]["solve_us"]


def test_without_the_full_model_the_fields_are_the_atlas_s(artifact, pressure, tmp_path):
    solve(artifact, POSITION, pressure, vtu=tmp_path / "out.vtu")
    atlas, fields = ReducedModel.load(artifact), meshio.read(tmp_path / "out.vtu").point_data
    solution = atlas.press(POSITION, pressure)
    assert list(fields) == ["displacement", "von_mises", "load", "clamped"]
    np.testing.assert_allclose(fields["displacement"], atlas.displacement(solution), atol=1e-6)
    np.testing.assert_allclose(fields["von_mises"], atlas.von_mises(solution), atol=1e-5)


def test_no_load_has_no_error(artifact):
    report = solve(artifact, POSITION, 0.0, full_model=True)
    assert report["full_model"]["error"] == {"displacement": 0.0, "von_mises": 0.0}


def test_a_load_without_equilibrium_is_told(artifact, monkeypatch):
    monkeypatch.setattr(query, "ABSURD", np.inf)
    with pytest.raises(NoEquilibrium, match=r"^pressure: no equilibrium .* up to [0-9.]+ kPa"):
        solve(artifact, POSITION, 1e4)


def test_a_pressure_far_beyond_all_training_is_refused(artifact):
    largest = ReducedModel.load(artifact).pressure_max
    with pytest.raises(QueryError, match=r"^pressure: must be at most 10 times the .* kPa"):
        solve(artifact, POSITION, 1.001 * ABSURD * largest)


@pytest.mark.parametrize("factor", [2.0, 5.0, 20.0])
def test_far_beyond_the_range_there_is_a_sound_answer_or_none(artifact, pressure, factor):
    try:
        report = solve(artifact, POSITION, factor * pressure)
    except NoEquilibrium:
        return
    assert report["trust"]["min_jacobian"] > 0
    known = report["trust"]["error_estimate"]["displacement"] is not None
    assert known == report["trust"]["in_range"]
    json.dumps(report, allow_nan=False)
