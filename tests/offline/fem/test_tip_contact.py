"""The full model under the rigid tip."""

import numpy as np
import pytest

from palpate.offline.fem.mesh import build_mesh
from palpate.offline.fem.model import FullModel
from palpate.offline.fem.terms import TipContact, TipLoad
from palpate.offline.scenes import find_scene
from palpate.shared.mechanics.neo_hookean import NeoHookeanTissue
from palpate.shared.mechanics.sphere import tip_of, tip_surface

YOUNG, POISSON = 15.0, 0.45
TISSUE = NeoHookeanTissue(law="neo-hookean", young=YOUNG, poisson=POISSON)


def pressed_block(radius, size, divisions):
    """A block of hex20 clamped at its bottom, its contact with a tip, and the middle of its top."""
    scene = find_scene("quick")
    geometry = scene.geometry.model_copy(update={"size": size, "divisions": divisions})
    mesh = build_mesh(scene.model_copy(update={"geometry": geometry}))
    model = FullModel(mesh, "hex20", TISSUE)
    surface = tip_surface(mesh.nodes, mesh.faces, mesh.accessible, radius)
    contact = TipContact(model, surface, tip_of(radius, YOUNG))
    return model, contact, np.array([size[0] / 2, size[1] / 2, size[2]])


@pytest.fixture(scope="module")
def block():
    return pressed_block(2.0, (8.0, 8.0, 6.0), (3, 3, 2))


def touch(block, depth, aside=(0.0, 0.0), start=None):
    model, contact, top = block
    position = np.add(top, [*aside, contact.tip.radius - depth])
    approach = np.array([0.0, 0.0, -max(depth, 0.0)])
    return model.solve(TipLoad(contact, position, approach), start=start)


def test_a_tip_off_the_block_moves_nothing(block):
    found = touch(block, -0.01)
    assert not found.displacement.any()
    assert not found.force.any()


def test_force_energy_and_tangent_agree(block):
    """Force and tangent are derivatives of the stored energy in the tip's position."""
    found = touch(block, 0.6, (0.3, -0.2))
    assert found.force[2] > 0 > found.tangent[2, 2]
    np.testing.assert_allclose(found.tangent, found.tangent.T, atol=1e-6 * abs(found.tangent).max())
    h = 1e-4
    for axis, step in enumerate(h * np.eye(3)):
        ahead, behind = (
            touch(block, 0.6 - s * step[2], (0.3 + s * step[0], -0.2 + s * step[1]),
                  found.displacement)
            for s in (1, -1)
        )  # fmt: skip
        slope = (ahead.energy - behind.energy) / (2 * h)
        assert -found.force[axis] == pytest.approx(slope, abs=1e-4 * found.force[2])
        tangent = (ahead.force - behind.force) / (2 * h)
        error = np.abs(found.tangent[:, axis] - tangent).max()
        assert error <= 1e-3 * np.abs(found.tangent).max()


def test_the_way_in_does_not_matter(block):
    jump = touch(block, 0.5)
    step = touch(block, 0.5, start=touch(block, 0.4).displacement)
    assert np.abs(jump.displacement - step.displacement).max() <= 1e-6


def test_forces_on_tool_and_support_balance(block):
    model, *_ = block
    found = touch(block, 0.5, (0.4, 0.1))
    force = np.zeros(found.displacement.size)
    model.internal(found.displacement.ravel(), force)
    support = force.reshape(-1, 3)[model.mesh.clamped].sum(axis=0)
    np.testing.assert_allclose(support, found.force, atol=1e-6 * abs(found.force).max())


def test_penetration_is_small(block):
    for depth in (0.2, 0.5, 1.0):
        assert 0 < touch(block, depth).penetration < 0.02 * depth


def test_a_load_after_the_tip_knows_nothing_of_it(block):
    model, *_ = block
    touch(block, 0.5)
    assert not model.solve(np.zeros_like(model.mesh.nodes)).displacement.any()


def test_a_ball_on_a_layer_is_that_of_hertz():
    """Hertz's force with the correction for a bonded layer (Dimitriadis et al. 2002, eq. 12)."""
    radius, depth, height = 10.0, 0.4, 10.0
    model, contact, top = pressed_block(radius, (20.0, 20.0, height), (10, 10, 4))
    found = touch((model, contact, top), depth)
    a = -(1.2876 - 1.4678 * POISSON + 1.3442 * POISSON**2) / (1 - POISSON)
    b = (0.6387 - 1.0277 * POISSON + 1.5164 * POISSON**2) / (1 - POISSON)
    chi, pi = np.sqrt(radius * depth) / height, np.pi
    layer = (
        1 - 2 * a / pi * chi + 4 * a**2 / pi**2 * chi**2
        - 8 / pi**3 * (a**3 + 4 * pi**2 / 15 * b) * chi**3
        + 16 * a / pi**4 * (a**3 + 3 * pi**2 / 5 * b) * chi**4
    )  # fmt: skip
    hertz = 4 / 3 * YOUNG / (1 - POISSON**2) * np.sqrt(radius) * depth**1.5
    assert found.force[2] == pytest.approx(hertz * layer, rel=0.1)
