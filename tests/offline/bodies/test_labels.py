"""Bodies from images of labels: spacing and handedness, several labels, what they border on."""

import numpy as np
import pytest

from palpate.offline.bodies.base import base_mesh
from palpate.offline.bodies.labels import read_image, surface_round
from palpate.offline.bodies.surface import mesh_of, repaired
from palpate.offline.fem.mesh import build_mesh
from palpate.shared.anatomy import LabelBody

from .conftest import scene_of

nibabel = pytest.importorskip("nibabel")
nrrd = pytest.importorskip("nrrd")
pytest.importorskip("pyvista")

SPACING = np.array([1.0, 0.8, 1.5])
BODY = LabelBody(
    kind="labels", file="x.nii", labels=(3,), smoothing=0.0, deviation=0.5, edge=4.0
)  # fmt: skip


def wedge():
    """A block of label 3, which reaches farther to the right, with a mark of 5 above its front."""
    labels = np.zeros((20, 24, 14), np.uint8)
    labels[4:16, 5:19, 3:9] = 3
    labels[16:19, 5:19, 3:5] = 3
    labels[4:16, 14:19, 9:12] = 5
    return labels


def affine_of(signs, origin=(-7.0, 11.0, 3.0)):
    affine = np.diag([*(signs * SPACING), 1.0])
    affine[:3, 3] = origin
    return affine


def as_nifti(path, signs):
    """The image with its axes turned, at the same places in space."""
    labels, affine = wedge(), affine_of(np.ones(3))
    for axis, sign in enumerate(signs):
        if sign < 0:
            labels = np.flip(labels, axis)
            affine[:3, 3] += affine[:3, axis] * (labels.shape[axis] - 1)
            affine[:3, axis] *= -1
    image = nibabel.Nifti1Image(labels, affine)
    image.header.set_xyzt_units("mm")
    nibabel.save(image, path)
    return path


def as_nrrd(path, space, signs):
    affine = np.diag([*signs, 1.0]) @ affine_of(np.ones(3))
    nrrd.write(str(path), wedge(), {
        "space": space, "space directions": affine[:3, :3].T, "space origin": affine[:3, 3],
    })  # fmt: skip
    return path


def corners_of(path):
    points, _, volume = surface_round(path, read_image(path), BODY)
    return points.min(axis=0), points.max(axis=0), volume, points.mean(axis=0)


EXPECTED = (
    np.array([-7, 11, 3]) + (np.array([4, 5, 3]) - 0.5) * SPACING,
    np.array([-7, 11, 3]) + (np.array([18, 18, 8]) + 0.5) * SPACING,
)


@pytest.mark.parametrize(
    "made",
    [
        lambda p: as_nifti(p / "x.nii", (1, 1, 1)),
        lambda p: as_nifti(p / "x.nii.gz", (-1, 1, 1)),
        lambda p: as_nifti(p / "x.nii.gz", (-1, -1, 1)),
        lambda p: as_nifti(p / "x.nii", (1, -1, -1)),
        lambda p: as_nrrd(p / "x.nrrd", "right-anterior-superior", (1, 1, 1)),
        lambda p: as_nrrd(p / "x.nrrd", "left-posterior-superior", (-1, -1, 1)),
        lambda p: as_nrrd(p / "x.nrrd", "left-anterior-superior", (-1, 1, 1)),
    ],
    ids=["RAS", "LAS", "LPS", "RPI", "nrrd RAS", "nrrd LPS", "nrrd LAS"],
)
def test_a_body_is_where_it_is_however_a_file_orders_its_axes(tmp_path, made):
    low, high, volume, middle = corners_of(made(tmp_path))
    np.testing.assert_allclose(low, EXPECTED[0], atol=1e-5)
    np.testing.assert_allclose(high, EXPECTED[1], atol=1e-5)
    voxels = 12 * 14 * 6 + 3 * 14 * 2
    assert volume == pytest.approx(voxels * SPACING.prod())
    np.testing.assert_allclose(middle, corners_of(as_nifti(tmp_path / "o.nii", (1, 1, 1)))[3])


def test_metres_and_micrometres_of_nifti_are_read(tmp_path):
    for unit, factor in (("meter", 1e-3), ("micron", 1e3)):
        affine = affine_of(np.ones(3))
        affine[:3] *= factor
        image = nibabel.Nifti1Image(wedge(), affine)
        image.header.set_xyzt_units(unit)
        nibabel.save(image, tmp_path / "x.nii")
        np.testing.assert_allclose(corners_of(tmp_path / "x.nii")[0], EXPECTED[0], atol=1e-3)


def test_smoothing_rounds_steps_and_hardly_moves_the_surface(tmp_path):
    path = as_nifti(tmp_path / "x.nii", (1, 1, 1))
    image, found = read_image(path), []
    for smoothing in (0.0, None, 1.5):
        body = BODY.model_copy(update={"smoothing": smoothing})
        points, triangles, volume = surface_round(path, image, body)
        mesh = repaired(path, mesh_of(points, triangles))
        found.append((mesh_of(mesh.points, mesh.triangles), volume))
    sharp, usual, soft = (mesh for mesh, _ in found)
    assert sharp.volume == pytest.approx(found[0][1], rel=0.1)
    assert sharp.volume > usual.volume > soft.volume > 0.8 * sharp.volume
    angles = [np.percentile(mesh.face_adjacency_angles, 95) for mesh in (sharp, soft)]
    assert angles[1] < 0.6 * angles[0]


def test_labels_are_regions_and_those_around_are_places(tmp_path):
    pytest.importorskip("pytetwild")
    labels = wedge()
    labels[:, :, :3] = 7  # what it lies on
    image = nibabel.Nifti1Image(labels, affine_of(np.ones(3)))
    nibabel.save(image, tmp_path / "x.nii.gz")
    geometry = 'kind = "labels"\nfile = "x.nii.gz"\nlabels = [3, 5]\nedge = 4.0\ndeviation = 0.6'
    scene = scene_of(tmp_path, geometry, support='set = "7"', surface='set = "5"')
    base = base_mesh(scene)
    assert set(base.cells) == {"3", "5"}
    high = base.nodes[base.elements[base.cells["5"], :4]].mean(axis=1)[:, 2]
    low = base.nodes[base.elements[base.cells["3"], :4]].mean(axis=1)[:, 2]
    assert high.mean() > low.mean() + 4
    mesh = build_mesh(scene)
    floor = 3 + 2.5 * SPACING[2]
    assert mesh.nodes[mesh.clamped][:, 2].max() < floor + 2.0
    assert mesh.nodes[mesh.faces[mesh.accessible]][..., 2].mean() > 14
    assert base.told["volume_of_labels_mm3"] == pytest.approx((labels % 7 > 0).sum() * 1.2)
