"""What is known of the body that comes from a file, and of its mesh."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from palpate.offline.bodies import surface
from palpate.offline.bodies.base import (
    Base,
    base_mesh,
    body_file,
    deviations,
    parts_of,
    surface_of,
)
from palpate.offline.bodies.places import boundary_of_corners
from palpate.offline.bodies.tetrahedra import boundary, curved, edge_lengths, manifold, quality
from palpate.shared.arrays import Array
from palpate.shared.scene import Scene

PLACES = 500
"""Where the thickness is taken."""


def report(scene: Scene) -> dict[str, Any]:
    """What to know of a scene's body from a file, JSON-able.

    ``components`` and ``closed`` of the mesh; ``volume_mm3``, and ``volume_change`` from that of
    the file's surface; ``deviation`` of mesh and surface from each other, mm (95th percentiles and
    largest, both ways); ``quality`` of the elements; ``thickness_mm`` of the body, and over how
    many edges of elements; ``repaired``, what was done to the file's surface.
    """
    base = base_mesh(scene)
    faces, _, _ = boundary(base.elements)
    found: dict[str, Any] = {
        "file": body_file(scene)[0].file,
        "tetrahedra": len(base.elements),
        "dofs": base.nodes.size,
        "components": parts_of(base.elements),
        "closed": manifold(faces),
        "sets": sorted({*base.faces, *base.cells}),
        "quality": quality(base.nodes, base.elements),
        **_thickness(base),
        **base.told,
    }
    own = surface_of(scene)
    if own is None:
        return found
    mesh = surface.mesh_of(*own)
    gaps = deviations(base.nodes, faces, *own)
    volume = found["quality"]["volume_mm3"]
    return found | {
        "volume_of_surface_mm3": float(mesh.volume),
        "volume_change": volume / float(mesh.volume) - 1.0,
        "deviation_mm": {name: gap for name, gap in gaps.items() if name != "place"},
    }


def in_words(told: Mapping[str, Any]) -> dict[str, str]:
    """What a ``report`` says, for people, by what it is about."""
    quality, thick = told["quality"], told["thickness_mm"]
    volume, said = f"{quality['volume_mm3']:.4g} mm³", dict[str, str]()
    if "volume_change" in told:
        gaps = told["deviation_mm"]
        volume += f", {abs(told['volume_change']):.2%} from that of the file"
        said["surface"] = (
            f"the mesh is within {gaps['mesh_p95']:.2g} mm of the file's (95 of 100), the file's "
            f"within {gaps['surface_p95']:.2g} of the mesh; at most {gaps['max']:.2g}"
        )
    return said | {
        "volume": volume,
        "elements": f"as stored, angles of {quality['dihedral_min']:.1f} degrees or more (99 of "
        f"100 {quality['dihedral_1_percent']:.1f}), scaled Jacobians of "
        f"{quality['scaled_jacobian_min']:.2f} or more",
        "thickness": f"{thick['median']:.2g} mm in the middle, {thick['p5']:.2g} or more at 95 of "
        f"100 places; {told['thickness_over_edge']['p5']:.1f} elements or more through it there",
    }


def _thickness(base: Base) -> dict[str, Any]:
    """Thickness under faces spread over the body, and that over the edges of elements there."""
    faces, owner, _ = boundary(base.elements)
    chosen = np.unique(np.linspace(0, len(faces) - 1, PLACES).astype(int))
    points, triangles = curved(faces, base.nodes)
    at, outward = boundary_of_corners(points[triangles])
    places, normals = boundary_of_corners(base.nodes[faces[chosen, :3]])
    found = thickness(places, normals, at, outward)
    edges = edge_lengths(base.nodes, base.elements[owner[chosen]]).mean(axis=1)
    return {
        "thickness_mm": _spread(found),
        "thickness_over_edge": _spread(found / edges),
    }


def _spread(values: Array) -> dict[str, float]:
    low, median = np.percentile(values, [5, 50])
    return {"min": float(values.min()), "p5": float(low), "median": float(median)}


def thickness(points: Array, normals: Array, opposite: Array, outward: Array) -> Array:
    """How thick a body is (p,) mm under points (p, 3) of its boundary of given outward normals.

    That is the diameter of the largest ball that touches the surface at the point from inside and
    does not reach through the opposite side, points (q, 3) of outward normals (q, 3); inf where
    there is none.

    Notes
    -----
    The ball through ``x`` (normal ``n``) and ``y`` has diameter ``|x - y|^2 / (n . (x - y))``; the
    opposite side is where the normal differs by more than 120 degrees (cf. Hildebrand & Ruegsegger,
    J. Microscopy 1997).
    """
    found = np.full(len(points), np.inf)
    for i, (point, normal) in enumerate(zip(points, normals, strict=True)):
        across = point - opposite[outward @ normal < -0.5]
        depth = across @ normal
        diameter = np.sum(across**2, axis=1)[depth > 0] / depth[depth > 0]
        found[i] = diameter.min(initial=np.inf)
    return found
