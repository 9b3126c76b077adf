import csv

import numpy as np
import pytest

from palpate.offline.methods.shipped import Shipped
from palpate.offline.scenes import find_scene
from palpate.offline.studies import chart as study
from palpate.offline.studies.chart_points import Point, pareto
from palpate.offline.validate.loads import validate
from palpate.shared.errors import PalpateError
from palpate.shared.model import ReducedModel

PLAN = {"artifact": (1,), "pod": (5,), "linear": (10, 20), "mass-spring": (0.5,), "full": (0.5, 1)}
QUERIES = 6


class Killed(Exception):
    pass


def run(artifact, **how):
    return study.chart(find_scene("quick"), artifact, 20, QUERIES, 1, PLAN, **how)


@pytest.fixture(scope="module")
def killed(artifact):
    """Return the points of a run that was killed when it had measured everything."""
    points = []

    def kill(path, rows):
        points.extend(rows)
        raise Killed

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "write_csv", kill)
        with pytest.raises(Killed):
            run(artifact)
    return {row["key"]: row for row in points}


@pytest.fixture(scope="module")
def report(artifact, killed):
    return run(artifact)


def test_a_killed_run_goes_on_where_it_stopped(killed, report):
    # no time is measured twice alike
    times = {key: row["time_us"] for key, row in killed.items()}
    assert {key: row["time_us"] for key, row in report["points"].items()} == times


def test_the_artifact_is_on_the_front_and_linear_elasticity_below_it(report, artifact):
    points = report["points"]
    own = Shipped(ReducedModel.load(artifact)).unknowns
    plan = PLAN | {"pod": (5, own)}  # as many modes as the artifact has unknowns
    assert list(points) == [f"{name} {size:g}" for name, sizes in plan.items() for size in sizes]
    assert points[f"pod {own}"]["displacement_p95"] > points["artifact 1"]["displacement_p95"]
    assert all(row["time_us"] > 0 and row["unconverged"] == 0 for row in points.values())
    assert "artifact 1" in report["pareto"]
    assert report["pareto"][-1] == "full 1"
    assert report["speed_of_next"] > 10
    for field in ("displacement", "von_mises", "refined"):
        shipped = points["artifact 1"][f"{field}_p95"]
        assert 0 < shipped <= points["artifact 1"][f"{field}_max"]
        assert shipped < points["linear 20"][f"{field}_p95"]


def test_the_mesh_s_error_shows_only_against_the_refined_one(report):
    scene, coarse = report["points"]["full 1"], report["points"]["full 0.5"]
    assert scene["displacement_max"] < 1e-6
    assert 1e-3 < scene["refined_p95"] < coarse["refined_p95"]
    assert np.isnan(coarse["displacement_p95"])


def test_the_artifact_s_errors_are_those_of_validate(report, artifact):
    validated = validate(artifact, QUERIES, 1)
    for field in ("displacement", "von_mises"):
        found = report["points"]["artifact 1"]
        for statistic in ("p95", "max"):
            assert found[f"{field}_{statistic}"] == pytest.approx(
                validated[field][statistic], rel=1e-4
            )


def test_table_picture_and_page_are_on_disk_and_nothing_else(report, artifact):
    folder = artifact.parent / "quick" / "report"
    with (folder / "chart.csv").open() as file:
        rows = {row["key"]: row for row in csv.DictReader(file)}
    assert list(rows) == list(report["points"])
    for key, row in rows.items():
        assert float(row["time_us"]) == pytest.approx(report["points"][key]["time_us"], rel=1e-3)
    assert (folder / "chart.png").stat().st_size > 50_000
    assert "linear response" in (folder / "chart.html").read_text(encoding="utf-8")
    assert not list(artifact.parent.glob(".*"))


def test_another_scene_s_artifact_is_refused(artifact):
    with pytest.raises(PalpateError, match="another scene"):
        study.chart(find_scene("turbinate"), artifact, 20, 1, 0)


def test_the_front_is_what_nothing_beats_in_both():
    def point(key, time, error):
        return Point(key, "", "", 1, time, *9 * [error], 0)

    points = [point("a", 3, 0.1), point("b", 1, 0.5), point("c", 2, 0.6), point("d", 3, 0.2)]
    assert [p.key for p in pareto(points)] == ["b", "a"]
