"""Integration points of a mesh: in the volume, on the boundary, and for stress recovery."""

import numpy as np

from palpate.shared.arrays import Array, Numbers
from palpate.shared.errors import PalpateError
from palpate.shared.geometry.elements import (
    gauss,
    hexahedron,
    quadrilateral,
    shape,
)
from palpate.shared.geometry.recovery import patches
from palpate.shared.mechanics.footprint import SurfaceQuadrature
from palpate.shared.mechanics.stress import StressRecovery
from palpate.shared.mechanics.tissue import Law

LOAD_SPACING = 0.4
"""Millimetres of a face's edge to a Gauss point: the load must be smooth in the contact point."""


def volume_quadrature(nodes: Array, elements: Numbers, points: int) -> tuple[Array, Array]:
    """Gradients of the shape functions and weights at ``points``^3 Gauss points.

    Returns
    -------
    gradients : ndarray, shape (e, q, n, 3), 1/mm
    weights : ndarray, shape (e, q), mm^3

    Raises
    ------
    PalpateError
        If an element is inverted in the reference state.
    """
    at, w = gauss(points, 3)
    _, dN = shape(hexahedron(elements.shape[1]), at)
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
    """Gauss points of boundary faces, one to each ``spacing`` mm of an edge, at least two.

    They feed mesh nodes.  Raises `PalpateError` if a face has no area somewhere.
    """
    X = nodes[faces]
    edges = np.linalg.norm(X[:, [1, 2, 3, 0]] - X[:, :4], axis=2)
    counts = np.ceil(np.maximum(edges[:, :2], edges[:, 2:]) / spacing).astype(int)
    counts = np.maximum(counts, 2)  # one point loads all nodes of a small face alike
    parts = []
    for along, across in np.unique(counts, axis=0):
        own = np.flatnonzero((counts == (along, across)).all(axis=1))
        (x, wx), (y, wy) = gauss(along, 1), gauss(across, 1)
        at = np.column_stack([np.repeat(x[:, 0], across), np.tile(y[:, 0], along)])
        N, dN = shape(quadrilateral(faces.shape[1]), at)
        tangents = np.einsum("fai,qaj->fqij", X[own], dN)
        normals = np.cross(tangents[..., 0], tangents[..., 1])
        areas = np.linalg.norm(normals, axis=-1)
        if not areas.min() > 0.0:
            raise PalpateError("mesh: a face of the boundary has no area somewhere")
        parts.append(
            (
                np.einsum("qa,fai->fqi", N, X[own]).reshape(-1, 3),
                (normals / areas[..., None]).reshape(-1, 3),
                (areas * np.outer(wx, wy).ravel()).reshape(-1),
                np.repeat(faces[own], len(at), axis=0).astype(np.int32),
                np.tile(N, (len(own), 1)),
            )
        )
    return SurfaceQuadrature(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def stress_recovery(
    nodes: Array, elements: Numbers, law: Law, precision: type = np.float64
) -> StressRecovery:
    """Recovery of nodal stresses from 2x2x2 points per element of one tissue; law (e,)."""
    gradients, _ = volume_quadrature(nodes, elements, 2)
    found = patches(nodes, elements)
    return StressRecovery(
        connectivity=np.ascontiguousarray(elements, dtype=np.int32),
        gradients=np.ascontiguousarray(np.moveaxis(gradients, 1, 3), dtype=precision),
        corners=found.corners,
        around=found.elements,
        weights=np.ascontiguousarray(found.weights, dtype=precision),
        midsides=found.midsides,
        lines=found.lines,
        shares=found.shares.astype(precision),
        law=law.at(np.zeros(len(nodes), int)),
    )
