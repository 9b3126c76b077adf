"""The tip's law in series with a footprint, and how its energy changes with place and centre."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import root
from scipy.special import j0, jv

from palpate.shared.mechanics import tip
from palpate.shared.mechanics.viscosity import step_weights

from .material_point import TISSUES

TISSUE = TISSUES["neo-hookean"]
TIP = tip.tip_of(2.0, TISSUE)
LAW = TIP.local_law(1.0 / TIP.radius, np.inf)
DEPTHS = (1e-6, 1e-3, 0.05, 0.3, 0.8, 1.6)


def slope(function, x, h):
    near, far = function(x + h) - function(x - h), function(x + 2 * h) - function(x - 2 * h)
    return (8 * near - far) / (12 * h)


@pytest.mark.parametrize("past", [(0.0, 0.0), (0.2, 0.4)], ids=["at once", "in time"])
@pytest.mark.parametrize("depth", DEPTHS)
def test_force_and_stiffness_are_derivatives_of_the_energy(depth, past):
    force, stiffness, energy = tip.push(*LAW, *past, depth)
    if past[1] and depth < 0.05:
        assert force == stiffness == energy == 0.0
        return
    h = 1e-3 * depth
    assert slope(lambda d: tip.push(*LAW, *past, d)[2], depth, h) == pytest.approx(force, rel=1e-6)
    found = slope(lambda d: tip.push(*LAW, *past, d)[0], depth, h)
    assert found == pytest.approx(stiffness, rel=1e-6)


@pytest.mark.parametrize("depth", DEPTHS)
def test_the_approach_is_the_inverse_of_the_force(depth):
    force, *_ = tip.squeeze(*LAW, depth)
    assert tip.approach(*LAW, force) == pytest.approx(depth, rel=1e-9)


def test_with_a_footprint_on_a_half_space_it_is_hertzs_law():
    """A half-space moves by ``RELIEF F / (E* R)`` under a footprint of the force."""
    beta, relief = LAW
    for depth in (0.01, 0.1, 0.3):
        force = 4 / 3 * TIP.modulus * np.sqrt(TIP.radius) * depth**1.5
        under = tip.RELIEF * force / (TIP.modulus * TIP.radius)
        assert tip.squeeze(beta, relief, depth - under)[0] == pytest.approx(force, rel=1e-9)


def test_an_edge_dents_as_twice_the_force_does_and_more_and_further_away_it_is_not_felt():
    psi = 1.29 - (0.08 - 0.5 * TISSUE.poisson) / (1.0 - TISSUE.poisson)
    softer = (1.0 + psi) / 2.0
    at_edge, away = (TIP.local_law(1.0 / TIP.radius, edge) for edge in (0.0, 4.0 * TIP.radius))
    for force in (0.01, 1.0):
        assert tip.approach(*at_edge, force) == pytest.approx(
            softer * tip.approach(*LAW, 2 * force)
        )
        assert tip.approach(*away, force) == pytest.approx(tip.approach(*LAW, force), rel=1e-8)
    blunt = TIP.local_law(1.0 / TIP.radius, TIP.image_distance(0.0, 0.3))
    assert LAW[0] < blunt[0] < at_edge[0]


PASTS = pytest.mark.parametrize(
    "past",
    [(1.0, 0.0, 0.0), (0.0, 0.1, 0.15)],
    ids=["at once", "in time, without relief"],
)


def law_at(edge, past):
    """Beta, relief, loss, held; and the energy at a depth."""
    relieved, loss, before = past
    beta, relief = TIP.local_law(1.0 / TIP.radius, edge)
    law = beta, relieved * relief, loss, tip.held(beta, before)
    return law, lambda d: (1.0 - loss) * tip.squeeze(*law[:2], d)[2] - law[3] * d


@PASTS
def test_how_the_law_fades_from_an_edge_is_a_derivative(past):
    edge, depth, found, h = 0.2, 0.3, np.empty(3), 1e-3
    law, own = law_at(edge, past)
    assert tip.push(*law, depth)[0] == pytest.approx(slope(own, depth, h), rel=1e-8)
    TIP.fading(edge, law, depth, found)

    def energy(s):
        return law_at(s, past)[1](depth)

    assert found[0] == pytest.approx(slope(energy, edge, h), rel=1e-8)
    assert found[1] == pytest.approx(
        slope(lambda s: tip.push(*law_at(s, past)[0], depth)[0], edge, h), rel=1e-8
    )
    second = (energy(edge + h) - 2 * energy(edge) + energy(edge - h)) / h**2
    assert found[2] == pytest.approx(second, rel=1e-4)


@pytest.mark.parametrize("share", [0.9, 0.5, 0.001])
def test_a_relaxed_force_leans_as_it_did(share):
    """Down to no force at all, where contact ends."""
    depth, found, before = 0.3, np.empty(3), np.empty(3)
    beta, relief = TIP.local_law(1.0 / TIP.radius, 0.2)
    whole = tip.squeeze(beta, relief, depth)[0]
    TIP.fading(0.2, (beta, relief, 0.0, 0.0), depth, before)
    law = beta, relief, 0.1, (0.9 - share) * whole
    TIP.fading(0.2, law, depth, found)
    assert tip.push(*law, depth)[0] == pytest.approx(share * whole, rel=1e-9)
    assert found[0] == pytest.approx(share * before[0], rel=1e-9)


def test_the_relief_is_the_mean_displacement_of_a_half_space_under_its_footprint():
    """Of the waves of the pressure, ``u(k) = 2 P(k) / (E* k)``; its transform in closed form."""

    def transform(k):
        # (1 - r^4)^2 = 1 - 2 r^4 + r^8, and int r^(n+1) J_0(k r) dr by quadrature
        return quad(lambda r: (1 - r**4) ** 2 * r * j0(k * r), 0, 1, limit=200)[0]

    whole = quad(lambda k: transform(k) ** 2, 0, 40, limit=400)[0]
    assert whole / (np.pi * transform(0.0) ** 2) == pytest.approx(tip.RELIEF, rel=1e-4)
    assert jv(0, 0.0) == 1.0


def test_the_law_relaxes_as_plane_strain_does_at_constant_bulk_modulus():
    tissue = TISSUE.model_copy(update={"prony": ((0.3, 0.1), (0.2, 1.0))})
    own, time = tip.tip_of(2.0, tissue), step_weights(tissue.prony, 1e9)
    loss, past = tip.history(own, np.zeros(1), time)
    mu, bulk = TISSUE.young / 2.9, TISSUE.young / 0.3  # of a Poisson's ratio of 0.45
    young = 9 * bulk * mu / 2 / (3 * bulk + mu / 2)
    poisson = young / mu - 1
    left = young / (1 - poisson**2)
    assert tip.held(LAW[0], past) == 0.0
    assert 1.0 - loss == pytest.approx(left / own.modulus, rel=1e-6)


def test_a_held_law_remembers_and_forgets():
    tissue = TISSUE.model_copy(update={"prony": ((0.3, 0.1),)})
    own, dent, forces = tip.tip_of(2.0, tissue), np.zeros(1), []
    elastic = tip.squeeze(*LAW, 0.3)[0]
    for dt in (0.0, 0.02, 0.05, 0.2, 10.0):
        time = step_weights(tissue.prony, dt)
        loss, past = tip.history(own, dent, time)
        law = *LAW, loss, tip.held(LAW[0], past)
        forces.append(tip.push(*law, 0.3)[0])
        dent = tip.dented(dent, time, law, forces[-1])
        assert tip.held(LAW[0], dent[-1]) == pytest.approx(elastic, rel=1e-12)
    lost = own.lost * 0.3 * (1 - np.exp(-np.cumsum([0.0, 0.02, 0.05, 0.2, 10.0]) / 0.1))
    np.testing.assert_allclose(forces, elastic * (1 - lost), rtol=1e-9)


class Bumpy:
    """A small linear body whose contact sees a curved surface, of which all is known.

    It may have an edge, ``away`` mm from the origin, and a past.
    """

    def __init__(self, rng, away, past=(1.0, 0.0, 0.0)):
        self.away, self.inwards = away, np.array([0.8, 0.6]) * np.isfinite(away)
        self.past = past
        A = rng.standard_normal((8, 8))
        self.K = 20.0 * (A @ A.T / 8 + np.eye(8))
        self.U = 0.4 * rng.standard_normal((6, 3, 8))  # mean, and its derivatives 1, 2, 11, 12, 22
        self.bent = np.array([[0.12, 0.03], [0.03, -0.05]])

    def surface(self, X, u):
        """The smoothed surface, its slopes (2, 3) and second derivatives (2, 2, 3)."""
        s = np.array([X[0], X[1], X[0] ** 2 / 2, X[0] * X[1], X[1] ** 2 / 2])
        rest = np.array([*X, -0.5 * X @ self.bent @ X])
        mean = self.U[0] + np.tensordot(s, self.U[1:], 1)
        one = self.U[1] + X[0] * self.U[3] + X[1] * self.U[4]
        two = self.U[2] + X[0] * self.U[4] + X[1] * self.U[5]
        slopes = np.hstack([np.eye(2), -(self.bent @ X)[:, None]]) + np.stack([one @ u, two @ u])
        curved = np.array([[self.U[3] @ u, self.U[4] @ u], [self.U[4] @ u, self.U[5] @ u]])
        curved[..., 2] -= self.bent
        return rest + mean @ u, slopes, curved, mean, (one, two)

    def solve(self, c):
        """Stationary state and place, and energy, for a tip at c."""

        def gradient(z):
            u, X = z[:8], z[8:]
            m, slopes, _, mean, _ = self.surface(X, u)
            d = c - m
            gap = np.linalg.norm(d)
            force = tip.push(*self.law(X), TIP.radius - gap)[0]
            fading = self.fading(X, TIP.radius - gap)[0] * self.inwards
            return np.concatenate(
                [self.K @ u + force * mean.T @ d / gap, slopes @ d * force / gap + fading]
            )

        z = root(gradient, np.zeros(10), tol=1e-13).x
        u, X = z[:8], z[8:]
        gap = np.linalg.norm(c - self.surface(X, u)[0])
        stored = law_at(self.away + self.inwards @ X, self.past)[1](TIP.radius - gap)
        return u, X, 0.5 * u @ self.K @ u + stored

    def law(self, X):
        return law_at(self.away + self.inwards @ X, self.past)[0]

    def fading(self, X, depth):
        changes = np.empty(3)
        TIP.fading(self.away + self.inwards @ X, self.law(X), depth, changes)
        return changes


FROM_AN_EDGE = pytest.mark.parametrize("away", [np.inf, 0.3], ids=["inside", "near an edge"])


@FROM_AN_EDGE
@PASTS
def test_place_and_force_follow_the_centre(away, past, rng):
    """Beside differences of the energy, and of the place where it is stationary."""
    body, c = Bumpy(rng, away, past), np.array([0.1, -0.2, TIP.radius - 0.5])
    u, X, _ = body.solve(c)
    m, slopes, curved, mean, turned = body.surface(X, u)
    gap = float(np.linalg.norm(c - m))
    normal = (c - m) / gap
    seen = np.vstack([mean, normal @ turned[0], normal @ turned[1]])
    force, stiffness, _ = tip.push(*body.law(X), TIP.radius - gap)
    fading = body.fading(X, TIP.radius - gap)
    g, H = np.empty(tip.SEEN), np.empty((tip.SEEN, tip.SEEN))
    M = np.ascontiguousarray(seen @ np.linalg.solve(body.K, seen.T))
    tip.settle(
        M,
        force,
        stiffness,
        gap,
        normal,
        normal,
        slopes,
        curved @ normal,
        body.inwards,
        fading,
        g,
        H,
    )
    follows, tangent = np.empty((2, 3)), np.empty((3, 3))
    tip.follow(H, np.zeros(2), follows, tangent)
    np.testing.assert_allclose(g[:2], 0.0, atol=1e-9)
    h = 1e-3
    for axis, step in enumerate(h * np.eye(3)):
        (_, ahead, most), (_, behind, least) = body.solve(c + step), body.solve(c - step)
        assert g[2 + axis] == pytest.approx((most - least) / (2 * h), rel=1e-4, abs=1e-5)
        np.testing.assert_allclose(follows[:, axis], (ahead - behind) / (2 * h), atol=1e-5)
    for i, j in ((0, 0), (1, 1), (2, 2), (0, 2), (1, 2), (0, 1)):
        a, b = h * np.eye(3)[[i, j]]
        corners = [
            body.solve(c + s * a + t * b)[2] for s, t in ((1, 1), (1, -1), (-1, 1), (-1, -1))
        ]
        second = (corners[0] - corners[1] - corners[2] + corners[3]) / (4 * h * h)
        assert tangent[i, j] == pytest.approx(-second, abs=2e-4 * np.abs(tangent).max())


@FROM_AN_EDGE
def test_a_step_leads_to_the_place(away, rng):
    """From a place and a normal beside the right ones, the error falls quadratically."""
    body, c = Bumpy(rng, away), np.array([0.1, -0.2, TIP.radius - 0.5])
    known, exact, _ = body.solve(c)
    right, errors = c - body.surface(exact, known)[0], []
    for beside in (0.04, 0.02):
        X = exact + beside * np.array([0.6, -0.8])
        normal = right / np.linalg.norm(right) + beside * np.array([0.5, 0.5, 0.0])
        normal /= np.linalg.norm(normal)

        def gradient(u, X=X, normal=normal):
            m, *_, mean, _ = body.surface(X, u)
            depth = TIP.radius - normal @ (c - m)
            return body.K @ u + tip.squeeze(*body.law(X)[:2], depth)[0] * mean.T @ normal

        u = root(gradient, known, tol=1e-13).x
        m, slopes, curved, mean, turned = body.surface(X, u)
        gap = float(np.linalg.norm(c - m))
        seen = np.vstack([mean, normal @ turned[0], normal @ turned[1]])
        depth = TIP.radius - normal @ (c - m)
        force, stiffness, _ = tip.squeeze(*body.law(X)[:2], depth)
        fading = body.fading(X, depth)
        g, H, moved = np.empty(tip.SEEN), np.empty((tip.SEEN, tip.SEEN)), np.empty(2)
        M = np.ascontiguousarray(seen @ np.linalg.solve(body.K, seen.T))
        towards, bent = (c - m) / gap, curved @ normal
        tip.settle(
            M, force, stiffness, gap, normal, towards, slopes, bent, body.inwards, fading, g, H
        )
        tip.next_place(g, H, np.zeros(2), 0.0, moved)
        errors.append(np.linalg.norm(X + moved - exact))
    assert errors[1] < 0.3 * errors[0] < 0.3 * 0.001


@pytest.mark.parametrize("bend", [-2.0, 0.5])
def test_a_wall_bars_where_the_energy_grows_beyond_it(bend):
    g, H, moved = np.array([0.4, 0.2]), np.diag([bend, -1.0]), np.empty(2)
    tip.next_place(g, H, np.zeros(2), 0.0, moved)
    np.testing.assert_allclose(moved, [-0.4 / bend, 0.2])
    wall = np.array([1.0, 0.0])
    tip.next_place(g, H, wall, 0.0, moved)
    np.testing.assert_allclose(moved, [0.0, 0.2])
    assert wall.any()
    tip.next_place(-g, H, wall, 0.0, moved)
    turned = -1.0 if bend > 0.0 else 1.0  # away from the wall at any rate
    np.testing.assert_allclose(moved, turned * np.array([0.4 / bend, -0.2]))
    assert not wall.any()


def test_a_step_that_rises_and_leaves_goes_along_the_wall():
    """Though the energy falls straight out of the surface: Newton's step is not straight."""
    g, H, moved = np.array([-0.1, 1.0]), np.array([[-1.0, 0.9], [0.9, -2.0]]), np.empty(2)
    wall = np.array([1.0, 0.0])
    tip.next_place(g, H, np.zeros(2), 0.0, moved)
    assert moved @ wall > 0.0
    assert moved @ g > 0.0
    tip.next_place(g, H, wall, 0.0, moved)
    np.testing.assert_allclose(moved, [0.0, 0.5])
    assert wall.any()
