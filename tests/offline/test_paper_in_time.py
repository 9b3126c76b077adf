"""The paper's first figure for visco-elastic tissue, on a cube of few elements."""

import csv
import json

import numpy as np
import pytest
from click.testing import CliRunner

from palpate.offline.run.workshop import Workshop
from palpate.offline.scenes import find_scene
from palpate.offline.studies import paper
from palpate.offline.studies.relaxation import load_steps
from palpate.shared.cli import main

PNG = b"\x89PNG\r\n\x1a\n"
SIZES = (1, 3, 6)


def coarse(scene):
    geometry = scene.geometry.model_copy(update={"divisions": (2, 2, 2)})
    return Workshop(scene.model_copy(update={"geometry": geometry}))


@pytest.fixture
def report(tmp_path, monkeypatch):
    monkeypatch.setattr(paper, "Workshop", coarse)
    monkeypatch.setattr(paper, "ROUNDS", 1)
    monkeypatch.setattr(paper, "SIZES", SIZES)
    folder = tmp_path / "new"
    arguments = ["study", "cube", "cube-visco", "--report", str(folder), "--json"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    return folder, json.loads(result.stdout)


def test_the_cube_pressed_held_and_let_go(report):
    folder, found = report
    assert found["load"]["point_P_mm"] == [5, 5, 10]
    figure = found["figure_1"]
    assert found["claims"]["pod_least_error"]["holds"]
    # the first bending modes know nothing of a load straight down
    assert figure["MOD 1"]["error_at_P_mean"] == pytest.approx(1, abs=1e-3)
    assert figure["POD 6"]["error_at_P_mean"] < 1e-3 < figure["POD 1"]["error_at_P_mean"]
    assert figure["POD 6"]["von_mises_error_mean"] < 3e-3
    with (folder / "paper_cube-visco.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["bases"]) for row in rows if row["method"] == "RITZ"] == list(SIZES)
    assert all(row["unconverged"] == "0" for row in rows)
    assert (folder / "paper_cube-visco.png").read_bytes().startswith(PNG)


def test_pod_is_asked_another_history_than_it_learns_from():
    learnt, asked = (np.array(load_steps(phases)) for phases in
                     (paper.TRAINING, paper.QUERY))  # fmt: skip
    assert learnt.shape == asked.shape
    loaded = asked[:, 1] > 0
    assert (learnt[loaded] != asked[loaded]).all()
    held = paper.HELD
    assert asked[held, 1] == asked[:, 1].max() > asked[held + 1, 1]


def test_the_cube_bears_its_pressure_for_ever(monkeypatch):
    monkeypatch.setattr(paper, "Workshop", coarse)
    monkeypatch.setattr(paper, "compare", lambda example, report: example)
    example = paper.cube("cube-visco", None)
    assert find_scene("cube-visco").tissue.prony
    relaxed = example.workshop.model.relaxed.solve(example.load).displacement
    assert 0.5 < -relaxed[example.point, 2] < 2.0
    assert np.abs(relaxed[example.point, :2]).max() < 1e-3
