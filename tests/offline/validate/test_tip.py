import json

import numpy as np
import pytest

from palpate.offline.reduce.tip_models import residuals_left
from palpate.offline.run.workshop import Workshop
from palpate.offline.validate.tip import (
    QUANTITIES,
    TouchComparison,
    calibrate_touches,
    random_positions,
    validate_touches,
)
from palpate.shared.artifact import read_artifact
from palpate.shared.model import ReducedModel


@pytest.fixture(scope="module")
def validated(artifact):
    return validate_touches(artifact, 12, 3)


def test_the_reduced_model_is_near_the_full_one(validated):
    json.dumps(validated, allow_nan=False)
    assert validated["queries"] == 12
    assert validated["unconverged"] == validated["without_equilibrium"] == 0
    assert validated["displacement"]["mean"] < 0.02
    assert validated["force"]["mean"] < 0.005
    assert 0 <= validated["covered"] <= 1


def test_the_artifact_says_how_near(artifact):
    report = ReducedModel.load(artifact).info["validation_tip"]
    assert report["covered"] >= 0.85
    assert report["force"]["p95"] < 0.03


def test_patches_know_what_their_answers_leave_in_the_full_model(artifact):
    atlas, workshop = ReducedModel.load(artifact), Workshop.of_artifact(read_artifact(artifact))
    rng = np.random.default_rng(5)
    positions = random_positions(atlas.surface, atlas.limits, atlas.scene, 40, rng)
    answers = [atlas.touch(position) for position in positions]
    moved = np.array([atlas.displacement(answer).ravel() for answer in answers], float)
    left = np.log(residuals_left(workshop.model, workshop.body, moved, positions))
    foretold = np.array([answer.features[-1] for answer in answers])
    assert np.median(np.abs(left - foretold)) < 0.4
    assert np.corrcoef(left, foretold)[0, 1] > 0.5


def row(features, errors):
    return TouchComparison(0, 0, 0, 1, 1, 0, *errors, 0, True, True, 1, features=features)


def test_the_estimate_covers_what_it_is_fitted_to(rng):
    rows = []
    for _ in range(60):
        features = np.concatenate([[1.0], rng.standard_normal(9)])
        rows.append(row(features, np.exp(rng.standard_normal(3) + features[1] - 8)))
    estimator = calibrate_touches(rows)
    covered = 0
    for known in rows:
        known.estimate(estimator)
        covered += all(getattr(known, f"estimated_{q}") >= getattr(known, q) for q in QUANTITIES)
    assert covered >= 0.97 * len(rows)
    elsewhere = row(rows[0].features, [0.5, 0.5, 0.5])  # in another equilibrium
    np.testing.assert_array_equal(
        calibrate_touches([*rows, elsewhere]).coefficients, estimator.coefficients
    )
