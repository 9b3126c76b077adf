"""The tables that compiled queries read, from what training found out about a scene."""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.shared.arrays import Field, Ints, Numbers
from palpate.shared.local_models import Body, LocalModels
from palpate.shared.mechanics.footprint import SurfaceQuadrature
from palpate.shared.reduced.points import LANES, Points
from palpate.shared.reduced.press import PressModels
from palpate.shared.scene import Scene

AT_ONCE = 16 * LANES
"""Points whose gradients are found together: all of the cubature, and of all points of a body so
many as stay in the processor's cache."""


def press_models(body: Body, models: LocalModels, scene: Scene) -> PressModels:
    """Everything the compiled query needs for footprints of up to the scene's radius."""
    surface, reach = body.boundary, models.extent + scene.endoscope.radius
    near = body.boundary_tree.query_ball_point(models.centres, reach, return_sorted=True)
    points = _without_gradients(body, models)
    wanted = [
        np.union1d(surface.nodes[faces], body.elements[_points_of(body, models, k)[0]])
        for k, faces in enumerate(near)
    ]
    found = {}
    for k, rows in _modes_at(body, models, wanted):
        G = _gradients(body, models, k, rows, points.gradients.shape[2])
        points.steps[k] = np.maximum(np.abs(G).max(axis=1), 1e-30) / np.iinfo(np.int16).max
        points.gradients[k] = np.rint(G / points.steps[k, :, None])
        nodes, own = _compact(surface.nodes[near[k]])
        found[k] = rows(nodes), own
    modes, corners = zip(*(found[k] for k in sorted(found)), strict=True)
    faces = SurfaceQuadrature(*(part[np.concatenate(near)] for part in surface))
    return PressModels(
        centres=np.ascontiguousarray(models.centres.T),
        frames=models.frames,
        pressures=np.ascontiguousarray(models.pressures),
        points=points,
        node_from=_offsets(modes),
        modes=np.concatenate(modes).reshape(-1, 3 * models.modes.shape[2]),
        face_from=_offsets(near),
        faces=faces._replace(nodes=np.concatenate(corners)),
        defect=models.defect,
        guess=models.guess,
        directions=models.directions,
        change=models.change,
        residuals=models.residuals,
        blend=models.blend,
        tolerance_factor=math.sqrt(scene.tolerance.looseness),
        max_tilt=scene.endoscope.max_tilt,
    )


def _modes_at(
    body: Body, models: LocalModels, wanted: Sequence[Numbers]
) -> Iterator[tuple[int, Callable[[Any], Field]]]:
    """Every local model with what gives its modes (k, 3, m) at nodes (k,), region by region.

    Nodes are among those ``wanted`` of the model, a small share of its window.
    """
    place = np.zeros(len(body.nodes), int)
    for region, steps in enumerate(models.steps):
        own = np.flatnonzero(models.region == region).tolist()
        window, near = models.window(region)
        used = np.flatnonzero(np.isin(window, np.concatenate([wanted[k] for k in own])))
        nodes = window[used]
        place[nodes] = np.arange(len(nodes))
        far = models.body.reshape(-1, len(body.nodes), 3)[:, nodes]
        # one row of memory to a node, so that gathering nodes reads rows
        basis = _by_node(near.reshape(len(steps), len(window), 3)[:, used]) * steps
        share = models.body_steps[:, None] * models.far[region].T
        basis += (_by_node(far).reshape(3 * len(nodes), -1) @ share).reshape(basis.shape)
        for k in own:
            yield k, partial(_rows, basis, place, models.modes[k])


def _compact(numbers: Numbers) -> tuple[Numbers, Numbers]:
    """Nodes (n,) of faces (f, k), and the faces in terms of them."""
    nodes, own = np.unique(numbers, return_inverse=True)
    return nodes, own.reshape(numbers.shape).astype(np.int32)


def _points_of(body: Body, models: LocalModels, k: int) -> tuple[Ints, Ints]:
    """Element of each point of model k, and its number there."""
    own = slice(models.point_from[k], models.point_from[k + 1])
    return np.divmod(models.points[own], body.gradients.shape[1])


def _without_gradients(body: Body, models: LocalModels) -> Points:
    """The points of all models, with room for the gradients of their modes there."""
    counts, modes = np.diff(models.point_from), models.modes.shape[2]
    width = -(-int(counts.max()) // LANES) * LANES
    points, weights = np.zeros((len(counts), width), int), np.zeros((len(counts), width))
    used = np.arange(width) < counts[:, None]
    points[used], weights[used] = models.points, models.weights
    return Points(
        np.zeros((len(counts), modes, 9 * width), np.int16),
        np.ones((len(counts), modes), np.float32),
        weights,
        body.point_law.at(np.divmod(points, body.gradients.shape[1])),
    )


def _gradients(
    body: Body, models: LocalModels, k: int, rows: Callable[[Any], Field], width: int
) -> Field:
    """Gradients (m, width) of the modes of model k at its points, in tiles."""
    element, q = _points_of(body, models, k)
    nodes, corners = _compact(body.elements[element])
    moved = rows(nodes)
    G = np.zeros((moved.shape[2], width), np.float32)
    for first in range(0, len(element), AT_ONCE):
        some = slice(first, first + AT_ONCE)
        slopes = np.swapaxes(body.gradients[element[some], q[some]], 1, 2).astype(np.float32)
        # (c, 1, J, n) @ (c, i, n, m) -> (c, i, J, m)
        found = np.matmul(slopes[:, None], np.swapaxes(moved[corners[some]], 1, 2))
        filled = np.zeros((-(-len(found) // LANES), LANES, 9, len(G)), np.float32)
        filled.reshape(-1, 9, len(G))[: len(found)] = found.reshape(-1, 9, len(G))
        tiles = filled.transpose(3, 0, 2, 1).reshape(len(G), -1)
        G[:, 9 * first : 9 * first + tiles.shape[1]] = tiles
    return G


def _by_node(modes: NDArray[Any]) -> Field:
    """Modes (n, 3, M) in floating point, from (M, n, 3)."""
    return np.ascontiguousarray(np.moveaxis(modes, 0, -1)).astype(np.float32)


def _rows(basis: Field, place: Ints, C: Field, nodes: Numbers) -> Field:
    """Rows (k, 3, m) of modes ``basis @ C`` at nodes in their ``place``; basis (n, 3, M)."""
    return (basis[place[nodes]].reshape(-1, len(C)) @ C).reshape(len(nodes), 3, -1)


def _offsets(parts: Sequence[Any]) -> Ints:
    return np.concatenate([[0], np.cumsum([len(part) for part in parts])]).astype(np.int64)
