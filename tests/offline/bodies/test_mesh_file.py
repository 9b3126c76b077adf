"""Bodies from meshes: every kind of cell, middles of edges, named sets."""

import numpy as np
import pytest

from palpate.offline.bodies.base import base_mesh
from palpate.offline.bodies.mesh_file import read_mesh
from palpate.offline.bodies.tetrahedra import EDGES, boundary, manifold, quality, raised
from palpate.offline.fem.mesh import build_mesh
from palpate.shared.geometry.elements import HEX_EDGES
from palpate.shared.scene import SceneError

from .conftest import bricks, scene_of

meshio = pytest.importorskip("meshio")
WEDGES = [[0, 1, 2, 4, 5, 6], [0, 2, 3, 4, 6, 7]]
PYRAMIDS = [[0, 1, 2, 3], [4, 7, 6, 5], [0, 4, 5, 1], [1, 5, 6, 2], [2, 6, 7, 3], [3, 7, 4, 0]]


def written(path, points, cells, **data):
    mesh = meshio.Mesh(points, cells, **data)
    mesh.write(path, **({"file_format": "gmsh22"} if path.suffix == ".msh" else {}))
    return path


def tetrahedra(points, cells):
    from palpate.offline.bodies.mesh_file import HEXAHEDRON, _split

    return _split(cells, HEXAHEDRON[0])[0]


def cells_of(kind, points, cells):
    """The box of bricks in cells of another kind: points and cells."""
    if kind == "hexahedron":
        return points, cells
    if kind in ("tetra", "tetra10"):
        corners = tetrahedra(points, cells)
        return (points, corners) if kind == "tetra" else raised(points, corners)
    if kind == "wedge":
        return points, np.concatenate([cells[:, w] for w in WEDGES])
    if kind == "hexahedron20":
        ends, number = np.unique(
            np.sort(cells[:, np.array(HEX_EDGES)], axis=2).reshape(-1, 2), axis=0,
            return_inverse=True,
        )  # fmt: skip
        middles = len(points) + number.reshape(len(cells), 12)
        return np.vstack([points, points[ends].mean(axis=1)]), np.hstack([cells, middles])
    apex = len(points) + np.arange(len(cells))
    found = [np.column_stack([cells[:, p], apex]) for p in PYRAMIDS]
    return np.vstack([points, points[cells].mean(axis=1)]), np.concatenate(found)


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh"])
@pytest.mark.parametrize(
    "kind", ["tetra", "tetra10", "hexahedron", "hexahedron20", "wedge", "pyramid"]
)
def test_every_kind_of_cell_fills_the_same_box(tmp_path, kind, suffix):
    points, cells = cells_of(kind, *bricks())
    path = written(tmp_path / f"box{suffix}", points / 10, [(kind, cells)])
    nodes, elements, _ = read_mesh(path, "cm")
    found = quality(nodes, elements)
    assert found["volume_mm3"] == pytest.approx(12 * 8 * 8)
    assert found["inverted"] == 0
    assert manifold(boundary(elements)[0])
    expected = {"tetra": 72, "tetra10": 72, "pyramid": 144}
    assert len(elements) == expected.get(kind, 72)


def test_hexahedra_whose_corners_are_numbered_at_random_fit_together(tmp_path):
    points, cells = bricks((3, 3, 3), (9.0, 9.0, 9.0))
    order = np.random.default_rng(4).permutation(len(points))
    place = np.argsort(order)
    path = written(tmp_path / "box.vtu", points[order], [("hexahedron", place[cells])])
    nodes, elements, _ = read_mesh(path, "mm")
    assert manifold(boundary(elements)[0])
    assert quality(nodes, elements)["volume_mm3"] == pytest.approx(9**3)


@pytest.mark.parametrize("kind", ["tetra10", "hexahedron20"])
def test_middles_of_edges_stay_where_the_file_has_them(tmp_path, kind):
    points, cells = cells_of(kind, *bricks())
    corners = len(bricks()[0])
    points[corners:] += np.random.default_rng(0).uniform(-0.2, 0.2, points[corners:].shape)
    nodes, elements, _ = read_mesh(written(tmp_path / "box.vtu", points, [(kind, cells)]), "mm")
    known = {tuple(p) for p in points.round(9).tolist()}
    own = {tuple(p) for p in nodes.round(9).tolist()}
    assert known <= own
    straight = nodes[elements[:, EDGES]].mean(axis=2)
    assert np.abs(nodes[elements[:, 4:]] - straight).max() > 0.1


def boxes(folder):
    """A box of two materials whose bottom and top have names, as Gmsh writes it."""
    points, cells = bricks()
    corners = tetrahedra(points, cells)
    faces = boundary(raised(points, corners)[1])[0][:, :3]
    height = points[faces][..., 2]
    bottom, top = faces[(height == 0).all(axis=1)], faces[(height == 8).all(axis=1)]
    right = points[corners][..., 0].mean(axis=1) > 8
    tags = [np.where(right, 2, 1), np.full(len(bottom), 3), np.full(len(top), 4)]
    names = {"soft": [1, 3], "hard": [2, 3], "bed": [3, 2], "lid": [4, 2]}
    return written(
        folder / "box.msh", points,
        [("tetra", corners), ("triangle", bottom), ("triangle", top)],
        cell_data={"gmsh:physical": tags, "gmsh:geometrical": tags},
        field_data={name: np.array(value) for name, value in names.items()},
    )  # fmt: skip


def test_groups_of_gmsh_are_sets_of_faces_and_of_cells(tmp_path):
    boxes(tmp_path)
    scene = scene_of(tmp_path, 'kind = "mesh"\nfile = "box.msh"\nunit = "mm"',
                     support='set = "bed"', surface='set = "lid"')  # fmt: skip
    base = base_mesh(scene)
    assert set(base.cells) == {"soft", "hard"}
    assert base.cells["hard"].sum() == 24
    assert (base.cells["hard"] ^ base.cells["soft"]).all()
    mesh = build_mesh(scene)
    assert (mesh.nodes[mesh.clamped][:, 2] == 0).all()
    assert (mesh.nodes[mesh.faces[mesh.accessible]][..., 2] == 8).all()
    assert mesh.accessible.sum() == 12
    hard = build_mesh(scene_of(tmp_path, 'kind = "mesh"\nfile = "box.msh"\nunit = "mm"',
                               support='set = "bed"', surface='set = "hard"'))  # fmt: skip
    assert hard.nodes[hard.faces[hard.accessible]][..., 0].min() == 8


def test_numbers_and_flags_of_vtk_files_are_sets(tmp_path):
    points, cells = bricks()
    written(
        tmp_path / "box.vtu", points, [("hexahedron", cells)],
        cell_data={"part": [(points[cells][..., 0].mean(axis=1) > 4).astype(int)]},
        point_data={"floor": (points[:, 2] == 0).astype(int), "inner": in_the_middle(points)},
    )  # fmt: skip
    geometry = 'kind = "mesh"\nfile = "box.vtu"\nunit = "mm"'
    scene = scene_of(tmp_path, geometry, support='set = "floor"', surface='set = "part=1"')
    mesh = build_mesh(scene)
    assert (mesh.nodes[mesh.clamped][:, 2] == 0).all()
    assert mesh.nodes[mesh.faces[mesh.accessible]][..., 0].min() == 4
    with pytest.raises(SceneError, match=r"surface.set = 'inner': lies inside the body"):
        build_mesh(scene_of(tmp_path, geometry, surface='set = "inner"', support='set = "floor"'))
    with pytest.raises(SceneError, match=r"'lid': no set .* has floor, inner, part=0, part=1|part"):
        build_mesh(scene_of(tmp_path, geometry, surface='set = "lid"', support='set = "floor"'))


def in_the_middle(points):
    return np.all((points > 0) & (points < points.max(axis=0)), axis=1).astype(int)
