"""Meshes chosen by their own error, unless the scene fixes them."""

import re

import numpy as np
import pytest

from palpate.offline.choose.mesh import LARGE_LOADS, as_fine, candidates, with_mesh
from palpate.offline.fem.mesh import Inverted, build_mesh
from palpate.offline.scenes import find_scene
from palpate.shared.scene import SceneError, parse_scene


def unmeshed(geometry=None, **tolerance):
    """The quick scene without divisions under a large tip, its geometry written in another way."""
    text = re.sub(r"^geometry.divisions.*\n", "", find_scene("quick").text, flags=re.M)
    text = text.replace("radius = 2.0", "radius = 4.0")  # whose meshes are coarse
    if geometry is not None:
        text = re.sub(r"^geometry.*\n", "", text, flags=re.M) + geometry
    said = [f"tolerance.{key} = {value}\n" for key, value in tolerance.items()]
    return parse_scene("".join([*said, text]))


def test_a_scene_that_fixes_its_mesh_keeps_it_and_without_divisions_there_is_none_yet():
    scene = find_scene("quick")
    assert with_mesh(scene) == (scene, None)
    with pytest.raises(SceneError, match=r"geometry.divisions: not given; palpate train"):
        build_mesh(unmeshed())


DOME = """
name = "dome"
geometry.kind = "extrusion"
geometry.section = "dome.csv"
geometry.corners = [[-3.97, 1.75], [3.94, 2.05], [3.12, 0.0], [-3.24, 0.01]]
geometry.length = 12.0
tissue.law = "neo-hookean"
tissue.young = 12.0
tissue.poisson = 0.45
support.side = "inner"
surface.side = "outer"
endoscope.radius = 2.0
endoscope.max_tilt = 20.0
load.max_indentation = 0.15
"""


def test_meshes_that_are_too_coarse_for_the_outline_are_not_tried(tmp_path):
    """A dome whose round top is one side, so long beside the others that few elements fold."""
    angle = np.linspace(np.pi, 0.0, 40)
    c, s = np.cos(angle), np.sin(angle)
    dome = np.column_stack([4.0 * np.sign(c) * abs(c) ** 0.87, 0.9 + 5.1 * s**0.87])
    flat = np.column_stack([np.linspace(3.1, -3.1, 12), np.zeros(12)])
    np.savetxt(tmp_path / "dome.csv", [*dome, *flat], delimiter=",", header="x,z", comments="")
    scene = parse_scene(DOME, tmp_path)
    with pytest.raises(Inverted, match="move corners, so that opposite sides are about as long"):
        build_mesh(as_fine(scene, (4, 2, 6)))
    coarsest = candidates(scene)[0]
    assert np.prod(coarsest) > 48
    build_mesh(as_fine(scene, coarsest))


LOOSE = {"displacement": 0.25, "von_mises": 0.5, "force": 0.2}


@pytest.mark.parametrize(
    ("quantity", "tight"), [("displacement", 0.05), ("von_mises", 0.1), ("force", 0.03)]
)
def test_a_tighter_tolerance_of_anything_takes_a_finer_mesh(quantity, tight):
    scene = unmeshed(**LOOSE | {quantity: tight})
    (loose, at_ease), (chosen, strained) = (with_mesh(x) for x in (unmeshed(**LOOSE), scene))
    assert build_mesh(chosen).nodes.size > build_mesh(loose).nodes.size
    assert len(at_ease["tried"]) == 1 < len(strained["tried"])
    *_, coarser, last = (trial["errors"] for trial in strained["tried"])
    most = scene.tolerance.mesh
    assert last[quantity] <= getattr(most, quantity) < coarser[quantity]
    assert all(coarser[other] <= getattr(most, other) for other in coarser if other != quantity)


def test_where_no_mesh_is_fine_enough_it_says_in_what():
    _, document = with_mesh(unmeshed(**LOOSE | {"von_mises": 0.01}))
    assert "no mesh tried, of up to 12111 DOFs, does so in von_mises: " in document["why"]


def test_it_says_how_much_stress_may_err_with_the_largest_loads():
    _, document = with_mesh(unmeshed(**LOOSE))
    (trial,) = document["tried"]
    most = LARGE_LOADS * trial["errors"]["von_mises"]
    assert f"of stress (with the largest loads up to {most:.0%})" in document["why"]


@pytest.mark.parametrize("geometry", [None, '[geometry]\nkind = "block"\nsize = [10, 10, 8]\n'])
def test_the_choice_is_in_the_scenes_text(geometry):
    chosen, document = with_mesh(unmeshed(geometry, **LOOSE))
    assert parse_scene(chosen.text).geometry.divisions == document["tried"][-1]["divisions"]
    assert with_mesh(chosen)[1] is None


def test_where_it_cannot_be_written_it_says_so():
    scene = unmeshed('geometry = { kind = "block", size = [10, 10, 8] }\n')
    with pytest.raises(SceneError, match=r"geometry.divisions: needed where"):
        with_mesh(scene)
