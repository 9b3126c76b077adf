"""Edges that are shorter at a place than elsewhere."""

import re

import numpy as np
import pytest

from palpate.offline.bodies.mesh import refined_body
from palpate.offline.bodies.tetrahedra import edge_lengths
from palpate.shared.scene import SceneError

from .conftest import bricks, scene_of
from .test_mesh_file import tetrahedra, written

AT_ONE_END = "x = [-1.0, 4.0]\nfinest = 0.8"


@pytest.fixture
def box(tmp_path):
    """Return a function that gives the scene of a box 12 mm long, with places of shorter edges."""
    points, cells = bricks()
    written(tmp_path / "box.vtu", points, [("tetra", tetrahedra(points, cells))])

    def scene(finer):
        geometry = 'kind = "mesh"\nfile = "box.vtu"\nunit = "mm"\nfinest = 2.0\n'
        geometry += f"[geometry.finer]\n{finer}" if finer else ""
        return scene_of(tmp_path, geometry, "z = [-0.1, 0.1]", "z = [7.9, 8.1]")

    return scene


def longest_on_top(mesh, low, high):
    corners = mesh.elements[:, :4]
    at = mesh.nodes[corners]
    there = (at[..., 2] > 7.99) & (at[..., 0] >= low) & (at[..., 0] <= high)
    return edge_lengths(mesh.nodes, corners)[there.sum(axis=1) == 3].max()


def test_edges_are_shorter_there_and_elsewhere_as_they_were(box):
    finer, even = refined_body(box(AT_ONE_END)), refined_body(box(""))
    assert longest_on_top(finer, 0.0, 4.0) <= 0.8
    assert longest_on_top(even, 0.0, 4.0) > 1.2
    assert longest_on_top(finer, 8.0, 12.0) == longest_on_top(even, 8.0, 12.0) > 1.2
    assert {node.tobytes() for node in even.nodes} < {node.tobytes() for node in finer.nodes}


def test_a_place_where_the_support_ends_counts_as_well(box):
    finer = refined_body(box("z = [-1.0, 4.0]\nfinest = 0.8"))
    ends = np.isin(finer.nodes[:, 2], 0.0) & np.isin(finer.nodes[:, 0], 0.0)
    assert np.diff(np.sort(finer.nodes[ends, 1])).max() <= 0.4
    assert longest_on_top(finer, 0.0, 12.0) > 1.2


@pytest.mark.parametrize(
    ("finer", "words"),
    [
        ("x = [20.0, 30.0]\nfinest = 0.8", "geometry.finer: no face of the body is there"),
        ("z = [3.0, 7.0]\nfinest = 0.8", "nothing there can be touched, and nothing held ends"),
        ('set = "top"\nfinest = 0.8', "geometry.finer.set = 'top': no set of the body's file"),
        ("finest = 0.8", "must name a place: one of x, y, z, near, radius, set"),
        ("x = [0.0, 1.0]", "geometry.finer.finest: missing (longest edges there, mm)"),
        ("x = [0.0, 1.0]\nfinest = 0", "geometry.finer.finest = 0: "),
    ],
)
def test_a_place_that_is_no_place_is_named(box, finer, words):
    with pytest.raises(SceneError, match=re.escape(words)):
        refined_body(box(finer))
