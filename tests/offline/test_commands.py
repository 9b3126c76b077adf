"""The offline commands as their user meets them, on an artifact of the quick scene."""

import csv
import json
import re
import subprocess
import sys

import meshio
import pytest
from click.testing import CliRunner

from palpate.offline import bench as timing
from palpate.offline.info import closing
from palpate.offline.scenes import find_scene
from palpate.shared.cli import main
from palpate.shared.model import ReducedModel

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
    assert find_scene("quick").text == report["text"]


def test_info_for_people_is_a_dozen_lines_in_units(run, artifact):
    lines = run("info", artifact).stdout.splitlines()
    assert len(lines) <= 12
    assert lines[0].startswith("scene          quick: A thin slab")
    assert "Young's modulus at rest 15 kPa" in lines[2]
    assert lines[8].endswith(" % in von Mises stress")
    for line in lines:
        assert len(line) <= 120
        assert not re.search(r"[{}\[\]]|  %|None", line), line


def test_info_builds_no_model(artifact):
    script = (
        "import sys; from palpate.offline.info import info, lines; from pathlib import Path\n"
        f"lines(info(Path({str(artifact)!r}))); print('palpate.shared.model' in sys.modules)"
    )
    output = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)
    assert output.stdout.strip() == b"False"


def test_what_is_next_after_training_is_a_command_that_works(run, answer, artifact):
    *_, following = closing(artifact)
    assert following.startswith("next: palpate solve ")
    report = answer(*following.split()[2:])
    assert report["trust"]["in_range"]
    assert report["contact"]["distance"] < 1e-6


def test_an_artifact_answers_to_the_name_of_its_scene(run, answer, artifact, tmp_path, monkeypatch):
    (tmp_path / "artifacts").mkdir()
    (tmp_path / "artifacts" / "quick.h5").symlink_to(artifact)
    monkeypatch.chdir(tmp_path)
    assert answer("solve", "quick", *CONTACT)["scene"] == "quick"
    untrained = run("solve", "cube", *CONTACT)
    assert untrained.exit_code == 2
    assert "neither a file 'cube' nor artifacts/cube.h5, which palpate train" in untrained.stderr


def test_outside_the_range_it_warns_and_knows_no_error(run, artifact):
    pressure = str(2 * ReducedModel.load(artifact).pressure_max)
    result = run("solve", artifact, "--at", "4", "5.5", "8", "--pressure", pressure, "--json")
    assert result.exit_code == 0, result.stderr
    assert result.stderr.startswith("Warning: pressure is outside the trained range of ")
    trust = json.loads(result.stdout)["trust"]
    assert trust["error_estimate"] == {"displacement": None, "von_mises": None}


def test_solve(answer, artifact):
    report = answer("solve", artifact, *CONTACT)
    assert report["contact"]["direction"] == pytest.approx([0, 0, -1])
    assert report["contact"]["pressure"] == 1.5
    assert report["force"][2] > 0  # on the tool
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
        (["--at", "4", "5.5", "8", "--pressure", "999"], "pressure: must be at most 10 times"),
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


@pytest.mark.parametrize(
    "command",
    ["scene", "train", "info", "solve", "picture", "validate", "bench", "study"],
)
def test_help_is_plain_text(run, command):
    assert "\\b" not in run(command, "--help").output


def test_training_an_unknown_scene_names_those_there_are(run):
    result = run("train", "septum")
    assert result.exit_code == 2
    assert "neither a .toml file nor one of cube, " in result.stderr
    assert all(name in result.stderr for name in ("quick", "turbinate", "turbinate-visco"))


def test_a_study_of_an_untrained_scene_says_so(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = run("study", "stability", "cube")
    assert result.exit_code == 2
    assert "cube.h5: cannot be read: No such file" in result.stderr
