"""The paper's figures on bodies of few elements, and those of its claims that hold there."""

import csv
import json
import sys

import numpy as np
import pytest
from click.testing import CliRunner

from palpate.offline.fem.mesh import local_thickness
from palpate.offline.fem.problem import FullProblem
from palpate.offline.scenes import find_scene
from palpate.offline.studies import paper, paper_claims, paper_pictures
from palpate.offline.studies.relaxation import load_steps
from palpate.shared.cli import main
from palpate.shared.errors import PalpateError

SIZES = (1, 2, 3, 6)
PNG = b"\x89PNG\r\n\x1a\n"


def coarse(name, *divisions):
    scene = find_scene(name)
    geometry = scene.geometry.model_copy(update={"divisions": divisions})
    return FullProblem(scene.model_copy(update={"geometry": geometry}))


@pytest.fixture(autouse=True)
def few_snapshots(monkeypatch):
    monkeypatch.setattr(paper, "SNAPSHOTS", 8)
    monkeypatch.setattr(paper, "SIZES", SIZES)


@pytest.fixture
def pressed():
    return paper.footprint(coarse("turbinate", 7, 1, 7), paper.MEDIAL)


@pytest.mark.parametrize(("name", "rounds"), [("cube", 3), ("cube-visco", 1)])
def test_the_cube_under_compression(tmp_path, monkeypatch, name, rounds):
    divisions = (4, 4, 4) if name == "cube" else (2, 2, 2)
    monkeypatch.setattr(paper, "FullProblem", lambda scene: coarse(scene.name, *divisions))
    monkeypatch.setattr(paper, "ROUNDS", rounds)
    report = tmp_path / "new"
    arguments = ["study", "cube", name, "--report", str(report), "--json"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["load"]["point_P_mm"] == [5, 5, 10]
    claims, figure = found["claims"], found["figure_1"]
    assert claims["pod_least_error"]["holds"]
    # the first bending modes know nothing of a load straight down
    assert figure["MOD 1"]["error_at_P_mean"] == pytest.approx(1, abs=1e-3)
    with (report / f"paper_{name}.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["method"] for row in rows} == {"MOD", "RITZ", "POD"}
    assert [int(row["bases"]) for row in rows if row["method"] == "RITZ"] == list(SIZES)
    assert all(row["unconverged"] == "0" for row in rows)
    assert (report / f"paper_{name}.png").read_bytes().startswith(PNG)
    if name == "cube":
        ratios = claims["pod_best_cpu_ratio"]["at_accuracy"]["0.001"]
        assert ratios["POD"] > 1
        assert ratios["MOD"] is None
        assert ratios["RITZ"] is None
        assert all(float(row["cpu_ratio"]) > 1 for row in rows)
        assert claims["stress_best_near_support"]["largest_stress_is_near"]
    else:
        assert figure["POD 6"]["error_at_P_mean"] < 1e-3 < figure["POD 1"]["error_at_P_mean"]
        assert figure["POD 6"]["von_mises_error_mean"] < 3e-3


def test_the_turbinate_under_a_footprint(tmp_path, pressed):
    found = paper.compare(pressed, tmp_path, SIZES)
    claims = found["claims"]
    assert claims["pod_least_error"]["holds"]
    assert claims["pod_best_cpu_ratio"]["holds"]
    # POD alone is accurate at all
    assert claims["pod_best_cpu_ratio"]["at_accuracy"]["0.01"]["RITZ"] is None
    assert found["figure_1"]["POD 3"]["error_at_P_mean"] < 1e-3
    few = found["claims_with_fewer_bases"]["3"]
    assert few["error_largest_where_value_smallest"]["holds"]
    assert few["stress_best_near_support"]["holds"]
    assert not list(tmp_path.glob("*contours*"))


def test_the_footprint_presses_as_hard_as_is_trained_for(pressed):
    largest = np.linalg.norm(paper.snapshots(pressed)[-1], axis=1).max()
    allowed = pressed.problem.scene.load.max_indentation
    at, normal, _ = pressed.problem.surface.project(np.array(paper.MEDIAL))
    (thickness,) = local_thickness(pressed.problem.mesh, at[None], normal[None])
    assert largest == pytest.approx(allowed * thickness, rel=0.05)


def test_pressure_on_the_whole_top():
    example = paper.covered(coarse("cube", 2, 2, 2), 2.0)
    np.testing.assert_allclose(example.load.sum(axis=0), [0, 0, -200], atol=1e-9)


def test_pod_is_asked_another_history_than_it_learns_from():
    learnt, asked = (np.array(load_steps(x)) for x in (paper.TRAINING, paper.QUERY))
    assert learnt.shape == asked.shape
    loaded = asked[:, 1] > 0
    assert (learnt[loaded] != asked[loaded]).all()
    held = paper.HELD
    assert asked[held, 1] == asked[:, 1].max() > asked[held + 1, 1]


def test_the_cube_bears_its_pressure_for_ever(monkeypatch):
    monkeypatch.setattr(paper, "FullProblem", lambda scene: coarse(scene.name, 2, 2, 2))
    monkeypatch.setattr(paper, "compare", lambda example, report: example)
    example = paper.cube("cube-visco", None)
    assert example.in_time
    relaxed = example.problem.model.relaxed.solve(example.load).displacement
    assert 0.5 < -relaxed[example.point, 2] < 2.0
    assert np.abs(relaxed[example.point, :2]).max() < 1e-3


def test_tenths_are_by_value():
    value = np.arange(1.0, 101.0)
    found = paper_claims._tenths(value, 1 / value)
    assert found["holds"]
    assert found["rank_correlation"] == pytest.approx(-1)
    assert not paper_claims._tenths(value, value)["holds"]


def test_contours(tmp_path, pressed):
    pytest.importorskip("pyvista")
    mesh = pressed.problem.mesh
    error = np.where(mesh.clamped, np.nan, 10.0 ** -mesh.nodes[:, 0])
    out = tmp_path / "new" / "contours.png"
    paper_pictures.contours(out, mesh, {"displacement": error, "stress": error}, pressed.at, 2.0)
    assert out.read_bytes().startswith(PNG)


def test_missing_pyvista_is_named_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(PalpateError, match=r"\.\[pictures\]"):
        paper.turbinate("turbinate", tmp_path)
    assert not list(tmp_path.iterdir())
