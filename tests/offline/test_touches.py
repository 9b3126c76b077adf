import json

import numpy as np
import pytest

from offline.touches import QUANTITIES, TouchComparison, calibrate_touches, validate_touches
from shared.atlas import Atlas


@pytest.fixture(scope="module")
def validated(artifact):
    return validate_touches(artifact, 12, 3)


def test_the_reduced_model_is_near_the_full_one(validated):
    json.dumps(validated, allow_nan=False)
    assert validated["queries"] == 12
    assert validated["unconverged"] == validated["without_equilibrium"] == 0
    # the basis of quick's few regions holds the far field of a force better than its dent
    assert validated["displacement"]["mean"] < 0.05
    assert validated["force"]["mean"] < 0.02
    assert 0 <= validated["covered"] <= 1


def test_the_artifact_says_how_near(artifact):
    report = Atlas.load(artifact).info["validation_tip"]
    assert report["covered"] >= 0.85
    assert report["force"]["p95"] < 0.03


def test_the_estimate_covers_what_it_is_fitted_to(rng):
    rows = []
    for _ in range(60):
        features = np.concatenate([[1.0], rng.standard_normal(8)])
        errors = np.exp(rng.standard_normal(3) + features[1] - 5)
        rows.append(
            TouchComparison(
                0, 0, 0, 1, 1, 0, *errors[:2], errors[2], 0, True, True, 1, features=features
            )
        )  # fmt: skip
    estimator = calibrate_touches(rows)
    covered = 0
    for row in rows:
        row.estimate(estimator)
        covered += all(getattr(row, f"estimated_{q}") >= getattr(row, q) for q in QUANTITIES)
    assert covered >= 0.97 * len(rows)
