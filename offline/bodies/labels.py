"""Images of labels: the surface round some of them, and what they border on.

Points are in mm, x to the right, y to the front, z up, whatever the order of a file's axes: NIfTI
says so itself, NRRD names the directions of its space.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from palpate.offline.bodies.files import first_line, refuse_size, require
from palpate.shared.anatomy import LabelBody
from palpate.shared.arrays import Array, Ints
from palpate.shared.errors import PalpateError
from palpate.shared.scene import SceneError

KINDS = ".nii", ".nii.gz", ".nrrd"

MOST_VOXELS = 400_000_000

TO_RIGHT_ANTERIOR_SUPERIOR = {
    "right-anterior-superior": (1, 1, 1),
    "left-posterior-superior": (-1, -1, 1),
    "left-anterior-superior": (-1, 1, 1),
    "ras": (1, 1, 1),
    "lps": (-1, -1, 1),
    "las": (-1, 1, 1),
}
"""Signs of the axes of an NRRD file's space."""

NIFTI_UNITS = {"mm": 1.0, "meter": 1000.0, "micron": 1e-3, "unknown": 1.0}

AROUND = 3.0
"""Standard deviations of the filter that an image is padded by."""


class Image(NamedTuple):
    """Labels (i, j, k), and the map (4, 4) from indices to mm."""

    labels: NDArray[Any]
    affine: Array

    def at(self, points: Array) -> Ints:
        """Labels (n,) at points (n, 3) mm; 0 outside."""
        inverse = np.linalg.inv(self.affine)
        index = np.rint(points @ inverse[:3, :3].T + inverse[:3, 3]).astype(int)
        inside = ((index >= 0) & (index < self.labels.shape)).all(axis=1)
        found = np.zeros(len(points), dtype=np.int64)
        found[inside] = self.labels[tuple(index[inside].T)]
        return found

    @property
    def spacing(self) -> Array:
        """Edges (3,) mm of a voxel."""
        return np.linalg.norm(self.affine[:3, :3], axis=0)


def read_image(path: Path) -> Image:
    """Read an image of labels; raise `SceneError` if it is none."""
    reader = _nrrd if path.suffix == ".nrrd" else _nifti
    try:
        labels, affine = reader(path)
    except PalpateError:
        raise
    except Exception as error:  # of the library's readers, whatever they trip over
        raise SceneError(
            f"{path}: cannot be read as an image ({first_line(error)}); save it anew"
        ) from error
    if labels.ndim != 3:
        raise SceneError(f"{path}: has {labels.ndim} dimensions; save one volume of labels")
    if labels.dtype.kind == "f" and not (labels == np.rint(labels)).all():
        raise SceneError(f"{path}: holds grey values; save the segmentation, of whole numbers")
    if not (np.isfinite(affine).all() and abs(np.linalg.det(affine[:3, :3])) > 1e-9):
        raise SceneError(f"{path}: its axes span no space; save it anew with spacing and direction")
    return Image(labels.astype(np.int64) if labels.dtype.kind == "f" else labels, affine)


def _nifti(path: Path) -> tuple[NDArray[Any], Array]:
    image = require("nibabel").load(path)
    _refuse_many(path, image.shape)
    if not (image.header["sform_code"] or image.header["qform_code"]):
        raise SceneError(f"{path}: does not say which way its axes go; save it with an sform")
    unit = image.header.get_xyzt_units()[0]
    affine = np.array(image.affine, float)
    affine[:3] *= NIFTI_UNITS[unit]
    return np.asanyarray(image.dataobj), affine


def _nrrd(path: Path) -> tuple[NDArray[Any], Array]:
    nrrd = require("nrrd")
    header = nrrd.read_header(str(path))
    _refuse_many(path, header["sizes"])
    signs = TO_RIGHT_ANTERIOR_SUPERIOR.get(str(header.get("space", "")).lower())
    if signs is None:
        known = ", ".join(name for name in TO_RIGHT_ANTERIOR_SUPERIOR if "-" in name)
        raise SceneError(f"{path}: its space is none of {known}; save it with its orientation")
    labels, header = nrrd.read(str(path))
    affine = np.eye(4)
    affine[:3, :3] = np.array(header["space directions"], float).T
    affine[:3, 3] = header.get("space origin", np.zeros(3))
    return labels, np.diag([*signs, 1.0]) @ affine


def _refuse_many(path: Path, shape: tuple[int, ...]) -> None:
    if np.prod(np.array(shape, float)) > MOST_VOXELS:
        raise SceneError(
            f"{path}: has more than {MOST_VOXELS // 1_000_000} million voxels; crop it to the body"
        )


def surface_round(path: Path, image: Image, body: LabelBody) -> tuple[Array, Ints, float]:
    """Points (p, 3) mm and triangles (t, 3) round a body's labels, and the volume (mm³) of these.

    The labels' indicator is rounded by a Gauss filter and contoured at a half.
    """
    chosen = np.isin(image.labels, body.labels)
    if missing := [label for label in body.labels if not (image.labels == label).any()]:
        there = np.unique(image.labels)
        known = ", ".join(map(str, there[there > 0][:20])) or "none"
        raise SceneError(f"geometry.labels = {missing[0]}: not in {path}, which has {known}")
    spacing = image.spacing
    width = 0.5 * spacing.max() if body.smoothing is None else body.smoothing
    margin = np.ceil(AROUND * width / spacing).astype(int) + 2
    (box,) = ndimage.find_objects(chosen.astype(np.uint8))
    low = np.array([side.start for side in box]) - margin
    around = np.pad(chosen[box], [(m, m) for m in margin]).astype(np.float32)
    soft = ndimage.gaussian_filter(around, width / spacing)
    pv = require("pyvista")
    grid = pv.ImageData(dimensions=soft.shape, origin=low.astype(float))
    grid["inside"] = soft.ravel(order="F")
    contour = grid.contour([0.5], scalars="inside", method="flying_edges").triangulate()
    if not contour.n_points:
        raise SceneError(
            f"{path}: nothing remains of the labels smoothed by {width:.2g} mm; state a smaller "
            "geometry.smoothing"
        )
    points = np.array(contour.points, float) @ image.affine[:3, :3].T + image.affine[:3, 3]
    refuse_size(path, points, "mm")
    voxel = abs(np.linalg.det(image.affine[:3, :3]))
    return points, contour.faces.reshape(-1, 4)[:, 1:], float(chosen.sum() * voxel)


def regions(image: Image, body: LabelBody, centres: Array) -> Ints:
    """Which of the body's labels elements (e,) of given centres (e, 3) mm have, or are nearest."""
    if len(body.labels) == 1:
        return np.full(len(centres), body.labels[0])
    at = np.argwhere(np.isin(image.labels, body.labels))
    places = at @ image.affine[:3, :3].T + image.affine[:3, 3]
    nearest = at[cKDTree(places).query(centres)[1]]
    return image.labels[tuple(nearest.T)].astype(np.int64)


def neighbours(image: Image, body: LabelBody, centres: Array, normals: Array) -> Ints:
    """Labels (f,) that faces of given centres and outward normals (f, 3) border on, or 0."""
    step = image.spacing.max() + body.deviation
    found = image.at(centres + step * normals)
    return np.where(np.isin(found, body.labels), 0, found)
