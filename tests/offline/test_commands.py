"""The offline commands as their user meets them, on an artifact of the quick scene."""

import csv
import json

import meshio
import pytest
from click.testing import CliRunner

from palpate.offline import bench as timing
from palpate.shared.cli import main

CONTACT = ["--at", "4", "5.5", "8", "--pressure", "1.5"]
STATISTICS = {"mean", "p95", "max"}


@pytest.fixture
def run():
    def run(*arguments):
        return CliRunner().invoke(main, [str(argument) for argument in arguments])

    return run


@pytest.fixture
def answer(run):
    """Return a function that runs a command with --json and returns what it prints."""

    def answer(*arguments):
        result = run(*arguments, "--json")
        assert result.exit_code == 0, result.output
        return json.loads(result.stdout)

    return answer


def test_info(run, answer, artifact):
    report = answer("info", artifact)
    assert report["scene"] == "quick"
    assert report["loads"]["largest_tilt"] == 30.0
    assert report["loads"]["largest_pressure"] > 0
    assert report["training"]["mesh"]
    assert {"queries", "displacement", "von_mises"} <= report["validation"].keys()
    assert {"started", "packages", "git_commit", "seed"} <= report["provenance"].keys()
    lines = dict(line.split(None, 1) for line in run("info", artifact).stdout.splitlines())
    assert lines["scene"] == "quick"
    assert lines["loads.radius"] == "2"


def test_solve(answer, artifact):
    report = answer("solve", artifact, *CONTACT)
    assert report["contact"]["direction"] == pytest.approx([0, 0, -1])
    assert report["contact"]["pressure"] == 1.5
    assert report["force"][2] < 0
    assert report["contact_displacement"][2] < 0
    assert report["trust"]["converged"]
    tilted = answer("solve", artifact, *CONTACT, "--direction", "0.4", "0", "-2")
    assert tilted["force"][0] / tilted["force"][2] == pytest.approx(-0.2)


def test_solve_with_the_full_model_and_a_file(answer, artifact, tmp_path):
    out = tmp_path / "out.vtu"
    report = answer("solve", artifact, *CONTACT, "--full-model", "--vtu", out)
    assert report["full_model"]["error"].keys() == {"displacement", "von_mises"}
    assert {"displacement", "von_mises", "load", "clamped"} <= meshio.read(out).point_data.keys()


def test_validate(answer, artifact, tmp_path):
    out = tmp_path / "rows.csv"
    report = answer("validate", artifact, "--queries", 6, "--seed", 2, "--csv", out)
    assert list(report)[:5] == ["queries", "unconverged", "covered", "displacement", "von_mises"]
    assert report["queries"] == 6
    assert report["displacement"].keys() == report["von_mises"].keys() == STATISTICS
    with out.open() as file:
        assert len(list(csv.reader(file))) == 7


def test_bench(answer, artifact, monkeypatch):
    monkeypatch.setattr(timing, "ROUNDS", 2)
    monkeypatch.setattr(timing, "QUERIES", 10)
    report = answer("bench", artifact)
    assert list(report)[:5] == ["cold_us", "warm_us", "surface_us", "fields_us", "full_us"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--at", "4", "5.5", "80", "--pressure", "1"], "position: "),
        (["--at", "4", "5.5", "nan", "--pressure", "1"], "position: "),
        (["--at", "4", "5.5", "8", "--pressure", "-1"], "pressure: "),
        (["--at", "4", "5.5", "8", "--pressure", "inf"], "pressure: "),
        ([*CONTACT, "--direction", "0", "0", "0"], "direction: "),
        ([*CONTACT, "--direction", "0", "0", "1"], "direction: "),
    ],
)
def test_loads_that_make_no_sense_are_told_in_a_line(run, artifact, arguments, message):
    result = run("solve", artifact, *arguments)
    assert result.exit_code == 2
    assert result.stderr.startswith(f"Error: {message}")
    assert len(result.stderr.splitlines()) == 1


@pytest.mark.parametrize("command", ["info", "validate", "bench", "solve"])
def test_a_file_that_is_no_artifact_is_told_in_a_line(run, command, tmp_path):
    path = tmp_path / "text.h5"
    path.write_text("not an artifact")
    result = run(command, path, *(CONTACT if command == "solve" else []))
    assert result.exit_code == 2
    assert result.stderr == f"Error: {path}: not an artifact of this software\n"


def test_training_an_unknown_scene_names_those_there_are(run):
    result = run("train", "septum")
    assert result.exit_code == 2
    assert "neither a .toml file nor one of cube, " in result.stderr
    assert all(name in result.stderr for name in ("quick", "turbinate", "turbinate-visco"))


def test_a_study_of_an_untrained_scene_says_so(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = run("study", "baselines", "cube")
    assert result.exit_code == 2
    assert "cube.h5: cannot be read: No such file" in result.stderr
