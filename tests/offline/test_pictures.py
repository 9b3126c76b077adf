"""Pictures of pressed tissue."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from palpate.offline import pictures
from palpate.offline.pictures import _across, _tip_centre

from .conftest import drawn

CONTACT = ["--at", "4", "5.5", "8", "--pressure", "1.5"]


@pytest.mark.parametrize("direction", [[], ["--direction", "0.3", "0", "-1"]])
def test_picture(run, artifact, tmp_path, direction):
    pytest.importorskip("pyvista")
    out = tmp_path / "new" / "pressed.png"
    result = run("picture", artifact, *CONTACT, *direction, "--out", out)
    assert result.exit_code == 0, result.output
    assert drawn(out)


def test_a_smooth_body_is_drawn_without_its_edges(run, artifact, tmp_path, monkeypatch):
    pytest.importorskip("pyvista")
    monkeypatch.setattr(pictures, "SHARP", 179.0)  # degrees; none of a block's edges is
    result = run("picture", artifact, *CONTACT, "--out", tmp_path / "pressed.png")
    assert result.exit_code == 0, result.output
    assert drawn(tmp_path / "pressed.png")


@pytest.mark.parametrize(
    "command", [["picture", "A", *CONTACT, "--out", "x.png"], ["study", "turbinate"]]
)
def test_missing_pyvista_is_named_before_any_work(run, artifact, tmp_path, monkeypatch, command):
    monkeypatch.setitem(sys.modules, "pyvista", None)
    monkeypatch.chdir(tmp_path)
    result = run(*(artifact if word == "A" else word for word in command))
    assert result.exit_code == 2
    assert "palpate[pictures]" in result.output
    assert not list(tmp_path.iterdir())


def test_the_tip_touches_the_surface_and_no_more(atlas):
    solution = atlas.press([4, 5.5, 8], 1.5, [0.3, 0, -1])
    surface = (atlas.nodes + atlas.displacement(solution))[atlas.surface_nodes]
    distance = np.linalg.norm(surface - _tip_centre(surface, solution), axis=1)
    assert distance.min() == pytest.approx(solution.radius)


@pytest.mark.parametrize(
    ("normal", "direction", "across"),
    [
        ((1, 0, 0), (-1, 0, 0), "y"),
        ((0.7, 0, -0.7), (-0.7, 0, 0.7), "y"),
        ((1, 0, 0), (-0.87, 0.5, 0), "z"),
        ((0, 1, 0), (0, -1, 0), "z"),
    ],
)
def test_the_cut_holds_the_load(normal, direction, across):
    nodes = np.array([[0, 0, 0], [10, 40, 15]], float)
    solution = SimpleNamespace(normal=np.array(normal), direction=np.array(direction))
    assert _across(nodes, solution).tolist() == [float(axis == across) for axis in "xyz"]
