"""The overall stiffness with which a crude model of a body answers small loads best."""

from __future__ import annotations

import numpy as np

from palpate.offline.methods.relaxation import Elastic
from palpate.offline.methods.tetrahedra import Tetrahedra
from palpate.offline.reduce.sampling import random_points
from palpate.offline.run.workshop import Workshop

LOADS = 24
"""Number of small loads, normal to the surface at points all over it."""

RESIDUAL = 1e-3
"""Residual of the crude model's answers, relative to the load."""


def stiffening(workshop: Workshop, mesh: Tetrahedra, body: Elastic) -> float:
    """Factor on a body's stiffness with which it answers small loads as the full model does.

    It minimises the sum of squared differences over all loads and nodes of the scene.
    """
    rng = np.random.default_rng(workshop.scene.seed)
    body.linearise(np.zeros((3, len(mesh.nodes))))
    own, step = np.zeros((3, len(mesh.nodes))), np.zeros((3, mesh.free))
    both, square = 0.0, 0.0
    for point in random_points(workshop.surface, LOADS, rng):
        weights, normal = workshop.unit_load(point)
        load = -weights[:, None] * normal
        wanted = np.zeros(load.size)
        free = workshop.model.free
        wanted[free] = workshop.model.solve_linear(load.ravel()[free])
        force = np.ascontiguousarray((mesh.carrier.T @ load)[: mesh.free].T)
        body.stencil.solve(force, RESIDUAL, own.size, step)
        own[:, : mesh.free] = step
        found = mesh.displacement(own).ravel()
        both += float(found @ wanted)
        square += float(found @ found)
    return square / both
