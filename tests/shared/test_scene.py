"""Scenes: what is accepted, what is refused, and how the refusal reads."""

import math
import re

import numpy as np
import pytest

from palpate.offline.scenes import find_scene
from palpate.shared.mechanics.laws import law_of
from palpate.shared.scene import (
    Block,
    Extrusion,
    Scene,
    SceneError,
    Tolerance,
    load_scene,
    parse_scene,
)

SLAB = """
name = "slab"
description = "a slab"
seed = 1
[geometry]
kind = "block"
size = [10.0, 8, 5.0]
element = "hex8"
divisions = [4, 4, 2]
[tissue]
law = "neo-hookean"
young = 15.0
poisson = 0.45
[support]
side = "bottom"
[surface]
side = "top"
x = [1.0, 9.0]
[endoscope]
radius = 2.0
max_tilt = 30.0
reach = 3.0
[load]
max_indentation = 0.4
[tolerance]
displacement = 0.01
von_mises = 0.02
[budget]
query = 150e-6
[training]
limit_spacing = 4.0
region_spacing = 7.5
blend = 0.2
samples = 60
"""


def test_a_scene_reads_back_from_its_own_text() -> None:
    scene = parse_scene(SLAB)
    assert isinstance(scene.geometry, Block)
    assert scene.geometry.size == (10.0, 8.0, 5.0)
    assert scene.surface.x == (1.0, 9.0)
    assert scene.text == SLAB
    assert parse_scene(scene.text) == scene
    assert scene.tissue.prony == ()
    in_time = SLAB.replace("0.45", "0.45\nprony = [[0.3, 0.1], [0.2, 1.0]]")
    in_time = parse_scene(in_time.replace("reach", "tip = true\nreach"))
    assert in_time.tissue.prony == ((0.3, 0.1), (0.2, 1.0))
    assert in_time.endoscope.tip


def test_a_section_is_not_needed_to_read_a_scene() -> None:
    block = SLAB[SLAB.index("kind") : SLAB.index("element")]
    extrusion = """kind = "extrusion"
section = "nowhere.csv"
corners = [[0, 1], [1, 1], [1, 0], [0, 0]]
length = 40
"""
    text = SLAB.replace(block, extrusion).replace("bottom", "lip").replace("top", "outer")
    scene = parse_scene(text)
    assert isinstance(scene.geometry, Extrusion)
    assert scene.folder is None


def test_a_tolerance_is_as_loose_as_the_stricter_of_its_parts() -> None:
    for u, s, expected in ((0.03, 0.12, 1), (0.15, 0.6, 5), (0.15, 0.12, 1), (0.015, 0.9, 1)):
        assert Tolerance(displacement=u, von_mises=s).looseness == pytest.approx(expected)


def test_mesh_and_reduction_together_have_the_tolerance() -> None:
    tolerance = Tolerance(displacement=0.06, force=0.1)
    assert tolerance.reduction == pytest.approx((0.02, 0.02, 0.1 / 3))
    for parts in zip(tolerance.mesh, tolerance.reduction, tolerance.total, strict=True):
        assert math.hypot(*parts[:2]) == pytest.approx(parts[2])
    assert tolerance.exceeded(tolerance.total) == ()
    assert tolerance.exceeded((0.07, 0.1)) == ("displacement",)  # of a load, whose force is given
    assert tolerance.exceeded((0.01, math.inf, math.nan)) == ("von_mises", "force")


def test_under_a_tip_errors_may_be_larger_than_under_loads() -> None:
    tolerance = Tolerance(displacement=0.04, tip_von_mises=0.4)
    assert tolerance.of(tip=False) is tolerance
    assert tolerance.of(tip=True).total == pytest.approx((0.08, 0.4, 0.05))
    with pytest.raises(SceneError) as told:
        parse_scene(SLAB.replace("displacement = 0.01", "displacement = 3.0"))
    assert str(told.value) == "scene: tolerance.displacement = 3.0: Input should be less than 1"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("seed = 1", "seed = = 1", r"not TOML.*line 4"),
        ("young", "yuong", r"tissue.yuong: unknown key; did you mean 'young'\?"),
        ("[budget]", "[bugdet]", r"bugdet: unknown key; did you mean 'budget'\?"),
        (
            "radius",
            "xyzzy",
            r"endoscope.xyzzy: unknown key; known are radius, max_tilt, reach, tip$",
        ),
        ("size", "sise", r"geometry.sise: unknown key; did you mean 'size'\?"),
        ("young = 15.0\n", "", r"tissue.young: missing \(Young's modulus at rest, kPa\)"),
        (
            'kind = "block"\n',
            "",
            r"geometry.kind: missing \(one of extrusion, which needs section, corners, length; "
            r"block, which needs size; surface, which needs file, unit; ",
        ),
        ("0.45", "0.5", r"tissue.poisson = 0.5: .*less than 0.5"),
        ("0.45", "-0.1", r"tissue.poisson = -0.1: .*greater than or equal to 0"),
        ("young = 15.0", "young = nan", r"tissue.young = nan: .*finite"),
        (
            "0.45",
            "0.45\nprony = [[0.6, 0.1], [0.4, 1.0]]",
            r"tissue: .*prony must sum to less than 1",
        ),
        (
            "0.45",
            "0.45\nprony = [[0.5, 0.0]]",
            r"tissue.prony.0.1 = 0.0: .*greater than or equal to",
        ),
        ("young = 15.0", "young = true", r"tissue.young = True: .*valid number"),
        ("neo-hookean", "hooke", r"tissue.law = 'hooke': .*neo-hookean, .*mooney-rivlin"),
        ("neo-hookean", "mooney-rivlin", r"tissue.c10: missing \(factor of the first inv.*, kPa\)"),
        (
            "[10.0, 8, 5.0]",
            "[10.0, -8, 5.0]",
            r"geometry.size.1 = -8: .*greater than or equal to 0.01",
        ),
        ("[4, 4, 2]", "[4, 0, 2]", r"geometry.divisions.1 = 0: .*greater than or equal to 1"),
        ("hex8", "tet4", r"geometry.element = 'tet4': .*'hex20'"),
        ("block", "sphere", r"geometry.kind = 'sphere': .*extrusion, .*block"),
        ('"top"', '"lip"', r"surface: side is 'lip', but the sides .* are left, right"),
        ("[1.0, 9.0]", "[9.0, 1.0]", r"surface: x must be \[from, to\]"),
        ('"slab"', '"../slab"', r"name = '../slab'"),
        ("max_tilt = 30.0", "max_tilt = 90.0", r"endoscope.max_tilt = 90.0: .*less than 90"),
        ("samples = 60", "samples = 6", r"training.samples = 6: .*greater than or equal to 60"),
        (
            "samples = 60",
            "size = {patch_spacing = 2, modes = 40, cubature_points = 64, region_modes = 36}",
            r"training.size.region_modes = 36: must be at least the 40 of modes",
        ),
    ],
)
def test_what_is_wrong_is_named(old: str, new: str, message: str) -> None:
    assert old in SLAB
    with pytest.raises(SceneError, match=message):
        parse_scene(SLAB.replace(old, new))


def test_every_wrong_field_is_reported_at_once() -> None:
    text = SLAB
    for old, new in (("young", "yuong"), ("seed = 1", "seed = -1"), ('"top"', '"lid"')):
        text = text.replace(old, new)
    with pytest.raises(SceneError) as error:
        parse_scene(text.replace("radius = 2.0", "radius = -2.0"), source="slab.toml")
    head, *faults = str(error.value).split("\n  ")
    assert head == "slab.toml:"
    starts = (
        "seed = -1:", "tissue.young: missing", "tissue.yuong: unknown key",
        "surface: side is 'lid'", "endoscope.radius = -2.0:",
    )  # fmt: skip
    assert len(faults) == len(starts)
    for fault, start in zip(faults, starts, strict=True):
        assert fault.startswith(start)


def test_an_empty_scene_is_told_all_that_it_lacks() -> None:
    with pytest.raises(SceneError) as error:
        parse_scene("")
    missing = [line.split(":")[0].strip() for line in str(error.value).splitlines()[1:]]
    assert missing == [
        "name", "geometry.kind", "tissue.law", "support", "surface", "endoscope.radius",
        "endoscope.max_tilt", "load.max_indentation",
    ]  # fmt: skip


def test_what_kinds_need_is_told_at_once_with_a_side_that_they_do_not_have() -> None:
    kinds = 'geometry.kind = "block"\ntissue.law = "demiray"\nsupport.side = "lip"\n'
    with pytest.raises(SceneError) as error:
        parse_scene(kinds)
    told = [line.split(":")[0].strip() for line in str(error.value).splitlines()[1:]]
    assert told == [
        "name", "geometry.size", "tissue.poisson", "tissue.young", "tissue.b", "support",
        "surface", "endoscope.radius", "endoscope.max_tilt", "load.max_indentation",
    ]  # fmt: skip


@pytest.mark.parametrize("table", ["geometry", "endoscope", "support"])
def test_what_should_be_a_table_is_named(table: str) -> None:
    with pytest.raises(SceneError, match=rf"(?m)^  {table} = 3: "):
        parse_scene(f"{table} = 3\n")


def test_what_each_kind_needs_is_told_where_there_is_none() -> None:
    with pytest.raises(SceneError) as error:
        parse_scene("")
    told = dict(line.strip().split(": ", 1) for line in str(error.value).splitlines()[1:])
    assert told["tissue.law"] == (
        "missing (one of neo-hookean, which needs poisson, young; mooney-rivlin, which needs "
        "poisson, c10, c01; demiray, which needs poisson, young, b)"
    )
    assert "block, which needs size; surface, which needs file, unit;" in told["geometry.kind"]


def test_lengths_that_are_absent_are_multiples_of_the_radius() -> None:
    text = SLAB.replace("reach = 3.0", "").replace("radius = 2.0", "radius = 3.0")
    scene = parse_scene(re.sub(r"^(limit_spacing|region_spacing).*\n", "", text, flags=re.M))
    assert scene.endoscope.reach == 4.5
    assert scene.training.limit_spacing == 6.0
    assert scene.training.region_spacing == 11.25
    assert scene.training.blend == 0.2


def test_a_file_knows_its_folder_and_an_unreadable_one_is_refused(tmp_path) -> None:
    path = tmp_path / "slab.toml"
    path.write_text(SLAB, encoding="utf-8")
    assert load_scene(path).folder == tmp_path
    missing = tmp_path / "missing.toml"
    with pytest.raises(SceneError, match=re.escape(str(missing))):
        load_scene(missing)
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SceneError, match="cannot be read"):
        load_scene(binary)


def test_every_number_of_a_scene_says_its_unit_or_what_it_is_relative_to() -> None:
    words = ("mm", "kPa", "degrees", " s", "error", "over", "ratio", "elements", "labels")
    for name, definition in Scene.model_json_schema()["$defs"].items():
        for key, field in definition["properties"].items():
            tables = "$ref" in field.get("items", {})
            if field.get("type") in ("number", "array") and not tables:
                assert any(word in field.get("description", "") for word in words), (name, key)


@pytest.mark.parametrize("name", ["quick", "quick-mooney-rivlin", "quick-demiray"])
def test_tissue_of_every_law_can_be_as_stiff_as_wanted(name: str) -> None:
    scene = find_scene(name)
    twice = scene.of_tissue(young=2.0 * scene.tissue.young).tissue
    assert twice.young == pytest.approx(2.0 * scene.tissue.young)
    assert twice.poisson == scene.tissue.poisson
    once = law_of(scene.tissue, np.zeros(1, np.int32))
    np.testing.assert_allclose(law_of(twice, np.zeros(1, np.int32))[0], 2.0 * once[0])
