"""Meshes chosen by their own error, unless the scene fixes them."""

import re

import pytest

from palpate.offline.fem.choose_mesh import SHARE, with_mesh
from palpate.offline.fem.mesh import build_mesh
from palpate.offline.scenes import find_scene
from palpate.shared.scene import SceneError, parse_scene


def unmeshed(tolerance, text=None):
    """The quick scene without divisions."""
    text = find_scene("quick").text if text is None else text
    text = re.sub(r"^divisions.*\n", "", text, flags=re.M)
    return parse_scene(text.replace("displacement = 0.01", f"displacement = {tolerance}"))


def test_a_scene_that_fixes_its_mesh_keeps_it():
    scene = find_scene("quick")
    assert with_mesh(scene) == (scene, None)


def test_without_divisions_there_is_no_mesh_yet():
    with pytest.raises(SceneError, match=r"geometry.divisions: not given; palpate train"):
        build_mesh(unmeshed(0.01))


def test_a_tighter_tolerance_takes_a_finer_mesh():
    (loose, at_ease), (tight, strained) = (with_mesh(unmeshed(t)) for t in (0.05, 0.004))
    assert build_mesh(tight).nodes.size > build_mesh(loose).nodes.size
    assert [len(d["tried"]) for d in (at_ease, strained)] == [1, len(strained["tried"])]
    assert len(strained["tried"]) > 1
    assert strained["tried"][-1]["error"] <= SHARE * 0.004 < strained["tried"][-2]["error"]


def test_the_choice_is_in_the_scenes_text():
    chosen, document = with_mesh(unmeshed(0.05))
    assert parse_scene(chosen.text).geometry.divisions == document["tried"][-1]["divisions"]
    assert with_mesh(chosen)[1] is None


def test_where_there_is_no_table_it_says_so():
    scene = unmeshed(0.05)
    inline = re.sub(
        r"\[geometry\]\n(.*?)\n\n",
        lambda m: "",
        scene.text,
        flags=re.S,
    )
    text = 'geometry = {kind = "block", size = [10.0, 10.0, 8.0], element = "hex20"}\n' + inline
    with pytest.raises(SceneError, match=r"geometry.divisions: needed"):
        with_mesh(parse_scene(text))
