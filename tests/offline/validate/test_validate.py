"""Validation of trained artifacts, of every kind, by its command."""

import numpy as np
import pytest

from palpate.offline.run.streams import stream
from palpate.offline.scenes import find_scene
from palpate.offline.validate.queries import LOADS, held_out_loads, random_loads
from palpate.online.demo import TRAINED
from palpate.shared.artifact import read_artifact

from ..conftest import table

QUERIES = 12


@pytest.fixture(scope="module")
def validate(answer, tmp_path_factory):
    """Return a function that gives the report and the rows of the command."""

    def validate(artifact, *arguments):
        path = tmp_path_factory.mktemp("validated") / "new folder" / "rows.csv"
        return answer("validate", artifact, *arguments, "--csv", path), table(path)

    return validate


@pytest.fixture(scope="module")
def validated(artifact, validate):
    return validate(artifact, "--queries", QUERIES, "--seed", 3)


def test_the_table_is_that_of_its_rows_and_they_are_those_of_the_loads(validated, atlas):
    report, rows = validated
    assert report["queries"] == len(rows) == QUERIES
    assert report["unconverged"] == report["without_equilibrium"] == 0
    for name in ("displacement", "von_mises", "von_mises_p99"):
        errors = [float(row[name]) for row in rows]
        said = {"mean": np.mean(errors), "p95": np.percentile(errors, 95), "max": max(errors)}
        assert report[name] == pytest.approx(said, rel=1e-4)
        assert 0 < report[name]["mean"] < 0.5
    within = [
        all(float(row[name]) <= float(row[f"estimated_{name}"]) for name in LOADS.quantities)
        for row in rows
    ]
    assert report["covered"] == np.mean(within)
    positions = [[float(row[axis]) for axis in "xyz"] for row in rows]
    loads = held_out_loads(atlas, QUERIES, 3)
    np.testing.assert_allclose(positions, [load.position for load in loads], atol=1e-4)


def test_stiffer_tissue_is_as_right_as_that_of_the_training(validated, artifact, atlas, validate):
    """Beside a full model of that tissue, under loads that are as much larger."""
    report, rows = validate(
        artifact, "--queries", QUERIES, "--seed", 3, "--young", 3.0 * atlas.scene.tissue.young
    )
    known, before = validated
    for own, other in zip(rows, before, strict=True):
        assert float(own["pressure"]) == pytest.approx(3.0 * float(other["pressure"]), rel=1e-4)
        for name in ("displacement", "von_mises"):
            assert float(own[name]) == pytest.approx(float(other[name]), rel=0.02, abs=1e-5)
    assert report["covered"] == known["covered"]


def test_loads_differ_by_seed_and_from_those_of_training(atlas):
    def positions(loads):
        return {tuple(load.position) for load in loads}

    training = random_loads(atlas, 50, stream(atlas.scene.seed, LOADS.stage))
    inner = set(map(tuple, atlas.surface.vertices))
    sets = [positions(training), *(positions(held_out_loads(atlas, 50, i)) for i in range(4))]
    for i, one in enumerate(sets):
        for other in sets[:i]:
            assert not (one & other) - inner


def test_validation_under_the_tip(artifact, atlas, validate):
    report, rows = validate(artifact, "--tip", "--queries", QUERIES, "--seed", 3)
    assert report["queries"] == len(rows) == QUERIES
    assert report["unconverged"] == report["without_equilibrium"] == 0
    assert report["displacement"]["mean"] < 0.02
    assert report["force"]["mean"] < 0.005
    assert 0 <= report["covered"] <= 1
    trained = atlas.info["validation_tip"]
    assert trained["covered"] >= 0.85
    assert trained["force"]["p95"] < 0.03


def test_validation_over_histories(visco_artifact, validate):
    report, rows = validate(visco_artifact, "--histories", 3, "--seed", 2)
    assert report["histories"] + report["without_equilibrium"] == 3
    assert report["histories"] == len(rows)
    assert report["steps"] == sum(int(row["steps"]) for row in rows)
    assert report["unconverged"] == 0
    assert 0.0 < report["displacement"]["max"] < 0.05
    assert 0.0 < report["von_mises"]["max"] < 0.1
    assert 0.5 < report["covered"] <= 1.0
    assert 1.0 < report["estimate_over_error_median"]["von_mises"] < 10.0
    assert report["worst_displacement"]["max"] >= report["last_displacement"]["max"]


@pytest.fixture(scope="module")
def touched(visco_artifact, validate):
    return validate(visco_artifact, "--tip", "--histories", 2, "--seed", 3)


def test_estimates_over_histories_of_the_tip_cover_their_errors(touched):
    assert touched[0]["covered"] >= 0.8


@pytest.mark.xfail(reason="contact on the rim ends two moments earlier in one of the models")
def test_both_models_are_in_one_equilibrium_over_histories_of_the_tip(touched):
    assert touched[0]["other_equilibrium"] == 0


def test_validation_over_histories_of_the_tip(touched):
    report, rows = touched
    assert [report[k] for k in ("histories", "unconverged")] == [2, 0]
    assert report["displacement"]["mean"] <= 0.015
    assert report["von_mises"]["mean"] <= 0.02
    assert report["force"]["mean"] <= 0.01
    assert all(float(row["force"]) for row in rows)


@pytest.mark.parametrize("kind", [(), ("--tip",)])
def test_the_pad_that_comes_trained_is_that_of_its_scene_and_as_right_as_it_asks(validate, kind):
    artifact, scene = TRAINED / "pad.h5", find_scene("pad")
    assert read_artifact(artifact).scene == scene.text
    report, _ = validate(artifact, "--queries", 60, "--seed", 7, *kind)
    assert report["unconverged"] == 0
    # where 95 % are, one in a thousand such samples has less
    assert report["covered"] >= 0.85
    asked = scene.tolerance.model_dump()
    for name in ("displacement", "von_mises", "force") if kind else ("displacement", "von_mises"):
        assert report[name]["p95"] < 0.5 * asked[name]  # the rest is the mesh's
