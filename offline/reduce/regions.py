"""The common basis of a region: Ritz vectors of many footprints, compressed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.offline.fem.problem import FullProblem
from palpate.offline.reduce.patches import RegionResult
from palpate.offline.reduce.ritz import RITZ_VECTORS, Footprint, energy_pod, ritz_vectors

Array = NDArray[np.float64]

POINTS_IN_BASIS = 50
"""Footprints all of whose Ritz vectors make up a basis; of further ones only the linear do."""

RESPONSES = 24
"""Modes that the responses to nodal forces add to those of footprints, for the rigid tip."""

RESOLUTION = 2e-6
"""Displacement (mm) that a step of a stored mode amounts to where the mode is at work: a mode of
small amplitude is stored in coarse steps, which compress well."""


def region(problem: FullProblem, footprints: list[Footprint], modes: int) -> RegionResult:
    """Basis of a region and the Ritz vectors of footprints in it."""
    model = problem.model
    vectors = np.stack([_ritz(problem, footprint) for footprint in footprints], axis=1)
    first = np.arange(vectors.shape[2]) % RITZ_VECTORS < 3
    apart = -(-len(footprints) // POINTS_IN_BASIS)
    linear, rest = vectors[:, :, first], vectors[:, ::apart, ~first]
    wanted = [part.reshape(len(model.free), -1) for part in (linear, rest)]
    basis, _ = energy_pod(model, np.hstack(wanted), modes)
    vectors = vectors.reshape(len(model.free), -1)
    amplitude = np.sqrt(np.mean(((model.rest_stiffness @ basis).T @ vectors) ** 2, axis=1))
    if problem.scene.endoscope.tip:
        points = np.array([footprint.point for footprint in footprints])
        responses = _nodal_responses(problem, points, basis)
        # in front, where a truncation does not reach; in the finest steps
        basis = np.hstack([responses, basis])
        amplitude = np.concatenate([np.full(responses.shape[1], np.inf), amplitude])
    largest = np.abs(basis).max(axis=0)
    steps = np.clip(RESOLUTION / amplitude, largest / np.iinfo(np.int16).max, largest / 100)
    stored = np.round(basis / steps).astype(np.int16)
    # rounding costs the modes their orthonormality: give it back by a change of coordinates
    rounded = stored * steps.astype(np.float32)
    stiff = model.rest_stiffness @ rounded
    L = np.linalg.cholesky(rounded.T @ stiff)
    full = np.zeros((len(steps), 3 * len(problem.mesh.nodes)), np.int16)
    full[:, model.free] = stored.T
    ritz = np.linalg.solve(L, stiff.T @ vectors).reshape(len(steps), len(footprints), -1)
    return RegionResult(
        basis=full,
        steps=steps.astype(np.float32),
        orthonormal=np.linalg.inv(L).T.astype(np.float32),
        ritz=np.moveaxis(ritz, 1, 0).astype(np.float32),
    )


def _nodal_responses(problem: FullProblem, points: Array, basis: Array) -> Array:
    """Modes (free dofs, <= RESPONSES) of the responses to normal forces on single nodes.

    The nodes are those near the points (k, 3) mm.  Footprints spread a load over a disc, which a
    rigid tip does not; what the basis holds already is left out.
    """
    model, radius = problem.model, problem.scene.endoscope.radius
    nodes = problem.body.touchable[1]
    nodes = nodes[~problem.mesh.clamped[nodes]]
    nodes = nodes[cKDTree(points).query(problem.mesh.nodes[nodes])[0] < radius]
    loads = np.zeros((len(problem.mesh.nodes), 3, len(nodes)))
    for i, node in enumerate(nodes):
        loads[node, :, i] = problem.surface.project(problem.mesh.nodes[node])[1]
    responses = model.solve_linear(loads.reshape(-1, len(nodes))[model.free])
    for _ in range(2):  # twice is enough for orthogonality
        responses -= basis @ ((model.rest_stiffness @ basis).T @ responses)
    return energy_pod(model, responses, RESPONSES)[0]


def _ritz(problem: FullProblem, footprint: Footprint) -> Array:
    """Nonlinear Ritz vectors, and those of the relaxed tissue if time changes it."""
    nodal, _ = problem.unit_load(footprint.point)
    loads = (nodal[:, None, None] * footprint.loads.T).reshape(-1, 3)[problem.model.free]
    models = [problem.model, problem.model.relaxed] if problem.model.prony else [problem.model]
    return np.hstack([ritz_vectors(model, loads) for model in models])
