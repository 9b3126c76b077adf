"""From tables of one local model each to those of all, and what neighbours have in common."""

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.offline.fem.model import FullModel
from palpate.offline.reduce.ritz import Region
from palpate.shared.arrays import Array, Field, Numbers
from palpate.shared.local_models import LocalModels, ViscousModels

FOLLOWED = 2.0
"""Distance of centres, in extents of a patch, up to which one takes over the other's history."""


def with_points(
    models: LocalModels, points: NDArray[np.integer[Any]], weights: Array
) -> LocalModels:
    """One local model with other cubature points."""
    point_from = np.array([0, len(points)])
    return replace(models, point_from=point_from, points=points.astype(np.int32), weights=weights)


def half(values: Array) -> Field:
    """A field of one local model, in half precision and in the order it is stored in.

    Kernels would be compiled again for another order.
    """
    return values[None].astype(np.float16, order="C").astype(np.float32)


def bases_of(regions: Sequence[Region], body: NDArray[np.int16], steps: Field) -> dict[str, Any]:
    """Tables of the bases of regions, with modes of the body (G, 3 n) in steps (G,)."""
    shares = np.zeros((len(regions), len(regions[0].steps), len(steps)), np.int16)
    for row, region in zip(shares, regions, strict=True):
        row[:, : region.shares.shape[1]] = region.shares  # none where the window is the whole body
    return {
        "body": body,
        "body_steps": steps,
        "shares": shares,
        "share_steps": np.stack([region.share_steps for region in regions]),
        "node_from": np.cumsum([0, *(len(region.nodes) for region in regions)]),
        "nodes": np.concatenate([region.nodes for region in regions]),
        "basis": np.concatenate([region.basis.ravel() for region in regions]),
        "steps": np.stack([region.steps for region in regions]),
    }


def join(
    model: FullModel, bases: dict[str, Any], region: Numbers, parts: list[LocalModels]
) -> LocalModels:
    """Tables of all local models, which lie in given regions, from those of each."""
    models = _joined(
        parts,
        **bases,
        region=region,
        extent=parts[0].extent,
        blend=parts[0].blend,
        viscous=None,
    )
    soft = [part.viscous.deviatoric for part in parts if part.viscous is not None]
    if soft:
        followed = neighbours(models, FOLLOWED * models.extent)
        products = overlaps(model, models, models.modes, followed)
        models = replace(models, viscous=ViscousModels(np.concatenate(soft), followed, products))
    return models


def _joined(parts: Sequence[LocalModels], **own: Any) -> LocalModels:
    """Tables one after the other, but for fields of their own."""
    own["point_from"] = np.concatenate([[0], np.cumsum([len(part.points) for part in parts])])
    for name in {field.name for field in fields(parts[0])} - own.keys():
        own[name] = np.concatenate([getattr(part, name) for part in parts])
    return LocalModels(**own)


def neighbours(models: LocalModels, reach: float) -> Numbers:
    """Pairs (n, 2) of patches whose centres are at most ``reach`` mm apart, the smaller first."""
    pairs = sorted(cKDTree(models.centres).query_pairs(reach))
    return np.array(pairs, np.int32).reshape(-1, 2)


def overlaps(model: FullModel, models: LocalModels, modes: Field, pairs: Numbers) -> Field:
    """Products (n, r, r) of the modes (p, M, r) of both patches of each pair, in energy at rest.

    In half precision: products of orthonormal modes are at most one.
    """
    found = np.empty((len(pairs), modes.shape[2], modes.shape[2]), np.float16)
    regions = models.region[pairs]
    for number in np.unique(regions[:, 0]):
        stiffened = model.rest_stiffness @ _basis(model, models, number)
        for other in np.unique(regions[regions[:, 0] == number, 1]):
            cross = stiffened.T @ _basis(model, models, other)
            for i in np.flatnonzero((regions == (number, other)).all(axis=1)):
                k, n = pairs[i]
                found[i] = modes[k].T @ cross @ modes[n]
    return found.astype(np.float32)


def deviatoric_of(model: FullModel, modes: Array) -> Field:
    """Part of the rest stiffness (1, m, m) that relaxes, in modes (free dofs, m)."""
    return (modes.T @ (model.deviatoric_stiffness @ modes)).astype(np.float32)[None]


def _basis(model: FullModel, models: LocalModels, region: int) -> Array:
    """Modes (free dofs, M) mm of a region."""
    nodes, near = models.window(region)
    rows = (models.far[region] * models.body_steps) @ models.body.astype(float)
    by_node = rows.reshape(len(rows), -1, 3)
    by_node[:, nodes] += near.reshape(len(rows), -1, 3) * models.steps[region][:, None, None]
    return np.ascontiguousarray(rows[:, model.free].T)
