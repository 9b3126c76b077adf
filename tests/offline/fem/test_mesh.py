"""Meshes of the shipped scenes: valid, closed, oriented, of the promised size."""

from collections import Counter
from functools import cache

import numpy as np
import pytest

from palpate.offline.doubts import doubts
from palpate.offline.fem.mesh import (
    accessible_surface,
    build_mesh,
    determinants,
    least_volume_ratio,
    local_thickness,
    mesh_quality,
    ticks_of,
)
from palpate.offline.fem.problem import FullProblem
from palpate.offline.fem.section import TURN, bulge, map_section, polygon_area, read_outline
from palpate.offline.fem.shapes import shape_of
from palpate.offline.scenes import FOLDER, filled, find_scene, shipped_scenes
from palpate.shared.geometry.elements import HEX_EDGES
from palpate.shared.scene import SceneError, parse_scene

OUTLINE = FOLDER / "inferior_turbinate_section.csv"


@cache
def shipped_mesh(name):
    return build_mesh(find_scene(name))


BODIES = {(scene.geometry, scene.support, scene.surface): scene.name
          for scene in map(find_scene, shipped_scenes())
          if getattr(scene.geometry, "divisions", None) is not None}  # fmt: skip
"""A scene of every body that comes along with the divisions of its mesh."""


@pytest.fixture(params=BODIES.values())
def mesh(request):
    return shipped_mesh(request.param)


def variant(name, *changes):
    """A shipped scene with some of its text, all defaults included, replaced."""
    scene = find_scene(name)
    text = filled(scene)
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return parse_scene(text, scene.folder)


@cache
def turbinate_hex8():
    divisions = ("[13, 2, 13]", "[23, 3, 20]")
    return build_mesh(variant("turbinate-paper", ('"hex20"', '"hex8"'), divisions))


def test_elements_are_not_inverted_every_node_is_used_and_the_surface_is_not_held(mesh):
    assert determinants(mesh.nodes, mesh.elements).min() > 0
    assert np.array_equal(np.unique(mesh.elements), np.arange(len(mesh.nodes)))
    assert mesh.elements.dtype == mesh.faces.dtype == np.int32
    assert mesh.clamped.any()
    assert mesh.accessible.any()
    assert not mesh.clamped[mesh.faces[mesh.accessible]].any()


def test_boundary_is_closed_and_outward(mesh):
    edges = Counter()
    for face in mesh.faces[:, :4]:
        edges.update(zip(face.tolist(), np.roll(face, -1).tolist(), strict=True))
    # Every edge is walked once each way: closed, and consistently oriented.
    assert set(edges.values()) == {1}
    assert all(edge[::-1] in edges for edge in edges)
    # By the divergence theorem the enclosed volume is positive only if the normals point out.
    a, b, c, d = np.moveaxis(mesh.nodes[mesh.faces[:, :4]], 1, 0)
    volume = sum(np.sum(p * np.cross(q, r)) / 6 for p, q, r in ((a, b, c), (a, c, d)))
    assert volume == pytest.approx(mesh_quality(mesh)["volume_mm3"], rel=0.06)


def test_midside_nodes_lie_near_the_middle_of_their_edge(mesh):
    for middle, (start, end) in enumerate(HEX_EDGES, start=8):
        a, b, m = (mesh.nodes[mesh.elements[:, i]] for i in (start, end, middle))
        length = np.linalg.norm(b - a, axis=1)
        assert (np.abs(np.sum((m - (a + b) / 2) * (b - a), axis=1)) < 0.25 * length**2).all()


def test_turbinate_has_the_promised_size_and_the_volume_of_the_section():
    assert turbinate_hex8().nodes.size == pytest.approx(6048, rel=0.03)
    # less what the turned corners take
    expected = 40.0 * abs(polygon_area(read_outline(OUTLINE))) * (1 - 3.5e-3)
    for name, dofs, tolerance in (("turbinate-paper", 6048, 4e-3), ("turbinate", 22932, 1e-3)):
        mesh = shipped_mesh(name)
        assert mesh.nodes.size == pytest.approx(dofs, rel=0.03)
        assert mesh_quality(mesh)["volume_mm3"] == pytest.approx(expected, rel=tolerance)


def test_elements_are_well_shaped_and_of_even_size_along_the_outer_side():
    quality = mesh_quality(shipped_mesh("turbinate-paper"))
    assert quality["scaled_jacobian_min"] > 0.3
    assert quality["scaled_jacobian_median"] > 0.85
    assert quality["aspect_ratio_max"] < 10
    assert quality["jacobian_ratio_min"] > 0.04
    # with rows at the lip its elements are slender, but less distorted
    assert mesh_quality(shipped_mesh("turbinate"))["jacobian_ratio_min"] > 0.15
    perfect = dict.fromkeys(quality, 1.0) | {"volume_mm3": 1000.0}
    assert mesh_quality(shipped_mesh("cube")) == pytest.approx(perfect)
    mesh = turbinate_hex8()
    face = mesh.faces[mesh.accessible]
    front = face[np.isclose(mesh.nodes[face, 1].min(axis=1), 0.0)]
    corner = mesh.nodes[front][..., [0, 2]]
    length = np.linalg.norm(corner - np.roll(corner, -1, axis=1), axis=2).max(axis=1)
    assert length.max() < 1.1 * length.min()


def test_turbinate_is_touched_medially_and_below_end_to_end_and_clamped_on_the_lip_only():
    mesh = shipped_mesh("turbinate")
    touched = mesh.nodes[mesh.faces[mesh.accessible]]
    (x0, y0, z0), (_, y1, z1) = touched.min(axis=(0, 1)), touched.max(axis=(0, 1))
    assert (y0, y1) == (0.0, pytest.approx(40.0))
    assert x0 == pytest.approx(1.2, abs=0.1)  # as far as the hook's tip
    assert z0 == pytest.approx(0.0, abs=0.05)  # round the lower edge
    assert 15.0 < z1 < 17.0
    normals = np.cross(touched[:, 2] - touched[:, 0], touched[:, 3] - touched[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert np.abs(normals[:, 1]).max() < 1e-12
    assert normals[:, 0].max() > 0.99  # medial
    assert accessible_surface(mesh).normals[:, 2].min() < -0.99  # inferior
    assert normals[:, 0].min() < -0.6  # lateral-inferior, towards the hook
    x, y, z = mesh.nodes[mesh.clamped].T
    assert x.max() < 4.4
    assert z.min() > 14.2
    assert (y.min(), y.max()) == (0.0, pytest.approx(40.0))


def test_the_surface_is_that_of_the_body_and_not_of_the_faces():
    scene = find_scene("turbinate")
    problem, rng = FullProblem(scene), np.random.default_rng(0)
    at = np.column_stack([rng.random((300, 2)), np.ones(300)])  # of the outer side
    on = shape_of(scene).at(at)
    inside = on[:, 2] < 15.0
    ways = 1e-5 * np.eye(3)[:2]
    along, across = (shape_of(scene).at(at + way) - shape_of(scene).at(at - way) for way in ways)
    normals = np.cross(along, across)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    def off(surface):
        found = [surface.project(x) for x in on[inside]]
        turned = [n @ normal for (_, n, _), normal in zip(found, normals[inside], strict=True)]
        return 1e3 * max(gap for *_, gap in found), np.degrees(np.arccos(min(turned)))

    gap, angle = off(problem.surface)
    assert gap < 2.5  # um
    assert angle < 0.2  # degrees
    gap, angle = off(accessible_surface(problem.mesh))
    assert gap > 5.0
    assert angle > 1.5


@pytest.mark.parametrize("grading", ["1.0", "1.7"])
@pytest.mark.parametrize("divisions", [(7, 2), (10, 2), (13, 3), (20, 4), (40, 3)])
def test_no_element_of_the_turbinate_is_inverted_however_coarse_or_fine(divisions, grading):
    changes = ("[13, 2, 13]", str([*divisions, 2])), ("grading = 1.7", f"grading = {grading}")
    quality = mesh_quality(build_mesh(variant("turbinate-paper", *changes)))
    assert quality["jacobian_ratio_min"] > 0.005


@pytest.mark.parametrize("element", ["hex8", "hex20"])
@pytest.mark.parametrize("name", ["turbinate-paper", "quick"])
def test_a_mesh_may_have_other_ticks_than_those_of_the_divisions(name, element):
    scene = variant(name, ('"hex20"', f'"{element}"'))
    own, built = ticks_of(scene.geometry), build_mesh(scene)
    np.testing.assert_array_equal(build_mesh(scene, own).nodes, built.nodes)
    graded = np.array([0.0, 0.1, 0.3, 0.7, 1.0]), np.array([0.0, 0.2, 1.0]), own[2]
    mesh = build_mesh(scene, graded)
    assert len(mesh.elements) == 4 * 2 * (len(own[2]) - 1)
    volumes = [mesh_quality(body)["volume_mm3"] for body in (mesh, built)]
    assert volumes[0] == pytest.approx(volumes[1], rel=0.2 if element == "hex8" else 0.02)
    corners = shape_of(scene).grid(*graded)
    first, last = corners[0, 0, 0], corners[1, 1, 1]
    np.testing.assert_allclose(mesh.nodes[mesh.elements[0, [0, 6]]], [first, last], atol=1e-12)


def test_a_graded_block_has_thin_layers_at_its_top():
    mesh = build_mesh(variant("quick", ("grading = 1.0", "grading = 1.5")))
    heights = np.unique(mesh.nodes[mesh.elements[:, :8], 2].round(9))
    np.testing.assert_allclose(heights, 8.0 * (1 - np.array([1, 2 / 3, 1 / 3, 0]) ** 1.5))


@pytest.mark.parametrize("rows", [1, 3, 6])
def test_a_refined_lip_has_short_rows_and_thin_layers_at_its_edges_only(rows):
    scene = variant("turbinate-paper", ("lip_rows = 0", f"lip_rows = {rows}"), ("[13, 2", "[16, 3"))
    mesh, plain = build_mesh(scene), build_mesh(variant("turbinate-paper", ("[13, 2", "[16, 3")))
    assert len(mesh.elements) == (16 + rows) * 3 * 13
    assert mesh_quality(mesh)["jacobian_ratio_min"] > 2 * mesh_quality(plain)["jacobian_ratio_min"]
    along, _, layers = ticks_of(scene.geometry)
    rows_of_lip = np.diff(along)[: rows + 1]
    assert rows_of_lip.sum() == pytest.approx(1 / 16)
    assert (rows_of_lip[2:] / rows_of_lip[1:-1] > 2).all()
    np.testing.assert_allclose(layers[0], [0.0, 0.1, 0.9, 1.0])
    np.testing.assert_allclose(layers[-1], 1 - np.array([1, 2 / 3, 1 / 3, 0]) ** 1.7)


def test_what_hangs_from_a_refined_lip_moves_as_it_does_on_far_finer_meshes():
    """Mean displacement (mm) under a footprint for 1 kPa, linear; extrapolated from 126 k DOFs."""
    x, converged = np.array([10.18, 20.0, 11.0]), 0.252
    moved = []
    for rows in (0, 2):
        changes = ("lip_rows = 0", f"lip_rows = {rows}"), ("[13, 2, 13]", "[13, 3, 16]")
        body = FullProblem(variant("turbinate-paper", *changes))
        nodal, normal = body.unit_load(x)
        load = (nodal[:, None] * normal).reshape(-1)[body.model.free]
        moved.append(load @ body.model.solve_linear(load) / nodal.sum())
    assert moved[1] == pytest.approx(converged, rel=0.02)
    assert moved[0] < 0.975 * converged


def test_a_mesh_with_an_inverted_element_is_refused_and_says_where():
    folded = ("[13, 2, 13]", "[3, 1, 2]")
    with pytest.raises(SceneError, match=r"2 of 6 elements are inverted, .* \([\d., ]+\) mm"):
        build_mesh(variant("turbinate-paper", folded))


def test_volume_ratios_are_looked_for_at_nodes_and_between_points():
    mesh = shipped_mesh("quick")
    stretch = np.diag([1.2, 0.9, 0.8]) - np.eye(3)
    assert least_volume_ratio(mesh, mesh.nodes @ stretch) == pytest.approx(1.2 * 0.9 * 0.8)
    # one corner pushed far into the body: its neighbours fold
    pushed = np.zeros_like(mesh.nodes)
    pushed[0] = 0.4 * np.ptp(mesh.nodes, axis=0)
    assert least_volume_ratio(mesh, pushed) < 0


def test_no_corner_of_the_section_is_straight():
    section = shape_of(find_scene("turbinate"))
    small = np.array([0.0, 1e-4])
    for u in (small, 1 - small):
        for w in (small, 1 - small):
            corner, along, across = section.grid(u, np.zeros(1), w)[[0, 1, 0], 0, [0, 0, 1]]
            a, b = along - corner, across - corner
            assert a @ b / np.linalg.norm(a) / np.linalg.norm(b) > -0.97


def test_section_map_follows_the_outline():
    points = read_outline(OUTLINE)
    section = map_section(points, find_scene("turbinate").geometry.corners)
    along = np.linspace(0, 1, 400)
    rim = [section(along, np.full_like(along, v)) for v in (0.0, 1.0)]
    rim += [section(np.full_like(along, u), along) for u in (0.0, 1.0)]
    gaps = np.linalg.norm(np.concatenate(rim)[:, None] - points[None], axis=2)
    # The points lie 0.33 mm apart, so the nearest is at most about half of that away.
    assert gaps.min(axis=1).max() < 0.18


def test_local_thickness():
    mesh = shipped_mesh("quick")
    x, y, height = mesh.nodes.max(axis=0)
    points = np.array([[3.1, 4.2, height], [0.0, 0.0, height], [x / 2, y / 2, height]])
    up = np.tile([0.0, 0.0, 1.0], (3, 1))
    assert local_thickness(mesh, points, up) == pytest.approx(height, rel=5e-3)
    # Tilted, the ball touches the left side first: x / 2 - 0.6 D / 2 = D / 2.
    tilted = np.array([[0.6, 0.0, 0.8]])
    assert local_thickness(mesh, points[2:], tilted) == pytest.approx(x / 1.6, rel=5e-3)
    # About straight across from the medial side to the deepest point of the inner one.
    wall, medial = np.array([[10.12, 20.0, 9.4]]), np.array([[1.0, 0.0, 0.0]])
    thickness = local_thickness(shipped_mesh("turbinate"), wall, medial)
    assert thickness == pytest.approx(10.12 - 5.58, abs=0.1)


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("quick", '"bottom"', '"bottom"\nx = [20, 30]', "support: no face"),
        ("quick", '"top"', '"top"\ny = [-2, -1]', "surface: no face"),
        ("quick", '"bottom"', '"top"', "surface: the support holds all of it"),
        ("turbinate-paper", "turbinate_section", "nothing", "section: .* cannot be read"),
        (
            "turbinate-paper",
            "[1.2, 2.9]",
            "[3.2, 7.0]",
            r"corners.1 = \[3.2, 7\]: lies 1.* mm from the",
        ),
        (
            "turbinate-paper",
            "[[4.3, 17.7], [1.2, 2.9]",
            "[[1.2, 2.9], [4.3, 17.7]",
            "corners: .* clockw",
        ),
    ],
)
def test_impossible_meshes_are_refused(name, old, new, message):
    with pytest.raises(SceneError, match=message):
        build_mesh(variant(name, (old, new)))


def test_a_scene_is_found_by_name_or_path_and_meshed_with_its_folder_alone():
    assert find_scene("quick") == find_scene(FOLDER / "quick.toml")
    with pytest.raises(SceneError, match="turbinate"):
        find_scene("turbine")
    with pytest.raises(SceneError, match="folder"):
        build_mesh(parse_scene(find_scene("turbinate").text))


def read_back(folder, points):
    """Write an outline and read it."""
    path = folder / "outline.csv"
    np.savetxt(path, points, delimiter=",", header="x_mm,z_mm", comments="")
    return read_outline(path)


def circle(count):
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.column_stack([np.cos(angle), np.sin(angle)])


def test_a_round_section_keeps_its_area_whichever_way_its_outline_runs(tmp_path):
    outline, other = (read_back(tmp_path, circle(64)[::way]) for way in (1, -1))
    assert polygon_area(outline) < 0  # clockwise
    assert polygon_area(other) < 0
    section = map_section(outline, [[-0.7, 0.7], [0.7, 0.7], [0.7, -0.7], [-0.7, -0.7]])
    # Green's theorem over the rim of the map.
    t = np.linspace(0, 1, 200)
    one, zero = np.ones_like(t), np.zeros_like(t)
    rim = [section(zero, t), section(t, one), section(one, t[::-1]), section(t[::-1], zero)]
    corners = 8 * TURN * (np.pi / 6) ** 2 / 12  # what turning them takes
    assert abs(polygon_area(np.concatenate(rim))) == pytest.approx(np.pi - corners, rel=1e-3)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.column_stack([np.sin(np.arange(12)), np.cos(np.arange(12) * 2.5)]), "crosses itself"),
        (circle(5), "at least 8"),
        (np.vstack([circle(10), [[np.nan, 0.0]]]), "finite"),
        (np.repeat(circle(10), 2, axis=0), "repeats"),
        (np.ones((10, 3)), "x, z"),
    ],
)
def test_bad_outlines_are_refused(tmp_path, points, message):
    with pytest.raises(SceneError, match=message):
        read_back(tmp_path, points)


def test_an_outline_of_few_points_is_doubted_and_a_drawn_one_is_not():
    points = [(0, 0), (0, 2), (0, 4), (4, 4), (8, 4), (12, 4), (12, 2), (12, 0), (8, 0), (4, 0)]
    gap, place = bulge(np.array(points, float))
    assert gap == pytest.approx(0.64, abs=0.01)
    assert np.linalg.norm(place - [1.05, 4.45]) < 0.1
    scene = find_scene("turbinate")
    assert bulge(read_outline(FOLDER / scene.geometry.section))[0] < 0.03
    assert not any("smooth curve" in doubt for doubt in doubts(scene, np.eye(3) * 20))


def test_a_sparse_outline_is_told(tmp_path):
    text = "x,z\n0,0\n0,2\n0,4\n4,4\n8,4\n12,4\n12,2\n12,0\n8,0\n4,0\n"
    (tmp_path / "inferior_turbinate_section.csv").write_text(text)
    scene = parse_scene(find_scene("turbinate").text, tmp_path)
    (doubt,) = (doubt for doubt in doubts(scene, 20 * np.eye(3)) if "smooth curve" in doubt)
    assert "through its 10 points strays 0.64 mm from the straight lines" in doubt
