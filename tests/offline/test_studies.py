"""The studies run and write what they promise; here on meshes too coarse to conclude from."""

import numpy as np
import pytest

from palpate.offline.fem.mesh import local_thickness
from palpate.offline.studies import mesh_error
from palpate.offline.studies.continuity import continuity
from palpate.offline.studies.mesh_error import Discretisation

from .conftest import drawn, table


@pytest.mark.parametrize("tip", [False, True])
def test_answers_under_a_gliding_tool_jump_no_more_than_the_full_models(artifact, tip):
    found = continuity(artifact, 2, 6, 3, tip=tip)
    assert found["steps"] + found["left_out"] == 12
    assert found["left_out"] < (6 if tip else 1)
    assert 0 < found["excess"]["median"] < found["change"]["median"]
    assert found["excess"]["max"] <= 0.01 or not tip


def test_a_tip_on_a_layer_is_compared_with_the_theory(answer, artifact):
    """On a block too narrow for it, which the tip's own law hides at small depths."""
    report = answer("study", "layer", artifact)
    assert max(map(abs, report["error"].values())) < 0.03
    assert abs(report["exponent"] - report["exponent_of_theory"]) < 0.02
    rows = table(artifact.parent / artifact.stem / "report" / "layer.csv")
    assert [float(row["depth_mm"]) for row in rows] == [0.1, 0.2, 0.4]
    for row in rows:
        found = float(row["force_mN"]) / float(row["theory_mN"]) - 1
        assert found == pytest.approx(report["error"][row["depth_mm"]], abs=1e-5)


def test_mesh_error_is_tabled(tmp_path, monkeypatch):
    coarse, fine = (Discretisation("hex20", (n, 2, 4), 1.0) for n in (6, 9))
    hex8 = Discretisation("hex8", (8, 2, 5), 1.7)
    monkeypatch.setattr(mesh_error, "REFERENCE", fine)
    monkeypatch.setattr(mesh_error, "PROBE", coarse)
    monkeypatch.setattr(mesh_error, "SECOND_OPINION", coarse)
    monkeypatch.setattr(mesh_error, "CANDIDATES", (hex8,))
    monkeypatch.setattr(mesh_error, "POINTS", 2)
    monkeypatch.setattr(mesh_error, "INDENTATION", 0.05)
    result = mesh_error.mesh_error(tmp_path / "report")
    assert list(result) == [str(fine), str(coarse), str(hex8)]
    assert result[str(fine)]["largest_greatest"] == 0.0
    assert result[str(hex8)]["under_footprint_least"] < -0.1  # stiff
    rows = table(tmp_path / "report" / "mesh_error.csv")
    assert [row["mesh"] for row in rows] == list(result)


def test_the_tissue_moves_by_the_share_of_its_thickness_that_is_asked_for(monkeypatch):
    monkeypatch.setattr(mesh_error, "POINTS", 2)
    monkeypatch.setattr(mesh_error, "INDENTATION", 0.05)
    coarse = Discretisation("hex20", (6, 2, 4), 1.0).body()
    for x, normal, traction in mesh_error.contacts(coarse, coarse):
        _, under = coarse.press_at(x, normal, traction)
        (thickness,) = local_thickness(coarse.mesh, x[None], normal[None])
        assert np.linalg.norm(under) == pytest.approx(0.05 * thickness, rel=0.05)


def test_relaxation_press_hold_release(answer, visco_artifact):
    report = answer("study", "relaxation", visco_artifact)
    assert report["depth_held_mm"] > 1.3 * report["depth_pressed_mm"] > 0.3
    assert 0.0 < report["dent_left_mm"] < 0.1 * report["depth_held_mm"]
    assert report["largest_difference_mm"] < 0.02 * report["depth_held_mm"]
    folder = visco_artifact.parent / visco_artifact.stem / "report"
    assert drawn(folder / "relaxation.png")
    rows = table(folder / "relaxation.csv")
    assert float(rows[-1]["force_mN"]) == 0.0
    assert len(rows) == 95
