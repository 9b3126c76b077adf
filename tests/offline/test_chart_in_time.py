"""The speed-accuracy chart over histories, at toy size."""

import csv

import pytest

from palpate.offline.studies.chart import PLAN_IN_TIME, chart_in_time
from palpate.offline.studies.chart_points import FULL, SHIPPED, TWIN
from palpate.shared.errors import QueryError

SIZES = (5, 40)


@pytest.fixture(scope="module")
def report(visco_artifact):
    plan = {name: sizes if sizes == (1,) else SIZES for name, sizes in PLAN_IN_TIME.items()}
    return chart_in_time(visco_artifact, 2, 1, 1, plan)


def test_every_method_has_a_point(report):
    galerkin = {f"{name} {size}" for name in ("pod", "modal", "ritz") for size in SIZES}
    assert set(report["points"]) == {SHIPPED, TWIN, FULL} | galerkin
    for row in report["points"].values():
        assert row["unconverged"] == 0
        assert row["time_us"] > 0.0
        assert 0.0 < row["displacement_p95"] <= row["displacement_max"]


def test_the_artifact_and_its_twin_are_accurate_and_the_full_model_exact(report):
    points = report["points"]
    for key in (SHIPPED, TWIN):
        assert points[key]["displacement_p95"] < 0.02
        assert points[key]["von_mises_p95"] < 0.04
        assert points[key]["displacement_p95"] < points["modal 40"]["displacement_p95"]
    assert points[SHIPPED]["unknowns"] == points[TWIN]["unknowns"]
    # references are kept in single precision
    assert points[FULL]["displacement_max"] < 1e-6
    assert points["modal 40"]["displacement_p95"] < points["modal 5"]["displacement_p95"]


def test_what_memory_costs_is_told(report):
    points = report["points"]
    ratio = points[SHIPPED]["time_us"] / points[TWIN]["time_us"]
    assert report["step_over_elastic"] == pytest.approx(ratio)
    as_good = [row["time_us"] for key, row in points.items() if key not in (SHIPPED, TWIN)
               and row["displacement_p95"] <= points[SHIPPED]["displacement_p95"]]  # fmt: skip
    assert report["speed_of_next"] == pytest.approx(min(as_good) / points[SHIPPED]["time_us"])


def test_table_and_picture(report, visco_artifact):
    folder = visco_artifact.parent / visco_artifact.stem / "report"
    with (folder / "chart_in_time.csv").open() as file:
        assert [row["key"] for row in csv.DictReader(file)] == list(report["points"])
    assert (folder / "chart_in_time.png").stat().st_size > 20_000
    assert "the same without memory" in (folder / "chart_in_time.html").read_text(encoding="utf-8")
    assert not list(visco_artifact.parent.glob(".*chart*"))


def test_elastic_scenes_have_no_such_chart(artifact):
    with pytest.raises(QueryError, match="elastic"):
        chart_in_time(artifact, 1, 1, 0)
