"""Meshes chosen by their own error, unless the scene fixes them."""

import re

import pytest

from palpate.offline.choose.mesh import SHARE, with_mesh
from palpate.offline.fem.mesh import build_mesh
from palpate.offline.scenes import find_scene
from palpate.shared.scene import SceneError, parse_scene


def unmeshed(tolerance, geometry=None):
    """The quick scene without divisions under a large tip, its geometry written in another way."""
    text = re.sub(r"^geometry.divisions.*\n", "", find_scene("quick").text, flags=re.M)
    text = text.replace("radius = 2.0", "radius = 4.0")  # whose meshes are coarse
    if geometry is not None:
        text = re.sub(r"^geometry.*\n", "", text, flags=re.M) + geometry
    return parse_scene(f"tolerance.displacement = {tolerance}\n{text}")


def test_a_scene_that_fixes_its_mesh_keeps_it_and_without_divisions_there_is_none_yet():
    scene = find_scene("quick")
    assert with_mesh(scene) == (scene, None)
    with pytest.raises(SceneError, match=r"geometry.divisions: not given; palpate train"):
        build_mesh(unmeshed(0.01))


def test_a_tighter_tolerance_takes_a_finer_mesh():
    (loose, at_ease), (tight, strained) = (with_mesh(unmeshed(t)) for t in (0.05, 0.004))
    assert build_mesh(tight).nodes.size > build_mesh(loose).nodes.size
    assert [len(d["tried"]) for d in (at_ease, strained)] == [1, len(strained["tried"])]
    assert len(strained["tried"]) > 1
    assert strained["tried"][-1]["error"] <= SHARE * 0.004 < strained["tried"][-2]["error"]


@pytest.mark.parametrize("geometry", [None, '[geometry]\nkind = "block"\nsize = [10, 10, 8]\n'])
def test_the_choice_is_in_the_scenes_text(geometry):
    chosen, document = with_mesh(unmeshed(0.05, geometry))
    assert parse_scene(chosen.text).geometry.divisions == document["tried"][-1]["divisions"]
    assert with_mesh(chosen)[1] is None


def test_where_it_cannot_be_written_it_says_so():
    scene = unmeshed(0.05, 'geometry = { kind = "block", size = [10, 10, 8] }\n')
    with pytest.raises(SceneError, match=r"geometry.divisions: needed where"):
        with_mesh(scene)
