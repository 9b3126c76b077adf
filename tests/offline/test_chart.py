import csv

import numpy as np
import pytest

from palpate.offline.methods.method import Case
from palpate.offline.run.workshop import Workshop
from palpate.offline.scenes import find_scene
from palpate.offline.studies import chart as study
from palpate.offline.studies.chart_points import Point, pareto
from palpate.offline.studies.remeshed import Remeshed, divided, interpolation
from palpate.offline.validate.loads import unseen_loads
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

    def kill(path, found):
        points.extend(found)
        raise Killed

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "write_csv", kill)
        with pytest.raises(Killed):
            run(artifact)
    return {point.key: point for point in points}


@pytest.fixture(scope="module")
def report(artifact, killed):
    return run(artifact)


def test_a_killed_run_goes_on_where_it_stopped(killed, report):
    # no time is measured twice alike
    times = {key: point.time_us for key, point in killed.items()}
    assert {key: row["time_us"] for key, row in report["points"].items()} == times


def test_the_artifact_is_on_the_front_and_linear_elasticity_below_it(report):
    points = report["points"]
    assert list(points) == [f"{name} {size:g}" for name, sizes in PLAN.items() for size in sizes]
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


@pytest.mark.parametrize("factor", [0.5, 1.5, 2])
def test_other_meshes_give_linear_fields_at_the_nodes_of_the_scene(factor):
    scene = find_scene("quick")
    own, other = Workshop(scene), Workshop(divided(scene, factor))
    field = np.arange(9.0).reshape(3, 3)
    found = interpolation(own, other) @ (other.mesh.nodes @ field)
    np.testing.assert_allclose(found, own.mesh.nodes @ field, atol=1e-9)


def test_a_mesh_of_its_own_answers_like_the_scene_s(artifact):
    scene, load = find_scene("quick"), unseen_loads(ReducedModel.load(artifact), 2, 1)[1]
    workshop, method = Workshop(scene), Remeshed(scene, 1)
    answer = method.solve(Case.of(workshop, load))
    exact = workshop.solve(load).displacement
    np.testing.assert_allclose(method.displacement(answer), exact, atol=1e-9)
