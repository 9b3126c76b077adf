import csv
import json

import numpy as np
import pytest

from palpate.offline.validate.loads import random_loads, unseen_loads, validate
from palpate.offline.validate.norms import relative
from palpate.shared.model import ReducedModel

QUERIES = 12


@pytest.fixture(scope="module")
def atlas(artifact):
    return ReducedModel.load(artifact)


@pytest.fixture(scope="module")
def validated(artifact, tmp_path_factory):
    path = tmp_path_factory.mktemp("validated") / "new folder" / "rows.csv"
    report = validate(artifact, QUERIES, 3, path)
    with path.open() as file:
        return report, list(csv.DictReader(file))


def test_the_table_is_that_of_its_rows(validated):
    report, rows = validated
    json.dumps(report, allow_nan=False)
    assert report["queries"] == len(rows) == QUERIES
    assert report["unconverged"] == report["without_equilibrium"] == 0
    assert 0 <= report["covered"] <= 1
    for name in ("displacement", "von_mises"):
        errors = [float(row[name]) for row in rows]
        assert report[name]["mean"] == pytest.approx(np.mean(errors), rel=1e-4)
        assert report[name]["p95"] == pytest.approx(np.percentile(errors, 95), rel=1e-4)
        assert report[name]["max"] == pytest.approx(max(errors), rel=1e-4)
        assert 0 < report[name]["mean"] < 0.5


def test_rows_do_not_depend_on_who_was_first(validated, atlas):
    _, rows = validated
    loads = unseen_loads(atlas, QUERIES, 3)
    positions = [[float(row[axis]) for axis in "xyz"] for row in rows]
    np.testing.assert_allclose(positions, [load.position for load in loads], atol=1e-4)


def test_loads_differ_by_seed_and_from_those_of_training(atlas):
    def positions(loads):
        return {tuple(load.position) for load in loads}

    training = random_loads(
        atlas.surface, atlas.limits, atlas.scene, 50, np.random.default_rng([atlas.scene.seed, 3])
    )
    inner = set(map(tuple, atlas.surface.vertices))
    sets = [positions(training), *(positions(unseen_loads(atlas, 50, seed)) for seed in range(4))]
    for i, one in enumerate(sets):
        for other in sets[:i]:
            assert not (one & other) - inner


def test_loads_reach_the_ends_and_the_full_tilt(atlas):
    loads = unseen_loads(atlas, 64, 0)
    x = np.array([load.position for load in loads])
    assert (np.ptp(x[:, :2], axis=0) > 9.9).all()
    tilt = [np.degrees(np.arccos(-load.direction[2])) for load in loads]
    assert max(tilt) == pytest.approx(30.0)


def test_relative_error():
    assert relative(np.array([3.0, 1.0]), np.array([3.0, 0.0])) == pytest.approx(1 / 3)
    assert relative(np.ones(3), np.zeros(3)) == 0.0


def test_the_same_loads_give_the_same_table(artifact, validated):
    assert validate(artifact, QUERIES, 3) == validated[0]
