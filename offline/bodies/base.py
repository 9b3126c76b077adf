"""The stored mesh of a body from a file, whose elements all its other meshes divide.

It is made once: what makes it does not give the same mesh twice.  Its file lies beside the body's
and is named by a hash of that and of all keys it depends on.
"""

import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from palpate.offline.bodies import labels, mesh_file, regions, surface, tetwild
from palpate.offline.bodies.files import checked
from palpate.offline.bodies.places import boundary_of_corners
from palpate.offline.bodies.tetrahedra import (
    EDGES,
    boundary,
    curved,
    edge_lengths,
    least_determinants,
    manifold,
    raised,
)
from palpate.shared.anatomy import FileBody, LabelBody, MeshBody, SurfaceBody
from palpate.shared.arrays import Array, Flags, Numbers
from palpate.shared.files import write_whole
from palpate.shared.geometry.surface import Surface
from palpate.shared.scene import Scene, SceneError

EDITION = 1
"""Of what makes meshes; meshes of another are made anew."""

PULL, LEAST, HALVINGS = 0.2, 0.4, 5
"""How far a node moves onto the surface, over the lengths of edges there; least share of its volume
ratio that an element keeps; how often a pull that takes more is halved before it is given up."""

LEFT_OUT = 2.0
"""How far the surface may be from its mesh, in how far that may be from the surface: sharp edges
are cut off."""

SAMPLES = 20_000
"""Points at which distances of mesh and surface are taken."""


@dataclass(frozen=True)
class Base:
    """Nodes (n, 3) mm and elements (e, 10), and what names of the file stand for.

    ``faces`` are flags of faces as ``boundary`` numbers them, ``cells`` of elements; ``told`` is
    what is known of the file.
    """

    nodes: Array
    elements: Numbers
    faces: Mapping[str, Flags] = field(default_factory=dict)
    cells: Mapping[str, Flags] = field(default_factory=dict)
    told: Mapping[str, Any] = field(default_factory=dict)


def body_file(scene: Scene) -> tuple[FileBody, Path]:
    """Geometry of a scene's body and its file."""
    geometry = scene.geometry
    assert isinstance(geometry, FileBody)
    kinds = {SurfaceBody: surface.KINDS, MeshBody: mesh_file.KINDS, LabelBody: labels.KINDS}
    return geometry, checked(scene.folder, geometry.file, "geometry.file", kinds[type(geometry)])


def stored_at(scene: Scene) -> Path:
    """Where the base mesh of a scene's body is kept."""
    geometry, path = body_file(scene)
    sha = hashlib.sha256(path.read_bytes())
    keys = geometry.model_dump(mode="json") | {"edition": EDITION}
    del keys["file"], keys["finest"], keys["finer"]
    if scene.tissue.region:
        keys["regions"] = regions.places_of(scene)
    sha.update(json.dumps(keys, sort_keys=True).encode())
    for own in regions.files_of(scene):
        sha.update(own.read_bytes())
    return path.with_name(f"{path.name}.{sha.hexdigest()[:12]}.mesh.npz")


def base_mesh(scene: Scene) -> Base:
    """The base mesh of a scene's body, made and stored if it is not there.

    Raises
    ------
    SceneError
        If the file cannot be read, is no body, or cannot be meshed as asked.
    """
    path = stored_at(scene)
    if path.exists():
        return _load(path)
    base = _made(scene)
    if not path.exists():  # or another process has been faster
        try:
            write_whole(path, _bytes(base))
        except OSError as error:
            raise SceneError(f"{path}: the mesh of the body cannot be stored: {error}") from error
    return _load(path)


def surface_of(scene: Scene) -> tuple[Array, Numbers] | None:
    """Points (p, 3) mm and triangles (t, 3) that a body's mesh follows; None if it is a mesh."""
    geometry, path = body_file(scene)
    if isinstance(geometry, MeshBody):
        return None
    repaired = _surface(geometry, path)[0]
    return repaired.points, repaired.triangles


def _bytes(base: Base) -> bytes:
    arrays: dict[str, Any] = {"nodes": base.nodes, "elements": base.elements}
    arrays |= {f"faces/{name}": own for name, own in base.faces.items()}
    arrays |= {f"cells/{name}": own for name, own in base.cells.items()}
    arrays["told"] = np.frombuffer(json.dumps(base.told).encode(), np.uint8)
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def _load(path: Path) -> Base:
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as arrays:
            kept = {name: arrays[name] for name in arrays.files}
        sets = {
            kind: {name[6:]: own for name, own in kept.items() if name.startswith(kind)}
            for kind in ("faces/", "cells/")
        }
        told = json.loads(kept["told"].tobytes())
        return Base(kept["nodes"], kept["elements"], sets["faces/"], sets["cells/"], told)
    except Exception as error:  # whatever a damaged archive makes of it
        raise SceneError(f"{path}: damaged; delete it, and the body is meshed anew") from error


def _made(scene: Scene) -> Base:
    geometry, path = body_file(scene)
    if isinstance(geometry, MeshBody):
        nodes, elements, sets = mesh_file.read_mesh(path, geometry.unit)
        _refuse_parts(path, elements)
        return Base(nodes, elements, sets.faces, sets.cells)
    repaired, image, volume = _surface(geometry, path)
    own = repaired.points, repaired.triangles
    within = [
        closed for closed in regions.surfaces_of(scene) if regions.inside(closed[0], own).all()
    ]
    points, corners = tetwild.filled(path, [own, *within], geometry.edge, geometry.deviation)
    _refuse_parts(path, corners)
    nodes, elements = raised(points, corners.astype(np.int32))
    faces, owner, _ = boundary(elements)
    if not manifold(faces):
        raise SceneError(
            f"{path}: the mesh of the body touches itself along edges; state a smaller "
            "geometry.deviation, or thicken the surface there"
        )
    index = surface.index_of(repaired.points, repaired.triangles)
    nodes = pulled(nodes, elements, faces, index)
    gaps = deviations(nodes, faces, repaired.points, repaired.triangles)
    _refuse_far(geometry, path, gaps, repaired)
    told = {"repaired": repaired.done, "crossings": repaired.crossings}
    if image is None or not isinstance(geometry, LabelBody):
        return Base(nodes, elements, told=told)
    told["volume_of_labels_mm3"] = volume
    centres, normals = boundary_of_corners(nodes[faces[:, :3]])
    beside = labels.neighbours(image, geometry, centres, normals)
    label_of = labels.regions(image, geometry, nodes[elements[:, :4]].mean(axis=1))
    cells = {str(label): label_of == label for label in geometry.labels}
    named = {str(label): beside == label for label in np.unique(beside) if label}
    return Base(nodes, elements, named | {k: v[owner] for k, v in cells.items()}, cells, told)


def _surface(
    geometry: SurfaceBody | LabelBody, path: Path
) -> tuple[surface.Repaired, labels.Image | None, float]:
    """Surface of a body, and of labels the image and their volume (mm³)."""
    if isinstance(geometry, SurfaceBody):
        read = surface.read_surface(path, geometry.unit)
        return surface.repaired(path, read), None, 0.0
    image = labels.read_image(path)
    points, triangles, volume = labels.surface_round(path, image, geometry)
    return surface.repaired(path, surface.mesh_of(points, triangles)), image, volume


def _refuse_parts(path: Path, elements: Numbers) -> None:
    """Refuse a mesh whose elements hang together at no more than nodes."""
    parts = parts_of(elements)
    if parts > 1:
        raise SceneError(
            f"{path}: the mesh of the body falls into {parts} parts; save one of them, or thicken "
            "what joins them"
        )


def parts_of(elements: Numbers) -> int:
    """Number of parts of a mesh that share no node."""
    corners = elements[:, :4]
    row, column = np.repeat(corners[:, :1], 3, axis=1).ravel(), corners[:, 1:].ravel()
    used = np.unique(corners)
    graph = coo_matrix((np.ones(len(row)), (row, column)), shape=[used.max() + 1] * 2)
    labels = connected_components(graph, directed=False)[1]
    return len(np.unique(labels[used]))


def _refuse_far(
    geometry: SurfaceBody | LabelBody, path: Path, gaps: dict[str, Any], found: surface.Repaired
) -> None:
    """Refuse a mesh that leaves out part of the surface, or lies elsewhere."""
    worst, most = gaps["max"], geometry.deviation
    if gaps["mesh_max"] <= most and gaps["surface_max"] <= LEFT_OUT * most:
        return
    x, y, z = gaps["place"]
    why = "it is thinner there than geometry.deviation can follow: state a smaller one"
    if found.crossings:
        why = f"it is cut off; {surface.in_words(found.crossings, found.place)}"
    raise SceneError(
        f"{path}: the mesh lies up to {worst:.2g} mm from the surface, with "
        f"geometry.deviation = {most:g}; near ({x:.1f}, {y:.1f}, {z:.1f}) mm {why}"
    )


def deviations(nodes: Array, faces: Numbers, points: Array, triangles: Numbers) -> dict[str, Any]:
    """Distances (mm) of a mesh's boundary and a surface from each other.

    ``max``, ``place`` of that and 95th percentiles, of the mesh from the surface (``mesh_p95``) and
    of the surface from the mesh (``surface_p95``).
    """
    own = curved(faces, nodes)
    there = surface.sampled(*own, SAMPLES)
    back = surface.sampled(points, triangles, SAMPLES)
    one = surface.nearest(surface.index_of(points, triangles), there)[1]
    two = surface.nearest(surface.index_of(*own), back)[1]
    place = there[np.argmax(one)] if one.max() > two.max() else back[np.argmax(two)]
    return {
        "max": float(max(one.max(), two.max())),
        "place": place.tolist(),
        "mesh_max": float(one.max()),
        "mesh_p95": float(np.percentile(one, 95)),
        "surface_max": float(two.max()),
        "surface_p95": float(np.percentile(two, 95)),
    }


def pulled(nodes: Array, elements: Numbers, faces: Numbers, onto: Surface) -> Array:
    """Nodes (n, 3) mm of which those of faces (f, 6) have moved towards a surface.

    Corners first, then the middles of edges, which are straight before.  Where an element would
    lose too much of its volume ratio they move half as far, or not.
    """
    nodes = nodes.copy()
    reach = PULL * _shortest_edges(nodes, elements)
    for kind in (slice(0, 3), slice(3, 6)):
        at = np.unique(faces[:, kind])
        target, gap = surface.nearest(onto, nodes[at])
        step = np.zeros_like(nodes)
        step[at] = (target - nodes[at]) * np.minimum(1.0, reach[at] / np.maximum(gap, 1e-12))[
            :, None
        ]
        nodes = _moved(nodes, elements, step)
    return nodes


def _moved(nodes: Array, elements: Numbers, step: Array) -> Array:
    """Nodes moved by ``step`` (n, 3) mm, or a share of it; middles of other edges stay straight."""
    share = np.ones(len(nodes))
    before = _least_ratio(nodes, elements)
    for halving in range(HALVINGS + 1):
        moved = nodes + share[:, None] * step
        corners_move = not step[elements[:, 4:]].any()
        if corners_move:
            moved[elements[:, 4:]] = moved[elements[:, EDGES]].mean(axis=2)
        bad = _least_ratio(moved, elements) < LEAST * before
        if not bad.any():
            return moved
        share[np.unique(elements[bad])] *= 0.5 if halving < HALVINGS - 1 else 0.0
    return nodes


def _least_ratio(nodes: Array, elements: Numbers) -> Array:
    """Least determinant of elements (e,) over the cube of their mean edge."""
    edge = edge_lengths(nodes, elements).mean(axis=1)
    ratio: Array = least_determinants(nodes, elements) / edge**3
    return ratio


def _shortest_edges(nodes: Array, elements: Numbers) -> Array:
    """Length (n,) mm of the shortest edge at each node, of its own for a middle."""
    length = edge_lengths(nodes, elements)
    shortest = np.full(len(nodes), np.inf)
    np.minimum.at(shortest, elements[:, EDGES], length[:, :, None])
    np.minimum.at(shortest, elements[:, 4:], length)
    return shortest
