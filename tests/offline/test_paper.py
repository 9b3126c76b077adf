"""The paper's figures on bodies of few elements, and those of its claims that hold there."""

import numpy as np
import pytest

from palpate.offline.fem.mesh import local_thickness
from palpate.offline.fem.problem import FullProblem
from palpate.offline.scenes import find_scene
from palpate.offline.studies import paper, paper_pictures
from palpate.offline.studies.relaxation import load_steps

from .conftest import drawn, table

SIZES = (1, 2, 3, 6)


def coarse(name, *divisions):
    scene = find_scene(name)
    geometry = scene.geometry.model_copy(update={"divisions": divisions})
    return FullProblem(scene.model_copy(update={"geometry": geometry}))


@pytest.fixture(autouse=True)
def few_snapshots(monkeypatch):
    monkeypatch.setattr(paper, "SNAPSHOTS", 8)
    monkeypatch.setattr(paper, "SIZES", SIZES)


@pytest.fixture(scope="module")
def pressed():
    return paper.footprint(coarse("turbinate-paper", 7, 2, 7))


@pytest.mark.parametrize(("name", "rounds"), [("cube", 3), ("cube-visco", 1)])
def test_the_cube_under_compression(answer, tmp_path, monkeypatch, name, rounds):
    divisions = (4, 4, 4) if name == "cube" else (2, 2, 2)
    monkeypatch.setattr(paper, "FullProblem", lambda scene: coarse(scene.name, *divisions))
    monkeypatch.setattr(paper, "ROUNDS", rounds)
    report = tmp_path / "new"
    found = answer("study", "cube", name, "--report", report)
    assert found["load"]["point_P_mm"] == [5, 5, 10]
    claims, figure = found["claims"], found["figure_1"]
    assert claims["pod_least_error"]["holds"]
    # the first bending modes know nothing of a load straight down
    assert figure["MOD 1"]["error_at_P_mean"] == pytest.approx(1, abs=1e-3)
    rows = table(report / f"paper_{name}.csv")
    assert {row["method"] for row in rows} == {"MOD", "RITZ", "POD"}
    assert [int(row["bases"]) for row in rows if row["method"] == "RITZ"] == list(SIZES)
    assert all(row["unconverged"] == "0" for row in rows)
    assert drawn(report / f"paper_{name}.png")
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


def test_the_turbinate_under_a_footprint_as_hard_as_is_trained_for(tmp_path, pressed):
    found = paper.compare(pressed, tmp_path)
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
    largest = np.linalg.norm(paper.snapshots(pressed)[-1], axis=1).max()
    problem = pressed.problem
    at, normal, _ = problem.surface.project(np.array(paper.MEDIAL))
    (thickness,) = local_thickness(problem.mesh, at[None], normal[None])
    assert largest == pytest.approx(problem.scene.load.max_indentation * thickness, rel=0.05)


def test_pod_is_asked_another_history_than_it_learns_from():
    learnt, asked = (np.array(load_steps(x)) for x in (paper.TRAINING, paper.QUERY))
    assert learnt.shape == asked.shape
    loaded = asked[:, 1] > 0
    assert (learnt[loaded] != asked[loaded]).all()
    held = paper.HELD
    assert asked[held, 1] == asked[:, 1].max() > asked[held + 1, 1]


def test_the_cube_bears_its_pressure_for_ever():
    example = paper.covered(coarse("cube-visco", 2, 2, 2))
    assert example.in_time
    relaxed = example.problem.model.relaxed.solve(example.load).displacement
    assert 0.5 < -relaxed[example.point, 2] < 2.0
    assert np.abs(relaxed[example.point, :2]).max() < 1e-3


def test_tenths_are_by_value():
    value = np.arange(1.0, 101.0)
    found = paper._tenths(value, 1 / value)
    assert found["holds"]
    assert found["rank_correlation"] == pytest.approx(-1)
    assert not paper._tenths(value, value)["holds"]


def test_contours(tmp_path, pressed):
    pytest.importorskip("pyvista")
    mesh = pressed.problem.mesh
    error = np.where(mesh.clamped, np.nan, 10.0 ** -mesh.nodes[:, 0])
    out = tmp_path / "new" / "contours.png"
    paper_pictures.contours(out, mesh, {"displacement": error, "stress": error}, pressed.at, 2.0)
    assert drawn(out)
