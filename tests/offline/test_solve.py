"""`palpate solve`: the reduced model's answer, the full model's, and the file of their fields."""

import csv
import json
import re

import meshio
import numpy as np
import pytest

from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.problem import Load
from palpate.offline.solve import solve
from palpate.offline.table import solve_table
from palpate.shared import query
from palpate.shared.errors import PalpateError

POSITION = (4.0, 5.5, 8.2)
DIRECTION = (0.2, 0.1, -1.0)


@pytest.fixture(scope="module")
def pressure(atlas):
    return 0.4 * float(atlas.limits[:, 0].min())


@pytest.fixture(scope="module")
def solved(answer, artifact, pressure, tmp_path_factory):
    """Return a function that runs the command and gives its report and the mesh it wrote."""

    def solved(*options):
        path = tmp_path_factory.mktemp("solved") / "out.vtu"
        load = "--at", *POSITION, "--pressure", pressure, *options, "--vtu", path
        return answer("solve", artifact, *load), meshio.read(path)

    return solved


@pytest.fixture(scope="module")
def both(solved):
    return solved("--direction", *DIRECTION, "--full-model")


def test_the_report_and_the_fields_are_those_of_the_atlas(atlas, pressure, solved):
    report, mesh = solved()
    solution, fields = atlas.press(POSITION, pressure), mesh.point_data
    assert report["scene"] == "quick"
    assert report["contact"]["distance"] == pytest.approx(0.2)
    assert report["contact"]["direction"] == pytest.approx([0, 0, -1])
    assert report["contact"]["pressure"] == pressure
    assert report["force"] == pytest.approx(solution.force.tolist())
    assert report["force"][2] > 0  # on the tool
    assert report["contact_displacement"][2] < 0
    assert report["trust"]["converged"]
    assert report["trust"]["in_range"]
    assert report["peak"]["displacement"] > 0
    assert report["timing"]["solve_us"] > 0
    assert "full_model" not in report
    assert list(fields) == ["displacement_mm", "von_mises_kPa", "load_mN", "clamped"]
    np.testing.assert_allclose(fields["displacement_mm"], atlas.displacement(solution), atol=1e-6)
    np.testing.assert_allclose(fields["von_mises_kPa"], atlas.von_mises(solution), atol=1e-5)


def test_the_full_model_is_in_equilibrium_on_the_written_mesh(problem, both):
    report, mesh = both
    np.testing.assert_array_equal(mesh.points, problem.mesh.nodes)
    np.testing.assert_array_equal(mesh.point_data["clamped"] != 0, problem.mesh.clamped)
    displacement, load = (mesh.point_data[name] for name in ("full_displacement_mm", "load_mN"))
    force = np.zeros(mesh.points.size)
    problem.model.internal(displacement.ravel(), force)
    residual = (force - load.ravel())[problem.model.free]
    assert np.linalg.norm(residual) < 1e-8 * np.linalg.norm(load)
    assert np.abs(displacement[problem.mesh.clamped]).max() == 0.0
    found = report["contact"]
    at, direction = np.array(found["position"]), np.array(found["direction"])
    contact = problem.footprint(Load(at, direction, found["pressure"]))
    np.testing.assert_allclose(
        mesh.point_data["full_von_mises_kPa"], problem.von_mises(displacement, contact=contact)
    )
    np.testing.assert_allclose(report["force"], -load.sum(axis=0), rtol=1e-9)  # on the tool
    np.testing.assert_allclose(report["force"], -report["force"][2] * np.array(DIRECTION))


def test_the_errors_are_those_of_the_written_fields(problem, both):
    report, mesh = both
    volumes = problem.nodal_volumes
    for name, unit, weights in (
        ("displacement", "mm", volumes[:, None]),
        ("von_mises", "kPa", volumes * problem.beyond_clamped_layer),
    ):
        found, exact, off = (
            mesh.point_data[f"{field}_{unit}"] for field in (name, f"full_{name}", f"{name}_error")
        )
        np.testing.assert_allclose(found - exact, off, atol=1e-12)
        error = np.sqrt(np.sum(weights * off**2) / np.sum(weights * exact**2))
        assert report["full_model"]["error"][name] == pytest.approx(error)
        assert 0 < error < 0.5
    assert report["full_model"]["timing"]["solve_us"] > report["timing"]["solve_us"]


def test_no_load_has_no_error_and_a_load_without_equilibrium_is_told(artifact, monkeypatch):
    report = solve(artifact, POSITION, 0.0, full_model=True)
    assert report["full_model"]["error"] == {"displacement": 0.0, "von_mises": 0.0}
    monkeypatch.setattr(query, "ABSURD", np.inf)
    with pytest.raises(NoEquilibrium, match=r"^pressure: no equilibrium .* up to [0-9.]+ kPa"):
        solve(artifact, POSITION, 1e4)


def test_a_smaller_radius_is_answered_and_said_to_be_out_of_range(
    answer, artifact, atlas, pressure
):
    at = "--at", *POSITION, "--pressure", pressure, "--radius", 1.5
    report, expected = answer("solve", artifact, *at), atlas.press(POSITION, pressure, radius=1.5)
    assert report["contact"]["radius"] == 1.5
    np.testing.assert_allclose(report["force"], expected.force)
    assert 0 < report["force"][2] < atlas.press(POSITION, pressure).force[2]
    assert report["trust"]["converged"]
    assert report["trust"]["out_of_range"] == ["radius"]


def test_the_tip_is_answered_as_by_the_atlas(answer, artifact, atlas):
    at = 4.0, 5.5, 9.7
    report, expected = answer("solve", artifact, "--tip", "--at", *at), atlas.touch(at)
    np.testing.assert_allclose(report["force"], expected.force)
    np.testing.assert_allclose(report["tangent"], expected.tangent)
    assert report["contact"]["depth"] == pytest.approx(expected.depth)
    assert report["contact"]["depth_limit"] == pytest.approx(expected.depth_limit)
    assert report["trust"]["error_estimate"]["force"] == pytest.approx(expected.error_force)
    full = solve(artifact, at, None, full_model=True)["full_model"]
    assert 0 < full["error"]["displacement"] < 0.1


def test_every_row_of_a_table_is_answered(answer, artifact, atlas, tmp_path):
    table, out = tmp_path / "in.csv", tmp_path / "out.csv"
    table.write_text("x,y,z,pressure,dx,dy,dz\n4,5,8,0.5,0,0,-1\n6,5,8,1.0,0.2,0.1,-1\n")
    report = answer("solve", artifact, "--csv", table, "--out", out)
    assert (report["rows"], report["in_range"], report["without_equilibrium"]) == (2, 2, 0)
    rows = list(csv.DictReader(out.read_text().splitlines()))
    expected = atlas.press((6, 5, 8), 1.0, (0.2, 0.1, -1))
    assert float(rows[1]["force_z"]) == pytest.approx(expected.force[2], rel=1e-5)
    assert float(rows[1]["error_von_mises"]) == pytest.approx(expected.error_von_mises, rel=1e-5)
    assert rows[1]["pressure"] == "1"
    table.write_text("x,y,z\n4,5,9.7\n\n4,5,20\n")
    report = answer("solve", artifact, "--csv", table, "--out", out, "--tip")
    rows = list(csv.DictReader(out.read_text().splitlines()))
    assert [float(row["force_z"]) > 0.0 for row in rows] == [True, False]


WRONG = {
    "x,y,z\n": "its first line must be x,y,z,pressure or",
    "x,y,z,pressure\n1,2,3\n": "line 2: must be 4 numbers, not 1,2,3",
    "x,y,z,pressure\n5,5,8,1\n5,5,8,one\n": "line 3: must be 4 numbers",
    "x,y,z,pressure\n5,5,8,1\n5,5,8,nan\n": "line 3: pressures: must be finite",
    "x,y,z,pressure\n5,5,80,1\n": "line 2: positions: more than",
}


@pytest.mark.parametrize(("text", "reason"), WRONG.items())
def test_the_line_of_a_table_that_is_wrong_is_named(artifact, tmp_path, text, reason):
    (tmp_path / "in.csv").write_text(text)
    with pytest.raises(PalpateError, match=re.escape(reason)):
        solve_table(artifact, tmp_path / "in.csv", tmp_path / "out.csv", tip=False)
    assert not (tmp_path / "out.csv").exists()


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
