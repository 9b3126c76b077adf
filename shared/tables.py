"""What training finds out about a scene, and the tables that compiled queries read."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.shared.geometry.quadrature import surface_quadrature, volume_quadrature
from palpate.shared.mechanics.footprint import SurfaceQuadrature
from palpate.shared.mechanics.sphere import Tip, TipSurface, tip_surface
from palpate.shared.reduced.outcome import HISTORY_FEATURES, PRESS_FEATURES, TOUCH_FEATURES
from palpate.shared.reduced.points import LANES, PointTables
from palpate.shared.reduced.press import PressModels
from palpate.shared.reduced.touch import TouchModels
from palpate.shared.scene import Scene

Array = NDArray[np.float64]
Field = NDArray[np.float32]
Ints = NDArray[np.int64]

REACH = 0.8
"""Radius of a contact at most, in radii of the tip: nearer faces count."""

MIDDLE = 0.6
"""Height over a local model of a tip half as deep as may be, in radii of the tip."""


@dataclass(frozen=True)
class Body:
    """Mesh and tissue of a scene, as both sides see them.

    Attributes
    ----------
    nodes : ndarray, shape (n, 3), mm
    elements : ndarray, shape (e, 8) or (e, 20), int32
    faces : ndarray, shape (f, 4) or (f, 8), int32
    clamped : ndarray, shape (n,), bool
    accessible : ndarray, shape (f,), bool
        Faces an endoscope can touch.
    mu, lam : ndarray, shape (e,), kPa
    tip : Tip
        That touches it.
    """

    nodes: Array
    elements: NDArray[np.int32]
    faces: NDArray[np.int32]
    clamped: NDArray[np.bool_]
    accessible: NDArray[np.bool_]
    mu: Array
    lam: Array
    tip: Tip

    @cached_property
    def touchable(self) -> tuple[TipSurface, NDArray[np.int32]]:
        """Faces that the tip can touch, their nodes counted anew, and these nodes (s,)."""
        surface = tip_surface(self.nodes, self.faces, self.accessible, self.tip.radius)
        nodes, faces = np.unique(surface.faces, return_inverse=True)
        own = faces.reshape(surface.faces.shape).astype(np.int32)
        return surface._replace(nodes=self.nodes[nodes], faces=own), nodes

    @cached_property
    def gradients(self) -> Array:
        """Gradients of the shape functions (e, 8, n, 3) at the quadrature points, 1/mm."""
        return volume_quadrature(self.nodes, self.elements, 2)[0]

    @cached_property
    def boundary(self) -> SurfaceQuadrature:
        """Integration points of the whole boundary."""
        return surface_quadrature(self.nodes, self.faces)


@dataclass(frozen=True)
class ViscousModels:
    """What steps in time need beyond elastic local models.

    Attributes
    ----------
    deviatoric : ndarray, shape (p, r, r)
        Deviatoric part of the rest stiffness in the wide modes.
    pairs : ndarray, shape (n, 2), int32
        Patches whose wide spaces meet, the lower number first.
    overlap : ndarray, shape (n, r, r)
        ``B_k^T K_0 B_l`` of each pair (k, l).
    """

    deviatoric: Field
    pairs: NDArray[np.int32]
    overlap: Field


@dataclass(frozen=True)
class LocalTips:
    """What training finds out about p patches under the tip, from regions of M modes each.

    Attributes
    ----------
    modes : ndarray, shape (p, M, m), float32
        Of each patch, in the basis of its region.
    point_from : ndarray, shape (p + 1,), int64
        Cubature points of patch k are rows ``point_from[k] : point_from[k + 1]``.
    points : ndarray, shape (c,), int32
        Quadrature point, counted element by element.
    weights : ndarray, shape (c,), mm^3
    guess : ndarray, shape (p, TIP_FEATURES, m), float32
        Answer as a polynomial in place and depth.
    pairs : ndarray, shape (n, 2), int32
        Patches next to one another, the smaller number first.
    overlaps : ndarray, shape (n, m, m), float32
        Products of their modes in the energy of the rest state.
    residuals : ndarray, shape (p, RESIDUAL_FEATURES)
        Log of the residual that answers leave in the full model, relative to them in the energy
        norm at rest, by ``reduced.press.residual_features``: the direction is the inward normal,
        the load the depth.
    """

    modes: Field
    point_from: Ints
    points: NDArray[np.int32]
    weights: Array
    guess: Field
    pairs: NDArray[np.int32]
    overlaps: Field
    residuals: Array


@dataclass(frozen=True)
class LocalModels:
    """What training finds out about p patches of r modes each, from regions of M modes each.

    Attributes
    ----------
    basis : ndarray, shape (regions, M, 3 n), int16
        Modes of each region in steps of ``steps``; orthonormal in the energy of the rest state.
    steps : ndarray, shape (regions, M), float32, mm
    region : ndarray, shape (p,), int32
        Region of each patch.
    centres : ndarray, shape (p, 3), mm
    frames : ndarray, shape (p, 3, 3)
        Rows: outward normal and two tangents.
    pressures : ndarray, shape (p,), kPa
        Load scale.
    whole, mix : ndarray, shape (p, M, r), int16, and (p, r, r), float32
        Modes of each patch in the basis of its region are ``whole @ mix``: whole numbers, and
        the upper triangular matrix that makes orthonormal modes of them.
    point_from : ndarray, shape (p + 1,), int64
        Cubature points of patch k are rows ``point_from[k] : point_from[k + 1]``.
    points : ndarray, shape (c,), int32
        Quadrature point, counted element by element.
    weights : ndarray, shape (c,), mm^3
    defect : ndarray, shape (p, FEATURES, r), float32, mN
        Force that the cubature misses in equilibrium, as polynomials of the load.
    guess : ndarray, shape (p, FEATURES, r), float32
        Equilibrium less the linear response, as polynomials of the load.
    directions : ndarray, shape (p, CHANGING, r), float32
        Orthonormal directions in which the tangent changes most under load.
    change : ndarray, shape (p, TANGENT_FEATURES, CHANGES), float32
        Tangent there less that at rest, as polynomials of the load; its lower triangle.
    residuals : ndarray, shape (p, RESIDUAL_FEATURES)
        Log of the residual that answers leave in the full model, relative to them in the energy
        norm at rest, by ``reduced.press.residual_features``.
    extent : float, mm
        Largest distance of a contact point from the centre of a patch that answers for it.
    blend : float, mm
    tips : LocalTips, optional
        The same patches under the rigid tip.
    viscous, viscous_tips : ViscousModels, optional
        Of tissue that remembers; of the same patches under the tip.
    """

    basis: NDArray[np.int16]
    steps: Field
    region: NDArray[np.int32]
    centres: Array
    frames: Array
    pressures: Array
    whole: NDArray[np.int16]
    mix: Field
    point_from: NDArray[np.int64]
    points: NDArray[np.int32]
    weights: Array
    defect: Field
    guess: Field
    directions: Field
    change: Field
    residuals: Array
    extent: float
    blend: float
    tips: LocalTips | None
    viscous: ViscousModels | None = None
    viscous_tips: ViscousModels | None = None

    @cached_property
    def modes(self) -> Field:
        """Modes (p, M, r) of each patch in the basis of its region."""
        return self.whole.astype(np.float32) @ self.mix


@dataclass(frozen=True)
class Estimator:
    """Calibrated error estimate: ``log error = c . features``, one row per quantity.

    For the features see ``reduced.press``.
    """

    coefficients: Array  # (2, features): displacement, von Mises; under the tip also force

    def __call__(self, features: Array) -> list[float]:
        """Estimated relative errors, one for each row."""
        errors: list[float] = np.exp(self.coefficients @ features).tolist()
        return errors


@dataclass(frozen=True)
class Estimators:
    """Error estimates of loads and of the tip, at once and over histories; 1 if not calibrated."""

    loads: Estimator = Estimator(np.zeros((2, PRESS_FEATURES)))
    touches: Estimator = Estimator(np.zeros((3, TOUCH_FEATURES)))
    histories: Estimator = Estimator(np.zeros((2, HISTORY_FEATURES)))
    courses: Estimator = Estimator(np.zeros((3, HISTORY_FEATURES)))

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]]) -> Estimators:
        """Read from an artifact, which holds those of its scene."""
        return cls(
            **{
                name: Estimator(arrays[dataset])
                for name, dataset in ESTIMATORS.items()
                if dataset in arrays
            }
        )


ESTIMATORS = {
    "loads": "error_coefficients",
    "touches": "tip_error_coefficients",
    "histories": "history_error_coefficients",
    "courses": "tip_history_error_coefficients",
}
"""Where an artifact keeps each."""


def press_models(body: Body, models: LocalModels, scene: Scene) -> PressModels:
    """Everything the compiled query needs for footprints of up to the scene's radius."""
    gradients, surface = body.gradients, body.boundary
    per_element = gradients.shape[1]
    bases = models.basis.reshape(*models.steps.shape, len(body.nodes), 3)
    count, r = len(models.centres), models.modes.shape[2]
    most = -(-int(np.diff(models.point_from).max()) // LANES) * LANES
    point_gradients = np.zeros((count, r, 9 * most), np.int16)
    steps = np.empty((count, r), np.float32)
    weights, mu, lam = (np.zeros((count, most)) for _ in range(3))
    modes: list[Field] = [np.empty(0, np.float32)] * count
    rows: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = [(np.empty(0, int),) * 2] * count
    for region, steps_of_region in enumerate(models.steps):
        # one row of memory to a node, so that gathering nodes reads rows
        basis = np.ascontiguousarray(np.moveaxis(bases[region], 0, -1)).astype(np.float32)
        for k in np.flatnonzero(models.region == region):
            own = slice(models.point_from[k], models.point_from[k + 1])
            element, q = np.divmod(models.points[own], per_element)
            nodes, local = np.unique(body.elements[element], return_inverse=True)
            C = steps_of_region[:, None] * models.modes[k]
            V = _rows(basis, nodes, C)[local.reshape(len(element), -1)]
            G = _tiles(_mode_gradients(V, gradients[element, q]), most)
            steps[k] = np.maximum(np.abs(G).max(axis=1), 1e-30) / np.iinfo(np.int16).max
            point_gradients[k] = np.rint(G / steps[k, :, None])
            weights[k, : len(element)] = models.weights[own]
            mu[k, : len(element)], lam[k, : len(element)] = body.mu[element], body.lam[element]
            reach = models.extent + scene.endoscope.radius
            near = np.flatnonzero(np.sum((surface.points - models.centres[k]) ** 2, 1) < reach**2)
            nodes, local = np.unique(surface.nodes[near], return_inverse=True)
            modes[k] = _rows(basis, nodes, C)
            rows[k] = near, local.reshape(len(near), -1)
    near = np.concatenate([r[0] for r in rows])
    return PressModels(
        centres=np.ascontiguousarray(models.centres.T),
        frames=models.frames,
        pressures=np.ascontiguousarray(models.pressures),
        points=PointTables(point_gradients, steps, weights, mu, lam),
        node_from=_offsets(modes),
        modes=np.vstack(modes).reshape(-1, 3 * r),
        face_from=_offsets([r[0] for r in rows]),
        face_points=surface.points[near],
        face_normals=surface.normals[near],
        face_areas=surface.areas[near],
        face_nodes=np.vstack([r[1] for r in rows]).astype(np.int32),
        face_shape=surface.shape[near],
        defect=models.defect,
        guess=models.guess,
        directions=models.directions,
        change=models.change,
        residuals=models.residuals,
        blend=models.blend,
        tolerance_factor=math.sqrt(scene.tolerance.looseness),
    )


def touch_models(
    body: Body, models: LocalModels, tips: LocalTips, tangent: LocalTips | None = None
) -> TouchModels:
    """Everything the compiled query of the tip needs.

    The cubature of ``tangent``, which has the same modes, serves the tangent if given.
    """
    surface, surface_nodes = body.touchable
    reach = models.extent + REACH * body.tip.radius
    bases = models.basis.reshape(*models.steps.shape, len(body.nodes), 3)
    count = len(models.centres)
    points = _no_points(count, tips)
    tangent_points = points if tangent is None else _no_points(count, tangent)
    modes: list[Field] = [np.empty(0, np.float32)] * count
    near: list[NDArray[np.int32]] = [np.empty(0, np.int32)] * count
    own: list[tuple[NDArray[np.int32], NDArray[np.int64]]] = [(near[0], np.empty(0, int))] * count
    for region, steps in enumerate(models.steps):
        # one row of memory to a node, so that gathering nodes reads rows
        basis = np.ascontiguousarray(np.moveaxis(bases[region], 0, -1)).astype(np.float32)
        for k in np.flatnonzero(models.region == region):
            C = steps[:, None] * tips.modes[k]
            _place_points(body, basis, C, tips, int(k), points)
            if tangent is not None:
                _place_points(body, basis, C, tangent, int(k), tangent_points)
            away = np.linalg.norm(surface.nodes[surface.faces] - models.centres[k], axis=2)
            near[k] = np.flatnonzero((away < reach).any(axis=1)).astype(np.int32)
            own[k] = np.unique(surface.faces[near[k]], return_inverse=True)
            modes[k] = _rows(basis, surface_nodes[own[k][0]], C)
    normals = models.frames[:, 0]
    return TouchModels(
        centres=np.ascontiguousarray((models.centres + MIDDLE * body.tip.radius * normals).T),
        frames=models.frames,
        blend=models.blend,
        points=points,
        tangent_points=tangent_points,
        guess=tips.guess,
        tip=body.tip,
        surface=surface,
        node_from=_offsets([nodes for nodes, _ in own]),
        nodes=np.concatenate([nodes for nodes, _ in own]).astype(np.int32),
        modes=np.vstack(modes),
        face_from=_offsets(near),
        faces=np.concatenate(near),
        corners=np.vstack(
            [local.reshape(len(f), -1) for f, (_, local) in zip(near, own, strict=True)]
        ).astype(np.int32),
        **_neighbours(count, tips),
        residuals=tips.residuals,
    )


def _neighbours(count: int, tips: LocalTips) -> dict[str, NDArray[Any]]:
    """From pairs of models to the neighbours of each."""
    own, other = np.vstack([tips.pairs, tips.pairs[:, ::-1]]).T
    overlaps = np.concatenate([tips.overlaps, tips.overlaps.swapaxes(1, 2)])
    order = np.argsort(own, kind="stable")
    return {
        "neighbour_from": np.searchsorted(own[order], np.arange(count + 1)).astype(np.int64),
        "neighbours": other[order].astype(np.int32),
        "transfer": np.ascontiguousarray(overlaps[order]),
    }


def _no_points(count: int, tips: LocalTips) -> PointTables:
    """Room for the points of so many models."""
    most = -(-int(np.diff(tips.point_from).max()) // LANES) * LANES
    modes = tips.modes.shape[2]
    return PointTables(
        np.zeros((count, modes, 9 * most), np.float32),
        np.ones((count, modes), np.float32),
        *(np.zeros((count, most)) for _ in range(3)),
    )


def _place_points(
    body: Body, basis: Field, C: Field, tips: LocalTips, k: int, points: PointTables
) -> None:
    """Fill in the points of model k, of modes ``basis @ C``; basis (n, 3, M), C (M, m)."""
    rows = slice(tips.point_from[k], tips.point_from[k + 1])
    element, q = np.divmod(tips.points[rows], body.gradients.shape[1])
    nodes, local = np.unique(body.elements[element], return_inverse=True)
    V = _rows(basis, nodes, C)[local.reshape(len(element), -1)]
    G = _mode_gradients(V, body.gradients[element, q])
    points.gradients[k] = _tiles(G, points.weights.shape[1])
    points.weights[k, : len(element)] = tips.weights[rows]
    points.mu[k, : len(element)] = body.mu[element]
    points.lam[k, : len(element)] = body.lam[element]


def _rows(basis: Field, nodes: NDArray[np.int32], C: Field) -> Field:
    """Rows (k, 3, m) of modes ``basis @ C`` at some nodes; basis (n, 3, M), C (M, m)."""
    return (basis[nodes].reshape(-1, len(C)) @ C).reshape(len(nodes), 3, -1)


def _mode_gradients(V: Field, gradients: Array) -> Field:
    """Gradients (c, 9, m) of modes V (c, n, 3, m), at points with shape gradients (c, n, 3)."""
    c, _, _, m = V.shape
    # (c, 1, J, n) @ (c, i, n, m) -> (c, i, J, m)
    G = np.matmul(np.swapaxes(gradients, 1, 2)[:, None].astype(V.dtype), np.swapaxes(V, 1, 2))
    return G.reshape(c, 9, m)


def _tiles(G: Field, points: int) -> Field:
    """Gradients (c, 9, m) as rows (m, 9 points) in tiles, filled up with zeros."""
    filled = np.zeros((points, *G.shape[1:]), G.dtype)
    filled[: len(G)] = G
    return filled.reshape(-1, LANES, *G.shape[1:]).transpose(3, 0, 2, 1).reshape(G.shape[2], -1)


def _offsets(parts: list[Any]) -> NDArray[np.int64]:
    return np.concatenate([[0], np.cumsum([len(part) for part in parts])]).astype(np.int64)
