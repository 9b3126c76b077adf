"""Recovery of nodal von Mises stresses from displacements."""

import numpy as np
import pytest

from palpate.shared.geometry.elements import HEX20_NODES, HEX_CORNERS, HEX_EDGES, gauss, shape
from palpate.shared.geometry.quadrature import stress_recovery, volume_quadrature
from palpate.shared.mechanics.laws import von_mises
from palpate.shared.mechanics.neo_hookean import NeoHookean
from palpate.shared.mechanics.stress import NearField, nodal_von_mises, point_von_mises
from palpate.shared.mechanics.tissue import lame
from palpate.shared.near_field import NO_CONTACT

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


def recovered(nodes, elements, u, near=NO_CONTACT):
    law = NeoHookean(*(np.full(len(elements), value) for value in LAW))
    mesh = stress_recovery(nodes, elements, law)
    out = np.full(len(nodes), np.nan)
    nodal_von_mises(mesh, u, None, near, out)
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


def test_in_a_single_element_gradients_are_carried_linearly(reference, rng):
    nodes, elements = reference.copy(), np.arange(len(reference), dtype=np.int32)[None]
    u = 0.05 * rng.standard_normal(nodes.shape)
    gradients, _ = volume_quadrature(nodes, elements, 2)
    at_points = np.einsum("qai,aj->qji", gradients[0], u)
    linear, _ = shape(HEX_CORNERS, gauss(2, 3)[0])
    carried, _ = shape(HEX_CORNERS, reference)
    H = np.einsum("aq,qij->aij", carried @ np.linalg.inv(linear), at_points)
    expected = [von_mises(LAW, tuple((np.eye(3) + own).ravel())) for own in H]
    np.testing.assert_allclose(recovered(nodes, elements, u), expected, rtol=1e-10)


def test_what_a_near_field_takes_away_it_gives_back(reference, rng):
    """A linear field is the same, whether elements recover it or the near field knows it."""
    nodes, elements = pair(reference, rng)
    H = rng.uniform(-0.2, 0.2, (3, 3))
    u = nodes @ H.T
    near = NearField(np.arange(len(nodes)), 0.3 * u, np.tile(0.3 * H, (len(nodes), 1, 1)))
    expected = von_mises(LAW, tuple((np.eye(3) + H).ravel()))
    np.testing.assert_allclose(recovered(nodes, elements, u, near), expected, rtol=1e-11)


def test_stress_at_the_points_has_the_near_field_there(reference, rng):
    nodes, elements = pair(reference, rng)
    law = NeoHookean(*(np.full(len(elements), value) for value in LAW))
    u, moved = 0.05 * rng.standard_normal((2, *nodes.shape))
    near = NearField(np.arange(len(nodes)), moved, np.empty((len(nodes), 3, 3)))
    exact = NearField(np.array([3, 12]), np.empty((2, 3)), 0.1 * rng.standard_normal((2, 3, 3)))
    gradients, _ = volume_quadrature(nodes, elements, 2)
    H = np.einsum("eqai,eaj->eqji", gradients, (u - moved)[elements]).reshape(-1, 3, 3)
    H[exact.points] += exact.gradient
    out = np.empty(8 * len(elements))
    point_von_mises(stress_recovery(nodes, elements, law), u, None, near, exact, out)
    expected = [von_mises(LAW, tuple((np.eye(3) + own).ravel())) for own in H]
    np.testing.assert_allclose(out, expected, rtol=1e-10)
