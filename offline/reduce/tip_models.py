"""Training of a local model under the rigid tip: modes, cubature, first guess.

The full model is too slow to be asked for enough states.  The patch is asked instead, in a space
that holds nearly all that a tip can do to it: the modes that footprints gave it, and the linear
responses to forces at single nodes of the surface.  Of what it answers at contacts and depths all
over its range, and of how that changes with the position, come the few modes that it keeps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.model import FullModel, NoEquilibrium
from palpate.offline.fem.problem import FullProblem
from palpate.offline.reduce.cubature import (
    combined,
    damped_fit,
    fit_of_residuals,
    nonnegative,
    point_forces,
    with_linear_forces,
)
from palpate.offline.reduce.patches import PatchTask, TipResult
from palpate.offline.reduce.sampling import farthest
from palpate.offline.reduce.transfer import FOLLOWED, NEXT, neighbours, overlaps
from palpate.offline.reduce.viscous import deviatoric_of
from palpate.shared.local_models import Body, LocalModels, LocalTips
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.footprint import LIMIT_FIELDS, TIP_DEPTH
from palpate.shared.mechanics.tissue import Law
from palpate.shared.mechanics.viscosity import step_weights
from palpate.shared.reduced.features import (
    RESIDUAL_FEATURES,
    TIP_FEATURES,
    residual_features,
    tip_features,
)
from palpate.shared.reduced.outcome import TOUCH_FEATURES
from palpate.shared.reduced.past import Memory, Remembering, opened, remembering
from palpate.shared.reduced.points import LANES, SYMMETRIC, predict_points
from palpate.shared.reduced.terms import Elastic
from palpate.shared.reduced.touch import MAX_ITERATIONS, TouchModels, place, touch
from palpate.shared.reduced.workspace import touch_workspace
from palpate.shared.tables import touch_models

Array = NDArray[np.float64]
Past = tuple[NDArray[np.float32], NDArray[np.float32]]

TIP_MODES, TIP_POINTS = 32, 80
"""Modes and cubature points under the tip."""

NODAL = 36
"""Directions that responses to forces at nodes add to the modes of the patch."""

HISTORY_MODES, HISTORY_POINTS, HISTORY_NODAL = 52, 120, 64
"""The same of tissue that remembers."""

NODES = 0.6
"""Distance beyond the patch's extent within which nodes count, in radii of the tip."""

NO_LIMIT = 1e9
"""Millimetres: in training any depth is in range."""

PRESSED, DEPTHS = 12, 3
"""Contacts that a patch learns from, and depths at each."""

QUICK = 0.01
"""Seconds of a fast movement."""

ASIDE = 1.5
"""Millimetres that the tip slides at most."""

STEP = 0.15
"""Millimetres by which a state's derivatives in the position are followed."""

DEPARTURE = 0.03
"""Size of the random departure from equilibrium, relative to each mode's part in the states."""

EQUATIONS = 720
"""Random combinations that stand for the equations of all training states."""

RESPONSES = 40
"""Random displacements in which the points have to do what linear elasticity does."""

ANSWERS = 48
"""Answers of the trained model, and of how they change with the position, that the first guess is
fitted to; they tell the residual in the full model, too."""


class TipTrainer:
    """One local model of the tip that solves training positions by the compiled query.

    Parameters
    ----------
    problem : FullProblem
    models : LocalModels
        The local model by itself.
    tips : LocalTips
    tangent : LocalTips, optional
        With the same modes; its points serve the tangent.
    deviatoric : ndarray, shape (m, m), optional
        Deviatoric part of the rest stiffness in the modes, if the tissue is to remember.
    """

    def __init__(
        self,
        problem: FullProblem,
        models: LocalModels,
        tips: LocalTips,
        tangent: LocalTips | None = None,
        deviatoric: Array | None = None,
    ) -> None:
        surface, prony = problem.surface, problem.model.prony
        self.models = touch_models(problem.body, models, tips, tangent)
        self.radius = problem.body.tip.radius
        self._prony = prony
        past: Elastic | Remembering = Elastic()
        if deviatoric is not None:
            points = self.models.points.weights.shape[1]
            past = remembering(deviatoric[None].astype(np.float32), len(prony), points)
        no_limit = np.full((len(surface.vertices), LIMIT_FIELDS), NO_LIMIT)
        self._workspace = touch_workspace(
            self.models, surface.ground(no_limit), np.zeros((3, TOUCH_FEATURES)), past
        )
        self.rest()

    def rest(self) -> None:
        """Go back to where nothing has happened."""
        own = self._workspace
        own.forget()
        self._most: tuple[float, float] | None = None
        if isinstance(own.past, Remembering):
            own.past.records[0] = 0.0
            self._memory().share[-1] = 1.0
            self._most = 0.0, 0.0

    def solve(self, position: Array, dt: float = 0.0) -> _State | None:
        """Go on to a position of the tip, in ``dt`` s; None where there is no equilibrium.

        Elastic tissue goes there in one jump from the last answer.
        """
        own, most = self._workspace, MAX_ITERATIONS - 1
        if isinstance(own.past, Remembering):
            most = MAX_ITERATIONS
            for mine, weights in zip(own.past.time, step_weights(self._prony, dt), strict=True):
                mine[:] = weights
        place(own.solver, position, position)
        touch(own.solver, position, most)
        outcome, warm = own.outcome, own.warm
        if outcome.status.item() != newton.CONVERGED:
            return None
        state = _State(
            position=position,
            depth=outcome.depth.item(),
            normal=outcome.upward.copy(),
            q=warm.q[0].copy(),
            factor=np.tril(warm.factor[0]),
            coupling=warm.coupling[0].T.copy(),
            force=outcome.force.copy(),
        )
        if self._most is None:
            return state
        size, pushed = float(np.linalg.norm(state.q)), float(np.linalg.norm(state.force))
        self._most = max(self._most[0], size), max(self._most[1], pushed)
        return replace(state, past=self._past(), most=self._most)

    @property
    def in_time(self) -> bool:
        """Whether the tissue remembers."""
        return isinstance(self._workspace.past, Remembering)

    @property
    def gradients(self) -> NDArray[np.float32]:
        """Gradients (c, 9, m) of the modes at the points."""
        rows = self.models.points.gradients[0]
        tiles = rows.reshape(len(rows), -1, 9, LANES)
        return np.ascontiguousarray(tiles.transpose(1, 3, 2, 0).reshape(-1, 9, len(rows)))

    def _memory(self) -> Memory:
        past, points = self._workspace.past, self.models.points.weights.shape[1]
        assert isinstance(past, Remembering)
        memory: Memory = opened(past.records[0], len(self._prony), len(past.mean), points)
        return memory

    def _past(self) -> Past:
        """What the points remember now."""
        memory, points = self._memory(), self.models.points
        B, S = np.zeros((2, SYMMETRIC * points.weights.shape[1]), np.float32)
        now = step_weights(self._prony, 0.0)
        predict_points(memory.points, memory.linear, now, points.law.mu[0], B, S)
        return B, S


@dataclass(frozen=True)
class _State:
    """Answer of a local model."""

    position: Array  # (3,) mm
    depth: float  # mm
    normal: Array  # (3,) of the surface
    q: Array  # (m,)
    factor: Array  # (m, m)
    coupling: Array  # (m, 3)
    force: Array  # (3,)
    past: Past | None = None  # of tissue that remembers, see ``cubature.point_forces``
    most: tuple[float, float] | None = None  # largest size and force (mN) of its history

    def within(self, V: Array) -> _State:
        """Its part in orthonormal modes V (m, k)."""
        factor = np.asarray(np.linalg.cholesky(V.T @ self.factor @ self.factor.T @ V), float)
        return replace(self, q=V.T @ self.q, factor=factor, coupling=V.T @ self.coupling)

    @property
    def size(self) -> float:
        """What its errors count against, in the energy norm."""
        return float(np.linalg.norm(self.q)) if self.most is None else self.most[0]

    @property
    def pushed(self) -> float:
        """What errors of its force count against, mN."""
        return float(np.linalg.norm(self.force)) if self.most is None else self.most[1]

    @property
    def slope(self) -> Array:
        """Derivative (m, 3) of the answer in the position."""
        L = self.factor
        return np.asarray(np.linalg.solve(L.T, np.linalg.solve(L, self.coupling)))


def train_tip(
    problem: FullProblem,
    task: PatchTask,
    models: LocalModels,
    orthonormal: NDArray[np.float32],
    rng: np.random.Generator,
) -> TipResult:
    """Train one local model of the tip.

    Parameters
    ----------
    problem : FullProblem
    task : PatchTask
    models : LocalModels
        The patch by itself, trained for footprints.
    orthonormal : ndarray, shape (M, M)
        Orthonormal modes in the basis of its region.
    """
    model, weights = problem.model, problem.model.weights.ravel()
    count, most, nodal = (
        (HISTORY_MODES, HISTORY_POINTS, HISTORY_NODAL)
        if model.prony
        else (TIP_MODES, TIP_POINTS, NODAL)
    )
    space = _generous(problem.body, models, orthonormal, nodal)
    trainer = TipTrainer(
        problem,
        models,
        _untrained(space, np.arange(len(weights)), weights),
        _untrained(space, models.points, models.weights),
        deviatoric_of(model, models, space) if model.prony else None,
    )
    pressed = _press(trainer, task, rng)
    if not pressed:
        raise NoEquilibrium("endoscope.tip: no equilibrium found under it; is the load too large?")
    V = _modes(pressed, count)
    states = [state.within(V) for state in pressed]
    modes = (space @ V).astype(np.float32)
    gradients = trainer.gradients @ V.astype(np.float32)
    own = trainer.models.points
    forces = _training_forces(gradients, (own.weights[0], own.law.at(0)), states, rng)
    A = np.ascontiguousarray(forces[: len(weights)].T)
    points, chosen = nonnegative(A, A.sum(axis=1, dtype=float), most)
    # a first guess by what is known so far spares the answers that refine it half their iterations
    guess = _fit_guess(trainer.models, states)
    trained = _untrained(modes, points, chosen * weights[points], guess)
    shares, answers = _answers(TipTrainer(problem, models, trained), task, rng)
    return TipResult(
        modes=modes,
        points=trained.points,
        weights=trained.weights,
        guess=_fit_guess(trainer.models, answers).astype(np.float16),
        residual=_fit_residual(problem, models, trainer.models, modes, shares, answers),
    )


def local_tips(model: FullModel, models: LocalModels, results: Sequence[TipResult]) -> LocalTips:
    """Local models of the tip for all patches."""
    modes = np.stack([r.modes for r in results])
    pairs = neighbours(models, (FOLLOWED if model.prony else NEXT) * models.extent)
    return LocalTips(
        modes=modes,
        point_from=np.concatenate([[0], np.cumsum([len(r.points) for r in results])]),
        points=np.concatenate([r.points for r in results]),
        weights=np.concatenate([r.weights for r in results]),
        guess=np.stack([r.guess for r in results]).astype(np.float32),
        pairs=pairs,
        overlaps=overlaps(model, models, modes, pairs),
        residuals=np.stack([r.residual for r in results]),
    )


def compile_tip_query(problem: FullProblem, models: LocalModels) -> None:
    """Compile what ``train_tip`` runs, on a model of nothing."""
    modes = np.zeros((models.basis.shape[1], 4))
    tips = _untrained(modes, models.points, models.weights)
    surface = problem.surface
    over = surface.vertices[0] + 0.9 * problem.body.tip.radius * surface.normals[0]
    TipTrainer(problem, models, tips).solve(over)
    if problem.model.prony:
        TipTrainer(problem, models, tips, None, np.zeros((4, 4))).solve(over)


def _untrained(
    modes: NDArray[np.floating[Any]],
    points: NDArray[np.integer[Any]],
    weights: Array,
    guess: Array | None = None,
) -> LocalTips:
    """A model in modes (M, m) with given points, and no first guess unless it is given."""
    if guess is None:
        guess = np.zeros((TIP_FEATURES, modes.shape[1]))
    return LocalTips(
        modes=modes[None].astype(np.float32),
        point_from=np.array([0, len(points)]),
        points=points.astype(np.int32),
        weights=weights,
        guess=guess[None].astype(np.float32),
        pairs=np.zeros((0, 2), np.int32),
        overlaps=np.zeros((0, modes.shape[1], modes.shape[1]), np.float32),
        residuals=np.zeros((1, RESIDUAL_FEATURES)),
    )


def _generous(
    body: Body, models: LocalModels, orthonormal: NDArray[np.float32], nodal: int
) -> Array:
    """Modes of a patch (M, r + nodal) with its responses to forces at nodes of its surface.

    In the energy of the rest state, the response to a force at a node has the components of the
    orthonormal modes there.
    """
    _, nodes = body.touchable
    away = np.linalg.norm(body.nodes[nodes] - models.centres[0], axis=1)
    near = nodes[(away < models.extent + NODES * body.tip.radius) & ~body.clamped[nodes]]
    basis = models.basis[0].reshape(len(orthonormal), -1, 3)[:, near].reshape(len(orthonormal), -1)
    responses = orthonormal.T.astype(float) @ (models.steps[0][:, None] * basis)
    leading = np.linalg.solve(orthonormal.astype(float), models.modes[0].astype(float))
    rest = responses / np.linalg.norm(responses, axis=0)
    rest -= leading @ np.linalg.lstsq(leading, rest)[0]
    count = min(nodal, rest.shape[1]) // 4 * 4  # compiled loops take modes four at a time
    U = np.linalg.svd(rest, full_matrices=False)[0][:, :count]
    Q = np.linalg.qr(np.hstack([leading, U]))[0]
    return (orthonormal @ Q).astype(np.float32)


def _press(trainer: TipTrainer, task: PatchTask, rng: np.random.Generator) -> list[_State]:
    """Push the tip in at contacts far apart, step by step to about the largest depth.

    On tissue that remembers it is also held, slid to another contact, and lifted.
    """
    contacts, states = task.contacts, list[_State]()
    for i in farthest(contacts, min(PRESSED, len(contacts))):
        trainer.rest()
        steps = []
        for share in (np.arange(DEPTHS) + rng.uniform(0.3, 1.0, DEPTHS)) / DEPTHS:
            steps.append((i, share, QUICK))
            if trainer.in_time:
                steps.append((i, share, 10 ** rng.uniform(-1.5, 0.5)))
        if trainer.in_time:
            near = np.flatnonzero(np.linalg.norm(contacts - contacts[i], axis=1) < ASIDE)
            steps += [(rng.choice(near), rng.uniform(0.3, 0.9), QUICK), (i, 0.0, QUICK)]
        for at, share, dt in steps:
            state = trainer.solve(_centre(trainer, task, at, share), dt)
            if state is None:
                break
            states.append(state)
    return states


def _centre(trainer: TipTrainer, task: PatchTask, contact: int, share: float) -> Array:
    """Centre (3,) of the tip at a contact of the task, at a share of the largest depth there."""
    depth = float(share * task.ranges[contact, TIP_DEPTH])
    return np.asarray(task.contacts[contact] + (trainer.radius - depth) * task.normals[contact])


def _modes(states: list[_State], count: int) -> Array:
    """Leading directions (r, count) of states and their slopes, each state of size one."""
    vectors = [np.column_stack([state.q, STEP * state.slope]) / state.size for state in states]
    return np.linalg.svd(np.hstack(vectors), full_matrices=False)[0][:, :count]


def _training_forces(
    gradients: NDArray[np.float32],
    law: tuple[Array, Law],
    states: list[_State],
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """What each point (row) contributes to displacement and force of answers (columns).

    Times the square root of the compliance, an error of the internal force counts by the
    displacement it causes in the energy norm; times the slope, by the change of the force on the
    tool.  Random combinations stand for all of these.
    """
    columns = []
    each = EQUATIONS // (2 * len(states))
    for state in states:
        displacing = np.linalg.inv(state.factor).T / state.size
        looks = np.hstack([displacing, state.slope / state.pushed])
        departure = DEPARTURE * np.abs(state.q) * rng.standard_normal(len(state.q))
        for q in (state.q, state.q + departure):
            force = point_forces(gradients, *law, q, state.past)
            if force is not None:
                columns.append(force @ combined(looks.astype(np.float32), each, rng))
    return with_linear_forces(np.hstack(columns), gradients, law, RESPONSES, rng)


def _fit_guess(models: TouchModels, states: list[_State]) -> Array:
    """Polynomials (TIP_FEATURES, m) of the answers and of their change with the position."""
    rows, answers = [], []
    shifts = STEP * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
    for state in states:
        for shift in shifts:
            features, depth = np.zeros(TIP_FEATURES), state.depth - shift @ state.normal
            place = models.frames[0], models.centres[:, 0], state.position + shift
            tip_features(*place, max(depth, 0.0), features)
            rows.append(features)
            answers.append(state.q + state.slope @ shift)
    return damped_fit(np.array(rows), np.array(answers))


def _answers(
    trained: TipTrainer, task: PatchTask, rng: np.random.Generator
) -> tuple[list[float], list[_State]]:
    """Answers of a trained model all over its range, and their shares of the largest depth."""
    shares, answers = [], []
    for i in rng.integers(len(task.contacts), size=ANSWERS):
        share = np.sqrt(rng.random())
        trained.rest()
        answer = trained.solve(_centre(trained, task, i, share))
        if answer is not None:
            shares.append(share)
            answers.append(answer)
    return shares, answers


def _fit_residual(
    problem: FullProblem,
    models: LocalModels,
    placed: TouchModels,
    modes: NDArray[np.float32],
    shares: list[float],
    answers: list[_State],
) -> Array:
    """Log of the full model's relative residual (RESIDUAL_FEATURES,), by ``residual_features``.

    ``modes`` (M, m) are those of the answers.
    """
    rows = np.empty((len(answers), RESIDUAL_FEATURES))
    for row, share, answer in zip(rows, shares, answers, strict=True):
        place = placed.frames[0], placed.centres[:, 0], answer.position
        residual_features(*place, -answer.normal, share, row)
    nodal = (models.steps[0][:, None] * modes).T @ models.basis[0].astype(np.float32)
    displacements = np.array([answer.q for answer in answers]) @ nodal
    positions = np.array([answer.position for answer in answers])
    return fit_of_residuals(rows, residuals_left(problem, displacements, positions))


def residuals_left(problem: FullProblem, displacements: Array, positions: Array) -> Array:
    """Relative residuals (k,) in the full model of answers to positions of the tip.

    Parameters
    ----------
    problem : FullProblem
    displacements : ndarray, shape (k, 3 n), mm
    positions : ndarray, shape (k, 3), mm
        Of the tip's centre.
    """
    forces, free = np.zeros_like(displacements), problem.model.free
    for u, position, force in zip(displacements, positions, forces, strict=True):
        problem.tip_load(position).add_force(u, force)
    return problem.model.relative_residuals(displacements[:, free], -forces[:, free])
