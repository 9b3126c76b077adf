"""The range of loads: as far as the scene allows, and no further than the tissue bears it.

At first the range ends at the pressure at which the tissue of the full model moves as far as the
scene says.  The equilibrium path under ``p f`` starts along ``u_1 = K_0^-1 f`` and bends along its
second and third derivative at rest.  Galerkin's solution in these three vectors costs a fraction of
one full solution, and is within two percent of the path while the residual that it leaves in the
full model is small.  Where that is not as far as the scene says, full solutions go on from there.

Near a fold of the load path a small error of the force is a large one of the displacement, and
between the folds of the full and of the reduced model the two lie on different branches: the one
kind of answer that is converged, in range and wrong.  The reduced model is quick enough to be
pressed everywhere, in all directions and a little beyond the range, and shows where its own path
turns, or where it has no answer; the full model's turns close by.  The range is lowered to end
before that.

Where an endoscope pushes the rim of the surface aside, above all at a corner, it can fold a few
elements of the full model that the modes of the reduced one do not tell apart.  There Newton's
method of the full model leads far away from the reduced model's answer, in a dozen corrections,
where otherwise it is at its own after two or three.  A part of the body round the contact shows it,
with the rest where the reduced model has it.

Under the rigid tip a free edge can lie on either side of it, and slips off to the other as the tip
slides on.  There one position has several answers, and which is the right one hangs on the way that
the tip came: reduced and full model need not part from the same one at the same step.  The reduced
model is asked everywhere whether its answers depend on the way, straight in or aslant, and depths
are lowered likewise; and last, that it has an answer at many random positions.  Where the tip
would touch what cannot be touched first, as in a cleft, the range of its depths is next to nothing.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from palpate.offline.fem.mesh import local_thickness, points_of
from palpate.offline.fem.model import FullModel, NoEquilibrium
from palpate.offline.fem.potential import Potential, Projected
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.fem.terms import DeadLoad
from palpate.offline.reduce.ritz import energy_pod, ritz_vectors
from palpate.offline.reduce.sampling import (
    cone,
    farthest,
    random_points,
    random_points_and_rim,
    tangents,
)
from palpate.offline.reduce.window import WHOLE, part_of
from palpate.offline.run.streams import Stage
from palpate.offline.run.workers import read_result
from palpate.offline.validate.queries import Place
from palpate.shared.answer import Answer
from palpate.shared.arrays import Array, Flags, Numbers
from palpate.shared.errors import QueryError
from palpate.shared.geometry.elements import face_kind_of
from palpate.shared.geometry.surface import Surface
from palpate.shared.local_models import Estimators, LocalModels, Mesh
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.footprint import TIP_DEPTH, footprint
from palpate.shared.mechanics.laws import AnyTissue
from palpate.shared.mechanics.tip import approach
from palpate.shared.model import ReducedModel

NEAR = 0.1
"""Relative distance from the wanted displacement at which the pressure is interpolated."""

LEAST = 1e-3

TOLERANCE = 1e-3
"""Residual of solutions, relative to the load: a limit need not be known to a percent."""

MAX_ITERATIONS = 20

SURFACE = 0.9
"""Pressure over the shear modulus from which on the surface itself may give way under a footprint,
which derivatives at rest do not tell: full solutions decide."""

TRUSTED = 0.1
"""Residual left in the full model up to which Galerkin's solution is believed: as a displacement in
the energy at rest, relative to the whole."""

FAINT = 0.02
"""Share of the largest displacement below which a body is held for its load range."""

DEEPEST = 0.8
"""Largest depth of the tip, in radii: its centre must stay outside the undeformed body."""

SHALLOWEST = 0.02
"""Millimetres that the range of depths has at least."""

CELLS = 8
"""Of a face along each axis, at whose corners it is looked at what the tip touches besides."""

SHARES = np.linspace(0.6, 1.1, 11)
"""Of the limit at which each path is solved."""

SUDDEN = 1.0
"""Growth of the exponent of displacement over pressure from one step to the next: softening tissue
has up to .6, a jump by 5 % of the displacement 1."""

MARGIN = 1.1
"""Limit at which tissue gives way, in the full or the reduced model, over the one it gets."""

FIRM = 0.6
"""Pressure over the shear modulus below which no rim folds."""

FIRM_SHARES = np.linspace(1.0, 0.5, 6)
"""Of the limit that are tried, until the full model does not fold."""

CLOSE_BY, DIGIT = 6, 0.05
"""Newton's corrections from the reduced model's answer to the full model's, each with a new tangent
unless the last has gained a digit.  Of 437 largest loads on the rim of a turbinate 415 took up to
4, and 22 took 10 to more than 20."""

BESIDE = 5.0
"""Radii of the endoscope round a contact within which the full model is asked.  Of 15 folds on a
turbinate 3 radii miss 2 and 5 none, in a twelfth of the time of the whole body."""

TILTS = 8
"""Directions in which one point of the rim is pushed."""

DEPTH_SHARES = np.linspace(1.0, 0.1, 7)
"""Of the depth limit that are tried, until one has the same answer by all ways."""

WAYS, FAR, STRIDE = 4, 1.5, 0.5
"""Ways that the tip comes sliding, their length and steps (mm)."""

SAME = 0.1
"""Difference of answers, relative to them, that is not one of equilibria."""

Rng = np.random.Generator
Places = list[tuple[Any, ...]]
Ask = Callable[[str, Callable[..., float], Places], Iterable[float]]
"""Values of a function of the reduced model at places, its further arguments; under a title."""


class LoadPath:
    """The full model in the first three derivatives of the path under ``p load`` (free dofs,)."""

    def __init__(self, model: FullModel, load: Array) -> None:
        self._model = model
        self._load = model.filled(load)
        self._basis, _ = energy_pod(model, ritz_vectors(model, load[:, None]), 3)
        self._q = np.zeros(self._basis.shape[1])

    def solve(self, pressure: float, start: Array | None) -> Array:
        """Displacement (n, 3) mm at a pressure, from the last found unless ``start`` is None."""
        load = pressure * self._load
        path = Projected(self._model, [DeadLoad(load)], self._basis)
        q = np.zeros_like(self._q) if start is None else self._q.copy()
        target = TOLERANCE * float(np.linalg.norm(self._basis.T @ load[self._model.free]))
        status, *_ = newton.newton(
            path, q, np.empty((4, len(q))), target, 0.0, MAX_ITERATIONS, False
        )
        u = self._basis @ q
        if status != newton.CONVERGED or self._residual(u, load) > TRUSTED * np.linalg.norm(q):
            raise NoEquilibrium("load: no equilibrium found along its path")
        self._q = q
        return self._model.filled(u).reshape(-1, 3)

    def _residual(self, u: Array, load: Array) -> float:
        """What is left of a load (3 nodes,) at ``u`` (free dofs,), in the energy at rest."""
        left = load[self._model.free] - self._model.internal_free(u)
        return float(np.sqrt(left @ self._model.solve_linear(left)))


def pressure_that_moves(
    solve: Callable[[float, Array | None], Array],
    wanted: float,
    pressure: float,
    exponent: float | None = None,
    start: Array | None = None,
    stride: float = 2.5,
) -> tuple[float, float, Array | None]:
    """Pressure at which a node moves by ``wanted`` mm, or beyond which there is no equilibrium.

    ``solve`` finds the displacement (n, 3) at a pressure from a first guess or raises
    ``NoEquilibrium``, as this does if there is none at ``LEAST`` of the first guess either. Taken
    and returned: a pressure (kPa), the power of it by which the displacement grows near there, and
    a displacement there. From one pressure to the next it is at most ``stride`` times as large.
    """
    least = LEAST * pressure
    low, high, last, power = 0.0, np.inf, None, 1.0
    state = below = None  # the last state, and that at the pressure ``low``
    while high > 1.03 * low:
        try:
            state = solve(pressure, start)
        except NoEquilibrium:
            if pressure < least:
                raise
            high = pressure
            pressure, start = (low + high) / 2, below
            continue
        moved = float(np.linalg.norm(state, axis=1).max())
        if moved < wanted:
            low, below = pressure, state
        else:
            high = pressure
        if last is not None:
            exponent = np.log(moved / last[1]) / np.log(pressure / last[0])
        power = float(np.clip(1.0 if exponent is None else exponent, 0.4, 6.0))
        enough = pressure * (wanted / moved) ** (1 / power)
        if exponent is not None and abs(moved / wanted - 1) < NEAR:
            return enough, power, state
        last = pressure, moved
        pressure = float(np.clip(enough, 0.3 * pressure, stride * pressure))
        if not low < pressure < high:
            pressure = (low + high) / 2
        start = (pressure / last[0]) ** power * state
    return low, power, below


def moving_part(problem: FullProblem, displacement: Array) -> tuple[FullModel, Numbers]:
    """Model of the part of a body that moves by a displacement (n, 3), and its nodes; held beyond.

    As it is after an infinite time.  Where that is most of the body it is the body.
    """
    size, elements = np.linalg.norm(displacement, axis=1), problem.mesh.elements
    moving = (size > FAINT * size.max())[elements].any(axis=1)
    if moving.mean() > WHOLE:
        return problem.model.relaxed, np.arange(len(size), dtype=np.int32)
    part, nodes = _held_beyond(problem.mesh, moving, problem.scene.tissue)
    return part.relaxed, nodes


def _held_beyond(mesh: Mesh, inside: Flags, tissue: AnyTissue) -> tuple[FullModel, Numbers]:
    """Model of the elements ``inside`` (e,), and its nodes; held where others begin."""
    part, nodes, border = part_of(mesh, np.flatnonzero(inside).astype(np.int32))
    return FullModel(replace(part, clamped=part.clamped | border), tissue), nodes


def load_range(problem: FullProblem, position: Array) -> Array:
    """Load range (LIMIT_FIELDS,) at a surface point; see ``mechanics.footprint.pressure_limit``.

    The limit along the normal is where the tissue moves by the scene's indentation, or beyond
    which it has no equilibrium; the depth of the tip is where it has the force of that pressure.
    """
    model = problem.model.relaxed  # for as long as it takes
    nodal, normal = problem.unit_load(position)
    unit = np.einsum("n,ij->nij", nodal, np.eye(3)).reshape(-1, 3)[model.free]
    linear = model.solve_linear(unit)
    C = unit.T @ linear / nodal.sum()
    thickness = local_thickness(problem.mesh, position[None], normal[None])[0]
    wanted = problem.scene.load.max_indentation * thickness
    pressure = wanted / np.linalg.norm((linear @ normal).reshape(-1, 3), axis=1).max()
    along = -nodal[:, None] * normal
    model, nodes = moving_part(problem, model.filled(linear @ normal).reshape(-1, 3))
    nodal, along = nodal[nodes], along[nodes]
    path = LoadPath(model, along.ravel()[model.free])

    def full(pressure: float, start: Array | None) -> Array:
        # no load steps: where a jump fails, the pressure between is asked for
        return model.solve(
            pressure * along, start=start, smallest_step=1.0, tolerance=TOLERANCE
        ).displacement

    limit, power, moved = pressure_that_moves(path.solve, wanted, pressure)
    if not _far(moved, wanted) or limit > SURFACE * problem.body.touched[0]:
        near = limit or pressure, power, moved
        limit, _, moved = pressure_that_moves(full, wanted, *near, stride=1.5)
        limit /= 1.0 if _far(moved, wanted) else MARGIN
    depth = _tip_depth(problem, position, limit * nodal.sum())
    depth -= 0.0 if moved is None else float(nodal @ moved @ normal) / nodal.sum()
    depth = min(max(depth, SHALLOWEST), DEEPEST * problem.scene.endoscope.radius)
    return np.array([limit, *np.diag(C), C[0, 1], C[0, 2], C[1, 2], depth])


def _far(moved: Array | None, wanted: float) -> bool:
    """Whether a displacement (n, 3) mm is about as large as wanted."""
    return moved is not None and float(np.linalg.norm(moved, axis=1).max()) > (1 - NEAR) * wanted


def _tip_depth(problem: FullProblem, position: Array, force: float) -> float:
    """Depth (mm) of a tip of this force in the surface as it moves a footprint; held for ever."""
    beta, relief, *_ = problem.tip_at(position, position, position)[0].law
    loss = problem.body.tip.lost * sum(share for share, _ in problem.model.prony)
    return approach(beta, relief, force / (1.0 - loss))


def out_of_reach(problem: FullProblem) -> Flags:
    """Vertices (v,) of the surface that a tip does not reach for what cannot be touched."""
    mesh, surface, radius = problem.mesh, problem.surface, problem.scene.endoscope.radius
    faces = mesh.faces[~mesh.accessible]
    kind = face_kind_of(faces)
    points, outward = points_of(mesh, faces, kind.cells(*[CELLS] * kind.axes)[0])
    centres = surface.vertices + radius * surface.normals
    pairs = cKDTree(centres).sparse_distance_matrix(
        cKDTree(points), radius - SHALLOWEST, output_type="ndarray"
    )
    one, two = pairs["i"], pairs["j"]
    ahead = np.sum((centres[one] - points[two]) * outward[two], axis=1) > 0.0
    found = np.zeros(len(centres), dtype=bool)
    found[one[ahead]] = True
    return found


class Search(NamedTuple):
    """What to ask the reduced model all over the surface: how much of its range it bears."""

    title: str
    field: int  # of the load range, which is lowered
    stage: Stage  # whose random numbers are drawn
    points: Callable[[Surface, int, Rng], Iterable[Array]]  # of the surface, so many
    draw: Callable[..., tuple[Any, ...]]  # makes a place, its point first, of a point
    share: Callable[..., float]  # of the range that the model bears at a place
    first: int  # places for each local model
    closer: int  # more of them near each where it does not bear all
    reach: float  # mm from there up to which the range is lowered


def bearable_shares(search: Search, model: ReducedModel, ask: Ask, rng: Rng) -> Array:
    """Shares of the range at the vertices (v,) that the reduced model bears, at most 1."""
    surface, vertices = model.surface, cKDTree(model.surface.vertices)

    def lacking(points: Iterable[Array]) -> list[tuple[Array, float]]:
        places = [search.draw(model, i, point, rng) for i, point in enumerate(points)]
        shares = zip(places, ask(search.title, search.share, places), strict=True)
        return [(x, share) for (x, *_), share in shares if share < 1.0]

    most = search.first * len(model.models.centres)
    found = lacking(search.points(surface, most, rng))
    near = [rng.choice(vertices.query_ball_point(x, search.reach), search.closer) for x, _ in found]
    if near:
        closer = np.concatenate(near)
        if len(closer) > most:  # it lacks nearly everywhere
            closer = rng.choice(closer, most, replace=False)
        found += lacking(surface.vertices[closer])
    shares = np.ones(len(surface.vertices))
    for x, share in found:
        lowered = vertices.query_ball_point(x, search.reach)
        shares[lowered] = np.minimum(shares[lowered], share)
    return shares


def untested(
    problem: FullProblem, models: LocalModels, limits: Array, known: Estimators | None = None
) -> ReducedModel:
    """Reduced model of local models and a load range, with the error estimates known so far."""
    scene, known = problem.scene, known or Estimators()
    return ReducedModel(scene.name, scene, {}, problem.body, problem.surface, limits, models, known)


@lru_cache(maxsize=1)
def _pickled(problem: FullProblem, path: Path) -> ReducedModel:
    return untested(problem, *read_result(path))


def ask(
    problem: FullProblem, path: Path, function: Callable[..., float], places: Places
) -> list[float]:
    """Values of a function of a reduced model and of further arguments; for ``run.workers``.

    ``path`` is a pickle of the local models and their load range.
    """
    return [function(_pickled(problem, path), *place) for place in places]


def limit_load_share(model: ReducedModel, x: Array, direction: Array, limit: float) -> float:
    """Share of a pressure (kPa) up to which tissue yields gradually, with ``MARGIN``; at most 1."""
    moved = np.full(len(SHARES), np.nan)
    for i, share in enumerate(SHARES):
        answer = model.press(x, share * limit, direction)
        if answer.converged:
            moved[i] = sum(weight * np.linalg.norm(q) for _, weight, q in answer.parts)
    exponents = np.diff(np.log(moved)) / np.diff(np.log(SHARES))
    sudden = np.flatnonzero(~(np.diff(exponents) <= SUDDEN))  # or without an answer
    return float(SHARES[sudden[0] + 1]) / MARGIN if len(sudden) else 1.0


def bears(model: ReducedModel, load: Load) -> bool:
    """Whether the tissue yields gradually up to a load, so that the range does not end before."""
    limit = Place.at(model, load.position).limit(load.direction)
    return load.pressure <= limit * limit_load_share(model, load.position, load.direction, limit)


def firm_share(model: ReducedModel, x: Array, direction: Array, limit: float) -> float:
    """Share of a pressure (kPa) up to which the full model is close to the reduced one; at most 1.

    Less ``MARGIN`` where that is not all of it.
    """
    if limit < FIRM * model.body.touched[0]:
        return 1.0
    nodal, radius = np.zeros(len(model.body.nodes)), model.scene.endoscope.radius
    footprint(model.body.boundary, x, model.surface.project(x)[1], radius, nodal)
    part, nodes = _part_near(model, tuple(x.tolist()))
    whole = DeadLoad(np.outer(nodal[nodes], limit * direction).reshape(-1))
    for share in FIRM_SHARES:
        load = whole.at(share)
        u = model.fields.of_mesh(model.press(x, share * limit, direction))[nodes].astype(float)
        tissue = Potential(part, [load], u.reshape(-1))
        u = u.reshape(-1)[part.free]
        status, *_ = newton.newton(
            tissue, u, np.empty((4, len(u))), TOLERANCE * load.size, DIGIT, CLOSE_BY, False
        )
        if status == newton.CONVERGED:
            return 1.0 if share == 1.0 else float(share) / MARGIN
    return float(FIRM_SHARES[-1]) / MARGIN


@lru_cache(maxsize=1)
def _part_near(model: ReducedModel, x: tuple[float, ...]) -> tuple[FullModel, Numbers]:
    """Full model of the part of a body near a contact, and its nodes; held beyond."""
    body, reach = model.body, BESIDE * model.scene.endoscope.radius
    near = np.linalg.norm(body.nodes - x, axis=1) < reach
    return _held_beyond(body, near[body.elements].any(axis=1), model.scene.tissue)


def path_independent_share(model: ReducedModel, x: Array, turn: float = 0.0) -> float:
    """Share of the depth limit at a contact up to which the tip's way there does not matter.

    ``turn`` is the angle (rad) of the ways about the normal.
    """
    deepest = _pressed_in(model, x)
    for share in DEPTH_SHARES:
        if share <= deepest and not _depends_on_way(model, x, share, turn):
            return float(share) if share == 1.0 else float(share) / MARGIN
    return float(DEPTH_SHARES[-1]) / MARGIN


def _pressed_in(model: ReducedModel, x: Array) -> float:
    """Share up to which a tip pressed in at once is where one pressed further and further in is."""
    place, state, share = Place.at(model, x), model.new_warm(), DEPTH_SHARES[-1]
    for deeper in DEPTH_SHARES[::-1]:
        position = place.touch(deeper).position
        at_once = model.touch(position)
        if not at_once.converged or _apart(at_once, model.touch(position, warm=state)):
            break
        share = deeper
    return float(share)


def _depends_on_way(model: ReducedModel, x: Array, share: float, turn: float) -> bool:
    """Whether a tip that comes sliding finds another equilibrium than one pressed in, or that none.

    A tip that is pressed in and finds none has slipped off.
    """
    pressed = model.touch(Place.at(model, x).touch(share).position)
    if not pressed.converged:
        return True
    state = model.new_warm()
    for angle in turn + 2.0 * np.pi * np.arange(WAYS) / WAYS:
        state.forget()
        slid = None
        for place in reversed(_way(model, x, angle)):
            try:
                slid = model.touch(Place.at(model, place).touch(share).position, warm=state)
            except QueryError:  # in a fold the tip's centre can be below the other side
                continue
        if slid is not None and _apart(pressed, slid):
            return True
    return False


def _way(model: ReducedModel, x: Array, angle: float) -> list[Array]:
    """Points of the surface from one point on, as far as it goes."""
    places, normal = [x], model.surface.project(x)[1]
    heading = np.array([np.cos(angle), np.sin(angle)]) @ np.array(tangents(normal))
    for _ in range(round(FAR / STRIDE)):
        on, normal = model.surface.project(places[-1] + STRIDE * heading)[:2]
        heading = heading - heading @ normal * normal
        size = float(np.linalg.norm(heading))
        if size < 1e-6 or np.linalg.norm(on - places[-1]) < 0.3 * STRIDE:
            break
        heading /= size
        places.append(on)
    return places


def _apart(one: Answer, other: Answer) -> bool:
    """Whether answers to the same position are different equilibria, as far as they are known."""
    if not (one.converged and other.converged):
        return False
    known = {k: q for k, _, q in other.parts}
    both = [(weight, q, known[k]) for k, weight, q in one.parts if k in known]
    away = sum(weight * np.linalg.norm(p - q) for weight, p, q in both)
    return bool(away > SAME * sum(weight * np.linalg.norm(p) for weight, p, _ in both))


def answered_share(model: ReducedModel, x: Array, level: float) -> float:
    """Share of the depth limit at a contact that is left where a tip at a level has no answer."""
    try:
        found = model.touch(Place.at(model, x).touch(level).position)
    except QueryError:  # in a fold the tip's centre can be below the other side
        return 1.0
    return 1.0 if found.converged else level / MARGIN


def _largest_load(
    model: ReducedModel, i: int, point: Array, rng: Rng
) -> tuple[Array, Array, float]:
    """Contact, direction and largest pressure of a load, every other one at the largest tilt."""
    place = Place.at(model, point)
    direction = cone(place.normal, model.scene.endoscope.max_tilt, 1, rng, border=i % 2 == 0)[0]
    return place.position, direction, place.limit(direction)


def _rim_points(surface: Surface, count: int, rng: Rng) -> Array:
    """So many vertices of the rim, each ``TILTS`` times, or every third one, corners first."""
    rim = surface.vertices[rng.permutation(surface.rim())]
    spread = rim[farthest(rim, min(count // TILTS, -(-len(rim) // 3)))]
    return np.repeat(spread, TILTS, axis=0)


def _pushed_aside(
    model: ReducedModel, i: int, point: Array, rng: Rng
) -> tuple[Array, Array, float]:
    """Contact, direction and largest pressure of a load of the largest tilt, all round in turn."""
    place, tilt = Place.at(model, point), np.radians(model.scene.endoscope.max_tilt)
    turn = 2.0 * np.pi * (i + rng.random()) / TILTS
    one, two = tangents(place.normal)
    aside = np.cos(turn) * one + np.sin(turn) * two
    direction = np.sin(tilt) * aside - np.cos(tilt) * place.normal
    return place.position, direction, place.limit(direction)


def _contact(model: ReducedModel, _: int, point: Array, rng: Rng) -> tuple[Array, float]:
    """Contact of the tip, and the angle of the ways there."""
    return model.surface.project(point)[0], rng.uniform(0.0, 2.0 * np.pi)


def _level(model: ReducedModel, _: int, point: Array, rng: Rng) -> tuple[Array, float]:
    """Contact of the tip, and how deep: 1 is the limit."""
    return model.surface.project(point)[0], float(np.sqrt(rng.random()))


def _points_and_whole_rim(surface: Surface, count: int, rng: Rng) -> Iterator[Array]:
    """Every vertex of the rim, whose corners are few, and points all over the surface."""
    yield from surface.vertices[surface.rim()]
    yield from random_points(surface, 3 * count // 4, rng)


GIVING_WAY = Search(
    "giving way", 0, Stage.GIVING_WAY, random_points_and_rim, _largest_load, limit_load_share,
    first=16, closer=24, reach=2.0,
)  # fmt: skip
FOLDING = Search(
    "folding of the rim", 0, Stage.FOLDING, _rim_points, _pushed_aside, firm_share,
    first=4, closer=12, reach=2.0,
)  # fmt: skip
SLIPPING_OFF = Search(
    "slipping off", TIP_DEPTH, Stage.SLIPPING_OFF, _points_and_whole_rim, _contact,
    path_independent_share, first=6, closer=8, reach=1.0,
)  # fmt: skip
UNANSWERED = Search(
    "without an answer", TIP_DEPTH, Stage.UNANSWERED, random_points_and_rim, _level,
    answered_share, first=100, closer=8, reach=1.0,
)  # fmt: skip

# of 20 000 largest loads one round left 23 that give way before the margin ends, two left 15
# of 27 800 positions of the tip 7 had no answer, 4 after one round, 1 after two
SEARCHES = GIVING_WAY, GIVING_WAY, FOLDING, SLIPPING_OFF, UNANSWERED, UNANSWERED
