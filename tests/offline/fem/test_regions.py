"""Regions of the tissue: which elements are of them, and that the models know it."""

import numpy as np
import pytest

from palpate.offline.bodies.regions import RegionsTooSmall, inside
from palpate.offline.choose.mesh import as_fine, candidates
from palpate.offline.fem.mesh import build_mesh
from palpate.offline.fem.model import FullModel
from palpate.offline.fem.problem import FullProblem, Load
from palpate.shared.geometry.elements import POINTS
from palpate.shared.geometry.quadrature import volume_quadrature
from palpate.shared.mechanics.tissue import lame
from palpate.shared.scene import SceneError, parse_scene

BLOCK = """
name = "block"
endoscope.radius = 2.0
endoscope.max_tilt = 30.0
load.max_indentation = 0.2
support.side = "bottom"
surface.side = "top"
geometry.kind = "block"
geometry.size = [12.0, 12.0, 8.0]
geometry.divisions = [6, 6, 4]
tissue.law = "neo-hookean"
tissue.young = 15.0
tissue.poisson = 0.45
"""
CORE = """
[[tissue.region]]
name = "core"
young = {young}
poisson = {poisson}
{place}
"""
SLICE = "x = [6.0, 8.0]\nz = [0.0, 6.0]"
"""A single element thick."""

BOX = "x = [4.0, 8.0]\ny = [4.0, 8.0]\nz = [2.0, 4.0]"


def scene(young=15.0, poisson=0.45, place=BOX, more="", folder=None):
    core = CORE.format(young=young, poisson=poisson, place=place)
    return parse_scene(BLOCK + core + more, folder)


def pressed(problem, pressure=4.0):
    """The equilibrium under a footprint in the middle of the top."""
    return problem.solve(Load(np.array([6.0, 6.0, 8.0]), np.array([0.0, 0.0, -1.0]), pressure))


def test_elements_are_of_the_last_region_that_holds_their_centre():
    more = CORE.format(young=30.0, poisson=0.3, place="near = [5.0, 5.0, 3.0]\nradius = 0.5")
    mesh = build_mesh(scene(1500.0, 0.2, more=more.replace("core", "seed")))
    model = FullModel(mesh, scene(1500.0, 0.2, more=more).tissue)
    centres = mesh.nodes[mesh.elements].mean(axis=1)
    within = (np.abs(centres - [6.0, 6.0, 3.0]) < [2.0, 2.0, 1.0]).all(axis=1)
    seed = np.linalg.norm(centres - [5.0, 5.0, 3.0], axis=1) < 0.5
    assert within.sum() == 4
    assert seed.sum() == 1
    np.testing.assert_array_equal(mesh.region, np.where(seed, 2, within))
    constants = np.array([lame(15.0, 0.45), lame(1500.0, 0.2), lame(30.0, 0.3)])
    np.testing.assert_array_equal(np.column_stack(model.law[:2]), constants[mesh.region])


def test_a_region_of_the_same_tissue_changes_nothing_but_how_stress_is_carried():
    fine = BLOCK.replace("[6, 6, 4]", "[12, 12, 8]")
    core = CORE.format(young=15.0, poisson=0.45, place=BOX)
    plain, own = (FullProblem(parse_scene(text)) for text in (fine, fine + core))
    load = Load(np.array([6.0, 6.0, 8.0]), np.array([0.0, 0.0, -1.0]), 1.0)
    found = plain.solve(load)
    np.testing.assert_array_equal(own.solve(load).displacement, found.displacement)
    contact = plain.footprint(load, found)
    u = plain.displaced(found, contact)
    one, other = (problem.von_mises(u, contact=contact) for problem in (plain, own))
    volumes = plain.counted_volumes
    assert np.sqrt(volumes @ (one - other) ** 2 / (volumes @ one**2)) < 0.005


def test_stress_is_compared_of_elements_in_no_region():
    plain, thin = FullProblem(parse_scene(BLOCK)), FullProblem(scene(place=SLICE))
    mesh, nodes = thin.mesh, np.arange(len(thin.mesh.nodes))
    own, other = (np.unique(mesh.elements[mesh.region == number]) for number in (1, 0))
    inside, outside = np.setdiff1d(nodes, other), np.setdiff1d(nodes, own)
    assert len(inside) > 0
    assert not thin.counted_volumes[inside].any()
    np.testing.assert_allclose(thin.counted_volumes[outside], plain.counted_volumes[outside])
    shared, counted = np.intersect1d(own, other), plain.counted_volumes > 0.0
    less = thin.counted_volumes[shared] < plain.counted_volumes[shared]
    np.testing.assert_array_equal(less, counted[shared])


def test_a_stiff_region_hardly_deforms_and_all_scales_with_stiffness():
    soft, stiff = FullProblem(parse_scene(BLOCK)), FullProblem(scene(15_000.0, 0.3))
    a, b = pressed(soft), pressed(stiff)
    core = np.unique(stiff.mesh.elements[stiff.mesh.region == 1])
    X, u = stiff.mesh.nodes[core], b.displacement[core]
    X, moved = X - X.mean(axis=0), u - u.mean(axis=0)
    rigid = X @ np.linalg.lstsq(X, moved, rcond=None)[0]
    assert np.abs(moved - rigid).max() < 4.0 / 15_000.0 * 4.0  # load over stiffness, 4 mm across
    assert np.linalg.norm(b.displacement) < 0.9 * np.linalg.norm(a.displacement)
    twice = FullProblem(stiff.scene.of_tissue(young=30.0))
    np.testing.assert_allclose(
        pressed(twice, 8.0).displacement, b.displacement, atol=1e-8 * np.abs(u).max()
    )


def test_stress_jumps_where_regions_meet_and_is_told_of_each():
    """Under a vertical squeeze between plates both carry the same load per area, each its own."""
    layered = scene(60.0, 0.0, "z = [0.0, 4.0]").of_tissue(poisson=0.0)
    problem = FullProblem(layered)
    z = problem.mesh.nodes[:, 2]
    squeeze = 1e-4 * np.where(z < 4.0, z, 4.0 + 4.0 * (z - 4.0))  # a quarter of it below
    u = np.zeros_like(problem.mesh.nodes)
    u[:, 2] = -squeeze
    stress = problem.von_mises(u)
    np.testing.assert_allclose(stress, 60.0e-4, rtol=1e-3)
    u[:, 2] = -1e-4 * z
    stress, meeting = problem.von_mises(u), z == 4.0
    np.testing.assert_allclose(stress[(z > 4.0) | meeting], 15.0e-4, rtol=1e-3)
    np.testing.assert_allclose(stress[(z < 4.0)], 60.0e-4, rtol=1e-3)
    told = problem.stress_field.peaks_by_region(u, None, None)
    np.testing.assert_allclose(told, [[15.0e-4] * 2, [60.0e-4] * 2], rtol=1e-3)


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ("near = [50.0, 5.0, 3.0]\nradius = 2.0", "region 'core' .*no element's centre is there"),
        ("z = [2.0, 9.0]", "region 'core' reaches what can be touched"),
        ('set = "bone"', "region 'core': set = 'bone' is no set .* which has none"),
        ('inside = "missing.stl"', "region 'core': inside: .*missing.stl is not there"),
    ],
)
def test_regions_that_cannot_be_are_refused_by_name(place, said, tmp_path):
    with pytest.raises(SceneError, match=said):
        build_mesh(scene(30.0, 0.4, place, folder=tmp_path))


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ("young = 1.0e6\npoisson = 0.4\nz = [2.0, 4.0]", "'core' is 6.67e.04 times as stiff"),
        ("young = 20.0\npoisson = 0.5\nz = [2.0, 4.0]", r"tissue.region.0.poisson = 0.5"),
        ("young = 20.0\npoisson = 0.4", "must name a place: one of x, y, z, near, radius, set"),
        ("young = 20.0\npoisson = 0.4\nz = [4.0, 2.0]", r"z must be \[from, to\]"),
        ("c10 = 20.0\npoisson = 0.4\nz = [2.0, 4.0]", "tissue.region.0.c10: unknown key"),
    ],
)
def test_wrong_tables_are_refused(lines, said):
    with pytest.raises(SceneError, match=said):
        parse_scene(BLOCK + f'[[tissue.region]]\nname = "core"\n{lines}\n')


def test_points_are_inside_a_closed_surface_or_not(rng):
    trimesh = pytest.importorskip("trimesh")
    ring = trimesh.creation.torus(3.0, 1.0)
    points = rng.uniform(-4.0, 4.0, (2000, 3))
    away = np.hypot(np.hypot(*points[:, :2].T) - 3.0, points[:, 2])
    clear = np.abs(away - 1.0) > 0.03  # of its facets
    found = inside(points, (np.array(ring.vertices), np.array(ring.faces)))
    np.testing.assert_array_equal(found[clear], away[clear] < 1.0)


def test_a_surface_in_a_file_is_a_region_of_a_block(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(subdivisions=3, radius=2.0)
    ball.apply_translation([6.0, 6.0, 3.0])
    ball.export(tmp_path / "ball.stl")
    own = build_mesh(scene(30.0, 0.4, 'inside = "ball.stl"', folder=tmp_path))
    same = build_mesh(scene(30.0, 0.4, "near = [6.0, 6.0, 3.0]\nradius = 2.0"))
    np.testing.assert_array_equal(own.region, same.region)
    assert own.region.sum() == 4


def test_tetrahedra_have_faces_on_the_surface_of_a_region(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("pytetwild")
    trimesh.creation.icosphere(subdivisions=3, radius=10.0).export(tmp_path / "ball.stl")
    text = scene(150.0, 0.4, "near = [0.0, 0.0, -2.0]\nradius = 4.0").text
    head, _, core = text.partition("[[tissue.region]]")
    kept = [line for line in head.splitlines() if not line.startswith(("geometry", "su"))]
    body = (
        'geometry = {kind = "surface", file = "ball.stl", unit = "mm", deviation = 0.2, edge = 2.0}'
    )
    places = "support.z = [-10.0, -8.0]\nsurface.z = [4.0, 10.0]"
    whole = "\n".join([*kept, body, places, "[[tissue.region]]" + core])
    mesh = build_mesh(parse_scene(whole, tmp_path))
    own = mesh.elements[mesh.region == 1]
    volume = volume_quadrature(mesh.nodes, own, POINTS)[1].sum()
    assert volume == pytest.approx(4 / 3 * np.pi * 4.0**3, rel=0.05)
    border = np.intersect1d(own[:, :4], mesh.elements[mesh.region == 0][:, :4])
    away = np.linalg.norm(mesh.nodes[border] - [0.0, 0.0, -2.0], axis=1)
    np.testing.assert_allclose(away, 4.0, atol=0.25)


def test_meshes_too_coarse_for_a_region_are_not_tried():
    text = BLOCK.replace("geometry.divisions = [6, 6, 4]\n", "")
    core = CORE.format(young=60.0, poisson=0.45, place="z = [3.2, 4.0]")
    plain, own = (candidates(parse_scene(text + more)) for more in ("", core))
    assert own == plain[-len(own) :]
    assert 0 < len(own) < len(plain)
    with pytest.raises(RegionsTooSmall):
        build_mesh(as_fine(parse_scene(text + core), plain[0]))
    assert build_mesh(as_fine(parse_scene(text + core), own[0])).region.any()
