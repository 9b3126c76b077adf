"""The speed-accuracy charts of loads and of histories, at toy size."""

import numpy as np
import pytest

from palpate.offline.scenes import find_scene
from palpate.offline.studies import chart as study
from palpate.offline.studies.chart_drawing import FULL, SHIPPED, TWIN, pareto
from palpate.offline.validate.compare import against_full
from palpate.offline.validate.queries import LOADS
from palpate.shared.errors import PalpateError

from .conftest import drawn, table

PLAN = {"artifact": (1,), "pod": (5,), "linear": (10, 20), "mass-spring": (0.5,), "full": (0.5, 1)}
QUERIES = 6
SIZES = (5, 40)


def run(artifact):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "PLAN", PLAN)
        return study.chart(artifact, find_scene("quick"), 20, QUERIES, 1)


@pytest.fixture(scope="module")
def report(artifact):
    """Return the report of a run that was killed at its end and went on where it stopped."""
    times = {}

    def kill(path, rows):
        times.update({row["key"]: row["time_us"] for row in rows})
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "write_csv", kill)
        with pytest.raises(KeyboardInterrupt):
            run(artifact)
    report = run(artifact)
    # no time is measured twice alike
    assert {key: row["time_us"] for key, row in report["points"].items()} == times
    return report


@pytest.fixture(scope="module")
def in_time(visco_artifact):
    plan = {name: sizes if sizes == (1,) else SIZES for name, sizes in study.PLAN_IN_TIME.items()}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "PLAN_IN_TIME", plan)
        return study.chart(visco_artifact, None, 1, 2, 1)


def test_the_artifact_is_on_the_front_and_linear_elasticity_below_it(report, atlas):
    points = report["points"]
    own = atlas.models.mix.shape[-1]
    plan = PLAN | {"pod": (5, own)}  # as many modes as the artifact has unknowns
    assert list(points) == [f"{name} {size:g}" for name, sizes in plan.items() for size in sizes]
    assert points[f"pod {own}"]["displacement_p95"] > points[SHIPPED]["displacement_p95"]
    assert all(row["time_us"] > 0 and row["unconverged"] == 0 for row in points.values())
    assert SHIPPED in report["pareto"]
    assert report["pareto"][-1] == FULL
    assert report["speed_of_next"] > 10
    for field in ("displacement", "von_mises", "total", "total_von_mises"):
        shipped = points[SHIPPED][f"{field}_p95"]
        assert 0 < shipped <= points[SHIPPED][f"{field}_max"]
        assert shipped < points["linear 20"][f"{field}_p95"]


def test_the_mesh_s_error_shows_only_beside_graded_meshes(report):
    scene, coarse = report["points"][FULL], report["points"]["full 0.5"]
    assert scene["displacement_max"] < 1e-6
    for field in ("total", "total_von_mises"):
        assert 1e-3 < scene[f"{field}_p95"] < coarse[f"{field}_p95"]
    assert np.isnan(coarse["displacement_p95"])


def test_the_artifact_s_errors_are_those_of_validate(report, artifact):
    validated, found = against_full(artifact, LOADS, QUERIES, 1), report["points"][SHIPPED]
    for statistic in ("p95", "max"):
        expected = pytest.approx(validated["displacement"][statistic], rel=1e-4)
        assert found[f"displacement_{statistic}"] == expected
        # without the near field, which is in the norm of what is validated
        expected = pytest.approx(validated["von_mises"][statistic], rel=0.3)
        assert found[f"von_mises_{statistic}"] == expected


def test_over_histories_every_method_has_a_point_and_the_artifact_is_accurate(in_time):
    points = in_time["points"]
    galerkin = {f"{name} {size}" for name in ("pod", "modal", "ritz") for size in SIZES}
    assert set(points) == {SHIPPED, TWIN, FULL} | galerkin
    for row in points.values():
        assert row["unconverged"] == 0
        assert row["time_us"] > 0.0
        assert 0.0 < row["displacement_p95"] <= row["displacement_max"]
    for key in (SHIPPED, TWIN):
        assert points[key]["displacement_p95"] < min(0.02, points["modal 40"]["displacement_p95"])
        assert points[key]["von_mises_p95"] < 0.04
    assert points[SHIPPED]["unknowns"] == points[TWIN]["unknowns"]
    # references are kept in single precision
    assert points[FULL]["displacement_max"] < 1e-6
    assert points["modal 40"]["displacement_p95"] < points["modal 5"]["displacement_p95"]
    ratio = points[SHIPPED]["time_us"] / points[TWIN]["time_us"]
    assert in_time["step_over_elastic"] == pytest.approx(ratio)


@pytest.mark.parametrize(
    ("fixture", "trained", "name"),
    [("report", "artifact", "chart"), ("in_time", "visco_artifact", "chart_in_time")],
)
def test_table_and_picture_are_on_disk_and_nothing_else(request, fixture, trained, name):
    found, path = request.getfixturevalue(fixture), request.getfixturevalue(trained)
    file = path.parent / path.stem / "report" / name
    rows = {row["key"]: row for row in table(file.with_suffix(".csv"))}
    assert list(rows) == list(found["points"])
    for key, row in rows.items():
        assert float(row["time_us"]) == pytest.approx(found["points"][key]["time_us"], rel=1e-3)
    assert drawn(file.with_suffix(".png"))
    assert not list(path.parent.glob(".*chart*"))


def test_an_artifact_of_another_scene_is_refused(artifact):
    with pytest.raises(PalpateError, match="another scene"):
        study.chart(artifact, find_scene("turbinate"), 20, 1, 0)


def test_the_front_is_what_nothing_beats_in_both():
    points = [("a", 3, 0.1), ("b", 1, 0.5), ("c", 2, 0.6), ("d", 3, 0.2)]
    rows = [{"key": key, "time_us": t, "displacement_p95": error} for key, t, error in points]
    assert [row["key"] for row in pareto(rows)] == ["b", "a"]
