"""Training of one local model: modes, cubature, first guess and first tangent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.problem import FullProblem
from palpate.offline.reduce.cubature import (
    combined,
    compress,
    damped_fit,
    fit_of_residuals,
    nonlinear_forces,
    nonnegative,
    point_forces,
    with_linear_forces,
)
from palpate.offline.reduce.patches import PatchResult, PatchTask, RegionResult, local_models
from palpate.offline.reduce.ritz import RITZ_VECTORS, local_modes, whole_numbers
from palpate.offline.reduce.sampling import cone, fewer, tangents
from palpate.offline.reduce.tip_models import compile_tip_query, train_tip
from palpate.shared.local_models import LocalModels
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.footprint import LIMIT_FIELDS, pressure_limit
from palpate.shared.mechanics.tissue import Law
from palpate.shared.reduced.features import (
    CHANGING,
    RESIDUAL_FEATURES,
    residual_features,
)
from palpate.shared.reduced.outcome import PRESS_FEATURES
from palpate.shared.reduced.points import LANES, STATE, increments, linearise
from palpate.shared.reduced.press import place, press
from palpate.shared.reduced.terms import Elastic
from palpate.shared.reduced.workspace import press_workspace
from palpate.shared.scene import Scene
from palpate.shared.tables import press_models

Array = NDArray[np.float64]

LOADS = 20
"""Training loads of the cubature; each gives an equilibrium and a state off equilibrium."""

EXTREME = 0.5
"""Share of them near the largest pressure, half of those at the largest tilt: where cubature errs
most, random loads are rare."""

OFF_EQUILIBRIUM = 0.03
"""Size of the random departure from equilibrium, relative to each mode's part in the states."""

SKETCH = 24
"""Random combinations that stand for all components of a force; their errors add up alike."""

RESPONSES = 20
"""Random displacements in which the points have to do what linear elasticity does."""

STATES = 24
"""Random loads at each footprint, half of them at the largest tilt, that modes are made for."""

FAINT = 0.1
"""Weight of the Ritz vectors themselves beside their states."""

RESIDUAL_LOADS = 64

DEFECT_LOADS, DEFECT_DAMPING = 240, 0.1
"""Equilibria that the defect is fitted to, and the damping of the fit: undamped it goes astray at
the ends of the range, where it is largest."""

GUESS_LOADS, GUESS_DAMPING = 500, 1e-2
TANGENT_LOADS = 100
"""Equilibria that the first guess is fitted to, and those of them at which the tangent is looked
at; the damping of both fits."""

NO_LIMIT = 1e100
"""Largest pressure, kPa, that a local model in training answers for."""

EQUATIONS = 300
"""Combinations of the reduced internal force that cubature is fitted to.

This, ``LOADS`` and ``RESIDUAL_LOADS`` are for the usual tolerance; see ``reduce.sampling.fewer``.
"""


class Sample(NamedTuple):
    """Answer of a local model to a training load."""

    x: Array  # (3,) mm, contact point
    normal: Array  # (3,) of the surface there
    q: Array  # (r,)
    load: Array  # (r,) mN, less what the cubature misses
    compliance: Array  # (r, r) inverse tangent as far as the search has come to know it
    features: Array  # (LOAD_FEATURES,) of the load
    tangent_features: Array  # (TANGENT_FEATURES,)


class LocalTrainer:
    """One local model by itself, which solves training loads by the compiled query."""

    def __init__(self, problem: FullProblem, models: LocalModels) -> None:
        scene, surface = problem.scene, problem.surface
        self.radius = scene.endoscope.radius
        self.models = models
        self.tables = press_models(problem.body, models, scene)
        no_limit = np.tile(np.eye(LIMIT_FIELDS)[1:4].sum(0), (len(surface.vertices), 1))
        no_limit[:, 0] = NO_LIMIT
        self._workspace = press_workspace(
            self.tables, surface.ground(no_limit), scene.endoscope.max_tilt,
            np.zeros((2, PRESS_FEATURES)), Elastic(),
        )  # fmt: skip

    def solve(self, x: Array, direction: Array, pressure: float) -> Sample | None:
        """Solve a load independently of the last; None if there is no equilibrium."""
        own = self._workspace
        own.forget()
        place(own.solver, x, direction)
        press(own.solver, pressure, self.radius)
        if own.outcome.status.item() != newton.CONVERGED:
            return None
        scratch = own.scratch
        return Sample(
            own.outcome.foot.copy(),
            own.outcome.upward.copy(),
            own.warm.q[0].copy(),
            scratch.load.copy(),
            own.warm.inverse[0].copy(),
            scratch.features.copy(),
            scratch.tangent_features.copy(),
        )

    @property
    def gradients(self) -> NDArray[np.float32]:
        """Gradients (r, 9 c) of the modes at the points, in tiles, 1/mm."""
        points = self.tables.points
        return np.asarray(points.gradients[0] * points.steps[0][:, None])

    @property
    def law(self) -> tuple[Array, Law]:
        """Weights (mm^3) and parameters of the law of the points, each (c,)."""
        points = self.tables.points
        return points.weights[0], points.law.at(0)

    def internal_forces(self, states: Array) -> Array:
        """What the law adds to linear elasticity's force: (k, r) in states (k, r)."""
        return nonlinear_forces(self.gradients, *self.law, states)

    def tangent_changes(self, states: Array) -> Array:
        """Tangents in states (k, r) less that at rest, (k, r, r)."""
        rows = self.gradients
        moduli = np.empty(STATE * len(self.law[0]), np.float32)
        products, changes = np.empty_like(rows), []
        for q in states.astype(np.float32):
            linearise(q @ rows, *self.law, moduli)
            increments(self.law[1], moduli, rows, products)
            changes.append(rows @ products.T)
        return np.array(changes, float)

    @property
    def nodal_modes(self) -> NDArray[np.float32]:
        """Modes (r, 3 n) at the nodes."""
        modes = self.models.steps[0][:, None] * self.models.modes[0]
        return np.asarray(modes.T @ self.models.basis[0].astype(np.float32))

    def displacement(self, q: Array) -> Array:
        """Displacement of the nodes (n, 3) mm in a state (r,)."""
        return np.asarray(q @ self.nodal_modes).reshape(-1, 3)


def compile_query(problem: FullProblem) -> None:
    """Compile what local models are trained and queried with, on a model of nothing."""
    surface = problem.surface
    stored, factors = np.zeros((LANES, LANES), np.int16), np.zeros((LANES, LANES), np.float32)
    basis = RegionResult(
        np.zeros((LANES, problem.mesh.nodes.size), np.int16), factors[0], factors, factors[None]
    )
    nothing = PatchResult.untrained(np.eye(3), stored, factors, np.zeros(1, np.int32), np.ones(1))
    own = np.zeros(1, np.int32), surface.vertices[:1], np.ones(1)
    models = local_models([basis], *own, [nothing], 1.0, 1.0)
    trainer = LocalTrainer(problem, models)
    trainer.solve(surface.vertices[0], surface.normals[0], 0.0)
    if problem.scene.endoscope.tip:
        compile_tip_query(problem, models)


def train_patch(
    problem: FullProblem, region: RegionResult, task: PatchTask, tip: bool = True
) -> PatchResult:
    """Train one patch; a task for ``run.workers``.

    Parameters
    ----------
    problem : FullProblem
    region : RegionResult
        With the Ritz vectors of the task's footprints.
    task : PatchTask
    tip : bool
        Whether under the tip, too, if the scene has one.
    """
    rng, scene = np.random.default_rng(task.seed), problem.scene
    weights = problem.model.weights.ravel()
    frame = np.array([task.normal, *tangents(task.normal)])
    ritz = region.ritz.astype(np.float64)
    leading = local_modes(_expected(scene, ritz, task, rng), task.size.modes)
    whole, mix = whole_numbers(region.orthonormal @ leading, region.orthonormal)
    # stored in these and in half precision, so trained in it
    numbers = np.arange(len(weights), dtype=np.int32)
    everywhere = PatchResult.untrained(frame, whole, mix, numbers, weights)
    galerkin = local_trainer(problem, region, task, everywhere)
    contributions = _training_forces(galerkin, scene, task, rng)[: len(weights)]
    most = task.size.cubature_points
    equations = max(most, fewer(EQUATIONS, scene.tolerance))
    points, chosen = _cubature(contributions, weights, equations, most, rng)
    result = replace(everywhere, points=points.astype(np.int32), weights=chosen)
    reduced = local_trainer(problem, region, task, result)
    defect = _fit_defect(galerkin, reduced, scene, task, rng)
    result = replace(result, defect=defect.astype(np.float16))
    reduced = local_trainer(problem, region, task, result)
    samples = _answered(reduced, scene, task, random_load, GUESS_LOADS, rng)
    directions, change = _fit_tangent(reduced, samples[:TANGENT_LOADS])
    residual = _fit_residual(problem, reduced, task, frame, rng)
    touched = None
    if tip and scene.endoscope.tip:
        touched = train_tip(problem, task, reduced.models, region.orthonormal, rng)
    return replace(
        result,
        guess=_fit_guess(samples).astype(np.float16),
        directions=directions.astype(np.float16),
        change=change.astype(np.float16),
        residual=residual,
        tip=touched,
    )


def local_trainer(
    problem: FullProblem, region: RegionResult, task: PatchTask, result: PatchResult
) -> LocalTrainer:
    """A patch by itself, ready to be solved."""
    own = np.zeros(1, np.int32), task.centre[None], np.array([task.pressure])
    return LocalTrainer(problem, local_models([region], *own, [result], task.extent, task.blend))


def _expected(scene: Scene, ritz: Array, task: PatchTask, rng: np.random.Generator) -> Array:
    """What modes are to span (M, k): states under random loads, and faintly all Ritz vectors.

    The states are those of third order in the load, from Ritz vectors (f, M, 19 or more).
    """
    parts = [FAINT * vectors for vectors in ritz]
    tilt = scene.endoscope.max_tilt
    for pressed, vectors in zip(task.footprints, ritz, strict=True):
        directions = [
            cone(pressed.normal, tilt, STATES // 2, rng, border) for border in (False, True)
        ]
        loads = pressed.pressure * np.sqrt(rng.random((STATES, 1))) * np.vstack(directions)
        for first in range(0, vectors.shape[1], RITZ_VECTORS):  # the relaxed tissue's, too
            own = vectors[:, first : first + RITZ_VECTORS]
            one, two, three = pressed.path_derivatives(own, loads)
            parts.append((one + two / 2 + three / 6).T / np.sqrt(STATES))
    return np.hstack(parts)


def _fit_residual(
    problem: FullProblem,
    reduced: LocalTrainer,
    task: PatchTask,
    frame: Array,
    rng: np.random.Generator,
) -> Array:
    """Log of the full model's relative residual (RESIDUAL_FEATURES,), by ``residual_features``."""
    rows, states, loads, scene = [], [], [], problem.scene
    features, free = np.zeros(RESIDUAL_FEATURES), problem.model.free
    for _ in range(fewer(RESIDUAL_LOADS, scene.tolerance)):
        x, direction, limit = _limit(scene, task, rng, border=False)
        share = np.sqrt(rng.random())
        sample = reduced.solve(x, direction, share * limit)
        if sample is not None:
            nodal = problem.unit_load_at(sample.x, sample.normal)
            residual_features(frame, task.centre, x, direction, share, features)
            rows.append(features.copy())
            states.append(sample.q)
            loads.append((share * limit * nodal[:, None] * direction).ravel())
    answers = np.array(states) @ reduced.nodal_modes
    left = problem.model.relative_residuals(answers[:, free], np.array(loads)[:, free])
    return fit_of_residuals(np.array(rows), left)


def random_load(
    scene: Scene, task: PatchTask, rng: np.random.Generator
) -> tuple[Array, Array, float]:
    """Contact point, direction and pressure, denser towards large pressures."""
    x, direction, limit = _limit(scene, task, rng, border=False)
    return x, direction, limit * np.sqrt(rng.random())


def extreme_load(
    scene: Scene, task: PatchTask, rng: np.random.Generator
) -> tuple[Array, Array, float]:
    """Contact point, direction and pressure near the end of their range."""
    x, direction, limit = _limit(scene, task, rng, border=rng.random() < 0.5)
    return x, direction, limit * (1 - 0.15 * rng.random())


def _training_load(
    scene: Scene, task: PatchTask, rng: np.random.Generator
) -> tuple[Array, Array, float]:
    draw = extreme_load if rng.random() < EXTREME else random_load
    return draw(scene, task, rng)


def _answered(
    trainer: LocalTrainer,
    scene: Scene,
    task: PatchTask,
    draw: Callable[[Scene, PatchTask, np.random.Generator], tuple[Array, Array, float]],
    count: int,
    rng: np.random.Generator,
) -> list[Sample]:
    """Answers to drawn loads; those that it does not solve are left out."""
    samples = [trainer.solve(*draw(scene, task, rng)) for _ in range(count)]
    return [sample for sample in samples if sample is not None]


def _limit(
    scene: Scene, task: PatchTask, rng: np.random.Generator, border: bool
) -> tuple[Array, Array, float]:
    """Contact point, direction, in the cone or on its border, and the largest pressure there."""
    i = rng.integers(len(task.contacts))
    direction = cone(task.normals[i], scene.endoscope.max_tilt, 1, rng, border=border)[0]
    limit = pressure_limit(task.ranges[i], task.normals[i], direction)
    return task.contacts[i], direction, float(limit)


def _training_forces(
    trainer: LocalTrainer, scene: Scene, task: PatchTask, rng: np.random.Generator
) -> NDArray[np.float32]:
    """What each point (row) contributes to the internal force in and off equilibrium (columns).

    It is taken times the square root of the compliance there, so that its error is one of
    displacement in the energy norm; random combinations stand for all of its components.
    """
    columns = []
    gradients, count = _by_point(trainer.gradients), fewer(LOADS, scene.tolerance)
    for sample in _answered(trainer, scene, task, _training_load, count, rng):
        q = sample.q
        looks = (np.linalg.cholesky(sample.compliance) / np.linalg.norm(q)).astype(np.float32)
        departure = OFF_EQUILIBRIUM * np.abs(q) * rng.standard_normal(len(q))
        for state in (q, q + departure):
            force = point_forces(gradients, *trainer.law, state)
            if force is not None:
                columns.append(force @ combined(looks, SKETCH, rng))
    return with_linear_forces(np.hstack(columns), gradients, trainer.law, RESPONSES, rng)


def _by_point(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Gradients (c, 9, r) of modes, from those in tiles (r, 9 c)."""
    tiles = rows.reshape(len(rows), -1, 9, LANES)
    return np.ascontiguousarray(tiles.transpose(1, 3, 2, 0).reshape(-1, 9, len(rows)))


def _cubature(
    contributions: NDArray[np.float32],
    weights: Array,
    equations: int,
    most: int,
    rng: np.random.Generator,
) -> tuple[NDArray[np.int64], Array]:
    """Points and weights that reproduce the sums of the contributions."""
    A, b = compress(contributions, equations, rng)
    chosen, x = nonnegative(A, b, most)
    return chosen, x * weights[chosen]


def _fit_defect(
    galerkin: LocalTrainer,
    reduced: LocalTrainer,
    scene: Scene,
    task: PatchTask,
    rng: np.random.Generator,
) -> Array:
    """Force (LOAD_FEATURES, r) that the cubature misses in equilibrium, relative to the answer."""
    samples = _answered(reduced, scene, task, _training_load, DEFECT_LOADS, rng)
    states, rows = np.array([s.q for s in samples]), np.array([s.features for s in samples])
    missed = galerkin.internal_forces(states) - reduced.internal_forces(states)
    scale = 1.0 / np.linalg.norm(states, axis=1, keepdims=True)
    kept = np.isfinite(missed).all(axis=1)
    return damped_fit((scale * rows)[kept], (scale * missed)[kept], DEFECT_DAMPING)


def _fit_guess(samples: Sequence[Sample]) -> Array:
    """What equilibria add to the linear response (LOAD_FEATURES, r), relative to that."""
    scale = np.array([[1.0 / np.linalg.norm(s.load)] for s in samples])
    rows = np.array([s.features for s in samples])
    added = np.array([s.q - s.load for s in samples])
    return damped_fit(scale * rows, scale * added, GUESS_DAMPING)


def _fit_tangent(reduced: LocalTrainer, samples: Sequence[Sample]) -> tuple[Array, Array]:
    """Directions (CHANGING, r) in which equilibria change the tangent most, and how.

    The change (TANGENT_FEATURES, CHANGES) is that of ``shared.local_models.LocalModels``.
    """
    changes = reduced.tangent_changes(np.array([s.q for s in samples]))
    U = np.linalg.svd(np.hstack(list(changes)), full_matrices=False)[0][:, :CHANGING]
    rows, columns = np.tril_indices(CHANGING)
    seen = (U.T @ changes @ U)[:, rows, columns]
    features = np.array([s.tangent_features for s in samples])
    return np.ascontiguousarray(U.T), damped_fit(features, seen, GUESS_DAMPING)
