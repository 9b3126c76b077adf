import csv

import numpy as np
import pytest

from palpate.offline.reduce.ritz import energy_pod
from palpate.offline.run.workshop import Workshop
from palpate.offline.studies.baselines import baselines, solve_galerkin
from palpate.offline.validate.loads import unseen_loads, validate
from palpate.shared.artifact import read_artifact
from palpate.shared.model import ReducedModel

QUERIES = 12


@pytest.fixture(scope="module")
def report(artifact):
    return baselines(artifact, snapshots=90, queries=QUERIES, seed=1)


def test_more_modes_are_better_and_the_artifact_best(report):
    errors = [report[name]["displacement"]["mean"] for name in report if "Galerkin" in name]
    assert len(errors) >= 2
    assert errors == sorted(errors, reverse=True)
    assert all(
        report["artifact"][field]["mean"] < report[name][field]["mean"]
        for field in ("displacement", "von_mises")
        for name in report.keys() - {"artifact"}
    )
    assert all(row["unconverged"] == 0 for row in report.values())


def test_the_artifact_s_row_is_that_of_validate(report, artifact):
    validated = validate(artifact, QUERIES, 1)
    for field in ("displacement", "von_mises"):
        assert report["artifact"][field] == pytest.approx(validated[field], rel=1e-4)


def test_the_table_is_on_disk_and_nothing_else(report, artifact):
    with (artifact.parent / "quick" / "report" / "baselines.csv").open() as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert list(rows) == list(report)
    for method, row in rows.items():
        assert float(row["von_mises_p95"]) == pytest.approx(
            report[method]["von_mises"]["p95"], rel=1e-3
        )
    assert not list(artifact.parent.glob(".*"))


def test_galerkin_in_a_basis_that_holds_the_answer_finds_it(artifact):
    workshop, atlas = Workshop.of_artifact(read_artifact(artifact)), ReducedModel.load(artifact)
    model, load = workshop.model, unseen_loads(atlas, 2, 0)[1]
    exact = workshop.solve(load).displacement.ravel()[model.free]
    rng = np.random.default_rng(0)
    modes, _ = energy_pod(model, np.stack([exact, *rng.random((3, len(exact)))], axis=1), 4)
    coordinates, converged = solve_galerkin(workshop, modes, [load], np.zeros((1, 4)))
    assert converged.all()
    np.testing.assert_allclose(modes @ coordinates[0], exact, atol=1e-6 * np.abs(exact).max())
