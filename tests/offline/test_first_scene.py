"""A scene written from nothing: what it must say, what is filled in, and where the keys stand."""

import re
from pathlib import Path

import pytest

from palpate.offline.scenes import FOLDER, filled, find_scene, reference, shipped_scenes
from palpate.shared.scene import Scene, parse_scene

SLAB = """\
name = "slab"
geometry.kind = "block"
geometry.size = [20.0, 20.0, 8.0]
tissue.law = "neo-hookean"
tissue.young = 5.0
tissue.poisson = 0.45
support.side = "bottom"
surface.side = "top"
endoscope.radius = 3.0
endoscope.max_tilt = 20.0
load.max_indentation = 0.2
"""


@pytest.fixture
def slab(tmp_path):
    """Return the file of a scene that says no more than it must."""
    path = tmp_path / "slab.toml"
    path.write_text(SLAB)
    return path


def test_a_scene_is_twelve_lines_at_most_and_the_readme_shows_it(slab):
    assert len(SLAB.splitlines()) <= 12
    scene = find_scene(slab)
    assert scene.description == "slab"
    assert scene.geometry.element == "hex20"
    assert scene.training.blend == pytest.approx(0.3)
    readme = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    shown = re.search(r"```toml\n(.*?)```", readme, re.DOTALL)
    assert parse_scene(shown[1]).model_dump() == scene.model_dump()


def test_the_command_prints_it_with_all_defaults_and_explains_every_key(run, slab):
    result = run("scene", slab)
    assert result.exit_code == 0, result.output
    assert "\nreach = 4.5 " in result.stdout
    lines = result.stdout.splitlines()
    for line, above in zip(lines[1:], lines, strict=False):
        assert not line or line.count("# ") or above.startswith("# "), line
        assert "None" not in line
    assert parse_scene(result.stdout).model_dump() == find_scene(slab).model_dump()


@pytest.mark.parametrize("name", shipped_scenes())
def test_a_filled_scene_reads_back_as_it_was(name):
    scene = find_scene(name)
    assert parse_scene(filled(scene)).model_dump() == scene.model_dump()


def test_the_readme_lists_all_keys_as_the_command_does(run):
    assert reference() in (FOLDER / "README.md").read_text(encoding="utf-8")
    assert run("scene", "--keys").stdout == reference()
    for name, field in Scene.model_fields.items():
        assert field.description, name
    assert "None" not in reference()


@pytest.mark.parametrize(
    ("said", "slip", "asked"),
    [
        ("[20.0, 20.0, 8.0]", "[0.2, 0.2, 0.08]", "lengths are in mm"),
        ("young = 5.0", "young = 5000.0", "soft tissue has 0.1 to 1000 kPa"),
        ("radius = 3.0", "radius = 30.0", "wider than the body of 20 x 20 x 8 mm"),
        ("max_tilt = 20.0", "max_tilt = 0.35", "angles are in degrees"),
    ],
)
def test_what_is_likely_a_slip_is_asked_about(run, slab, said, slip, asked):
    assert "is this meant?" not in run("train", slab, "--check").stdout
    slab.write_text(SLAB.replace(said, slip))
    checked = run("train", slab, "--check")
    assert checked.exit_code == 0, checked.output
    assert asked in checked.stdout


@pytest.mark.parametrize(
    ("line", "key"),
    [
        ("training.limit_spacing = 0.05", "training.limit_spacing"),
        ("training.region_spacing = 0.05", "training.region_spacing"),
        ("training.size = {patch_spacing = 0.1, modes = 40, cubature_points = 64, "
         "region_modes = 60}", "training.size.patch_spacing"),
        ("endoscope.reach = 4.5", ""),
    ],
)  # fmt: skip
def test_a_spacing_that_makes_too_many_points_is_refused_by_its_key(run, slab, line, key):
    slab.write_text(f"{SLAB}{line}\n")
    checked = run("train", slab, "--check")
    assert checked.exit_code == (2 if key else 0), checked.output
    told = f"Error: {slab}: {key}: the accessible surface"
    assert checked.stderr.startswith(told if key else "")
