"""The tables that compiled queries read, from what training found out about a scene."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.shared.local_models import Body, LocalModels, LocalTips
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


def press_models(body: Body, models: LocalModels, scene: Scene) -> PressModels:
    """Everything the compiled query needs for footprints of up to the scene's radius."""
    gradients, surface = body.gradients, body.boundary
    per_element = gradients.shape[1]
    bases = models.basis.reshape(*models.steps.shape, len(body.nodes), 3)
    count, r = len(models.centres), models.modes.shape[2]
    most = -(-int(np.diff(models.point_from).max()) // LANES) * LANES
    point_gradients = np.zeros((count, r, 9 * most), np.int16)
    steps = np.empty((count, r), np.float32)
    weights, elements = np.zeros((count, most)), np.zeros((count, most), int)
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
            elements[k, : len(element)] = element
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
        points=PointTables(point_gradients, steps, weights, body.law.at(elements)),
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
    points = _no_points(body, tips)
    tangent_points = points if tangent is None else _no_points(body, tangent)
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


def _no_points(body: Body, tips: LocalTips) -> PointTables:
    """Room for the points of all models: of their tissue, but without gradients and weights."""
    counts, modes = np.diff(tips.point_from), tips.modes.shape[2]
    elements = np.zeros((len(counts), -(-int(counts.max()) // LANES) * LANES), int)
    filled = np.arange(elements.shape[1]) < counts[:, None]
    elements[filled] = tips.points // body.gradients.shape[1]
    return PointTables(
        np.zeros((len(counts), modes, 9 * elements.shape[1]), np.float32),
        np.ones((len(counts), modes), np.float32),
        np.zeros(elements.shape),
        body.law.at(elements),
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
