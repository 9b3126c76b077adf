"""Validation of trained artifacts, of every kind, by its command."""

import csv
import json

import numpy as np
import pytest
from click.testing import CliRunner

from palpate.offline.reduce.queries import random_loads
from palpate.offline.run.streams import stream
from palpate.offline.validate.against_full import against_full, held_out_loads
from palpate.offline.validate.kinds import LOADS
from palpate.shared.cli import main
from palpate.shared.model import ReducedModel

QUERIES = 12


@pytest.fixture(scope="module")
def atlas(artifact):
    return ReducedModel.load(artifact)


def validate(artifact, path, *arguments):
    """Report and rows of the command."""
    arguments = ["validate", str(artifact), *arguments, "--csv", str(path), "--json"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    with path.open() as file:
        report, rows = json.loads(result.stdout), list(csv.DictReader(file))
    json.dumps(report, allow_nan=False)
    return report, rows


@pytest.fixture(scope="module")
def validated(artifact, tmp_path_factory):
    path = tmp_path_factory.mktemp("validated") / "new folder" / "rows.csv"
    return validate(artifact, path, "--queries", str(QUERIES), "--seed", "3")


def test_the_table_is_that_of_its_rows(validated):
    report, rows = validated
    assert report["queries"] == len(rows) == QUERIES
    assert report["unconverged"] == report["without_equilibrium"] == 0
    assert 0 <= report["covered"] <= 1
    for name in ("displacement", "von_mises", "von_mises_p99"):
        errors = [float(row[name]) for row in rows]
        assert report[name]["mean"] == pytest.approx(np.mean(errors), rel=1e-4)
        assert report[name]["p95"] == pytest.approx(np.percentile(errors, 95), rel=1e-4)
        assert report[name]["max"] == pytest.approx(max(errors), rel=1e-4)
        assert 0 < report[name]["mean"] < 0.5
    within = [
        all(float(row[name]) <= float(row[f"estimated_{name}"]) for name in LOADS.quantities)
        for row in rows
    ]
    assert report["covered"] == np.mean(within)


def test_rows_do_not_depend_on_who_was_first(validated, atlas):
    _, rows = validated
    loads = held_out_loads(atlas, QUERIES, 3)
    positions = [[float(row[axis]) for axis in "xyz"] for row in rows]
    np.testing.assert_allclose(positions, [load.position for load in loads], atol=1e-4)


def test_the_same_loads_give_the_same_table(artifact, validated):
    assert against_full(artifact, LOADS, QUERIES, 3) == validated[0]


def test_loads_differ_by_seed_and_from_those_of_training(atlas):
    def positions(loads):
        return {tuple(load.position) for load in loads}

    training = random_loads(atlas, 50, stream(atlas.scene.seed, LOADS.stage))
    inner = set(map(tuple, atlas.surface.vertices))
    sets = [positions(training), *(positions(held_out_loads(atlas, 50, i)) for i in range(4))]
    for i, one in enumerate(sets):
        for other in sets[:i]:
            assert not (one & other) - inner


def test_validation_under_the_tip(artifact, tmp_path):
    report, rows = validate(
        artifact, tmp_path / "rows.csv", "--tip", "--queries", str(QUERIES), "--seed", "3"
    )
    assert report["queries"] == len(rows) == QUERIES
    assert report["unconverged"] == report["without_equilibrium"] == 0
    assert report["displacement"]["mean"] < 0.02
    assert report["force"]["mean"] < 0.005
    assert 0 <= report["covered"] <= 1


def test_the_artifact_says_how_near_it_is_under_the_tip(atlas):
    report = atlas.info["validation_tip"]
    assert report["covered"] >= 0.85
    assert report["force"]["p95"] < 0.03


def test_validation_over_histories(visco_artifact, tmp_path):
    report, rows = validate(
        visco_artifact, tmp_path / "rows.csv", "--histories", "3", "--seed", "2"
    )
    assert report["histories"] + report["without_equilibrium"] == 3
    assert report["histories"] == len(rows)
    assert report["steps"] == sum(int(row["steps"]) for row in rows)
    assert report["unconverged"] == 0
    assert 0.0 < report["displacement"]["max"] < 0.05
    assert 0.0 < report["von_mises"]["max"] < 0.1
    assert 0.5 < report["covered"] <= 1.0
    assert 1.0 < report["estimate_over_error_median"]["von_mises"] < 10.0
    assert report["worst_displacement"]["max"] >= report["last_displacement"]["max"]


def test_validation_over_histories_of_the_tip(visco_artifact, tmp_path):
    report, rows = validate(
        visco_artifact, tmp_path / "rows.csv", "--tip", "--histories", "4", "--seed", "3"
    )
    assert [report[k] for k in ("histories", "unconverged", "other_equilibrium")] == [4, 0, 0]
    assert report["displacement"]["mean"] <= 0.015
    assert report["von_mises"]["mean"] <= 0.02
    assert report["force"]["mean"] <= 0.01
    assert report["covered"] >= 0.8
    assert all(float(row["force"]) for row in rows)


@pytest.mark.parametrize("tip", [(), ("--tip",)])
def test_elastic_scenes_have_no_histories(artifact, tip):
    result = CliRunner().invoke(main, ["validate", str(artifact), *tip, "--histories", "2"])
    assert result.exit_code != 0
    assert "is elastic" in result.output
