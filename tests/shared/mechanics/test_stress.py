"""Recovery of nodal von Mises stresses from displacements."""

import numpy as np
import pytest

from palpate.shared.geometry.elements import HEX20_NODES, HEX_CORNERS, HEX_EDGES
from palpate.shared.geometry.quadrature import stress_recovery
from palpate.shared.mechanics.laws import von_mises
from palpate.shared.mechanics.neo_hookean import NeoHookean
from palpate.shared.mechanics.stress import nodal_von_mises
from palpate.shared.mechanics.tissue import lame

from .material_point import rotation

LAW = NeoHookean(*lame(15.0, 0.45))


def pair(reference, rng):
    """Two distorted elements side by side that share a face: nodes and elements."""
    n = len(reference)
    nodes, weld = np.unique(
        np.vstack([reference, reference + np.array([2, 0, 0])]), axis=0, return_inverse=True
    )
    elements = weld.reshape(2, n)
    corners = np.unique(elements[:, :8])
    nodes[corners] += rng.uniform(-0.15, 0.15, (len(corners), 3))
    if n == 20:
        nodes[elements[:, 8:]] = nodes[elements[:, np.array(HEX_EDGES)]].mean(axis=2)
    return nodes, elements.astype(np.int32)


def recovered(nodes, elements, u):
    law = NeoHookean(*(np.full(len(elements), value) for value in LAW))
    mesh = stress_recovery(nodes, elements, law)
    out = np.full(len(nodes), np.nan)
    nodal_von_mises(mesh, u, None, out)
    return out


@pytest.fixture(params=[HEX_CORNERS, HEX20_NODES], ids=["hex8", "hex20"])
def reference(request):
    return request.param


def test_a_uniform_state_is_recovered_exactly(reference, rng):
    nodes, elements = pair(reference, rng)
    F = np.eye(3) + rng.uniform(-0.2, 0.2, (3, 3))
    expected = von_mises(LAW, tuple(F.ravel()))
    stress = recovered(nodes, elements, nodes @ (F - np.eye(3)).T)
    np.testing.assert_allclose(stress, expected, rtol=1e-11)


def test_rest_and_rotation_are_free_of_stress(reference, rng):
    nodes, elements = pair(reference, rng)
    Q = rotation(rng)
    assert np.abs(recovered(nodes, elements, np.zeros_like(nodes))).max() < 1e-12
    assert np.abs(recovered(nodes, elements, nodes @ (Q - np.eye(3)).T)).max() < 1e-11


def test_midside_nodes_take_the_mean_of_their_corners(rng):
    nodes, elements = pair(HEX20_NODES, rng)
    stress = recovered(nodes, elements, 0.05 * rng.standard_normal(nodes.shape))
    ends = elements[:, np.array(HEX_EDGES)]
    np.testing.assert_allclose(stress[elements[:, 8:]], stress[ends].mean(axis=2), rtol=1e-13)
    assert (stress >= 0).all()
