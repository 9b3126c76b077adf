"""Which elements are of which region of the tissue, and surfaces that a mesh keeps between them.

An element is of the last region in which its centre lies.  A mesh of tetrahedra has faces on the
surface of a region that is a ball, a box or the inside of a file and lies whole within the body;
of a lattice, or of other regions, the border runs along the elements.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from palpate.offline.bodies import surface
from palpate.offline.bodies.files import checked, require
from palpate.offline.bodies.places import box_of, near, ranges
from palpate.shared.anatomy import Unit
from palpate.shared.arrays import Array, Flags, Numbers
from palpate.shared.mechanics.tissue import Region
from palpate.shared.scene import Scene, SceneError

ROUND = 3
"""How often the triangles of an icosahedron are divided for a ball."""

BLOCK = 4_000_000
"""Pairs of a point and a triangle that are looked at at a time."""


class RegionsTooSmall(SceneError):
    """Regions that no element of a mesh is of, or that reach what can be touched in it."""


Triangles = tuple[Array, Numbers]
"""Points (p, 3) mm and triangles (t, 3), outward."""


def regions_at(scene: Scene, centres: Array, sets: Mapping[str, Flags]) -> Numbers | None:
    """Region (e,) of elements with centres (e, 3) mm, 0 for none; None if the tissue has none.

    ``sets`` (e,) are those of the body's file.

    Raises
    ------
    RegionsTooSmall
        If no element is of one.
    """
    if not scene.tissue.region:
        return None
    found = np.zeros(len(centres), np.int32)
    for number, region in enumerate(scene.tissue.region, 1):
        found[_holds(scene, region, centres, sets)] = number
    for number, region in enumerate(scene.tissue.region, 1):
        if not (found == number).any():
            raise RegionsTooSmall(
                f"tissue.region '{region.name}' ({region.in_words()}): no element's centre is "
                f"there; they have {box_of(centres)}; move it, or make the mesh finer there"
            )
    return found


def refuse_touched(
    scene: Scene, nodes: Array, elements: Numbers, regions: Numbers | None, touched: Numbers
) -> None:
    """Refuse regions at nodes (k,) of what can be touched, where a tip knows the tissue alone."""
    if regions is None:
        return
    at = np.zeros(len(nodes), dtype=bool)
    at[touched] = True
    bad = np.flatnonzero((regions > 0) & at[elements].any(axis=1))
    if len(bad):
        x, y, z = nodes[elements[bad[0]]].mean(axis=0)
        name = scene.tissue.region[regions[bad[0]] - 1].name
        raise RegionsTooSmall(
            f"tissue.region '{name}' reaches what can be touched, near ({x:.1f}, {y:.1f}, {z:.1f}) "
            "mm: an element of the tissue itself must lie between; move one of them, or make the "
            "mesh finer there"
        )


def surfaces_of(scene: Scene) -> list[Triangles]:
    """Surfaces of the regions that have one of their own."""
    return [own for region in scene.tissue.region if (own := _surface(scene, region)) is not None]


def files_of(scene: Scene) -> Iterator[Path]:
    """Files that a scene's regions name."""
    for region in scene.tissue.region:
        if region.inside is not None:
            yield _file(scene, region)


def places_of(scene: Scene) -> list[dict[str, Any]]:
    """Where the regions are, JSON-able."""
    return [r.model_dump(mode="json", include={*r.places()}) for r in scene.tissue.region]


def inside(points: Array, closed: Triangles) -> Flags:
    """Which of points (k, 3) mm lie inside a closed surface (k,).

    Notes
    -----
    By the solid angle of all triangles: van Oosterom & Strackee, IEEE Trans. Biomed. Eng. 30, 1983.
    """
    corners = closed[0][closed[1]]
    angle = np.empty(len(points))
    step = max(1, BLOCK // len(corners))
    for first in range(0, len(points), step):
        a, b, c = (corners[:, k] - points[first : first + step, None] for k in range(3))
        la, lb, lc = (np.linalg.norm(side, axis=2) for side in (a, b, c))
        above = np.einsum("ktj,ktj->kt", a, np.cross(b, c))
        ab, bc, ca = (np.einsum("ktj,ktj->kt", *pair) for pair in ((a, b), (b, c), (c, a)))
        below = la * lb * lc + ab * lc + bc * la + ca * lb
        angle[first : first + step] = np.arctan2(above, below).sum(axis=1)
    return np.asarray(angle > np.pi)


def _holds(scene: Scene, region: Region, centres: Array, sets: Mapping[str, Flags]) -> Flags:
    every = np.ones(len(centres), dtype=bool)
    for _, own in ranges(region, centres):
        every &= own
    if region.near is not None:
        every &= near(region, centres)
    if region.set is not None:
        if region.set not in sets:
            raise SceneError(
                f"tissue.region '{region.name}': set = {region.set!r} is no set of elements of the "
                f"body's file, which has {', '.join(sets) or 'none'}"
            )
        every &= sets[region.set]
    if region.inside is not None:
        every[every] = inside(centres[every], _read(scene, region))
    return every


def _surface(scene: Scene, region: Region) -> Triangles | None:
    """Surface of a region that is a ball, a box or the inside of a file."""
    given = {key for key in region.places() if getattr(region, key) is not None}
    if given == {"inside"}:
        return _read(scene, region)
    creation = require("trimesh").creation
    if given == {"near", "radius"}:
        ball = creation.icosphere(subdivisions=ROUND, radius=region.radius)
        return np.array(ball.vertices) + region.near, np.array(ball.faces, np.int32)
    if given == {"x", "y", "z"}:
        box = creation.box(bounds=np.transpose([region.x, region.y, region.z]))
        return np.array(box.vertices), np.array(box.faces, np.int32)
    return None


def _read(scene: Scene, region: Region) -> Triangles:
    path = _file(scene, region)
    unit: Unit = getattr(scene.geometry, "unit", "mm")
    found = surface.repaired(path, surface.read_surface(path, unit))
    return found.points, found.triangles


def _file(scene: Scene, region: Region) -> Path:
    assert region.inside is not None
    key = f"tissue.region '{region.name}': inside"
    return checked(scene.folder, region.inside, key, surface.KINDS)
