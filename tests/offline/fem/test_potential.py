"""Terms of the potential energy, each by itself, and their sum in a basis."""

from dataclasses import replace

import numpy as np
import pytest

from palpate.offline.fem.contact import SphereLoad
from palpate.offline.fem.model import FullModel
from palpate.offline.fem.potential import Potential, Projected
from palpate.offline.fem.terms import DeadLoad, PastStress
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.viscosity import step_weights

from .bodies import body, sphere_contact, support_force

PRONY = ((0.3, 0.1), (0.2, 1.0))
RADIUS = 2.0


@pytest.fixture(scope="module")
def model():
    return body("hex20", (2, 2, 1), (4.0, 4.0, 2.0), prony=PRONY)


@pytest.fixture(scope="module")
def dead_load(model):
    top = model.mesh.nodes[:, 2:] == 2.0
    return DeadLoad((top * [0.3, 0.1, -0.8]).ravel())


@pytest.fixture(scope="module")
def sphere_load(model):
    position = np.array([2.1, 2.0, 1.7 + RADIUS])
    return SphereLoad(sphere_contact(model, RADIUS), position, np.array([0.0, 0.0, -0.3]))


@pytest.fixture(scope="module")
def past(model, dead_load):
    """Tissue that has been pressed for a while."""
    pressed = model.solve(dead_load)
    return model.solve(dead_load, pressed.past, 0.2).past


@pytest.fixture(params=["dead_load", "sphere_load"])
def load(request):
    return request.getfixturevalue(request.param)


@pytest.fixture(params=["dead_load", "sphere_load", "past"])
def term(request, model):
    found = request.getfixturevalue(request.param)
    remembers = request.param == "past"
    return PastStress(model, found, step_weights(PRONY, 0.1)) if remembers else found


def test_force_and_stiffness_are_derivatives_of_the_energy_and_added(model, term, rng):
    free = model.free
    u = model.filled(0.02 * rng.standard_normal(len(free)))

    def at(u, before=0.0):
        force = np.full_like(u, before)
        return term.add_force(u, force), force[free] - before

    data = np.zeros(model.pattern.nnz)
    term.add_stiffness(u, data, False)
    K = model.matrix(data)
    energy, force = at(u)
    assert energy == at(u, 1.0)[0]
    np.testing.assert_allclose(at(u, 1.0)[1], force, atol=1e-12)
    h = 1e-6
    for _ in range(3):
        v = rng.standard_normal(len(free))
        (ahead, after), (behind, before) = at(u + h * model.filled(v)), at(u - h * model.filled(v))
        assert force @ v == pytest.approx((ahead - behind) / (2 * h), rel=1e-5, abs=1e-6)
        slope = (after - before) / (2 * h)
        np.testing.assert_allclose(K @ v, slope, atol=1e-4 * max(np.abs(slope).max(), 1e-3))


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
    forces = np.zeros((5, 3 * len(model.mesh.nodes)))
    parts = [load.at(fraction) for fraction in (0.0, 0.25, 0.5, 1.0)]
    for part, force in zip([*parts, load], forces, strict=True):
        part.add_force(np.zeros_like(force), force)
    sizes = np.linalg.norm(forces, axis=1)
    assert sizes[0] == 0.0
    assert np.all(np.diff(sizes[:4]) > 0.0)
    assert sizes[3] == sizes[4]


def test_the_tool_feels_what_holds_the_body(model, load):
    found = model.solve(load)
    np.testing.assert_allclose(found.force, support_force(model, found.displacement), atol=1e-8)


def test_what_is_clamped_is_held_where_it_is_said_to_be(model, dead_load):
    mesh, whole = model.mesh, model.solve(dead_load).displacement.ravel()
    part = FullModel(replace(mesh, clamped=mesh.clamped | (mesh.nodes[:, 0] > 2.0)), model.tissue)
    tissue, u = Potential(part, [dead_load], whole), np.zeros(len(part.free))
    target = 1e-10 * dead_load.size
    status, *_ = newton.newton(tissue, u, np.empty((4, len(u))), target, 0.0, 20, False)
    assert status == newton.CONVERGED
    np.testing.assert_allclose(u, whole[part.free], atol=1e-8)
    assert np.abs(whole[part.free]).max() > 0.05
