"""The pressure that moves the tissue as far as wanted, and where tissue gives way before.

The latter on a plate whose answer to a load is known.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.fem.sphere import FORCE
from palpate.offline.reduce.load_range import (
    FAR,
    FIRM,
    FOLDING,
    GIVING_WAY,
    MARGIN,
    SHALLOWEST,
    SLIPPING_OFF,
    TILTS,
    UNANSWERED,
    LoadPath,
    bearable_shares,
    bears,
    firm_share,
    limit_load_share,
    load_range,
    moving_part,
    out_of_reach,
    path_independent_share,
    pressure_that_moves,
)
from palpate.offline.scenes import find_scene
from palpate.shared.errors import QueryError
from palpate.shared.geometry.surface import Surface
from palpate.shared.mechanics.footprint import LIMIT_FIELDS, TIP_DEPTH
from palpate.shared.scene import parse_scene

LIMIT = RADIUS = 2.0
EDGE = 5.0


def spring(law, limit=np.inf):
    """One node that moves by ``law(pressure)`` and has no equilibrium beyond ``limit``."""
    asked = []

    def solve(pressure, start):
        asked.append(pressure)
        if pressure > limit:
            raise NoEquilibrium("load: too much")
        return np.array([[0.0, 0.0, law(pressure)]])

    return solve, asked


@pytest.mark.parametrize("guess", [0.01, 1.0, 40.0])
@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
def test_it_finds_the_pressure_of_a_power_law(power, guess):
    solve, asked = spring(lambda p: 2.0 * p**power)
    pressure, exponent, _ = pressure_that_moves(solve, 3.0, guess)
    assert pressure == pytest.approx(1.5 ** (1 / power), rel=1e-6)
    assert exponent == pytest.approx(power, rel=1e-6)
    assert len(asked) <= 12
    solve, asked = spring(lambda p: 2.0 * p**power)
    again, *_ = pressure_that_moves(solve, 3.0, 0.97 * pressure, exponent=power)
    assert again == pytest.approx(pressure)
    assert len(asked) == 1  # a known exponent saves the second solution


def test_beyond_the_last_equilibrium_it_stops_within_three_percent_or_says_that_there_is_none():
    solve, _ = spring(lambda p: p, limit=0.7)
    assert 0.7 / 1.03 <= pressure_that_moves(solve, 3.0, 2.0)[0] <= 0.7
    solve, asked = spring(lambda p: p, limit=0.0)
    with pytest.raises(NoEquilibrium):
        pressure_that_moves(solve, 3.0, 2.0)
    assert len(asked) < 15


def test_the_path_is_near_the_full_model(problem):
    x = problem.surface.vertices[len(problem.surface.vertices) // 2]
    nodal, normal = problem.unit_load(x)
    force = -nodal[:, None] * normal
    path = LoadPath(problem.model, force.reshape(-1)[problem.model.free])
    limit = load_range(problem, x)[0]
    for share, allowed in ((0.1, 1e-3), (0.5, 0.02), (1.0, 0.1)):
        exact = problem.model.solve(share * limit * force).displacement
        error = np.linalg.norm(path.solve(share * limit, None) - exact)
        assert error <= allowed * np.linalg.norm(exact)


@pytest.mark.parametrize("name", ["problem", "visco_problem"])
def test_the_limit_moves_the_tissue_by_the_indentation_in_the_end(request, name):
    problem = request.getfixturevalue(name)
    wanted = problem.scene.load.max_indentation * problem.scene.geometry.size[2]
    for x in problem.surface.vertices[:: len(problem.surface.vertices) // 4]:
        nodal, normal = problem.unit_load(x)
        limit = load_range(problem, x)[0]
        u = problem.model.relaxed.solve(-limit * nodal[:, None] * normal).displacement
        assert np.linalg.norm(u, axis=1).max() == pytest.approx(wanted, rel=0.02)


STRIP = """
name = "strip"
geometry.kind = "block"
geometry.size = [48.0, 8.0, 6.0]
geometry.divisions = [18, 3, 2]
tissue.law = "neo-hookean"
tissue.young = 15.0
tissue.poisson = 0.45
{past}
support.side = "bottom"
surface.side = "top"
endoscope.radius = 2.0
endoscope.max_tilt = 30.0
load.max_indentation = 0.15
"""


@pytest.mark.parametrize("past", ["", "tissue.prony = [[0.25, 0.1]]"])
def test_the_part_that_moves_has_the_range_of_the_body(past, monkeypatch):
    problem = FullProblem(parse_scene(STRIP.format(past=past)))
    x = np.array([20.0, 4.5, 6.0])
    found = load_range(problem, x)
    nodal, normal = problem.unit_load(x)
    loads = (nodal[:, None] * normal).reshape(-1, 1)[problem.model.free]
    linear = problem.model.filled(problem.model.solve_linear(loads)[:, 0]).reshape(-1, 3)
    part, nodes = moving_part(problem, linear)
    assert len(nodes) == len(part.mesh.nodes) < 0.6 * len(linear)
    np.testing.assert_array_equal(part.mesh.nodes, problem.mesh.nodes[nodes])
    left = np.delete(np.linalg.norm(linear, axis=1), nodes)
    assert left.max() <= 0.02 * np.linalg.norm(linear, axis=1).max()
    monkeypatch.setattr("palpate.offline.reduce.load_range.WHOLE", 0.0)
    np.testing.assert_allclose(found, load_range(problem, x), rtol=0.02)


class Plate:
    """Softening tissue of a flat surface, 10 mm wide, that snaps at a pressure near one corner."""

    lost = np.inf, np.inf
    """Between these pressures no equilibrium is found."""

    def __init__(self, snap):
        x = np.linspace(0.0, 10.0, 21)
        a = np.add.outer(21 * np.arange(20), np.arange(20)).ravel()  # corners of squares
        triangles = np.vstack([np.stack([a, a + 21, a + 22], 1), np.stack([a, a + 22, a + 1], 1)])
        vertices = np.stack([*np.meshgrid(x, x, indexing="ij"), np.zeros((21, 21))], axis=2)
        normals = np.tile([0.0, 0.0, 1.0], (21 * 21, 1))
        self.surface = Surface(vertices.reshape(-1, 3), triangles.astype(np.int32), normals)
        self.limits = np.tile(np.eye(LIMIT_FIELDS)[1:4].sum(axis=0), (21 * 21, 1))
        self.limits[:, 0] = LIMIT
        self.models = SimpleNamespace(centres=np.zeros((40, 3)))
        self.scene = SimpleNamespace(endoscope=SimpleNamespace(max_tilt=30.0, radius=RADIUS))
        self.snap = snap

    def press(self, position, pressure, direction):
        moved = pressure**1.8
        if pressure > self.snap and np.hypot(*position[:2]) < 2.0:
            moved *= 1.2
        found = not self.lost[0] < pressure < self.lost[1]
        return SimpleNamespace(
            converged=found, parts=((0, 1.0, np.array([moved if found else np.inf])),)
        )


def borne(search, atlas, rng):
    """Shares of the range that a plate or an atlas bears at the vertices."""

    def ask(_, function, rows):
        return [function(atlas, *row) for row in rows]

    return bearable_shares(search, atlas, ask, rng)


@pytest.mark.parametrize("snap", [0.78, 0.98, 1.03])
def test_the_range_ends_before_the_tissue_gives_way_and_only_there(snap, rng):
    plate = Plate(snap * LIMIT)
    shares = borne(GIVING_WAY, plate, rng)
    lowered = shares < 1.0
    away = np.linalg.norm(plate.surface.vertices, axis=1)
    assert lowered[away < 2.0].all()
    assert not lowered[away > 2.0 + GIVING_WAY.reach].any()
    assert (shares[lowered] <= snap / MARGIN).all()


def test_tissue_that_only_softens_and_slips_off_nowhere_keeps_its_range(rng):
    assert (borne(GIVING_WAY, Plate(np.inf), rng) == 1.0).all()
    assert (borne(SLIPPING_OFF, Edge(slip=np.inf), rng) == 1.0).all()


def test_a_trained_slab_hardly_gives_way_in_its_range_and_nothing_slips_off(atlas, rng):
    assert (borne(GIVING_WAY, atlas, rng) >= 0.7).all()
    assert (borne(SLIPPING_OFF, atlas, rng) == 1.0).all()


class Behind:
    """A reduced model that answers as the full one up to a pressure, and the same beyond."""

    def __init__(self, problem, last):
        self.body, self.scene, self.fields = problem.body, problem.scene, self
        self.problem, self.surface, self.last = problem, problem.surface, last

    def press(self, position, pressure, direction):
        load = self.problem.load_vector(Load(position, direction, min(pressure, self.last)))
        return self.problem.model.solve(load).displacement

    def of_mesh(self, displacement):
        return displacement


@pytest.mark.parametrize(("last", "least", "most"), [(1.0, 1.0, 1.0), (0.68, 0.5, 0.75)])
def test_the_range_ends_before_the_full_model_is_elsewhere(last, least, most):
    problem = FullProblem(parse_scene(STRIP.format(past="")))
    corner, outwards = np.array([48.0, 8.0, 6.0]), np.array([0.4, 0.3, -np.sqrt(0.75)])
    limit = 1.3 * problem.model.law.mu[0]
    model = Behind(problem, last * limit)
    assert least <= firm_share(model, corner, outwards, limit) <= most
    soft = 0.99 * FIRM * problem.model.law.mu[0]
    assert firm_share(SimpleNamespace(body=model.body), corner, outwards, soft) == 1.0


def test_the_rim_is_pushed_aside_all_round(rng):
    plate, middle = Plate(np.inf), np.array([5.0, 5.0, 0.0])
    points = FOLDING.points(plate.surface, 7 * TILTS, rng)
    assert len(points) == 7 * TILTS
    for around in points.reshape(-1, TILTS, 3):
        assert np.all(around == around[0])
        assert np.abs(around[0] - middle).max() == 5.0
        turns = []
        for i, point in enumerate(around):
            x, direction, limit = FOLDING.draw(plate, i, point, rng)
            np.testing.assert_array_equal(x, point)
            assert direction[2] == pytest.approx(-np.cos(np.radians(30.0)))
            assert np.linalg.norm(direction) == pytest.approx(1.0)
            assert 0.0 < limit <= LIMIT
            turns.append(np.arctan2(direction[1], direction[0]))
        between = np.diff(np.sort(turns), append=min(turns) + 2.0 * np.pi)
        assert between.max() < 2.0 * 2.0 * np.pi / TILTS


class Side:
    """On which side of the edge the tissue lies."""

    side = None

    def forget(self):
        self.side = None


class Edge(Plate):
    """Tissue with an edge across it that a deep tip carries along, 1 mm at most."""

    blind = False
    """Whether no way leads to an answer on the near side."""

    loose = np.inf
    """Depth from which on a tip that is pressed in at once slips off."""

    lost = np.inf
    """Depth from which on there is no answer over the edge, nor any place below it for the tip."""

    def __init__(self, slip):
        super().__init__(np.inf)
        self.limits[:, TIP_DEPTH] = 1.0
        self.models = SimpleNamespace(centres=np.zeros((100, 3)))
        self.slip = slip

    def new_warm(self):
        return Side()

    def touch(self, position, warm=None):
        if self.blind and warm is not None and position[0] < EDGE:
            raise QueryError("position", "below the surface")
        depth, beyond = RADIUS - position[2], position[0] - EDGE
        if depth > self.lost and abs(beyond) < 1.0:
            if beyond > 0.0:
                raise QueryError("position", "below the surface")
            return SimpleNamespace(converged=False)
        side = np.sign(beyond) or 1.0
        if warm is not None:
            carried = warm.side is not None and depth > self.slip and abs(beyond) < 1.0
            side = warm.side = warm.side if carried else side
        elif depth > self.loose:
            side = 0.0
        return SimpleNamespace(converged=True, parts=((3, 1.0, np.array([depth, side])),))


def test_the_depth_ends_where_the_way_to_a_contact_matters_and_only_there(rng):
    plate = Edge(slip=0.5)
    shares = borne(SLIPPING_OFF, plate, rng)
    lowered = shares < 1.0
    away = np.abs(plate.surface.vertices[:, 0] - EDGE)
    assert lowered[away < 0.5].mean() > 0.9
    assert not lowered[away > FAR + SLIPPING_OFF.reach].any()
    assert (shares[lowered] <= 0.5).all()
    assert (shares[lowered] > 0.3).all()


def test_the_depth_ends_before_positions_without_an_answer(rng):
    plate = Edge(slip=np.inf)
    plate.lost = 0.8
    shares = borne(UNANSWERED, plate, rng)
    beyond = plate.surface.vertices[:, 0] - EDGE
    assert (shares[(beyond > -0.9) & (beyond < -0.1)] < 0.8).all()
    assert (shares >= 0.8 / MARGIN).all()
    assert (shares[np.abs(beyond) > 1.0 + UNANSWERED.reach] == 1.0).all()


def test_the_range_ends_before_loads_without_an_answer():
    plate, down = Plate(np.inf), np.array([0.0, 0.0, -1.0])
    plate.lost = 0.9 * LIMIT, 0.97 * LIMIT
    assert 0.8 / MARGIN <= limit_load_share(plate, np.zeros(3), down, LIMIT) <= 0.9 / MARGIN


@pytest.mark.parametrize(("place", "share", "borne"), [(0, 0.6, 1), (0, 0.9, 0), (9, 0.9, 1)])
def test_a_load_is_borne_up_to_where_the_tissue_gives_way(place, share, borne):
    plate, down = Plate(0.78 * LIMIT), np.array([0.0, 0.0, -1.0])
    assert bears(plate, Load(np.array([place, 0.0, 0.0]), down, share * LIMIT)) == borne


@pytest.mark.parametrize("loose", [0.35, 0.75, 0.9])
def test_the_depth_ends_where_a_tip_pressed_in_at_once_is_elsewhere(loose):
    edge = Edge(slip=np.inf)
    edge.loose = loose
    share = path_independent_share(edge, np.array([EDGE + 0.1, 5.0, 0.0]))
    assert 0.7 * loose < share * MARGIN <= loose


def test_a_way_without_an_answer_tells_nothing():
    edge = Edge(slip=0.5)
    edge.blind = True
    assert path_independent_share(edge, np.array([EDGE + 0.1, 5.0, 0.0])) == 1.0


def test_a_tip_does_not_reach_the_end_of_a_cleft():
    """There a sphere that just touches the surface is far in what cannot be touched."""
    problem = FullProblem(find_scene("turbinate-mri"))
    surface, radius = problem.surface, problem.scene.endoscope.radius
    found = out_of_reach(problem)
    assert 0.01 < found.mean() < 0.04
    assert surface.rim_distance()[found].max() < radius
    at_rest = np.zeros_like(problem.mesh.nodes)
    centres = surface.vertices + radius * surface.normals
    deep = np.array([problem.contact.touch(x, at_rest, FORCE)[2] for x in centres])
    assert (deep[found] > SHALLOWEST / 2).mean() > 0.95
    assert (deep[~found] < 0.1).mean() > 0.99
    assert not out_of_reach(FullProblem(find_scene("quick"))).any()
