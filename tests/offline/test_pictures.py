"""Pictures of pressed tissue."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner

from palpate.offline.pictures import _across, _tip_centre
from palpate.shared.cli import main
from palpate.shared.model import ReducedModel

CONTACT = ["--at", "4", "5.5", "8", "--pressure", "1.5"]
PNG = b"\x89PNG\r\n\x1a\n"


def draw(artifact, out, *options):
    return CliRunner().invoke(
        main, ["picture", str(artifact), *CONTACT, *options, "--out", str(out)]
    )


@pytest.mark.parametrize("direction", [[], ["--direction", "0.3", "0", "-1"]])
def test_picture(artifact, tmp_path, direction):
    pytest.importorskip("pyvista")
    out = tmp_path / "new" / "pressed.png"
    result = draw(artifact, out, *direction)
    assert result.exit_code == 0, result.output
    assert out.read_bytes().startswith(PNG)


def test_missing_pyvista_is_named(artifact, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista", None)
    result = draw(artifact, tmp_path / "pressed.png")
    assert result.exit_code == 2
    assert ".[pictures]" in result.output


def test_the_tip_touches_the_surface_and_no_more(artifact):
    atlas = ReducedModel.load(artifact)
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
