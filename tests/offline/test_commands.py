"""The offline commands as their user meets them, on an artifact of the quick scene."""

import errno
import json
import os
import re
import subprocess
import sys
import time

import numpy as np
import pytest

from palpate.offline import commands
from palpate.offline.info import LABELS, budget, closing, info, percent
from palpate.offline.scenes import FOLDER, find_scene
from palpate.offline.train import is_of
from palpate.shared.artifact import read_artifact
from palpate.shared.cli import main
from palpate.shared.model import STORED
from palpate.shared.scene import Errors

from ..conftest import sealed

TIP_AT_THE_RIM = "--tip", "--at", 0.2, 0.2, 9.5
CONTACT = ["--at", "4", "5.5", "8", "--pressure", "1.5"]


def test_info(answer, artifact):
    report = answer("info", artifact)
    assert report["scene"] == "quick"
    assert report["loads"]["largest_tilt"] == 30.0
    assert report["loads"]["largest_pressure"] > 0
    assert report["training"]["mesh"]
    assert {"queries", "displacement", "von_mises"} <= report["validation"].keys()
    assert {"started", "packages", "git_commit", "seed"} <= report["provenance"].keys()
    assert find_scene("quick").text == report["text"]


def test_info_for_people_is_ten_lines_in_units_and_for_who_asks_a_table_of_errors(run, artifact):
    lines = run("info", artifact).stdout.splitlines()
    assert len(lines) == 10
    assert lines[0].startswith("scene          quick: A coarse slab")
    assert "Young's modulus at rest 15 kPa" in lines[2]
    share = r"[\d.]+ %"
    own = f"displacement {share}, von Mises {share}"
    mesh = f"by the mesh: {share}, {share}"
    assert re.fullmatch(f"errors +95 of 100 within: {own}; {mesh}", lines[7])
    own += f", tip's force {share}"
    assert re.fullmatch(f"tip's errors +95 of 100 within: {own}; {mesh}, {share}", lines[8])
    table = run("info", artifact, "--errors").stdout.splitlines()
    assert re.match(r"trust +covers 95 % of errors, confidence \d\d %; doubts", table[8])
    for line in lines + table:
        assert len(line) <= 120
        assert not re.search(r"[{}\[\]]|  %|None", line), line


def test_info_tells_the_sources_of_errors_side_by_side(answer, artifact):
    report = answer("info", artifact)
    table = {line[:LABELS].strip(): line[LABELS:].split("  ") for line in budget(report)[:8]}
    table = {key: [value.strip() for value in row if value.strip()] for key, row in table.items()}
    assert table["95 of 100"] == ["displacement", "von Mises", "tip's force"]
    assert table["tolerance"] == ["3 %", "12 %", "5 %"]
    assert table["- under it"] == ["6 %", "36 %", "5 %"]
    reduction = [report["validation"][key]["p95"] for key in ("displacement", "von_mises")]
    reduction.append(report["validation_tip"]["force"]["p95"])
    assert table["reduction"] == [percent(error) for error in reduction]
    mesh = report["training"]["mesh_errors"]
    assert table["mesh"] == [percent(mesh[key]["p95"]) for key in Errors._fields]
    mesh = report["training"]["mesh_errors_tip"]
    assert table["- of the tip"] == [percent(mesh[key]["p95"]) for key in Errors._fields]
    # the points are chosen so that they err by less than the modes
    assert 0 < report["training"]["cubature_errors"]["displacement"]["p95"] < reduction[0]
    assert table["- cubature"][1:] == table["- solver"][1:] == ["–", "–"]


def test_info_builds_no_model(artifact):
    script = (
        "import sys; from palpate.offline.info import info, lines; from pathlib import Path\n"
        f"lines(info(Path({str(artifact)!r}))); print('palpate.shared.model' in sys.modules)"
    )
    output = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)
    assert output.stdout.strip() == b"False"


def test_what_is_next_after_training_is_a_command_that_works(answer, artifact):
    *_, load, tip = closing(artifact)
    assert load.startswith("next: palpate solve ")
    report = answer(*load.split()[2:])
    assert report["trust"]["in_range"]
    assert report["contact"]["distance"] < 1e-6
    assert tip.endswith(" --tip")
    report = answer(*tip.split()[2:])
    assert report["trust"]["in_range"]
    assert np.linalg.norm(report["force"]) > 0.0


def test_training_ends_with_where_how_large_how_accurate_and_what_is_next(
    run, artifact, monkeypatch
):
    monkeypatch.setattr("palpate.offline.train.is_of", lambda *_: True)
    first, *said = run("train", "quick", "--out", artifact).stdout.splitlines()
    path, made = first.split(": ")
    assert path == str(artifact)
    size = f"{artifact.stat().st_size / 1e6:.1f}"
    assert re.fullmatch(rf"{size} MB, made in [\d.]+ (s|min)", made)
    assert re.match(r"errors: 95 of 100 within: displacement [\d.]+ %, von Mises ", said[0])
    assert said[-2].startswith(f"next: palpate solve {artifact} --at ")


def test_training_ends_with_a_word_of_a_tolerance_that_the_mesh_misses(artifact, monkeypatch):
    report = info(artifact)
    report["training"]["mesh_errors"]["von_mises"]["p95"] = 0.5
    monkeypatch.setattr("palpate.offline.info.info", lambda _: report)
    said = [line for line in closing(artifact) if "missed by the mesh alone" in line]
    assert any(line.startswith("errors: ") and "von Mises 50 % (tol" in line for line in said)


def test_an_artifact_answers_to_the_name_of_its_scene(answer, artifact, tmp_path, monkeypatch):
    (tmp_path / "artifacts").mkdir()
    (tmp_path / "artifacts" / "quick.h5").symlink_to(artifact)
    monkeypatch.chdir(tmp_path)
    assert answer("solve", "quick", *CONTACT)["scene"] == "quick"


def test_answers_for_people_have_units(run, artifact):
    said = run("solve", artifact, "--at", "5", "5", "8", "--pressure", "1").stdout
    for name, unit in {"contact.pressure": "kPa", "force": "mN", "peak.displacement": "mm"}.items():
        assert re.search(rf"^{name} +[-\d., e]+ {unit}$", said, re.M), name
    assert re.search(r"^contact.position +5, 5, 8 mm$", said, re.M)


def test_outside_the_range_it_warns_and_knows_no_error(run, artifact, atlas):
    pressure = 2 * atlas.pressure_max
    result = run("solve", artifact, *CONTACT[:-1], pressure, "--json")
    assert result.exit_code == 0, result.stderr
    assert result.stderr.startswith("Warning: pressure is outside the trained range of ")
    trust = json.loads(result.stdout)["trust"]
    assert trust["error_estimate"] == {"displacement": None, "von_mises": None}


def test_a_tip_in_the_air_is_told_with_its_way_to_the_tissue(run, artifact):
    told = run("solve", artifact, "--tip", "--at", 5, 5, 30, "--json")
    report = json.loads(told.stdout)
    assert report["force"] == [0.0, 0.0, 0.0]
    assert not report["contact"]["touches"]
    assert told.stderr == (
        "Warning: the tip touches nothing: it is 20 mm away from the surface, which is nearest at "
        "(5, 5, 8) mm\n"
    )
    assert "touches nothing" not in run("solve", artifact, "--tip", "--at", 5, 5, 9.7).stderr


@pytest.mark.parametrize("press", [("--at", 0.2, 0.2, 8, "--pressure", 1), TIP_AT_THE_RIM])
def test_estimates_beyond_the_tolerance_are_told(run, artifact, atlas, press):
    told = run("solve", artifact, *press, "--json")
    found = json.loads(told.stdout)["trust"]["error_estimate"]
    most = atlas.scene.tolerance.of("--tip" in press).total._asdict()
    beyond = [
        f"{name} {percent(error)} (tolerance {percent(most[name])})"
        for name, error in found.items()
        if error > most[name]
    ]
    assert beyond
    said = f"Warning: error_estimate is beyond the scene's tolerance: {', '.join(beyond)}\n"
    assert told.stderr == said


def test_of_a_table_it_is_told_how_many_rows_to_look_at(run, artifact, atlas, tmp_path):
    table, out = tmp_path / "in.csv", tmp_path / "out.csv"
    table.write_text("x,y,z\n5,5,30\n0.2,0.2,9.5\n")
    told = run("solve", artifact, "--tip", "--csv", table, "--out", out)
    error = percent(atlas.touch((0.2, 0.2, 9.5)).error_force)
    beyond = "Warning: error_force is more than the scene's tolerance of 5 %"
    assert told.stderr.splitlines()[0] == "Warning: the tip touches nothing in 1 of 2 rows"
    assert told.stderr.splitlines()[-1] == f"{beyond} in 1 of 2 rows, up to {error}"


AT = "--at 4 5.5 8 --pressure"
REFUSED = {
    "solve A --at 4 5.5 80 --pressure 1": "position: ",
    "solve A --at 4 5.5 nan --pressure 1": "nan is not a finite number",
    f"solve A {AT} -1": "pressure: ",
    f"solve A {AT} 999": "pressure: must be at most 10 times",
    f"solve A {AT} 1 --direction 0 0 1": "direction: ",
    f"solve text.h5 {AT} 1": "text.h5: not an artifact of this software",
    "info text.h5": "text.h5: not an artifact of this software",
    "validate text.h5": "text.h5: not an artifact of this software",
    "bench text.h5": "text.h5: not an artifact of this software",
    f"solve cube {AT} 1": "neither a file 'cube' nor artifacts/cube.h5, which palpate train",
    "train septum": "neither a .toml file nor one of cube, cube-visco, layer, liver, pad, quick",
    "study stability cube": "cube.h5: cannot be read: No such file",
    "study relaxation A": "is elastic",
    "study chart-in-time A": "is elastic",
    "study stability-in-time A": "is elastic",
    "validate A --histories 2": "is elastic",
    "train lost.toml": "lost.toml: geometry.section: lost.csv cannot be read: No such file",
    "train pipe.toml": "pipe.toml: geometry.section: pipe.csv cannot be read: pipe.csv is not",
    "train folder.toml": "folder.toml: geometry.section: . cannot be read: Is a directory",
    "train same.toml": "same.toml: surface: the support holds all of it",
    "train headless.toml": "headless.toml: geometry.section: headless.csv cannot be read: its",
    "train --check same.toml": "same.toml: surface: the support holds all of it",
    "train --check corners.toml": "corners.toml: geometry.corners.",
    "study convergence same.toml": "same.toml: surface: the support holds all of it",
    "info nested.toml": "'nested.toml' is a scene; palpate train nested.toml makes its artifact",
    "train nested.toml": "nested.toml: not TOML: maximum recursion depth",
    "train many.toml": "more than 200000 elements in all",
    "train tiny.toml": "endoscope.radius = 1e-09: Input should be greater than or equal to 0.01",
    f"solve A {AT} 1 --vtu full.vtu": "No space left on device",
    f"solve A {AT} 1 --vtu out.txt": "'out.txt' must end in .vtu",
    f"solve A {AT} 1 --radius 9": "radius: must be in [1.0, 2.0] mm",
    "study relaxation V --at nan 0 0": "nan is not a finite number",
    "study relaxation V --at 1000 0 0": "mm from the accessible surface",
    "validate A --queries 2 --csv /dev/full": "No space left on device",
    "validate A --tip --histories 2": "is elastic",
}


@pytest.mark.parametrize(("command", "reason"), REFUSED.items())
def test_what_makes_no_sense_is_told(
    run, artifact, visco_artifact, tmp_path, monkeypatch, command, reason
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.h5").write_text("not an artifact")
    quick, turbinate = (find_scene(name).text for name in ("quick", "turbinate"))
    scenes = {
        "lost": turbinate.replace("inferior_turbinate_section.csv", "lost.csv"),
        "pipe": turbinate.replace("inferior_turbinate_section.csv", "pipe.csv"),
        "folder": turbinate.replace("inferior_turbinate_section.csv", "."),
        "headless": turbinate.replace("inferior_turbinate_section.csv", "headless.csv"),
        "corners": turbinate.replace("[1.2, 2.9]", "[3.2, 7.0]"),
        "same": quick.replace('side = "top"', 'side = "bottom"'),
        "nested": "a = " + 5000 * "[" + 5000 * "]",
        "many": quick.replace("[4, 4, 3]", "[500, 500, 500]"),
        "tiny": quick.replace("radius = 2.0 ", "radius = 1e-9 "),
    }
    (tmp_path / "full.vtu").symlink_to("/dev/full")
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "inferior_turbinate_section.csv").symlink_to(
        FOLDER / "inferior_turbinate_section.csv"
    )
    (tmp_path / "headless.csv").write_text("0,0\n0,1\n")
    for name, text in scenes.items():
        (tmp_path / f"{name}.toml").write_text(text)
    named = {"A": artifact, "V": visco_artifact}
    result = run(*(named.get(word, word) for word in command.split()))
    assert result.exit_code == 2
    before, error, told = result.stderr.rpartition("Error: ")
    assert error
    assert not before or before[-1] in "\r\n"
    assert reason in told
    assert all(line.startswith("  ") for line in told.splitlines()[1:])


@pytest.mark.parametrize("missing", ["training", "provenance"])
def test_info_refuses_what_lacks_a_document(run, artifact, tmp_path, missing):
    whole = read_artifact(artifact, *STORED)
    documents = {name: found for name, found in whole.documents.items() if name != missing}
    path = sealed(tmp_path / "less.h5", whole, documents=documents)
    assert not is_of(path, "another")
    result = run("info", path)
    assert result.exit_code == 2
    assert result.stderr.startswith(f"Error: {path}: incomplete or inconsistent: KeyError")


def test_a_scene_that_is_a_pipe_is_told(run, tmp_path):
    os.mkfifo(tmp_path / "pipe.toml")
    result = run("train", tmp_path / "pipe.toml", "--check")
    assert result.exit_code == 2
    assert "is not a regular file" in result.stderr


def test_all_that_is_wrong_with_a_scene_is_told_a_line_each(run, tmp_path):
    path = tmp_path / "own.toml"
    path.write_text('name = "own"\ngeometry.kind = "ball"\nloads.max_indentation = 1\n')
    result = run("train", path, "--check")
    assert result.exit_code == 2
    first, *faults = result.stderr.splitlines()
    assert first == f"Error: {path}:"
    (geometry,) = (fault for fault in faults if fault.startswith("  geometry.kind = 'ball': not "))
    assert "length; block, which needs size; surface, which needs file, unit; " in geometry
    assert "  loads: unknown key; did you mean 'load'?" in faults
    assert len(faults) == 8


@pytest.mark.parametrize("shape", ["block", "section"])
def test_a_new_scene_can_be_trained_and_is_not_overwritten(run, tmp_path, monkeypatch, shape):
    monkeypatch.chdir(tmp_path)
    made = run("new", "own.toml", "--shape", shape)
    assert made.exit_code == 0, made.output
    assert made.stdout.splitlines()[-1] == "next: palpate train own.toml --check"
    text = (tmp_path / "own.toml").read_text()
    checked = run("train", "own.toml", "--check")
    assert checked.exit_code == 0, checked.output
    assert re.search(r"DOFs; about \d+ or more local models; at least ", checked.stdout)
    assert "is this meant?" not in checked.stdout
    assert checked.stdout.splitlines()[-1] == "nothing is wrong; next: palpate train own.toml"
    assert run("scene", "own.toml").exit_code == 0
    again = run("new", "own.toml", "--shape", shape)
    assert again.exit_code == 2
    assert "is there already" in again.stderr
    assert (tmp_path / "own.toml").read_text() == text
    assert not list(tmp_path.glob("artifacts*"))


def test_help_is_plain_text(run):
    for command in main.list_commands(None):
        told = run(command, "--help").output
        assert "\\b" not in told
        assert "None" not in told


FULL = """
import resource, sys
import numpy as np
from palpate.offline import train
from palpate.shared.artifact import Dataset, write_artifact
from palpate.shared.cli import main

def run(self, path, _):
    room = 10 if sys.argv[2] == "progress" else 100_000
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, -1))  # as on a disk with so much room
    much = np.random.default_rng(0).random(100_000)
    if sys.argv[2] == "progress":
        self.checkpoint._told("load range", 1, 2)
    if sys.argv[2] == "result":
        self.checkpoint.store("result", much)
    write_artifact(path, "", {}, {"much": Dataset(much, "1", "more than there is room for")})

if __name__ == "__main__":  # workers import this file
    train.Pipeline.run = run
    main(["train", "quick", "--out", sys.argv[1], "--workers", "1"])
"""


@pytest.mark.parametrize(
    ("write", "named"),
    [("progress", "progress.json"), ("result", "result.pickle"), ("all", "quick.h5")],
)
def test_training_without_room_ends_in_a_sentence_and_leaves_nothing(tmp_path, write, named):
    (tmp_path / "full.py").write_text(FULL)
    out = tmp_path / "artifacts" / "quick.h5"
    ended = subprocess.run(
        [sys.executable, tmp_path / "full.py", out, write], capture_output=True, text=True
    )
    *_, said = ended.stderr.splitlines()
    assert re.fullmatch(f"Error: {out.parent}/.*{named}: File too large", said), ended.stderr
    assert ended.returncode == 2
    assert "Traceback" not in ended.stderr
    assert list(out.parent.iterdir()) == []


def test_training_into_a_folder_that_can_only_be_read_ends_in_a_sentence(
    run, tmp_path, monkeypatch
):
    def refuse(path, *_):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    monkeypatch.setattr(os, "mkdir", refuse)
    ended = run("train", "quick", "--out", tmp_path / "quick.h5")
    assert ended.exit_code == 2
    said = f"Error: {tmp_path}/.quick.training.*: {os.strerror(errno.EROFS)}\n"
    assert re.fullmatch(said, ended.stderr)
    assert list(tmp_path.iterdir()) == []


def test_who_waits_long_for_an_answer_is_told_why(capfd, monkeypatch):
    monkeypatch.setattr(commands, "PATIENCE", 0.05)
    with commands._patience():
        time.sleep(0.5)
    assert "Compiling code" in capfd.readouterr().err
    with commands._patience():
        pass
    time.sleep(0.2)
    assert capfd.readouterr().err == ""
