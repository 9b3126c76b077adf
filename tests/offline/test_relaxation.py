"""The study of relaxation: press, hold, release."""

import csv
import json

from click.testing import CliRunner

from palpate.shared.cli import main


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


def test_elastic_scenes_do_not_relax(artifact):
    result = CliRunner().invoke(main, ["study", "relaxation", str(artifact)])
    assert result.exit_code != 0
    assert "is elastic" in result.output
