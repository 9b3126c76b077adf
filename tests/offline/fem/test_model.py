"""The full model of every element against mechanics that is known exactly."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.sparse.linalg import spsolve

from palpate.offline.fem.mesh import Mesh, build_mesh
from palpate.offline.fem.model import FullModel, NoEquilibrium
from palpate.offline.fem.potential import Potential
from palpate.offline.scenes import find_scene
from palpate.shared.geometry.elements import HEX_EDGES, gauss, hexahedron, shape
from palpate.shared.geometry.quadrature import surface_quadrature, volume_quadrature
from palpate.shared.mechanics import tissue
from palpate.shared.mechanics.footprint import footprint
from palpate.shared.mechanics.neo_hookean import NeoHookeanTissue

YOUNG, POISSON = 15.0, 0.45
HEX8 = ("hex8", "hex8-mean-dilatation", "hex8-fbar")
ELEMENTS = (*HEX8, "hex20")


@pytest.fixture(params=ELEMENTS)
def element(request):
    return request.param


def block(element, divisions=(3, 3, 3), size=(3.0, 3.0, 3.0)) -> Mesh:
    """A box that is clamped at its bottom."""
    scene = find_scene("quick")
    geometry = scene.geometry.model_copy(
        update={"element": element, "divisions": divisions, "size": size}
    )
    return build_mesh(scene.model_copy(update={"geometry": geometry}))


def distorted(mesh: Mesh, rng, by=0.2) -> Mesh:
    """The mesh with its inner corners moved, edges kept straight."""
    nodes = mesh.nodes.copy()
    inner = np.setdiff1d(mesh.elements[:, :8], mesh.faces)
    nodes[inner] += rng.uniform(-by, by, (len(inner), 3))
    if mesh.elements.shape[1] == 20:
        ends = mesh.elements[:, np.array(HEX_EDGES)]
        nodes[mesh.elements[:, 8:]] = nodes[ends].mean(axis=2)
    return replace(mesh, nodes=nodes)


def free(mesh: Mesh) -> Mesh:
    """The mesh with nothing clamped."""
    return replace(mesh, clamped=np.zeros_like(mesh.clamped))


def full_model(mesh, element, poisson=POISSON):
    tissue = NeoHookeanTissue(law="neo-hookean", young=YOUNG, poisson=poisson)
    return FullModel(mesh, element, tissue)


def internal_force(model, displacement):
    force = np.empty(displacement.size)
    energy, _ = model.internal(displacement.ravel(), force)
    return energy, force


def some_displacement(mesh, rng, size=0.3):
    """A smooth large deformation plus noise."""
    bend = size * np.column_stack(
        [np.sin(mesh.nodes[:, 2]), np.cos(mesh.nodes[:, 0]), 0.5 * mesh.nodes[:, 1]]
    )
    return bend + 0.03 * rng.standard_normal(mesh.nodes.shape)


def pressed(mesh, pressure, at=None, radius=2.0):
    """Load of a footprint in the middle of a block's top, straight down."""
    top = mesh.nodes.max(axis=0) * [0.5, 0.5, 1.0] if at is None else np.asarray(at)
    nodal = np.empty(len(mesh.nodes))
    footprint(
        surface_quadrature(mesh.nodes, mesh.faces), top, np.array([0.0, 0.0, 1.0]), radius, nodal
    )
    return np.outer(pressure * nodal, [0.0, 0.0, -1.0])


@pytest.mark.parametrize("shrunk", [1.0, 1.5, np.nan])
def test_inverted_tissue_has_infinite_energy(element, shrunk):
    """At det F = 0, det F < 0, and where that is not a number."""
    mesh = block(element)
    assert internal_force(full_model(mesh, element), -shrunk * mesh.nodes)[0] == tissue.INVERTED


def solve_prescribed(model, dofs, values, increments=4):
    """Displacement of an unclamped model whose ``dofs`` are moved to ``values``; no load."""
    u = np.zeros(model.mesh.nodes.size)
    rest = np.setdiff1d(np.arange(len(u)), dofs)
    for fraction in np.linspace(0, 1, increments + 1)[1:]:
        for _ in range(8):
            K = model.stiffness(u)[rest].tocsc()
            moved = fraction * values - u[dofs]
            out_of_balance = internal_force(model, u)[1][rest] + K[:, dofs] @ moved
            u[dofs] += moved
            u[rest] -= spsolve(K[:, rest], out_of_balance)
    return u.reshape(-1, 3)


# --- consistency -----------------------------------------------------------------------------


def test_patch_test(element, rng):
    """A linear displacement of the boundary is followed exactly inside a distorted mesh."""
    mesh = free(distorted(block(element), rng))
    gradient = rng.uniform(-0.2, 0.2, (3, 3))
    exact = mesh.nodes @ gradient.T
    boundary = np.unique(mesh.faces)
    dofs = (3 * boundary[:, None] + np.arange(3)).ravel()
    assert len(boundary) < len(mesh.nodes)
    model = full_model(mesh, element)
    u = solve_prescribed(model, dofs, exact[boundary].ravel())
    assert np.abs(u - exact).max() <= 1e-12 * np.abs(exact).max()
    # Inside, the internal forces of the elements cancel; on the boundary they are the traction.
    _, force = internal_force(model, exact)
    inside = np.setdiff1d(np.arange(len(mesh.nodes)), boundary)
    assert np.abs(force.reshape(-1, 3)[inside]).max() <= 1e-12 * np.abs(force).max()


def test_force_is_the_derivative_of_the_energy(element, rng):
    mesh = free(distorted(block(element, (2, 2, 2)), rng))
    model = full_model(mesh, element)
    u = some_displacement(mesh, rng)
    _, force = internal_force(model, u)
    for _ in range(5):
        direction = rng.standard_normal(u.shape)
        slope = fourth_order(lambda s, d=direction: internal_force(model, u + s * d)[0], 1e-3)
        assert force @ direction.ravel() == pytest.approx(
            slope, abs=1e-7 * np.linalg.norm(force) * np.linalg.norm(direction)
        )


def test_tangent_is_the_derivative_of_the_force(element, rng):
    mesh = free(distorted(block(element, (2, 2, 2)), rng))
    model = full_model(mesh, element)
    u = some_displacement(mesh, rng)
    K = model.stiffness(u.ravel())
    for _ in range(5):
        direction = rng.standard_normal(u.shape)
        slope = fourth_order(lambda s, d=direction: internal_force(model, u + s * d)[1], 1e-3)
        error = K @ direction.ravel() - slope
        assert np.abs(error).max() <= 1e-7 * np.abs(slope).max()


def fourth_order(function, step):
    near = function(step) - function(-step)
    far = function(2 * step) - function(-2 * step)
    return (8 * near - far) / (12 * step)


def test_tangent_is_symmetric(element, rng):
    mesh = distorted(block(element, (2, 2, 2)), rng)
    model = full_model(mesh, element)
    K = model.stiffness(some_displacement(mesh, rng).ravel())
    assert np.abs((K - K.T).toarray()).max() <= 1e-13 * np.abs(K.data).max()


def test_rest_stiffness_has_six_rigid_motions_and_no_more(element, rng):
    mesh = free(distorted(block(element, (2, 2, 2)), rng))
    model = full_model(mesh, element)
    values = np.linalg.eigvalsh(model.rest_stiffness.toarray())
    assert np.abs(values[:6]).max() < 1e-11 * values[-1]
    assert values[6] > 1e-4 * values[-1]


def test_rigid_rotation_is_free_of_force_and_energy(element, rng):
    mesh = free(distorted(block(element, (2, 2, 2)), rng))
    Q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    Q *= np.linalg.det(Q)
    model = full_model(mesh, element)
    energy, force = internal_force(model, mesh.nodes @ (Q - np.eye(3)).T + [1.0, 2.0, 3.0])
    assert abs(energy) <= 1e-12
    assert np.abs(force).max() <= 1e-12 * YOUNG


def test_forces_of_a_deformed_body_balance(element, rng):
    mesh = free(distorted(block(element, (2, 2, 2)), rng))
    u = some_displacement(mesh, rng)
    _, force = internal_force(full_model(mesh, element), u)
    force = force.reshape(-1, 3)
    assert np.abs(force.sum(axis=0)).max() <= 1e-12 * np.abs(force).max()
    moment = np.cross(mesh.nodes + u, force).sum(axis=0)
    assert np.abs(moment).max() <= 1e-11 * np.abs(force).max()


def test_clamped_nodes_stay(element):
    mesh = block(element)
    solution = full_model(mesh, element).solve(pressed(mesh, 5.0, radius=1.0))
    assert not solution.displacement[mesh.clamped].any()
    assert np.abs(solution.displacement).max() > 0.05


# --- solutions -------------------------------------------------------------------------------


@pytest.mark.parametrize("stretch", [0.6, 1.5])
def test_uniaxial_tension(element, stretch, rng):
    """A bar between frictionless plates: homogeneous, with the lateral stretch of the law."""
    mesh = free(distorted(block(element, (2, 2, 3), (2.0, 2.0, 3.0)), rng))
    x, y, z = mesh.nodes.T
    number = np.arange(len(mesh.nodes))
    held = [3 * number[x == 0], 3 * number[y == 0] + 1, 3 * number[z == 0] + 2]
    moved = 3 * number[np.isclose(z, 3.0)] + 2
    dofs = np.concatenate([*held, moved])
    values = np.where(np.isin(dofs, moved), 3.0 * (stretch - 1), 0.0)
    model = full_model(mesh, element)
    u = solve_prescribed(model, dofs, values)

    mu, lam = model.law.at(0)

    def pulled(lateral):
        """Nominal stresses (lateral, axial) of the law at principal stretches."""
        volumetric = lam / 2 * ((stretch * lateral**2) ** 2 - 1) - mu
        return mu * lateral + volumetric / lateral, mu * stretch + volumetric / stretch

    lateral = brentq(lambda s: pulled(s)[0], 0.3, 2.0, xtol=1e-15)
    expected = mesh.nodes * [lateral - 1, lateral - 1, stretch - 1]
    assert np.abs(u - expected).max() <= 1e-11
    force = internal_force(model, u)[1][moved].sum()
    assert force == pytest.approx(4.0 * pulled(lateral)[1], rel=1e-11)


def test_newton_ends_quadratically(element, monkeypatch):
    mesh = block(element, (4, 4, 2), (10.0, 10.0, 5.0))
    model = full_model(mesh, element)
    load = pressed(mesh, 6.0)
    states = []
    factorise = Potential.factorise

    def recorded(potential, u, shift):
        states.append(u.copy())
        return factorise(potential, u, shift)

    monkeypatch.setattr(Potential, "factorise", recorded)
    solution = model.solve(load, reuse=0.0)
    states.append(solution.displacement.ravel()[model.free])
    residuals = [model.internal_free(u) - load.ravel()[model.free] for u in states]
    norms = np.linalg.norm(residuals, axis=1) / np.linalg.norm(load)
    assert solution.load_steps == 1
    assert len(norms) <= 10
    # The exponent that carries each residual to the next, until round-off ends it.
    tail = np.flatnonzero((norms[:-1] < 0.1) & (norms[:-1] > 1e-6))
    assert len(tail) >= 1
    orders = np.log(norms[tail + 1]) / np.log(norms[tail])
    assert (orders > 1.7).all()


def test_solution_is_in_equilibrium(element):
    mesh = block(element, (4, 4, 2), (10.0, 10.0, 5.0))
    model = full_model(mesh, element)
    load = pressed(mesh, 6.0)
    solution = model.solve(load)
    _, force = internal_force(model, solution.displacement)
    out_of_balance = (force - load.ravel())[model.free]
    assert np.linalg.norm(out_of_balance) <= 1e-9 * np.linalg.norm(load)
    assert 0 < solution.min_jacobian < 1
    assert np.abs(solution.displacement).max() > 0.5


def test_way_to_the_solution_does_not_matter(element):
    mesh = block(element, (4, 4, 2), (10.0, 10.0, 5.0))
    model = full_model(mesh, element)
    load = pressed(mesh, 5.0)
    jump = model.solve(load).displacement
    halfway = model.solve(load / 2).displacement
    thrifty = model.solve(load, start=halfway, reuse=0.3).displacement
    assert np.abs(thrifty - jump).max() <= 1e-7


def test_no_load_no_displacement(element):
    mesh = block(element)
    solution = full_model(mesh, element).solve(np.zeros_like(mesh.nodes))
    assert not solution.displacement.any()


@pytest.mark.parametrize("pressure", [1e6, -1e8, np.nan])
def test_a_load_without_equilibrium_is_reported(element, pressure, monkeypatch):
    mesh = block(element, (4, 4, 2), (10.0, 10.0, 5.0))
    model = full_model(mesh, element)
    corrections = []
    correct = Potential.correct

    def counted(potential, residual, step):
        corrections.append(1)
        correct(potential, residual, step)

    monkeypatch.setattr(Potential, "correct", counted)
    with pytest.raises(NoEquilibrium, match="no equilibrium found beyond 0 %"):
        model.solve(pressed(mesh, pressure))
    assert len(corrections) <= 7 * 40  # load steps 1, 1/2, ... 1/64 of at most 40 iterations
    # The failure leaves nothing behind.
    assert model.solve(pressed(mesh, 2.0)).load_steps == 1


def test_small_loads_are_answered_in_proportion(element):
    """However small: residuals need not be smaller than the round-off of the body's forces."""
    mesh = block(element, (4, 4, 2), (10.0, 10.0, 5.0))
    model = full_model(mesh, element)
    load = pressed(mesh, 1.0)
    linear = model.solve_linear(load.ravel()[model.free])
    for share in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-8):
        u = model.solve(share * load).displacement.ravel()[model.free]
        assert np.linalg.norm(u / share - linear) <= max(0.3 * share, 1e-5) * np.linalg.norm(linear)


def peak_when_nearly_incompressible(element, divisions):
    mesh = block(element, divisions, (10.0, 10.0, 5.0))
    model = full_model(mesh, element, poisson=0.499)
    return np.abs(model.solve(pressed(mesh, 2.0, radius=5.0)).displacement).max()


def test_only_plain_hexahedra_lock(element):
    fine = peak_when_nearly_incompressible("hex20", (8, 8, 5))
    ratio = peak_when_nearly_incompressible(element, (6, 6, 4)) / fine
    assert ratio < 0.5 if element == "hex8" else ratio == pytest.approx(1.0, abs=0.03)


def smooth(x):
    """A large smooth shear (..., 3) mm that leaves the bottom of a block in place, and volumes."""
    y, z = x[..., 1], x[..., 2]
    return 0.2 * z[..., None] * np.stack([np.sin(2 * y + z), np.sin(2 * z), 0 * z], axis=-1)


def manufactured_error(element, divisions):
    """Relative L2 error of the equilibrium under the load that goes with ``smooth``.

    The load does the virtual work of the exact stress, which is integrated by 4x4x4 points.
    """
    mesh = block(element, (divisions,) * 3, (1.0, 1.0, 1.0))
    model = full_model(mesh, element)
    gradients, weights = volume_quadrature(mesh.nodes, mesh.elements, 4)
    N, _ = shape(hexahedron(mesh.elements.shape[1]), gauss(4, 3)[0])
    X = np.einsum("qa,eai->eqi", N, mesh.nodes[mesh.elements])
    h = 1e-4
    slope = [(smooth(X + step) - smooth(X - step)) / (2 * h) for step in h * np.eye(3)]
    F = np.eye(3) + np.stack(slope, axis=-1)
    J, T = np.linalg.det(F)[..., None, None], np.swapaxes(np.linalg.inv(F), 2, 3)
    mu, lam = model.law.at(0)
    P = mu * (F - T) + lam / 2 * (J**2 - 1) * T
    load = np.zeros_like(mesh.nodes)
    np.add.at(load, mesh.elements, np.einsum("eq,eqij,eqaj->eai", weights, P, gradients))
    u = model.solve(load).displacement
    away = np.einsum("qa,eai->eqi", N, u[mesh.elements]) - smooth(X)
    return np.sqrt(
        np.sum(weights[..., None] * away**2) / np.sum(weights[..., None] * smooth(X) ** 2)
    )


def test_errors_shrink_with_the_mesh_at_the_rate_of_the_element(element):
    """In L2 with the square of the size of linear elements, with the cube of quadratic ones'."""
    divisions, order = (3, 3.0) if element == "hex20" else (6, 2.0)
    coarse, fine = (manufactured_error(element, k * divisions) for k in (1, 2))
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.2)
    assert fine < 5e-3
