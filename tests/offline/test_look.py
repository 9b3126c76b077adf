"""Pictures of scenes before they are trained."""

import sys

import numpy as np
import pytest

from palpate.offline.scenes import FOLDER

from .conftest import drawn


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        ("quick", ["side bottom; 100 mm²", "side top; 100 mm²", "800 mm³"]),
        ("layer", ["side bottom", "elements hex20"]),
        ("turbinate", ["side outer, z 0 to 15.4 mm"]),
    ],
)
def test_a_scene_is_drawn_and_told(run, tmp_path, scene, words):
    pytest.importorskip("pyvista")
    out = tmp_path / "new" / "look.png"
    result = run("look", scene, "--out", out)
    assert result.exit_code == 0, result.output
    assert all(word in result.output for word in words), result.output
    assert drawn(out)


def test_a_body_from_a_file_is_drawn_with_its_report(run, tmp_path, monkeypatch):
    for library in ("pyvista", "trimesh"):
        pytest.importorskip(library)
    monkeypatch.chdir(tmp_path)
    result = run("look", "turbinate-mri")
    assert result.exit_code == 0, result.output
    for word in ("elements tet10", "the mesh is within 0.0", "angles of 1", "mm²"):
        assert word in result.output
    assert drawn(tmp_path / "artifacts" / "turbinate-mri" / "report" / "look.png")


def test_a_region_is_drawn_through_the_body_and_told(run, tmp_path):
    pytest.importorskip("pyvista")
    text = (FOLDER / "quick.toml").read_text()
    region = '\n[[tissue.region]]\nname = "bone"\nyoung = 90.0\npoisson = 0.3\nz = [0, 3]\n'
    pictures = []
    for name, own in (("without", text), ("with", text + region)):
        (tmp_path / "own.toml").write_text(own)
        pictures.append(tmp_path / f"{name}.png")
        result = run("look", tmp_path / "own.toml", "--out", pictures[-1])
        assert result.exit_code == 0, result.output
    assert "bone (z 0 to 3 mm) 16 elements, 267 mm³" in result.output
    assert amber(pictures[1]) > 1000 > amber(pictures[0])


def amber(picture):
    """Number of pixels of a picture that are more yellow than any other part of a body is."""
    imread = pytest.importorskip("matplotlib.pyplot").imread
    red, green, blue = np.moveaxis(imread(picture)[..., :3], -1, 0)
    return np.count_nonzero((red - blue > 0.3) & (green - blue > 0.15))


def test_a_body_that_is_large_for_its_endoscope_is_asked_about(run, tmp_path):
    pytest.importorskip("pyvista")
    text = (FOLDER / "quick.toml").read_text().replace("[10.0, 10.0", "[400.0, 400.0")
    (tmp_path / "own.toml").write_text(text)
    result = run("look", tmp_path / "own.toml", "--out", tmp_path / "look.png")
    assert result.exit_code == 0
    assert "is this meant? endoscope.radius = 2: its tip is tiny" in result.output


def test_a_body_is_drawn_even_if_it_is_held_nowhere(run, tmp_path):
    pytest.importorskip("pyvista")
    text = (FOLDER / "quick.toml").read_text().replace('"bottom"', '"bottom"\nsupport.z = [2, 3]')
    (tmp_path / "own.toml").write_text(text)
    result = run("look", tmp_path / "own.toml", "--out", tmp_path / "look.png")
    assert result.exit_code == 2
    assert "support: no face of the body is there; of " in result.output
    assert "16 by side" in result.output
    assert drawn(tmp_path / "look.png")


def test_missing_pyvista_is_named(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista", None)
    monkeypatch.chdir(tmp_path)
    result = run("look", "quick")
    assert result.exit_code == 2
    assert "palpate[pictures]" in result.output
    assert not list(tmp_path.iterdir())


def test_what_training_a_body_from_a_file_would_make_is_told(run):
    result = run("train", "liver", "--check")
    assert result.exit_code == 0, result.output
    assert "liver: " in result.stdout
    assert " elements tet10 or more, " in result.stdout
