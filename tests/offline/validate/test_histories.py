"""Histories of a moving tool: within range, on the surface, judged by the full model."""

import csv
import json

import numpy as np
import pytest
from click.testing import CliRunner

from palpate.offline.validate.histories import random_history
from palpate.shared.cli import main
from palpate.shared.mechanics.footprint import pressure_limit
from palpate.shared.model import ReducedModel


@pytest.fixture(scope="module")
def atlas(visco_artifact):
    return ReducedModel.load(visco_artifact)


def test_histories_stay_in_range_and_on_the_surface(atlas):
    rng = np.random.default_rng(0)
    slid = 0.0
    for number in range(20):
        presses = random_history(atlas, rng, rim=number % 8 == 0)
        for press in presses:
            _, normal, distance, fields = atlas.surface.locate(press.position, atlas.limits)
            assert distance == pytest.approx(0.0, abs=1e-9)
            assert press.dt > 0.0
            assert 0.0 <= press.pressure <= 1.001 * pressure_limit(fields, normal, press.direction)
            tilt = np.degrees(np.arccos(np.clip(-press.direction @ normal, -1, 1)))
            assert tilt <= atlas.scene.endoscope.max_tilt + 1e-6
        steps = np.diff([press.position for press in presses], axis=0)
        slid = max(slid, np.linalg.norm(steps, axis=1).sum())
    assert slid > 5.0


def test_validation_over_histories(visco_artifact, tmp_path):
    rows = tmp_path / "rows.csv"
    arguments = ["--histories", "3", "--seed", "2", "--csv", str(rows), "--json"]
    result = CliRunner().invoke(main, ["validate", str(visco_artifact), *arguments])
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert report["histories"] + report["without_equilibrium"] == 3
    assert report["unconverged"] == 0
    assert 0.0 < report["displacement"]["max"] < 0.05
    assert 0.0 < report["von_mises"]["max"] < 0.1
    assert 0.5 < report["covered"] <= 1.0
    assert 1.0 < report["estimate_over_error_median"]["von_mises"] < 10.0
    assert report["worst_displacement"]["max"] >= report["last_displacement"]["max"]
    with rows.open() as file:
        assert len(list(csv.DictReader(file))) == report["histories"]


def test_press_hold_release(visco_artifact):
    result = CliRunner().invoke(main, ["study", "relaxation", str(visco_artifact), "--json"])
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert report["depth_held_mm"] > 1.3 * report["depth_pressed_mm"] > 0.3
    assert 0.0 < report["dent_left_mm"] < 0.1 * report["depth_held_mm"]
    assert report["largest_difference_mm"] < 0.02 * report["depth_held_mm"]
    drawn = visco_artifact.parent / visco_artifact.stem / "report"
    assert (drawn / "relaxation.png").stat().st_size > 10_000
    with (drawn / "relaxation.csv").open() as file:
        table = list(csv.DictReader(file))
    assert float(table[-1]["force_mN"]) == 0.0
    assert len(table) == 95


def test_elastic_scenes_have_no_histories(artifact):
    for arguments in (
        ["validate", str(artifact), "--histories", "2"],
        ["study", "relaxation", str(artifact)],
    ):
        result = CliRunner().invoke(main, arguments)
        assert result.exit_code != 0
        assert "is elastic" in result.output
