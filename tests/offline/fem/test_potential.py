"""Terms of the potential energy, each by itself, and their sum in a basis."""

import numpy as np
import pytest

from palpate.offline.fem.mesh import build_mesh
from palpate.offline.fem.model import FullModel
from palpate.offline.fem.potential import Projected
from palpate.offline.fem.terms import DeadLoad, PastStress, TipContact, TipLoad
from palpate.offline.scenes import find_scene
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.neo_hookean import NeoHookeanTissue
from palpate.shared.mechanics.sphere import tip_of, tip_surface
from palpate.shared.mechanics.viscosity import step_weights

PRONY = ((0.3, 0.1), (0.2, 1.0))
YOUNG, RADIUS = 15.0, 2.0
TOP = np.array([2.0, 2.0, 2.0])


@pytest.fixture(scope="module")
def model():
    scene = find_scene("quick")
    geometry = scene.geometry.model_copy(update={"size": (4.0, 4.0, 2.0), "divisions": (2, 2, 1)})
    mesh = build_mesh(scene.model_copy(update={"geometry": geometry}))
    tissue = NeoHookeanTissue(law="neo-hookean", young=YOUNG, poisson=0.45, prony=PRONY)
    return FullModel(mesh, "hex20", tissue)


@pytest.fixture(scope="module")
def dead_load(model):
    nodes = model.mesh.nodes
    forces = np.where((nodes[:, 2] == 2.0)[:, None], [0.3, 0.1, -0.8], 0.0)
    return DeadLoad(forces.ravel())


@pytest.fixture(scope="module")
def tip_load(model):
    mesh = model.mesh
    surface = tip_surface(mesh.nodes, mesh.faces, mesh.accessible, RADIUS)
    contact = TipContact(model, surface, tip_of(RADIUS, YOUNG))
    return TipLoad(contact, np.add(TOP, [0.1, 0.0, RADIUS - 0.3]), np.array([0.0, 0.0, -0.3]))


@pytest.fixture(scope="module")
def past(model, dead_load):
    """Tissue that has been pressed for a while."""
    pressed = model.solve(dead_load)
    return model.solve(dead_load, pressed.past, 0.2).past


@pytest.fixture(params=["dead load", "tip"])
def load(request, dead_load, tip_load):
    return dead_load if request.param == "dead load" else tip_load


@pytest.fixture(params=["dead load", "tip", "past"])
def term(request, model, dead_load, tip_load, past):
    if request.param == "past":
        return PastStress(model, past, step_weights(PRONY, 0.1))
    return dead_load if request.param == "dead load" else tip_load


def test_force_and_stiffness_are_derivatives_of_the_energy(model, term, rng):
    free = model.free
    u = model.filled(0.02 * rng.standard_normal(len(free)))

    def at(u):
        force = np.zeros_like(u)
        return term.add_force(u, force), force[free]

    data = np.zeros(model.pattern.nnz)
    term.add_stiffness(u, data, False)
    K = model.pattern.copy()
    K.data = data
    _, force = at(u)
    h = 1e-6
    for _ in range(3):
        v = rng.standard_normal(len(free))
        (ahead, after), (behind, before) = at(u + h * model.filled(v)), at(u - h * model.filled(v))
        assert force @ v == pytest.approx((ahead - behind) / (2 * h), rel=1e-5, abs=1e-6)
        slope = (after - before) / (2 * h)
        np.testing.assert_allclose(K @ v, slope, atol=1e-4 * max(np.abs(slope).max(), 1e-3))


def test_terms_add_to_what_is_there(model, term, rng):
    u = model.filled(0.02 * rng.standard_normal(len(model.free)))
    alone, together = np.zeros_like(u), np.ones_like(u)
    assert term.add_force(u, alone) == term.add_force(u, together)
    np.testing.assert_allclose(together, alone + 1.0, atol=1e-12)


@pytest.mark.parametrize("dt", [None, 0.1], ids=["elastic", "in time"])
def test_in_a_basis_of_everything_it_is_the_full_model(model, load, past, dt):
    before = None if dt is None else past
    expected = model.solve(load, before, dt or 0.0)
    tissue = [] if dt is None else [PastStress(model, past, step_weights(PRONY, dt))]
    L = np.linalg.cholesky(model.rest_stiffness.toarray())
    basis = np.linalg.inv(L).T
    whole = Projected(model, [load, *tissue], basis)
    start = np.zeros(len(model.free)) if dt is None else past.displacement.ravel()[model.free]
    q = L.T @ start
    status, *_ = newton.newton(whole, q, np.empty((4, len(q))), 1e-8, 0.0, 40, False)
    assert status == newton.CONVERGED
    found = model.filled(basis @ q).reshape(-1, 3)
    np.testing.assert_allclose(found, expected.displacement, atol=1e-7)
    assert np.abs(found).max() > 0.1


def test_a_load_comes_little_by_little(model, load):
    u = np.zeros(3 * len(model.mesh.nodes))

    def force(fraction):
        out = np.zeros_like(u)
        load.at(fraction).add_force(u, out)
        return np.linalg.norm(out)

    whole = np.zeros_like(u)
    load.add_force(u, whole)
    sizes = [force(fraction) for fraction in (0.0, 0.25, 0.5, 1.0)]
    assert sizes[0] == 0.0
    assert np.all(np.diff(sizes) > 0.0)
    assert sizes[-1] == np.linalg.norm(whole)


def test_the_tool_feels_a_dead_load(model, dead_load):
    found = model.solve(dead_load)
    support = np.zeros(found.displacement.size)
    model.internal(found.displacement.ravel(), support)
    balance = support.reshape(-1, 3)[model.mesh.clamped].sum(axis=0)
    np.testing.assert_allclose(found.force, balance, atol=1e-8)
    assert not found.tangent.any()
