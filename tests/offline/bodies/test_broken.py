"""Files that are no body: each is refused with a sentence that names the file and what helps."""

import gzip
import re
import struct
import sys

import numpy as np
import pytest

from palpate.offline.bodies import files, labels, mesh_file, surface
from palpate.offline.fem.mesh import build_mesh
from palpate.shared.anatomy import LabelBody
from palpate.shared.errors import PalpateError
from palpate.shared.scene import SceneError

from .conftest import ball, bricks, scene_of

trimesh = pytest.importorskip("trimesh")
meshio = pytest.importorskip("meshio")
nibabel = pytest.importorskip("nibabel")
nrrd = pytest.importorskip("nrrd")
pytest.importorskip("pytetwild")

SURFACE = 'kind = "surface"\nfile = "{file}"\nunit = "mm"'
MESH = 'kind = "mesh"\nfile = "{file}"\nunit = "mm"'
LABELS = 'kind = "labels"\nfile = "{file}"\nlabels = [1]'


def exported(mesh, name="b.stl"):
    return lambda folder: mesh().export(folder / name)


def bytes_of(name, content):
    return lambda folder: (folder / name).write_bytes(content())


def without_cap():
    whole = ball()
    return trimesh.Trimesh(whole.vertices, whole.faces[whole.triangles_center[:, 2] < 5])


def two():
    return trimesh.util.concatenate([ball(), ball().apply_translation([30, 0, 0])])


def hollow():
    inner = ball(6.0)
    inner.invert()
    return trimesh.util.concatenate([ball(), inner])


def crossing():
    """A tube that is bent until it goes through itself."""
    path = np.array([[0, 0, 0], [20, 0, 0], [20, 0, 15], [5, 0, 15], [5, 0, -15]], float)
    steps = np.linspace(0, 4, 41)
    line = np.stack([np.interp(steps, np.arange(5), path[:, k]) for k in range(3)], axis=1)
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    tangent = np.gradient(line, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.tile([0.0, 1.0, 0.0], (41, 1))
    other = np.cross(tangent, side)
    rings = line[:, None] + 2.5 * (
        np.cos(angle)[:, None] * side[:, None] + np.sin(angle)[:, None] * other[:, None]
    )
    points = np.vstack([rings.reshape(-1, 3), line[[0, -1]]])
    faces = []
    for i in range(40):
        for k in range(12):
            a, b, m = 12 * i + k, 12 * i + (k + 1) % 12, 12
            faces += [[a, b, b + m], [a, b + m, a + m]]
    for k in range(12):
        n = (k + 1) % 12
        faces += [[492, n, k], [493, 480 + k, 480 + n]]
    return trimesh.Trimesh(points, faces)


def mobius():
    count = 40
    t = np.linspace(0, 2 * np.pi, count, endpoint=False)
    along = np.stack([np.cos(t), np.sin(t), 0 * t], axis=1)
    out = np.cos(t / 2)[:, None] * along + np.sin(t / 2)[:, None] * [0, 0, 1.0]
    points = np.stack([10 * along + s * out for s in (-3, 3)], axis=1).reshape(-1, 3)
    faces = []
    for i in range(count):
        a, b = 2 * i, 2 * i + 1
        c, d = (1, 0) if i == count - 1 else (a + 2, b + 2)
        faces += [[a, b, d], [a, d, c]]
    return trimesh.Trimesh(points, faces, process=False)


def branching():
    whole = ball()
    fin = [*whole.faces[0][:2], len(whole.vertices)]
    vertices = np.vstack([whole.vertices, [0, 0, 25.0]])
    back = [fin[1], fin[0], fin[2]]
    return trimesh.Trimesh(vertices, np.vstack([whole.faces, [fin], [back]]), process=False)


def not_finite():
    mesh = ball()
    content = bytearray(mesh.export(file_type="stl"))
    content[84 + 12 : 84 + 16] = struct.pack("<f", np.nan)
    return bytes(content)


def nothing():
    return bytes(80) + struct.pack("<I", 0)


def truncated():
    return ball().export(file_type="stl")[:4000]


def countless():
    """A header that promises a hundred billion bytes of triangles."""
    return bytes(80) + struct.pack("<I", 2_000_000_000) + bytes(500)


def needle():
    return trimesh.creation.box([40.0, 40.0, 0.02])


def box(kind="hexahedron", cells=None, points=None, **data):
    own, bricks_ = bricks()
    return lambda folder: meshio.Mesh(
        own if points is None else points(own), [(kind, bricks_ if cells is None else cells)],
        **data,
    ).write(folder / "b.vtu")  # fmt: skip


def folded(points):
    """One of the inner corners lies beyond the box."""
    points = points.copy()
    inner = np.flatnonzero(np.all((points > 0) & (points < points.max(axis=0)), axis=1))[0]
    points[inner] += [20.0, 0, 0]
    return points


def torn():
    """Cells of the upper half have points of their own, at the same places."""
    points, cells = bricks()
    upper = points[cells][..., 2].mean(axis=1) > 4
    return cells + len(points) * upper[:, None]


def image(change=None, affine=None, dtype=np.uint8, name="b.nii"):
    def write(folder):
        data = np.zeros((12, 12, 12), dtype)
        data[3:9, 3:9, 3:9] = 1
        if change is not None:
            change(data)
        made = nibabel.Nifti1Image(data, np.eye(4) * 2 if affine is None else affine)
        nibabel.save(made, folder / name)

    return write


def nameless(folder):
    image()(folder)
    content = bytearray((folder / "b.nii").read_bytes())
    content[252:256] = bytes(4)  # the codes of both transforms
    (folder / "b.nii").write_bytes(bytes(content))


def no_space(folder):
    nrrd.write(str(folder / "b.nrrd"), np.ones((4, 4, 4), np.uint8))


def cut_short(folder):
    image(name="b.nii.gz")(folder)
    content = (folder / "b.nii.gz").read_bytes()
    (folder / "b.nii.gz").write_bytes(content[: len(content) // 2])


def apart(data):
    data[:] = 0
    data[1:4, 1:4, 1:4] = 1
    data[7:11, 7:11, 7:11] = 1


def thin(data):
    data[:] = 0
    data[5, 3:9, 3:9] = 1


def grey(data):
    data += np.random.default_rng(0).random(data.shape).astype(data.dtype)


def large(folder):
    with (folder / "b.stl").open("wb") as file:
        file.truncate(files.MOST_BYTES + 1)  # without a byte on the disk


def stretched(factor):
    return lambda: ball().apply_scale(factor)


BROKEN = {
    "missing file": (SURFACE, "b.stl", lambda folder: None, "b.stl is not there"),
    "a folder": (SURFACE, "b.stl", lambda f: (f / "b.stl").mkdir(), "b.stl is not there, or no"),
    "empty file": (SURFACE, "b.stl", bytes_of("b.stl", bytes), "b.stl is empty"),
    "large file": (SURFACE, "b.stl", large, "b.stl has 500 MB; files of up to .* save the body"),
    "other kind": (SURFACE, "b.step", bytes_of("b.step", lambda: b"x"), "end in .stl or .obj or"),
    "wrong magic": (SURFACE, "b.ply", bytes_of("b.ply", lambda: b"GIF89a" * 99), "read as PLY .*"),
    "noise": (SURFACE, "b.stl", bytes_of("b.stl", lambda: bytes(range(256)) * 9), "b.stl: .*save"),
    "truncated": (SURFACE, "b.stl", bytes_of("b.stl", truncated), "b.stl: .*cut short; save"),
    "countless": (SURFACE, "b.stl", bytes_of("b.stl", countless), "b.stl: .*cut short; save"),
    "no triangles": (SURFACE, "b.stl", bytes_of("b.stl", nothing), "b.stl: .*; save"),
    "points alone": (SURFACE, "b.obj", bytes_of("b.obj", lambda: b"v 0 0 0\nv 1 0 0\n"), "save"),
    "bad numbers": (SURFACE, "b.obj", bytes_of("b.obj", lambda: b"v 0 0 0\nf 1 2 9\n"), "save"),
    "not finite": (SURFACE, "b.stl", bytes_of("b.stl", not_finite), "1 of .* not finite; remove"),
    "open": (SURFACE, "b.stl", exported(without_cap), "is open: a hole .* mm round, near .* close"),
    "two parts": (SURFACE, "b.stl", exported(two), "has 2 separate parts, of .* mm²; .* save one"),
    "cavity": (SURFACE, "b.stl", exported(hollow), "2 separate parts, .* without cavities"),
    "crosses": (SURFACE, "b.stl", exported(crossing), "pairs of triangles cross .* repair"),
    "one side": (SURFACE, "b.ply", exported(mobius, "b.ply"), "b.ply: the surface .*save it anew"),
    "branching": (SURFACE, "b.ply", exported(branching, "b.ply"), "branches.* repair it"),
    "metres": (SURFACE, "b.stl", exported(stretched(1e-3)), "0.02 x .* mm .* a larger geometry.un"),
    "micrometres": (SURFACE, "b.stl", exported(stretched(1e3)), "2e.04 x .* state a smaller geom"),
    "too thin": (SURFACE, "b.stl", exported(needle), "thinner .*; state a smaller one"),
    "inverted": (MESH, "b.vtu", box(points=folded), "of 72 tetrahedra are inverted .* repair the"),
    "torn": (MESH, "b.vtu", box(cells=torn(), points=lambda p: np.vstack([p, p])),
             "b.vtu: the mesh of the body falls into 2 parts; save one"),
    "no cells": (MESH, "b.vtu", box("triangle", bricks()[1][:, :3]), "no solid cells; .*'surface'"),
    "unknown": (MESH, "b.vtu", box("polygon", bricks()[1][:, :5]), "kind polygon; .* save"),
    "nan nodes": (MESH, "b.vtu", box(points=lambda p: p * np.where(p > 11, np.nan, 1)), "not fini"),
    "no vtu": (MESH, "b.vtu", bytes_of("b.vtu", lambda: b"<VTKFile>"), "cannot be read as VTU"),
    "short vtu": (MESH, "b.vtu", lambda f: (box()(f), (f / "b.vtu").write_bytes(
        (f / "b.vtu").read_bytes()[:900])), "cannot be read as VTU .* save it anew"),
    "no msh": (MESH, "b.msh", bytes_of("b.msh", lambda: b"$Nodes\n1\n"), "cannot be read as MSH"),
    "huge mesh": (MESH, "b.vtu", box(points=lambda p: 1e3 * p), "state a smaller geometry.unit"),
    "empty label": (LABELS, "b.nii", image(lambda d: d.fill(4)), "labels = 1: not in .* has 4"),
    "no label": (LABELS, "b.nii", image(lambda d: d.fill(0)), "not in .*, which has none"),
    "grey": (LABELS, "b.nii", image(grey, dtype=np.float32), "grey values; save the segmentation"),
    "flat axes": (LABELS, "b.nrrd", no_space, "its space is none of .* save it with its orienta"),
    "nameless axes": (LABELS, "b.nii", nameless, "which way its axes go; save it with an sform"),
    "short image": (LABELS, "b.nii.gz", cut_short, "cannot be read as an image .* save it anew"),
    "no image": (LABELS, "b.nii.gz", bytes_of("b.nii.gz", lambda: gzip.compress(b"x" * 999)),
                 "cannot be read as an image"),
    "two islands": (LABELS, "b.nii", image(apart), "2 separate parts"),
    "smoothed away": (LABELS + "\nsmoothing = 8.0", "b.nii", image(thin), "smaller geometry.smoot"),
    "four axes": (LABELS, "b.nii", lambda f: nibabel.save(
        nibabel.Nifti1Image(np.ones((3, 3, 3, 2), np.uint8), np.eye(4)), f / "b.nii"),
        "has 4 dimensions; save one volume"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_a_file_that_is_no_body_is_refused_with_a_sentence(tmp_path, name):
    geometry, file, make, message = BROKEN[name]
    make(tmp_path)
    scene = scene_of(tmp_path, geometry.replace("{file}", file), support="z = [-1e3, 0.0]")
    with pytest.raises(SceneError) as refused:
        build_mesh(scene)
    said = str(refused.value)
    assert re.search(message, said), said
    assert file in said
    assert "\n" not in said
    assert not list(tmp_path.glob("*.npz"))


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ('kind = "surface"\nfile = "b.stl"', r"geometry.unit: missing \(of lengths in the file"),
        ('kind = "surface"\nunit = "mm"', r"geometry.file: missing \(STL, OBJ or PLY"),
        ('kind = "surface"\nfile = "b.stl"\nunit = "inch"', "unit = 'inch': .*'mm', 'cm' or 'm'"),
        ('kind = "surface"\nfile = "b.stl"\nunit = "mm"\nlabel = 2', "geometry.label: unknown key"),
        ('kind = "mesh"\nfile = "b.vtu"\nunit = "mm"\nedge = 2', "geometry.edge: unknown key"),
        ('kind = "labels"\nfile = "b.nii"\nlabels = []', "geometry.labels = .*at least 1 item"),
        ('kind = "labels"\nfile = "b.nii"\nlabels = [0]', "geometry.labels.0 = 0: .*greater than"),
    ],
)
def test_a_geometry_that_says_too_little_is_refused_before_any_file_is_read(keys, message):
    with pytest.raises(SceneError, match=message):
        scene_of(None, keys)


def test_a_scene_without_a_folder_is_told_so():
    with pytest.raises(SceneError, match=r"geometry.file: the scene's folder is not known"):
        build_mesh(scene_of(None, SURFACE.replace("{file}", "b.stl")))


def test_a_missing_library_is_named(tmp_path, monkeypatch):
    ball().export(tmp_path / "b.stl")
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(PalpateError, match=r"need trimesh: pip install 'palpate\[anatomy\]'"):
        build_mesh(scene_of(tmp_path, SURFACE.replace("{file}", "b.stl")))


def written(folder):
    """A sound file of each kind."""
    points, cells = bricks()
    for name, how in {"a.vtu": {}, "b.vtk": {}, "c.msh": {"file_format": "gmsh"}}.items():
        meshio.Mesh(points, [("hexahedron", cells)]).write(folder / name, **how)
    for name in ("d.stl", "e.obj", "f.ply"):
        ball().export(folder / name)
    image(name="g.nii")(folder)
    image(name="h.nii.gz")(folder)
    space = {"space": "left-posterior-superior", "space directions": np.eye(3)}
    nrrd.write(str(folder / "i.nrrd"), np.pad(np.ones((4, 4, 4), np.uint8), 2), space)
    return sorted(folder.iterdir())


def read(path):
    """Read a file as far as it is meshed."""
    if path.suffix in mesh_file.KINDS:
        mesh_file.read_mesh(path, "mm")
    elif path.suffix in surface.KINDS:
        surface.repaired(path, surface.read_surface(path, "mm"))
    else:
        body = LabelBody(kind="labels", file=path.name, labels=(1,), deviation=0.5, edge=4.0)
        points, triangles, _ = labels.surface_round(path, labels.read_image(path), body)
        surface.repaired(path, surface.mesh_of(points, triangles))


@pytest.mark.filterwarnings("ignore")  # of the libraries that read
def test_damaged_files_are_refused_or_read_and_never_end_otherwise(tmp_path):
    rng = np.random.default_rng(0)
    for path in written(tmp_path):
        read(path)
        sound, said = path.read_bytes(), list[str]()
        for _ in range(20):
            content = bytearray(sound)
            start, length = rng.integers(len(content)), rng.integers(1, 60)
            if rng.random() < 0.4:
                del content[start : start + length]
            elif rng.random() < 0.5:
                del content[start:]
            for at in rng.integers(min(len(content), 900) or 1, size=min(len(content), 3)):
                content[at] = rng.integers(256)
            path.write_bytes(content)
            try:
                read(path)
            except SceneError as error:
                said.append(str(error))
        assert said
        assert all(path.name in text and "\n" not in text for text in said)


@pytest.mark.parametrize("library", ["trimesh", "meshio", "nibabel", "nrrd"])
def test_a_library_that_is_not_installed_is_named_and_no_file_blamed(
    tmp_path, monkeypatch, library
):
    paths = written(tmp_path)
    monkeypatch.setitem(sys.modules, library, None)
    said = set()
    for path in paths:
        try:
            read(path)
        except PalpateError as error:
            said.add(str(error))
    assert said == {f"bodies from files need {library}: pip install 'palpate[anatomy]'"}
