"""The full model of every element against mechanics that is known exactly."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.sparse.linalg import spsolve

from palpate.offline.fem.model import FullModel, NoEquilibrium
from palpate.offline.fem.potential import Potential
from palpate.shared.geometry.elements import kind_of
from palpate.shared.geometry.quadrature import (
    stress_recovery,
    surface_quadrature,
    volume_quadrature,
)
from palpate.shared.mechanics import tissue
from palpate.shared.mechanics.footprint import footprint
from palpate.shared.mechanics.laws import von_mises
from palpate.shared.mechanics.stress import nodal_von_mises
from palpate.shared.near_field import NO_CONTACT

from .bodies import ELEMENTS, YOUNG, body, tissue_of

PRONY = ((0.3, 0.1), (0.2, 1.0))


@pytest.fixture(params=ELEMENTS)
def element(request):
    return request.param


@pytest.fixture
def slab(element):
    """Return a block that is wide enough for a footprint."""
    return body(element, (4, 4, 2), (10.0, 10.0, 5.0))


@pytest.fixture
def bent(element, rng):
    """Return a body that nothing holds, and a smooth large deformation of it plus noise (n, 3)."""
    model = loose(body(element, (2, 2, 2), (3.0, 3.0, 3.0)), rng)
    x, y, z = model.mesh.nodes.T
    bend = 0.3 * np.column_stack([np.sin(z), np.cos(x), 0.5 * y])
    return model, bend + 0.03 * rng.standard_normal(bend.shape)


def loose(model, rng, by=0.2):
    """A model with its inner corners moved, edges kept straight, and nothing clamped."""
    mesh, nodes, kind = model.mesh, model.mesh.nodes.copy(), kind_of(model.mesh.elements)
    inner = np.setdiff1d(mesh.elements[:, : kind.corners], mesh.faces)
    nodes[inner] += rng.uniform(-by, by, (len(inner), 3))
    if kind.quadratic:
        ends = mesh.elements[:, np.array(kind.edges)]
        nodes[mesh.elements[:, kind.corners :]] = nodes[ends].mean(axis=2)
    mesh = replace(mesh, nodes=nodes, clamped=np.zeros_like(mesh.clamped))
    return FullModel(mesh, model.tissue)


def internal_force(model, displacement):
    """Energy and internal force (n, 3)."""
    force = np.empty(displacement.size)
    energy, _ = model.internal(displacement.ravel(), force)
    return energy, force.reshape(-1, 3)


def pressed(mesh, pressure, radius=2.0):
    """Load of a footprint in the middle of a block's top, straight down."""
    top, nodal = mesh.nodes.max(axis=0) * [0.5, 0.5, 1.0], np.empty(len(mesh.nodes))
    up = np.array([0.0, 0.0, 1.0])
    footprint(surface_quadrature(mesh.nodes, mesh.faces), top, up, radius, nodal)
    return np.outer(-pressure * nodal, up)


def solve_prescribed(model, dofs, values, increments=4):
    """Displacement of an unclamped model whose ``dofs`` are moved to ``values``; no load."""
    u = np.zeros(model.mesh.nodes.size)
    rest = np.setdiff1d(np.arange(len(u)), dofs)
    for fraction in np.linspace(0, 1, increments + 1)[1:]:
        for _ in range(8):
            K = model.stiffness(u)[rest].tocsc()
            moved = fraction * values - u[dofs]
            out_of_balance = internal_force(model, u)[1].ravel()[rest] + K[:, dofs] @ moved
            u[dofs] += moved
            u[rest] -= spsolve(K[:, rest], out_of_balance)
    return u.reshape(-1, 3)


# --- consistency -----------------------------------------------------------------------------


@pytest.mark.parametrize("shrunk", [1.0, 1.5, np.nan])
def test_inverted_tissue_has_infinite_energy(slab, shrunk):
    """At det F = 0, det F < 0, and where that is not a number."""
    assert internal_force(slab, -shrunk * slab.mesh.nodes)[0] == tissue.INVERTED


def test_patch_test(element, rng):
    """A linear displacement of the boundary is followed exactly inside a distorted mesh."""
    model = loose(body(element, (3, 3, 3), (3.0, 3.0, 3.0)), rng)
    mesh = model.mesh
    exact = mesh.nodes @ rng.uniform(-0.2, 0.2, (3, 3))
    boundary = np.unique(mesh.faces)
    dofs = (3 * boundary[:, None] + np.arange(3)).ravel()
    assert len(boundary) < len(mesh.nodes)
    u = solve_prescribed(model, dofs, exact[boundary].ravel())
    assert np.abs(u - exact).max() <= 1e-12 * np.abs(exact).max()
    # Inside, the internal forces of the elements cancel; on the boundary they are the traction.
    _, force = internal_force(model, exact)
    inside = np.setdiff1d(np.arange(len(mesh.nodes)), boundary)
    assert np.abs(force[inside]).max() <= 1e-12 * np.abs(force).max()


@pytest.mark.parametrize("relaxed", [False, True])
def test_force_and_symmetric_tangent_are_derivatives_of_the_energy(bent, relaxed, rng):
    model, u = bent
    if relaxed:
        model = FullModel(model.mesh, tissue_of(prony=PRONY)).relaxed
    _, force = internal_force(model, u)
    K = model.stiffness(u.ravel())
    assert np.abs((K - K.T).toarray()).max() <= 1e-13 * np.abs(K.data).max()
    for _ in range(5):
        v = rng.standard_normal(u.shape)
        energies, forces = zip(
            *(internal_force(model, u + s * 1e-3 * v) for s in (-2, -1, 1, 2)), strict=True
        )
        fourth_order = np.array([1, -8, 8, -1]) / 12e-3
        scale = np.linalg.norm(force) * np.linalg.norm(v)
        assert np.vdot(force, v) == pytest.approx(fourth_order @ energies, abs=1e-7 * scale)
        slope = np.tensordot(fourth_order, forces, 1).ravel()
        assert np.abs(K @ v.ravel() - slope).max() <= 1e-7 * np.abs(slope).max()


def test_rest_stiffness_has_six_rigid_motions_and_no_more(bent):
    values = np.linalg.eigvalsh(bent[0].rest_stiffness.toarray())
    assert np.abs(values[:6]).max() < 1e-11 * values[-1]
    assert values[6] > 1e-4 * values[-1]


def test_rotations_are_free_of_force_and_energy_and_forces_of_a_deformed_body_balance(bent, rng):
    model, u = bent
    Q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    Q *= np.linalg.det(Q)
    nodes = model.mesh.nodes
    energy, force = internal_force(model, nodes @ (Q - np.eye(3)).T + [1.0, 2.0, 3.0])
    assert abs(energy) <= 1e-12
    assert np.abs(force).max() <= 1e-12 * YOUNG
    _, force = internal_force(model, u)
    assert np.abs(force.sum(axis=0)).max() <= 1e-12 * np.abs(force).max()
    moment = np.cross(nodes + u, force).sum(axis=0)
    assert np.abs(moment).max() <= 1e-11 * np.abs(force).max()


# --- solutions -------------------------------------------------------------------------------


@pytest.mark.parametrize("stretch", [0.6, 1.5])
def test_uniaxial_tension(element, stretch, rng):
    """A bar between frictionless plates: homogeneous, with the lateral stretch of the law."""
    model = loose(body(element, (2, 2, 3), (2.0, 2.0, 3.0)), rng)
    nodes = model.mesh.nodes
    moved = 3 * np.flatnonzero(np.isclose(nodes[:, 2], 3.0)) + 2
    held = np.flatnonzero(nodes == 0.0)
    dofs = np.concatenate([held, moved])
    values = np.where(np.isin(dofs, moved), 3.0 * (stretch - 1), 0.0)
    u = solve_prescribed(model, dofs, values)

    mu, lam = model.law.at(0)

    def pulled(lateral):
        """Nominal stresses (lateral, axial) of the law at principal stretches."""
        volumetric = lam / 2 * ((stretch * lateral**2) ** 2 - 1) - mu
        return mu * lateral + volumetric / lateral, mu * stretch + volumetric / stretch

    lateral = brentq(lambda s: pulled(s)[0], 0.3, 2.0, xtol=1e-15)
    expected = nodes * [lateral - 1, lateral - 1, stretch - 1]
    assert np.abs(u - expected).max() <= 1e-11
    force = internal_force(model, u)[1].ravel()[moved].sum()
    assert force == pytest.approx(4.0 * pulled(lateral)[1], rel=1e-11)


def test_newton_ends_quadratically(slab, monkeypatch):
    load = pressed(slab.mesh, 6.0)
    states = []
    factorise = Potential.factorise

    def recorded(potential, u, shift):
        states.append(u.copy())
        return factorise(potential, u, shift)

    monkeypatch.setattr(Potential, "factorise", recorded)
    monkeypatch.setattr("palpate.offline.fem.model.KEEP_TANGENT", 0.0)
    solution = slab.solve(load)
    states.append(solution.displacement.ravel()[slab.free])
    residuals = [slab.internal_free(u) - load.ravel()[slab.free] for u in states]
    norms = np.linalg.norm(residuals, axis=1) / np.linalg.norm(load)
    assert solution.load_steps == 1
    assert len(norms) <= 10
    # The exponent that carries each residual to the next, until round-off ends it.
    tail = np.flatnonzero((norms[:-1] < 0.1) & (norms[:-1] > 1e-6))
    assert len(tail) >= 1
    orders = np.log(norms[tail + 1]) / np.log(norms[tail])
    assert (orders > 1.7).all()


def test_a_kept_tangent_leads_to_the_same_equilibrium(slab, monkeypatch):
    load, factorised = pressed(slab.mesh, 1.0), []
    near, exact = slab.solve(0.999 * load), slab.solve(load)
    slab.solve(0.998 * load)
    factorise = Potential.factorise
    monkeypatch.setattr(Potential, "factorise", lambda *at: factorised.append(at) or factorise(*at))
    kept = slab.solve(load, start=near.displacement, keep=True)
    assert not factorised
    np.testing.assert_allclose(kept.displacement, exact.displacement, atol=1e-7)


def test_solution_is_in_equilibrium_whatever_the_way_to_it(slab, monkeypatch):
    load = pressed(slab.mesh, 6.0)
    solution = slab.solve(load)
    _, force = internal_force(slab, solution.displacement)
    out_of_balance = (force - load).ravel()[slab.free]
    assert np.linalg.norm(out_of_balance) <= 1e-9 * np.linalg.norm(load)
    assert not solution.displacement[slab.mesh.clamped].any()
    assert 0 < solution.min_jacobian < 1
    assert np.abs(solution.displacement).max() > 0.5
    halfway = slab.solve(load / 2).displacement
    monkeypatch.setattr("palpate.offline.fem.model.KEEP_TANGENT", 0.3)
    thrifty = slab.solve(load, start=halfway).displacement
    assert np.abs(thrifty - solution.displacement).max() <= 1e-7


@pytest.mark.parametrize("pressure", [1e6, -1e8, np.nan])
def test_a_load_without_equilibrium_is_reported(slab, pressure, monkeypatch):
    corrections = []
    correct = Potential.correct

    def counted(potential, residual, step):
        corrections.append(1)
        correct(potential, residual, step)

    monkeypatch.setattr(Potential, "correct", counted)
    with pytest.raises(NoEquilibrium, match="no equilibrium found beyond 0 %"):
        slab.solve(pressed(slab.mesh, pressure))
    assert len(corrections) <= 7 * 40  # load steps 1, 1/2, ... 1/64 of at most 40 iterations
    corrections.clear()
    with pytest.raises(NoEquilibrium):
        slab.solve(pressed(slab.mesh, pressure), max_iterations=2, smallest_step=0.5)
    assert len(corrections) <= 2 * 2
    # The failure leaves nothing behind.
    assert slab.solve(pressed(slab.mesh, 2.0)).load_steps == 1


def test_small_loads_are_answered_in_proportion(slab):
    """However small: residuals need not be smaller than the round-off of the body's forces."""
    load = pressed(slab.mesh, 1.0)
    linear = slab.solve_linear(load.ravel()[slab.free])
    for share in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-8):
        u = slab.solve(share * load).displacement.ravel()[slab.free]
        assert np.linalg.norm(u / share - linear) <= max(0.3 * share, 1e-5) * np.linalg.norm(linear)
    assert not slab.solve(0.0 * load).displacement.any()


def peak_when_nearly_incompressible(element, divisions):
    model = body(element, divisions, (10.0, 10.0, 5.0), poisson=0.499)
    return np.abs(model.solve(pressed(model.mesh, 2.0, radius=5.0)).displacement).max()


@pytest.fixture(scope="module")
def peak_of_a_fine_mesh():
    return peak_when_nearly_incompressible("hex20", (8, 8, 5))


def test_only_plain_hexahedra_lock(element, peak_of_a_fine_mesh):
    ratio = peak_when_nearly_incompressible(element, (6, 6, 4)) / peak_of_a_fine_mesh
    assert ratio < 0.5 if element == "hex8" else ratio == pytest.approx(1.0, abs=0.03)


def smooth(x):
    """A large smooth shear (..., 3) mm that leaves the bottom of a block in place, and volumes."""
    y, z = x[..., 1], x[..., 2]
    return 0.2 * z[..., None] * np.stack([np.sin(2 * y + z), np.sin(2 * z), 0 * z], axis=-1)


def stretched(x):
    """The same, and a change of volume."""
    z = x[..., 2]
    return smooth(x) + 0.05 * (z**2 * (1 + np.sin(2 * x[..., 0])))[..., None] * np.array([0, 0, 1])


def slope_of(field, X):
    """Deformation gradients (..., 3, 3) of a displacement at points (..., 3) mm."""
    h = 1e-4
    slope = [(field(X + step) - field(X - step)) / (2 * h) for step in h * np.eye(3)]
    return np.eye(3) + np.stack(slope, axis=-1)


def manufactured(element, divisions, field):
    """Model and its equilibrium (n, 3) mm under the load that goes with a displacement.

    The load does the virtual work of the exact stress, which is integrated by 4x4x4 points.
    """
    model = body(element, (divisions,) * 3, (1.0, 1.0, 1.0))
    mesh = model.mesh
    gradients, weights = volume_quadrature(mesh.nodes, mesh.elements, 4)
    F = slope_of(field, at_points(mesh, mesh.nodes))
    J, T = np.linalg.det(F)[..., None, None], np.swapaxes(np.linalg.inv(F), 2, 3)
    mu, lam = model.law.at(0)
    P = mu * (F - T) + lam / 2 * (J**2 - 1) * T
    load = np.zeros_like(mesh.nodes)
    np.add.at(load, mesh.elements, np.einsum("eq,eqij,eqaj->eai", weights, P, gradients))
    return model, model.solve(load).displacement


def at_points(mesh, values):
    """Values (e, 64, ...) at 4x4x4 points of elements, of those at the nodes (n, ...)."""
    kind = kind_of(mesh.elements)
    N, _ = kind.shape(kind.rule(4)[0])
    return np.einsum("qa,ea...->eq...", N, values[mesh.elements])


def manufactured_error(element, divisions, field=smooth):
    """Relative L2 error of the displacement of ``manufactured``."""
    model, u = manufactured(element, divisions, field)
    _, weights = volume_quadrature(model.mesh.nodes, model.mesh.elements, 4)
    exact = field(at_points(model.mesh, model.mesh.nodes))
    away = at_points(model.mesh, u) - exact
    error, size = (np.sum(weights[..., None] * values**2) for values in (away, exact))
    return np.sqrt(error / size)


def stress_error(element, divisions, field):
    """Relative error of the von Mises stress at the nodes of ``manufactured``."""
    model, u = manufactured(element, divisions, field)
    nodes, found = model.mesh.nodes, np.empty(len(u))
    recovery = stress_recovery(nodes, model.mesh.elements, model.law, model.mesh.region)
    nodal_von_mises(recovery, u, None, NO_CONTACT, found)
    law = model.law.at(0)
    exact = [von_mises(law, tuple(F.ravel())) for F in slope_of(field, nodes)]
    return np.linalg.norm(found - exact) / np.linalg.norm(exact)


def test_errors_shrink_with_the_mesh_at_the_rate_of_the_element(element):
    """In L2 with the square of the size of linear elements, with the cube of quadratic ones'."""
    divisions, order = (6, 2.0) if element == "hex8" else (3, 3.0)
    coarse, fine = (manufactured_error(element, k * divisions) for k in (1, 2))
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.2)
    assert fine < 5e-3


def test_a_pressure_that_changes_is_followed_by_tetrahedra_to_second_order():
    """Most of it is one number per element; hexahedra follow it to third order."""
    for element, order in (("hex20", 3.0), ("tet10", 2.0)):
        coarse, fine = (manufactured_error(element, k, stretched) for k in (3, 6))
        assert np.log2(coarse / fine) == pytest.approx(order, abs=0.2)


@pytest.mark.parametrize(
    ("element", "field", "least"),
    [
        ("hex20", smooth, 3.0),
        ("hex20", stretched, 3.0),
        ("tet10", smooth, 2.0),
        ("tet10", stretched, 1.2),  # a pressure that changes they follow to first order
    ],
)
def test_stress_at_the_nodes_converges(element, field, least):
    coarse, fine = (stress_error(element, k, field) for k in (3, 6))
    assert np.log2(coarse / fine) > least
    assert fine < 0.03
