"""Integration points of a mesh: in the volume, on the boundary, and for stress recovery."""

import numpy as np

from palpate.shared.arrays import Array, Numbers
from palpate.shared.errors import PalpateError
from palpate.shared.geometry.elements import POINTS, face_kind_of, kind_of
from palpate.shared.geometry.recovery import by_region
from palpate.shared.mechanics.footprint import SurfaceQuadrature
from palpate.shared.mechanics.stress import StressRecovery
from palpate.shared.mechanics.tissue import Law

LOAD_SPACING = 0.4
"""Millimetres of a face's edge to a point: the load must be smooth in the contact point."""

WIDER = 2.0 / 15.0
"""The same in radii of the endoscope where that is more: the force of a ball on a layer is off by
.05 % at that spacing, and by .25 % at half as much again."""


def volume_quadrature(
    nodes: Array, elements: Numbers, points: int | None = None
) -> tuple[Array, Array]:
    """Gradients of the shape functions and weights at points of elements.

    Those of ``Kind.rule``, or of ``Kind.integration`` if no number is given.

    Returns
    -------
    gradients : ndarray, shape (e, q, n, 3), 1/mm
    weights : ndarray, shape (e, q), mm^3

    Raises
    ------
    PalpateError
        If an element is inverted in the reference state.
    """
    kind = kind_of(elements)
    at, w = kind.rule(points) if points else kind.integration[:2]
    _, dN = kind.shape(at)
    jacobian = np.einsum("eai,qaj->eqij", nodes[elements], dN)
    det = np.linalg.det(jacobian)
    if not (det > 0).all():
        worst = int(np.argmin(det.min(axis=1)))
        raise PalpateError(f"mesh: element {worst} is inverted; change geometry.divisions")
    gradients = np.einsum("qaj,eqji->eqai", dN, np.linalg.inv(jacobian))
    return np.ascontiguousarray(gradients), det * w


def surface_quadrature(
    nodes: Array, faces: Numbers, spacing: float = LOAD_SPACING
) -> SurfaceQuadrature:
    """Points of boundary faces, one to each ``spacing`` mm of an edge, at least two.

    They feed mesh nodes.  Raises `PalpateError` if a face has no area somewhere.
    """
    X, kind = nodes[faces], face_kind_of(faces)
    counts = np.ceil(kind.lengths(X) / spacing).astype(int)
    counts = np.maximum(counts, 2)  # one point loads all nodes of a small face alike
    parts = []
    for count in np.unique(counts, axis=0):
        own = np.flatnonzero((counts == count).all(axis=1))
        at, weights = kind.spread(*count)
        N, dN = kind.shape(at)
        tangents = np.einsum("fai,qaj->fqij", X[own], dN)
        normals = np.cross(tangents[..., 0], tangents[..., 1])
        areas = np.linalg.norm(normals, axis=-1)
        if not areas.min() > 0.0:
            raise PalpateError("mesh: a face of the boundary has no area somewhere")
        parts.append(
            (
                np.einsum("qa,fai->fqi", N, X[own]).reshape(-1, 3),
                (normals / areas[..., None]).reshape(-1, 3),
                (areas * weights).reshape(-1),
                np.repeat(faces[own], len(at), axis=0).astype(np.int32),
                np.tile(N, (len(own), 1)),
            )
        )
    return SurfaceQuadrature(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def stress_recovery(
    nodes: Array, elements: Numbers, law: Law, region: Numbers, precision: type = np.float64
) -> StressRecovery:
    """Recovery of nodal stresses from the points of elements of a law and regions (e,).

    Where regions meet stress jumps; nodes there are of the lowest of them, see ``by_region``.
    """
    gradients, _ = volume_quadrature(nodes, elements, POINTS)
    found, tissue_of = by_region(nodes, elements, region)
    return StressRecovery(
        points=tuple(range(gradients.shape[1])),
        connectivity=np.ascontiguousarray(elements, dtype=np.int32),
        gradients=np.ascontiguousarray(np.moveaxis(gradients, 1, 3), dtype=precision),
        corners=found.corners,
        around=found.elements,
        weights=np.ascontiguousarray(found.weights, dtype=precision),
        midsides=found.midsides,
        line=tuple(range(found.lines.shape[1])),
        lines=found.lines,
        shares=found.shares.astype(precision),
        tissue_of=tissue_of,
        law=law,
    )
