"""The studies run and write what they promise; here on meshes too coarse to conclude from."""

import csv

import pytest

from palpate.offline.studies import mesh_error
from palpate.offline.studies.continuity import continuity
from palpate.offline.studies.mesh_error import Discretisation


def test_the_force_on_a_gliding_tip_jumps_no_more_than_the_full_models(artifact):
    found = continuity(artifact, 2, 6, 3, tip=True)
    assert found["steps"] + found["left_out"] == 12
    assert found["left_out"] < 6
    assert 0 < found["excess"]["max"] <= 0.01
    assert found["excess"]["median"] < found["change"]["median"]


def test_the_displacement_under_a_gliding_footprint_jumps_little(artifact):
    found = continuity(artifact, 2, 6, 3)
    assert (found["steps"], found["left_out"]) == (12, 0)
    assert 0 < found["excess"]["median"] < found["change"]["median"]


def test_mesh_error_is_tabled_and_drawn(tmp_path, monkeypatch):
    coarse, fine = (Discretisation("hex20", (n, 1, 4), 1.0) for n in (6, 9))
    hex8 = Discretisation("hex8", (8, 2, 5), 1.7)
    monkeypatch.setattr(mesh_error, "REFERENCE", fine)
    monkeypatch.setattr(mesh_error, "PROBE", coarse)
    monkeypatch.setattr(mesh_error, "SECOND_OPINIONS", ())
    monkeypatch.setattr(mesh_error, "CANDIDATES", (coarse, hex8))
    monkeypatch.setattr(mesh_error, "POINTS", 2)
    monkeypatch.setattr(mesh_error, "INDENTATION", 0.05)
    result = mesh_error.mesh_error(tmp_path / "report")
    assert list(result) == [str(fine), str(coarse), str(hex8)]
    assert result[str(fine)]["largest_greatest"] == 0.0
    assert result[str(hex8)]["under_footprint_least"] < -0.1  # stiff
    with (tmp_path / "report" / "mesh_error_points.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2
    for row in rows:
        moved = float(row["under_footprint_mm"])
        assert moved == pytest.approx(0.05 * float(row["thickness_mm"]), rel=0.3)
        assert float(row[str(fine)]) == 0.0
    with (tmp_path / "report" / "mesh_error.csv").open() as file:
        assert [row["values"] for row in csv.DictReader(file)] == ["9", "9", "9"]
    assert (tmp_path / "report" / "mesh_error.png").stat().st_size > 5000
