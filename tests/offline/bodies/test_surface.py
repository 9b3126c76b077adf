"""Bodies from surfaces: what is repaired, and the mesh that is made once and stored."""

import numpy as np
import pytest

from palpate.offline.bodies import surface
from palpate.offline.bodies.base import base_mesh, stored_at
from palpate.offline.bodies.report import report
from palpate.offline.bodies.tetrahedra import boundary, quality
from palpate.offline.fem.mesh import build_mesh
from palpate.offline.run.workers import content_key
from palpate.offline.scenes import FOLDER, find_scene
from palpate.offline.scenes.liver import CAPSULE, LEVEL, level
from palpate.shared.scene import SceneError

from .conftest import ball, scene_of

trimesh = pytest.importorskip("trimesh")
BALL = 'kind = "surface"\nfile = "ball.stl"\nunit = "mm"\nedge = 6.0'


def repaired(tmp_path, mesh, name="body.ply"):
    mesh.export(tmp_path / name)
    return surface.repaired(tmp_path / name, surface.read_surface(tmp_path / name, "mm"))


@pytest.mark.parametrize("name", ["body.stl", "body.obj", "body.ply"])
def test_every_format_gives_the_same_closed_surface(tmp_path, name):
    found = repaired(tmp_path, ball(), name)
    assert len(found.points), len(found.triangles) == (162, 320)
    assert surface.mesh_of(found.points, found.triangles).volume == pytest.approx(
        ball().volume, rel=1e-5
    )


def test_holes_are_closed_triangles_turned_and_crumbs_and_copies_left_out(tmp_path):
    whole = ball(subdivisions=3)
    faces = whole.faces[1:].copy()
    faces[::3] = faces[::3, ::-1]
    faces = np.vstack([faces, faces[7:9], [[3, 3, 9]]])
    broken = trimesh.Trimesh(whole.vertices, faces, process=False)
    crumb = trimesh.creation.icosphere(subdivisions=1, radius=0.2).apply_translation([20, 0, 0])
    found = repaired(tmp_path, trimesh.util.concatenate([broken, crumb]))
    mended = surface.mesh_of(found.points, found.triangles)
    assert mended.is_watertight
    assert mended.volume == pytest.approx(whole.volume, rel=0.01)
    assert found.done["triangles_left_out"] == 3
    assert found.done["crumbs_left_out"] == 1
    assert found.done["holes_closed"] >= 1
    assert found.done["turned"] == 1


def test_a_surface_inside_out_is_turned(tmp_path):
    inside_out = ball()
    inside_out.invert()
    found = repaired(tmp_path, inside_out)
    assert surface.mesh_of(found.points, found.triangles).volume > 0


def test_triangles_that_cross_each_other_are_counted(tmp_path):
    assert repaired(tmp_path, ball()).crossings == 0
    crossed = ball(subdivisions=3)
    top = np.argmax(crossed.vertices[:, 2])
    vertices = crossed.vertices.copy()
    vertices[top] = 1.0, 0.7, -13.0  # through the bottom
    found = repaired(tmp_path, trimesh.Trimesh(vertices, crossed.faces))
    assert found.crossings > 0
    assert np.linalg.norm(found.place) < 10


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    pytest.importorskip("pytetwild")
    folder = tmp_path_factory.mktemp("ball")
    ball(subdivisions=3).export(folder / "ball.stl")
    return scene_of(folder, BALL)


def test_the_mesh_of_a_ball_is_close_to_it_and_stored(scene):
    base = base_mesh(scene)
    found = quality(base.nodes, base.elements)
    assert found["inverted"] == 0
    assert found["dihedral_min"] > 5
    assert found["volume_mm3"] == pytest.approx(ball(subdivisions=3).volume, rel=0.01)
    outer = base.nodes[np.unique(boundary(base.elements)[0])]
    np.testing.assert_allclose(np.linalg.norm(outer, axis=1), 10.0, atol=0.6)
    np.testing.assert_array_equal(base_mesh(scene).nodes, base.nodes)
    assert [path.name for path in scene.folder.iterdir() if path.name != "ball.stl"] == [
        stored_at(scene).name
    ]


def test_another_place_or_tissue_needs_no_other_mesh_but_another_file_or_edge_does(scene):
    same = scene_of(scene.folder, BALL, support="x = [-20.0, -5.0]")
    assert stored_at(same) == stored_at(scene)
    assert stored_at(scene_of(scene.folder, BALL.replace("6.0", "5.0"))) != stored_at(scene)


def test_a_damaged_stored_mesh_is_named(scene):
    path, content = stored_at(scene), stored_at(scene).read_bytes()
    path.write_bytes(content[:1000])
    with pytest.raises(SceneError, match=r"mesh.npz: damaged; delete it"):
        base_mesh(scene)
    path.write_bytes(content)


def test_a_mesh_for_the_model_has_support_and_surface(scene):
    mesh = build_mesh(scene)
    held = mesh.nodes[mesh.clamped]
    assert held[:, 2].max() < 1.0
    touched = mesh.nodes[mesh.faces[mesh.accessible]]
    assert touched[..., 2].min() > -5.0
    assert not mesh.clamped[mesh.faces[mesh.accessible]].all(axis=1).any()


def test_a_report_tells_of_the_body_and_of_its_mesh(scene):
    told = report(scene)
    assert told["components"] == 1
    assert told["closed"]
    assert abs(told["volume_change"]) < 0.01
    assert 0 < told["deviation_mm"]["surface_p95"] <= told["deviation_mm"]["max"] < 0.6
    assert told["thickness_mm"]["median"] == pytest.approx(20.0, rel=0.05)
    assert told["crossings"] == 0


@pytest.mark.parametrize(("name", "dofs"), [("turbinate-mri", 38_148), ("turbinate-bone", 82_158)])
def test_the_turbinate_comes_with_its_mesh_which_no_extra_is_needed_for(name, dofs):
    scene = find_scene(name)
    assert stored_at(scene).parent == FOLDER
    assert stored_at(scene).exists()
    mesh = build_mesh(scene)
    assert mesh.nodes.size == dofs
    assert mesh.region.any() == (name == "turbinate-bone")
    held, touched = mesh.nodes[mesh.clamped], mesh.nodes[mesh.faces[mesh.accessible]]
    assert held[:, 0].mean() < 7 < 12 < touched[..., 0].mean()  # lateral and medial
    assert held[:, 2].mean() > 14 > touched[..., 2].mean()  # above and below


def test_the_liver_is_what_its_generator_draws():
    points = surface.read_surface(FOLDER / "liver.stl", "mm").vertices
    np.testing.assert_allclose(level(points), LEVEL, atol=0.01)
    assert np.ptp(points, axis=0).max() == pytest.approx(146, abs=1)
    mesh = build_mesh(find_scene("liver"))
    assert mesh.nodes[mesh.clamped][:, 1].mean() < mesh.nodes[mesh.faces[mesh.accessible], 1].mean()
    corners = mesh.nodes[mesh.elements[:, :4]]
    tumour = corners[mesh.region == 2] - [26.0, 24.0, 15.0]
    assert np.linalg.norm(tumour, axis=2).max() < 10.0 + 0.75
    closed = surface.repaired(
        FOLDER / "liver.stl", surface.read_surface(FOLDER / "liver.stl", "mm")
    )
    inner = np.unique(corners[mesh.region == 1].reshape(-1, 3), axis=0)
    _, depth = surface.nearest(surface.index_of(closed.points, closed.triangles), inner[::5])
    assert depth.min() == pytest.approx(CAPSULE, abs=0.3)


def test_results_depend_on_the_mesh_and_on_surfaces_that_places_name(scene):
    near = 'close_to = "bone.stl"\ndistance = 3.0'
    ball(radius=4.0).apply_translation([0, 0, -13]).export(scene.folder / "bone.stl")
    hung = scene_of(scene.folder, BALL, support=near)
    keys = [content_key(scene), content_key(hung)]
    assert content_key(hung) == keys[1]
    ball(radius=4.5).apply_translation([0, 0, -13]).export(scene.folder / "bone.stl")
    keys.append(content_key(hung))
    stored_at(scene).unlink()
    keys += [content_key(hung)]
    assert len(set(keys)) == 4
    (scene.folder / "bone.stl").unlink()
