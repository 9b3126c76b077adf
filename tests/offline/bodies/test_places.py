"""Places: by side, box, cone, point, other surface, joined by and, or and not."""

import re

import numpy as np
import pytest

from palpate.offline.fem.mesh import build_mesh
from palpate.shared.scene import SceneError, parse_scene

from .conftest import SCENE, ball

BLOCK = """
geometry.kind = "block"
geometry.size = [12.0, 8.0, 8.0]
geometry.divisions = [6, 4, 4]
"""


def block(support='side = "bottom"', surface='side = "top"', folder=None):
    tables = f"[support]\n{support}\n[surface]\n{surface}\n"
    return build_mesh(parse_scene(SCENE + BLOCK + tables, folder))


def touched(surface, **others):
    mesh = block(surface=surface, **others)
    return {tuple(c) for c in mesh.nodes[mesh.faces[mesh.accessible, :4]].mean(axis=1).round(6)}


TOP = 'side = "top"'


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (TOP, "normal = [0, 0, 2.0]\nwithin = 1"),
        (TOP, "normal = [0.0, 0, 1]\nwithin = 89"),
        (TOP, "z = [7.9, 8.1]"),
        (TOP, 'any = [{side = "top", x = [0, 5]}, {side = "top", x = [5, 12]}]'),
        (TOP, "normal = [0, 0, 1]\nwithin = 95\n[surface.without]\nz = [0, 7.5]"),
        (f"{TOP}\nx = [0, 6]", f"{TOP}\n[surface.without]\nx = [6, 12]"),
        (f"{TOP}\nnear = [6, 4, 8]\nradius = 3", f"{TOP}\nnear = [6, 4, 8]\nradius = 3.1"),
    ],
)
def test_one_place_has_many_names(one, other):
    assert touched(one) == touched(other) != set()


def test_keys_of_a_table_hold_together():
    found = touched(f"{TOP}\nx = [0, 6]\ny = [0, 4]")
    assert found == touched(f"{TOP}\nx = [0, 6]") & touched(f"{TOP}\ny = [0, 4]")
    assert len(found) == 6


def test_what_is_held_cannot_be_touched():
    mesh = block(surface="z = [-1, 9]")
    held = mesh.clamped[mesh.faces].all(axis=1)
    assert held.sum() == 24
    assert mesh.accessible.sum() == len(mesh.faces) - 24


def test_a_place_may_be_near_another_surface(tmp_path):
    ball(radius=3.0).apply_translation([6, 4, 10]).export(tmp_path / "bone.stl")
    found = touched(f'{TOP}\nclose_to = "bone.stl"\ndistance = 0.6', folder=tmp_path)
    assert found == touched(f"{TOP}\nnear = [6, 4, 10]\nradius = 3.6")
    with pytest.raises(SceneError, match=r"surface.close_to: .*none.stl is not there"):
        block(surface='close_to = "none.stl"\ndistance = 1.0', folder=tmp_path)


@pytest.mark.parametrize(
    ("surface", "message"),
    [
        ("near = [6, 4, 4]\nradius = 1", "no face .* near lies inside the body, 4.24 mm from"),
        ("near = [6, 4, 20]\nradius = 1", "near lies outside the body, 12"),
        (f"{TOP}\nz = [0, 1]", r"of 128 faces 24 by side, 44 by z; their centres have x 0.0 to"),
        ('side = "bottom"', "the support holds all of it"),
        ("x = [5, 4]", "x must be .* from <= to"),
        ("", "must name a place"),
        ("normal = [0, 0, 0]\nwithin = 20", "normal must have a length"),
        ("near = [0, 0, 0]", "near needs radius"),
        ("distance = 1.0", "distance needs close_to"),
        ("any = []", "any must list a table"),
        ('set = "bone"', "only bodies of kind mesh or labels have sets"),
        ('any = [{side = "lip"}]', "side is 'lip', but the sides of this body are left, right"),
        ("any = [{near = [0, 0, 0], radios = 2}]", "any.0.radios: unknown key; did you mean 'rad"),
    ],
)
def test_a_place_that_is_none_is_refused_with_a_reason(surface, message):
    with pytest.raises(SceneError, match=message):
        block(surface=surface)


def test_places_can_be_read(tmp_path):
    text = (
        'side = "top"\nx = [0, 6]\nnormal = [0, 0, 1]\nwithin = 20\nnear = [1, 2, 8]\nradius = 3\n'
        "any = [{y = [0, 1]}, {y = [2, 3]}]\n[surface.without]\nz = [0, 1]"
    )
    tables = f'[support]\nside = "bottom"\n[surface]\n{text}\n'
    said = parse_scene(SCENE + BLOCK + tables).surface.in_words()
    assert said == (
        "side top, x 0 to 6 mm, within 3 mm of (1, 2, 8), normals within 20 degrees of (0, 0, 1), "
        "(y 0 to 1 mm or y 2 to 3 mm), without (z 0 to 1 mm)"
    )


def test_a_filled_scene_of_such_places_reads_back():
    from palpate.offline.scenes import filled

    tables = (
        '[support]\nside = "bottom"\n[surface]\n'
        "any = [{y = [0, 1]}, {near = [1, 2, 8], radius = 3}]\n[surface.without]\nz = [0, 1]"
    )
    scene = parse_scene(SCENE + BLOCK + tables)
    text = filled(scene)
    assert parse_scene(text).model_dump() == scene.model_dump()
    assert re.search(r"^any = \[\{y = \[0.0, 1.0\]\}, \{near", text, flags=re.M)
    assert np.isclose(scene.surface.any[1].radius, 3.0)
