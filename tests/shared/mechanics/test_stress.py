"""Recovery of nodal von Mises stresses from displacements."""

import numpy as np
import pytest

from palpate.shared.geometry.elements import HEX8, HEX20, POINTS, TET10
from palpate.shared.geometry.quadrature import stress_recovery, volume_quadrature
from palpate.shared.mechanics.laws import von_mises
from palpate.shared.mechanics.neo_hookean import NeoHookean
from palpate.shared.mechanics.stress import NearField, nodal_von_mises, point_von_mises
from palpate.shared.mechanics.tissue import lame
from palpate.shared.near_field import NO_CONTACT

from ...offline.fem.bodies import with_middles
from .material_point import rotation

LAW = NeoHookean(*lame(15.0, 0.45))


def pair(kind, rng):
    """Two distorted elements side by side that share a face: nodes and elements."""
    if kind is TET10:
        nodes = np.vstack([kind.straight.nodes, np.ones(3)])
        nodes, elements, _ = with_middles(nodes, np.array([[0, 1, 2, 3], [4, 2, 1, 3]]))
    else:
        two = np.vstack([kind.nodes, kind.nodes + np.array([2, 0, 0])])
        nodes, weld = np.unique(two, axis=0, return_inverse=True)
        elements = weld.reshape(2, -1)
    corners = np.unique(elements[:, : kind.corners])
    nodes[corners] += rng.uniform(-0.15, 0.15, (len(corners), 3))
    if kind.quadratic:
        ends = elements[:, np.array(kind.edges)]
        nodes[elements[:, kind.corners :]] = nodes[ends].mean(axis=2)
    return nodes, elements.astype(np.int32)


def recovered(nodes, elements, u, near=NO_CONTACT):
    law = NeoHookean(*(np.full(len(elements), value) for value in LAW))
    mesh = stress_recovery(nodes, elements, law, np.zeros(len(elements), np.int32))
    out = np.full(len(nodes), np.nan)
    nodal_von_mises(mesh, u, None, near, out)
    return out


@pytest.fixture(params=[HEX8, HEX20, TET10], ids=["hex8", "hex20", "tet10"])
def kind(request):
    return request.param


def test_a_uniform_state_is_recovered_exactly(kind, rng):
    nodes, elements = pair(kind, rng)
    F = np.eye(3) + rng.uniform(-0.2, 0.2, (3, 3))
    expected = von_mises(LAW, tuple(F.ravel()))
    stress = recovered(nodes, elements, nodes @ (F - np.eye(3)).T)
    np.testing.assert_allclose(stress, expected, rtol=1e-11)


@pytest.mark.parametrize("kind", [HEX20, TET10], ids=["hex20", "tet10"])
def test_a_uniform_state_is_recovered_exactly_in_curved_elements(kind, rng):
    nodes, elements = pair(kind, rng)
    middles = np.unique(elements[:, kind.corners :])
    nodes[middles] += rng.uniform(-0.03, 0.03, (len(middles), 3))
    H = rng.uniform(-0.2, 0.2, (3, 3))
    expected = von_mises(LAW, tuple((np.eye(3) + H).ravel()))
    np.testing.assert_allclose(recovered(nodes, elements, nodes @ H.T), expected, rtol=1e-11)


def test_rest_and_rotation_are_free_of_stress(kind, rng):
    nodes, elements = pair(kind, rng)
    Q = rotation(rng)
    assert np.abs(recovered(nodes, elements, np.zeros_like(nodes))).max() < 1e-12
    assert np.abs(recovered(nodes, elements, nodes @ (Q - np.eye(3)).T)).max() < 1e-11


def test_in_a_single_element_gradients_are_carried_linearly(kind, rng):
    nodes, elements = kind.nodes.copy(), np.arange(len(kind.nodes), dtype=np.int32)[None]
    u = 0.05 * rng.standard_normal(nodes.shape)
    gradients, _ = volume_quadrature(nodes, elements, POINTS)
    at_points = np.einsum("qai,aj->qji", gradients[0], u)
    linear, _ = kind.straight.shape(kind.rule(POINTS)[0])
    carried, _ = kind.straight.shape(kind.nodes)
    H = np.einsum("aq,qij->aij", carried @ np.linalg.inv(linear), at_points)
    expected = [von_mises(LAW, tuple((np.eye(3) + own).ravel())) for own in H]
    np.testing.assert_allclose(recovered(nodes, elements, u), expected, rtol=1e-10)


def test_what_a_near_field_takes_away_it_gives_back(kind, rng):
    """A linear field is the same, whether elements recover it or the near field knows it."""
    nodes, elements = pair(kind, rng)
    H = rng.uniform(-0.2, 0.2, (3, 3))
    u = nodes @ H.T
    near = NearField(np.arange(len(nodes)), 0.3 * u, np.tile(0.3 * H, (len(nodes), 1, 1)))
    expected = von_mises(LAW, tuple((np.eye(3) + H).ravel()))
    np.testing.assert_allclose(recovered(nodes, elements, u, near), expected, rtol=1e-11)


def test_stress_at_the_points_has_the_near_field_there(kind, rng):
    nodes, elements = pair(kind, rng)
    law = NeoHookean(*(np.full(len(elements), value) for value in LAW))
    u, moved = 0.05 * rng.standard_normal((2, *nodes.shape))
    near = NearField(np.arange(len(nodes)), moved, np.empty((len(nodes), 3, 3)))
    exact = NearField(np.array([3, 6]), np.empty((2, 3)), 0.1 * rng.standard_normal((2, 3, 3)))
    gradients, _ = volume_quadrature(nodes, elements, POINTS)
    H = np.einsum("eqai,eaj->eqji", gradients, (u - moved)[elements]).reshape(-1, 3, 3)
    H[exact.points] += exact.gradient
    out = np.empty(kind.points * len(elements))
    point_von_mises(
        stress_recovery(nodes, elements, law, np.zeros(len(elements), np.int32)),
        u,
        None,
        near,
        exact,
        out,
    )
    expected = [von_mises(LAW, tuple((np.eye(3) + own).ravel())) for own in H]
    np.testing.assert_allclose(out, expected, rtol=1e-10)
