"""Training of one local model: modes, cubature, first guess and first tangent."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.norms import relative
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.reduce import cubature
from palpate.offline.reduce.join import deviatoric_of, half, with_points
from palpate.offline.reduce.layout import Patch
from palpate.offline.reduce.ritz import RITZ_VECTORS, Footprint, Region, local_modes, whole_numbers
from palpate.offline.reduce.sampling import cone, fewer, tangents
from palpate.shared.arrays import Array, Field
from palpate.shared.geometry.surface import Surface, SurfaceIndex
from palpate.shared.local_models import LocalModels, ViscousModels
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.footprint import pressure_limit
from palpate.shared.mechanics.tip import EDGE_FIELD
from palpate.shared.reduced.features import (
    CHANGES,
    CHANGING,
    LOAD_FEATURES,
    RESIDUAL_FEATURES,
    TANGENT_FEATURES,
)
from palpate.shared.reduced.outcome import PRESS_FEATURES
from palpate.shared.reduced.past import Elastic
from palpate.shared.reduced.points import STATE, increments, linearise
from palpate.shared.reduced.press import place, press
from palpate.shared.reduced.workspace import Workspace
from palpate.shared.scene import Scene
from palpate.shared.tables import press_models

LOADS, EQUATIONS, POINTS = 20, 450, 128
"""Training loads of a cubature of up to so many points, each of which gives an equilibrium and a
state off equilibrium, and combinations of the reduced internal force there that it is fitted to.
More points learn from more in proportion."""

EXTREME = 0.5
"""Share of them near the largest pressure, half of those at the largest tilt: where cubature errs
most, random loads are rare."""

SKETCH = 24
"""Random combinations that stand for all components of a force."""

RESPONSES = 20
"""Random displacements in which the points have to do what linear elasticity does."""

STATES = 24
"""Random loads at each footprint, half of them at the largest tilt, that modes are made for."""

FAINT = 0.1
"""Weight of the Ritz vectors themselves beside their states."""

BETWEEN = 150
"""Random loads anywhere on a patch whose linear responses modes are made for, too.  Without them 76
modes miss of what is between the footprints of ``turbinate-mri``, where it is stiffest, .6 to 1.0 %
of displacement at 95 of 100 loads, with them .4 to .7; all 400 of the region miss .3 to .6."""

RESIDUAL_LOADS = 64
"""For the usual tolerance; see ``reduce.sampling.fewer``."""

DEFECT_LOADS, DEFECT_DAMPING = 240, 0.1
"""Equilibria that the defect is fitted to, and the damping of the fit: undamped it goes astray at
the ends of the range, where it is largest."""

GUESS_LOADS, GUESS_DAMPING = 500, 1e-2
TANGENT_LOADS = 100
"""Equilibria that the first guess is fitted to, and those of them at which the tangent is looked
at; the damping of both fits."""

CUBATURE_LOADS = 3
"""By which a local model is compared with itself with every quadrature point."""

CANDIDATES = 6
"""Points that are drawn for each of those of the cubature to choose from."""

NO_LIMIT = 1e9
"""Kilopascals and millimetres: in training any pressure and depth is in range."""


def endless(surface: Surface) -> SurfaceIndex:
    """The surface without end of its load range and without a rim; see ``outcome.Solver``."""
    limits, curvature = [NO_LIMIT, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, NO_LIMIT], [0.0] * EDGE_FIELD
    fields = [*limits, *curvature, NO_LIMIT, NO_LIMIT]
    return surface.ground(np.tile(fields, (len(surface.vertices), 1)))


@dataclass(frozen=True)
class RandomLoads:
    """Random loads on a patch."""

    scene: Scene
    patch: Patch
    rng: np.random.Generator

    def limit(self, border: bool = False) -> Load:
        """Of the largest pressure, in the cone of directions or on its border."""
        patch, i = self.patch, self.rng.integers(len(self.patch.contacts))
        tilt = self.scene.endoscope.max_tilt
        direction = cone(patch.normals[i], tilt, 1, self.rng, border=border)[0]
        limit = pressure_limit(patch.ranges[i], patch.normals[i], direction)
        return Load(patch.contacts[i], direction, float(limit))

    def any(self, border: bool = False) -> Load:
        """Denser towards large pressures."""
        load = self.limit(border)
        return replace(load, pressure=load.pressure * np.sqrt(self.rng.random()))

    def training(self) -> Load:
        """For cubature: many are extreme."""
        if self.rng.random() >= EXTREME:
            return self.any()
        load = self.limit(border=self.rng.random() < 0.5)
        return replace(load, pressure=load.pressure * (1 - 0.15 * self.rng.random()))


class Sample(NamedTuple):
    """Answer of a local model to a training load."""

    q: Array  # (r,)
    load: Array  # (r,) mN, less what the cubature misses
    compliance: Array  # (r, r) inverse tangent as far as the search has come to know it
    features: Array  # (LOAD_FEATURES,) of the load
    tangent_features: Array  # (TANGENT_FEATURES,)


class LocalTrainer:
    """One local model by itself, which solves training loads by the compiled query."""

    def __init__(self, problem: FullProblem, models: LocalModels) -> None:
        tables = press_models(problem.body, models, problem.scene)
        self.rows, self.law = cubature.points_alone(tables.points)
        self._radius = problem.scene.endoscope.radius
        index, unknown = endless(problem.surface), np.zeros((2, PRESS_FEATURES))
        self._workspace = Workspace(tables, problem.body.tip, index, unknown, Elastic())

    def solve(self, load: Load) -> Sample | None:
        """Solve a load independently of the last; None if there is no equilibrium."""
        own = self._workspace
        own.forget()
        place(own.solver, load.position, load.direction)
        press(own.solver, load.pressure, self._radius)
        if own.outcome.status.item() != newton.CONVERGED:
            return None
        warm, scratch = own.warm, own.scratch
        found = warm.q[0], scratch.load, warm.inverse[0], scratch.features, scratch.tangent_features
        return Sample(*map(np.copy, found))

    def answers(self, draw: Callable[[], Load], count: int) -> list[Sample]:
        """Answers to drawn loads; those that it does not solve are left out."""
        return [sample for _ in range(count) if (sample := self.solve(draw())) is not None]

    def tangent_changes(self, states: Array) -> Array:
        """Tangents in states (k, r) less that at rest, (k, r, r)."""
        moduli = np.empty(STATE * len(self.law[0]), np.float32)
        products, changes = np.empty_like(self.rows), []
        for q in states.astype(np.float32):
            linearise(q @ self.rows, *self.law, moduli)
            increments(self.law[1], moduli, self.rows, products)
            changes.append(self.rows @ products.T)
        return np.array(changes, float)


def train_patch(problem: FullProblem, region: Region, patch: Patch) -> LocalModels:
    """Train one local model; its tables lack the basis of the region, which is large."""
    models = trained_patch(problem, region, patch)
    points = problem.points_in_body(models.points)
    return replace(models, basis=models.basis[:0], points=points)


def trained_patch(problem: FullProblem, region: Region, patch: Patch) -> LocalModels:
    """Train one local model, whose tables are of the problem's nodes and have no pairs.

    ``region`` has the Ritz vectors of the patch's footprints, and its basis is of these nodes.
    """
    rng, scene, model = np.random.default_rng(patch.seed), problem.scene, problem.model
    loads, weights = RandomLoads(scene, patch, rng), model.weights.ravel()
    states = region.states(model)
    expected = _expected(scene, region, patch, rng)
    between = region.orthonormal.T @ _between(problem, patch, loads, states)
    leading = local_modes(np.hstack([expected, between]), region.soft, patch.size.modes)
    whole, mix = whole_numbers(region.orthonormal @ leading, region.orthonormal)
    # stored in these and in half precision, so trained in it
    models = untrained(problem, states, patch.at, patch.extent, whole, mix)
    galerkin = LocalTrainer(problem, models)
    most = patch.size.cubature_points
    more = max(1.0, most / POINTS)
    forces = _training_forces(galerkin, loads, round(more * LOADS))[: len(weights)]
    candidates, forces = cubature.drawn(forces, CANDIDATES * most, rng)
    A, b = cubature.compress(forces, round(more * EQUATIONS), rng)
    chosen, factors = cubature.nonnegative(A[:, : len(candidates)], b, most)
    points = candidates[chosen]
    models = with_points(models, points, factors * weights[points])
    defect = _fit_defect(galerkin, LocalTrainer(problem, models), loads)
    models = replace(models, defect=half(defect))
    trained = LocalTrainer(problem, models)
    samples = trained.answers(loads.any, GUESS_LOADS)
    directions, change = _fit_tangent(trained, samples[:TANGENT_LOADS])
    modes = states @ models.modes[0]
    residual = _fit_residual(problem, models, modes, trained, loads)
    viscous = None
    if model.prony:
        soft = deviatoric_of(model, modes)
        viscous = ViscousModels(soft, np.zeros((0, 2), np.int32), soft[:0])
    return replace(
        models,
        guess=half(_fit_guess(samples)),
        directions=half(directions),
        change=half(change),
        residuals=residual[None],
        cubature_errors=_cubature_errors(galerkin, trained, modes, loads)[None],
        viscous=viscous,
    )


def untrained(
    problem: FullProblem,
    states: Array,
    at: Footprint,
    extent: float,
    whole: NDArray[np.int16],
    mix: Field,
) -> LocalModels:
    """One local model that knows its modes alone, with every quadrature point.

    The first rows of ``states`` are the modes of its region, (free dofs, M) mm.
    """
    modes, weights = len(mix), problem.model.weights.ravel()
    nodes, free = np.arange(len(problem.mesh.nodes), dtype=np.int32), problem.model.free
    basis = np.zeros((states.shape[1], 3 * len(nodes)), np.float32)
    basis[:, free] = states[: len(free)].T
    return LocalModels(
        body=np.zeros((0, basis.shape[1]), np.int16),
        body_steps=np.zeros(0, np.float32),
        shares=np.zeros((1, len(basis), 0), np.int16),
        share_steps=np.zeros((1, len(basis)), np.float32),
        node_from=np.array([0, len(nodes)]),
        nodes=nodes,
        basis=basis.ravel(),
        steps=np.ones((1, len(basis)), np.float32),
        region=np.zeros(1, np.int32),
        centres=at.point[None],
        frames=np.array([[at.normal, *tangents(at.normal)]]),
        pressures=np.array([at.pressure]),
        whole=whole[None],
        mix=mix[None],
        point_from=np.array([0, len(weights)]),
        points=np.arange(len(weights), dtype=np.int32),
        weights=weights,
        defect=np.zeros((1, LOAD_FEATURES, modes), np.float32),
        guess=np.zeros((1, LOAD_FEATURES, modes), np.float32),
        directions=np.zeros((1, CHANGING, modes), np.float32),
        change=np.zeros((1, TANGENT_FEATURES, CHANGES), np.float32),
        residuals=np.zeros((1, RESIDUAL_FEATURES)),
        cubature_errors=np.zeros((1, 0)),
        extent=extent,
        blend=problem.scene.training.blend,
    )


def _expected(scene: Scene, region: Region, patch: Patch, rng: np.random.Generator) -> Array:
    """What modes are to span (M, k): states under random loads, and faintly all Ritz vectors."""
    ritz = region.ritz.astype(float)
    parts = [FAINT * vectors for vectors in ritz]
    tilt = scene.endoscope.max_tilt
    for pressed, vectors in zip(patch.footprints, ritz, strict=True):
        directions = [
            cone(pressed.normal, tilt, STATES // 2, rng, border) for border in (False, True)
        ]
        loads = pressed.pressure * np.sqrt(rng.random((STATES, 1))) * np.vstack(directions)
        for first in range(0, vectors.shape[1], RITZ_VECTORS):  # the relaxed tissue's, too
            one, two, three = pressed.series(vectors[:, first : first + RITZ_VECTORS], loads)
            parts.append((one + two + three).T / np.sqrt(STATES))
    return np.hstack(parts)


def _between(problem: FullProblem, patch: Patch, loads: RandomLoads, states: Array) -> Array:
    """Work (M, BETWEEN) of random loads on ``states`` (dofs, M), as heavy as the footprints."""
    free, work = problem.model.free, []
    for i in range(BETWEEN):
        forces = problem.load_vector(loads.any(border=i % 2 == 0)).ravel()[free]
        pressed = np.flatnonzero(forces)
        work.append(forces[pressed] @ states[pressed])
    return np.sqrt(len(patch.footprints) / BETWEEN) * np.transpose(work)


def _training_forces(trainer: LocalTrainer, loads: RandomLoads, count: int) -> Field:
    """``cubature.training_forces`` whose errors are those of displacement in the energy norm."""
    samples = trainer.answers(loads.training, count)
    states = [(s.q, np.linalg.cholesky(s.compliance) / np.linalg.norm(s.q), None) for s in samples]
    return cubature.training_forces(
        cubature.by_point(trainer.rows), trainer.law, states, SKETCH, RESPONSES, loads.rng
    )


def _fit_defect(galerkin: LocalTrainer, reduced: LocalTrainer, loads: RandomLoads) -> Array:
    """Force (LOAD_FEATURES, r) that the cubature misses in equilibrium, relative to the answer."""
    samples = reduced.answers(loads.training, DEFECT_LOADS)
    states, rows = np.array([s.q for s in samples]), np.array([s.features for s in samples])
    exact, found = (cubature.nonlinear_forces(t.rows, *t.law, states) for t in (galerkin, reduced))
    scale = 1.0 / np.linalg.norm(states, axis=1, keepdims=True)
    kept = np.isfinite(exact - found).all(axis=1)
    return cubature.damped_fit(
        (scale * rows)[kept], (scale * (exact - found))[kept], DEFECT_DAMPING
    )


def _fit_guess(samples: Sequence[Sample]) -> Array:
    """What equilibria add to the linear response (LOAD_FEATURES, r), relative to that."""
    scale = np.array([[1.0 / np.linalg.norm(s.load)] for s in samples])
    rows = np.array([s.features for s in samples])
    added = np.array([s.q - s.load for s in samples])
    return cubature.damped_fit(scale * rows, scale * added, GUESS_DAMPING)


def _fit_tangent(reduced: LocalTrainer, samples: Sequence[Sample]) -> tuple[Array, Array]:
    """``directions`` (CHANGING, r) and ``change`` (TANGENT_FEATURES, CHANGES) of a local model."""
    changes = reduced.tangent_changes(np.array([s.q for s in samples]))
    U = np.linalg.svd(np.hstack(list(changes)), full_matrices=False)[0][:, :CHANGING]
    rows, columns = np.tril_indices(CHANGING)
    seen = (U.T @ changes @ U)[:, rows, columns]
    features = np.array([s.tangent_features for s in samples])
    return U.T, cubature.damped_fit(features, seen, GUESS_DAMPING)


def _cubature_errors(
    galerkin: LocalTrainer, reduced: LocalTrainer, modes: Array, loads: RandomLoads
) -> Array:
    """Relative errors (CUBATURE_LOADS,) of displacement that the points make; nan if not known."""
    errors = np.full(CUBATURE_LOADS, np.nan)
    for i in range(CUBATURE_LOADS):
        load = loads.any()
        exact, found = galerkin.solve(load), reduced.solve(load)
        if exact is not None and found is not None:
            errors[i] = relative(modes @ found.q, modes @ exact.q)
    return errors


def _fit_residual(
    problem: FullProblem,
    models: LocalModels,
    modes: Array,
    trained: LocalTrainer,
    loads: RandomLoads,
) -> Array:
    """See ``cubature.fit_residual``."""
    known = []
    for _ in range(fewer(RESIDUAL_LOADS, problem.scene.tolerance)):
        limit, share = loads.limit(), np.sqrt(loads.rng.random())
        load = replace(limit, pressure=share * limit.pressure)
        sample = trained.solve(load)
        if sample is not None:
            known.append((load, load.direction, share, sample.q))
    return cubature.fit_residual(problem, models.frames[0], models.centres[0], modes, known)
