"""Which faces of a body are held, and which can be touched: what a scene's tables say of them."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from palpate.offline.bodies import surface
from palpate.offline.bodies.files import checked
from palpate.shared.anatomy import Unit
from palpate.shared.arrays import Array, Flags
from palpate.shared.place import Patch, Place
from palpate.shared.scene import Scene, SceneError


class Boundary(NamedTuple):
    """Faces of a body."""

    centres: Array  # (f, 3) mm
    normals: Array  # (f, 3) outward unit
    sides: Mapping[str, Flags] = {}
    sets: Mapping[str, Flags] = {}

    def nowhere(self) -> tuple[Flags, Flags]:
        """Flags (f,) of a support and a surface without faces."""
        none = np.zeros(len(self.centres), dtype=bool)
        return none, none


def boundary_of_corners(corners: Array) -> tuple[Array, Array]:
    """Centres (f, 3) mm and outward unit normals (f, 3) of faces with corners (f, 3 or 4, 3)."""
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, -1] - corners[:, 1])
    if corners.shape[1] == 3:
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return corners.mean(axis=1), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def support_and_surface(scene: Scene, faces: Boundary) -> tuple[Flags, Flags]:
    """Flags (f,) of the faces that are held, and of those that can be touched: none of the former.

    Raises
    ------
    SceneError
        If one of them is nowhere, or the support holds all that could be touched.
    """
    support, accessible = (
        faces_at(scene, name, patch, faces)
        for name, patch in (("support", scene.support), ("surface", scene.surface))
    )
    if not (accessible & ~support).any():
        raise SceneError("surface: the support holds all of it, so nothing can be pressed")
    return support, accessible & ~support


def faces_at(scene: Scene, name: str, place: Place, faces: Boundary) -> Flags:
    """Flags (f,) of the faces at a place that errors call ``name``; raise `SceneError` if none."""
    chosen = _holds(scene, name, place, faces)
    if not chosen.any():
        parts = dict(_keys(scene, name, place, faces))
        each = ", ".join(f"{np.sum(own)} by {key}" for key, own in parts.items())
        raise SceneError(
            f"{name}: no face of the body is there; of {len(faces.centres)} faces {each}; their "
            f"centres have {box_of(faces.centres)}{_where(place, faces)}"
        )
    return chosen


def box_of(points: Array) -> str:
    """Box round points (n, 3) mm in words."""
    ends = zip("xyz", points.min(axis=0), points.max(axis=0), strict=True)
    return ", ".join(f"{axis} {low:z.1f} to {high:.1f}" for axis, low, high in ends) + " mm"


def _where(place: Place, faces: Boundary) -> str:
    """How far a picked point is from the body."""
    if place.near is None:
        return ""
    away = faces.centres - place.near
    gap = np.linalg.norm(away, axis=1)
    nearest = int(np.argmin(gap))
    inside = "inside" if away[nearest] @ faces.normals[nearest] > 0 else "outside"
    return f"; near lies {inside} the body, {gap[nearest]:.3g} mm from the nearest"


def _holds(scene: Scene, name: str, place: Place, faces: Boundary) -> Flags:
    every = np.ones(len(faces.centres), dtype=bool)
    for _, own in _keys(scene, name, place, faces):
        every &= own
    return every


def _keys(scene: Scene, name: str, place: Place, faces: Boundary) -> Iterator[tuple[str, Flags]]:
    """Each key of a table, and the faces for which it holds."""
    if isinstance(place, Patch) and place.side is not None:
        yield "side", faces.sides[place.side]
    yield from ranges(place, faces.centres)
    if place.near is not None:
        yield "near", near(place, faces.centres)
    if place.set is not None:
        yield "set", _named(name, place.set, faces.sets)
    if isinstance(place, Patch):
        yield from _keys_of_patch(scene, name, place, faces)


def _keys_of_patch(
    scene: Scene, name: str, patch: Patch, faces: Boundary
) -> Iterator[tuple[str, Flags]]:
    """What only a patch has, but for its side."""
    if patch.normal is not None and patch.within is not None:
        cosine = faces.normals @ patch.normal / np.linalg.norm(patch.normal)
        yield "normal", cosine >= np.cos(np.radians(patch.within))
    if patch.close_to is not None and patch.distance is not None:
        yield "close_to", _gaps(scene, name, patch.close_to, faces.centres) <= patch.distance
    if patch.any is not None:
        yield "any", np.any([_holds(scene, name, own, faces) for own in patch.any], axis=0)
    if patch.without is not None:
        yield "without", ~_holds(scene, name, patch.without, faces)


def ranges(place: Place, centres: Array) -> Iterator[tuple[str, Flags]]:
    """Each range of a place, and which centres (n, 3) mm lie in it."""
    for axis, key in enumerate("xyz"):
        if (bounds := getattr(place, key)) is not None:
            yield key, (bounds[0] <= centres[:, axis]) & (centres[:, axis] <= bounds[1])


def near(place: Place, centres: Array) -> Flags:
    """Which centres (n, 3) mm are near the picked point of a place that has one."""
    assert place.near is not None and place.radius is not None  # noqa: PT018
    return np.asarray(np.linalg.norm(centres - place.near, axis=1) <= place.radius)


def _named(name: str, wanted: str, sets: Mapping[str, Flags]) -> Flags:
    if wanted not in sets:
        known = ", ".join(sets) or "none"
        raise SceneError(f"{name}.set = {wanted!r}: no set of the body's file, which has {known}")
    if not sets[wanted].any():
        raise SceneError(
            f"{name}.set = {wanted!r}: lies inside the body, none of its boundary is in this set"
        )
    return sets[wanted]


def files_of(scene: Scene, patch: Patch) -> Iterator[Path]:
    """Files that a scene's place names."""
    for table in patch.tables():
        if table.close_to is not None:
            yield checked(scene.folder, table.close_to, "close_to", surface.KINDS)


def _gaps(scene: Scene, name: str, file: str, points: Array) -> Array:
    """Distances (n,) mm of points from the surface in a file."""
    path = checked(scene.folder, file, f"{name}.close_to", surface.KINDS)
    unit: Unit = getattr(scene.geometry, "unit", "mm")
    mesh = surface.read_surface(path, unit)
    return surface.nearest(surface.index_of(mesh.vertices, mesh.faces), points)[1]
