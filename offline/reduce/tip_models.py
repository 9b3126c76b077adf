"""Training of a local model under the rigid tip: modes, cubature, first guess.

The full model is too slow to be asked for enough states.  The patch is asked instead, in a space
that holds nearly all that a tip can do to it: the modes that footprints gave it, and the linear
responses to forces at single nodes of the surface.  Of what it answers at contacts and depths all
over its range, and of how that changes with the position, come the few modes that it keeps.
"""

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.problem import FullProblem, TipPosition
from palpate.offline.reduce import cubature
from palpate.offline.reduce.join import deviatoric_of, half, nodal_modes, with_points
from palpate.offline.reduce.layout import Patch
from palpate.offline.reduce.sampling import farthest
from palpate.shared.arrays import Array, Field
from palpate.shared.geometry.surface import Surface, SurfaceIndex
from palpate.shared.local_models import Body, LocalModels, LocalTips
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.footprint import TIP_DEPTH
from palpate.shared.mechanics.viscosity import step_weights
from palpate.shared.reduced.features import RESIDUAL_FEATURES, TIP_FEATURES, tip_features
from palpate.shared.reduced.outcome import TOUCH_FEATURES
from palpate.shared.reduced.past import Elastic, Remembering, opened, remembering
from palpate.shared.reduced.points import SYMMETRIC, predict_points
from palpate.shared.reduced.touch import MAX_ITERATIONS, TouchModels, place, touch
from palpate.shared.reduced.workspace import Workspace
from palpate.shared.tables import touch_models

SIZES, SIZES_IN_TIME = (32, 80, 36), (52, 120, 64)
"""Modes, cubature points, and directions that responses to forces at nodes add to the modes of the
patch; the same of tissue that remembers."""

NODES = 0.6
"""Distance beyond the patch's extent within which nodes count, in radii of the tip."""

NO_LIMIT = 1e9
"""Kilopascals and millimetres: in training any pressure and depth is in range."""

PRESSED, DEPTHS = 12, 3
"""Contacts that a patch learns from, and depths at each."""

QUICK = 0.01
"""Seconds of a fast movement."""

ASIDE = 1.5
"""Millimetres that the tip slides at most."""

STEP = 0.15
"""Millimetres by which a state's derivatives in the position are followed."""

EQUATIONS = 720
"""Random combinations that stand for the equations of all training states."""

RESPONSES = 40
"""Random displacements in which the points have to do what linear elasticity does."""

ANSWERS = 48
"""Answers of the trained model, and of how they change with the position, that the first guess is
fitted to; they tell the residual in the full model, too."""


def endless(surface: Surface) -> SurfaceIndex:
    """The surface with a load range without end: see ``mechanics.footprint.pressure_limit``."""
    fields = [NO_LIMIT, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, NO_LIMIT]
    return surface.ground(np.tile(fields, (len(surface.vertices), 1)))


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
    past: cubature.Past | None  # of tissue that remembers, see ``cubature.point_forces``
    most: tuple[float, float]  # largest size and force (mN) of its history

    def within(self, V: Array) -> Self:
        """Its part in orthonormal modes V (m, k)."""
        factor = np.asarray(np.linalg.cholesky(V.T @ self.factor @ self.factor.T @ V), float)
        return replace(self, q=V.T @ self.q, factor=factor, coupling=V.T @ self.coupling)

    @property
    def size(self) -> float:
        """What its errors count against, in the energy norm."""
        return max(norm(self.q), self.most[0])

    @property
    def slope(self) -> Array:
        """Derivative (m, 3) of the answer in the position."""
        L = self.factor
        return np.linalg.solve(L.T, np.linalg.solve(L, self.coupling))

    @property
    def looks(self) -> Array:
        """What an error of the internal force counts for (m, m + 3).

        Times the square root of the compliance, it counts by the displacement that it causes in the
        energy norm; times the slope, by the change of the force on the tool.
        """
        pushed = max(norm(self.force), self.most[1])
        return np.hstack([np.linalg.inv(self.factor).T / self.size, self.slope / pushed])


def norm(vector: Array) -> float:
    """Euclidean norm."""
    return float(np.linalg.norm(vector))


class TipTrainer:
    """One local model of the tip that solves training positions by the compiled query.

    The points of ``tangent``, of the same modes, serve the tangent if given.  With the deviatoric
    part of the rest stiffness the tissue remembers.
    """

    def __init__(
        self,
        problem: FullProblem,
        models: LocalModels,
        tips: LocalTips,
        tangent: LocalTips | None = None,
    ) -> None:
        self._prony = problem.model.prony
        self.models = touch_models(problem.body, models, tips, tangent)
        self.radius = problem.body.tip.radius
        self.past: Elastic | Remembering = Elastic()
        if tips.deviatoric is not None:
            points = self.models.points.weights.shape[1]
            self.past = remembering(tips.deviatoric, len(self._prony), points)
            self._memory = opened(
                self.past.records[0], len(self._prony), tips.modes.shape[2], points
            )
        self._workspace = Workspace(
            self.models, endless(problem.surface), np.zeros((3, TOUCH_FEATURES)), self.past
        )
        self.rest()

    def rest(self) -> None:
        """Go back to where nothing has happened."""
        self._workspace.forget()
        self._most = 0.0, 0.0
        if isinstance(self.past, Remembering):
            self.past.records[0] = 0.0
            self._memory.share[-1] = 1.0

    def solve(self, position: Array, dt: float = 0.0) -> _State | None:
        """Go on to a position of the tip, in ``dt`` s; None where there is no equilibrium.

        Elastic tissue goes there in one jump from the last answer.
        """
        own, most = self._workspace, MAX_ITERATIONS - 1
        if isinstance(self.past, Remembering):
            most = MAX_ITERATIONS
            own.begin_step(self._prony, dt)
        place(own.solver, position, position)
        touch(own.solver, position, most)
        outcome, warm, past = own.outcome, own.warm, None
        if outcome.status.item() != newton.CONVERGED:
            return None
        if isinstance(self.past, Remembering):
            past, (q, force) = self._remembered(), self._most
            self._most = max(q, norm(warm.q[0])), max(force, norm(outcome.force))
        return _State(
            position=position,
            depth=outcome.depth.item(),
            normal=outcome.upward.copy(),
            q=warm.q[0].copy(),
            factor=np.tril(own.scratch.factor),
            coupling=own.scratch.coupling.T.copy(),
            force=outcome.force.copy(),
            past=past,
            most=self._most,
        )

    def _remembered(self) -> cubature.Past:
        """What the points remember now."""
        points, now = self.models.points, step_weights(self._prony, 0.0)
        B, S = np.zeros((2, SYMMETRIC * points.weights.shape[1]), np.float32)
        predict_points(self._memory.points, self._memory.linear, now, points.law.mu[0], B, S)
        return B, S


def train_tip(
    problem: FullProblem,
    patch: Patch,
    models: LocalModels,
    orthonormal: Field,
    rng: np.random.Generator,
) -> LocalTips:
    """Train one local model of the tip.

    ``models`` is the patch by itself, trained for footprints, ``orthonormal`` (M, M) are modes in
    the basis of its region.
    """
    model, weights = problem.model, problem.model.weights.ravel()
    count, most, nodal = SIZES_IN_TIME if model.prony else SIZES
    space = _generous(problem.body, models, orthonormal, nodal)
    everywhere = _untrained(space, weights)
    if model.prony:
        everywhere = replace(everywhere, deviatoric=deviatoric_of(model, models, space))
    tangent = with_points(everywhere, models.points, models.weights)
    trainer = TipTrainer(problem, models, everywhere, tangent)
    pressed = _press(trainer, patch, rng)
    if not pressed:
        raise NoEquilibrium("endoscope.tip: no equilibrium found under it; is the load too large?")
    V = _modes(pressed, count)
    states = [state.within(V) for state in pressed]
    rows, law = cubature.points_alone(trainer.models.points)
    forces = cubature.training_forces(
        cubature.by_point(rows) @ V.astype(np.float32), law,
        [(state.q, state.looks, state.past) for state in states],
        EQUATIONS // (2 * len(states)), RESPONSES, rng,
    )  # fmt: skip
    A = np.ascontiguousarray(forces[: len(weights)].T)
    points, chosen = cubature.nonnegative(A, A.sum(axis=1, dtype=float), most)
    # a first guess by what is known so far spares the answers that refine it half their iterations
    guess = _fit_guess(trainer.models, states)[None].astype(np.float32)
    tips = with_points(
        _untrained(space @ V, weights), points, chosen * weights[points], guess=guess
    )
    answers = _answers(TipTrainer(problem, models, tips), patch, rng)
    known = [
        (TipPosition(answer.position), -answer.normal, share, answer.q) for share, answer in answers
    ]
    placed, nodes = trainer.models, nodal_modes(models, tips.modes[0])
    residual = cubature.fit_residual(problem, placed.frames[0], placed.centres[:, 0], nodes, known)
    return replace(
        tips,
        guess=half(_fit_guess(placed, [answer for _, answer in answers])),
        residuals=residual[None],
        deviatoric=deviatoric_of(model, models, tips.modes[0]) if model.prony else None,
    )


def compile_tip_query(problem: FullProblem, models: LocalModels) -> None:
    """Compile what ``train_tip`` runs, on a model of nothing."""
    tips = _untrained(np.zeros((models.basis.shape[1], 4)), problem.model.weights.ravel())
    surface = problem.surface
    over = surface.vertices[0] + 0.9 * problem.body.tip.radius * surface.normals[0]
    TipTrainer(problem, models, tips).solve(over)
    if problem.model.prony:
        soft = np.zeros((1, 4, 4), np.float32)
        TipTrainer(problem, models, replace(tips, deviatoric=soft)).solve(over)


def _untrained(modes: NDArray[np.floating[Any]], weights: Array) -> LocalTips:
    """A model in modes (M, m) that knows nothing else, with every quadrature point."""
    m = modes.shape[1]
    return LocalTips(
        modes=modes[None].astype(np.float32),
        point_from=np.array([0, len(weights)]),
        points=np.arange(len(weights), dtype=np.int32),
        weights=weights,
        guess=np.zeros((1, TIP_FEATURES, m), np.float32),
        pairs=np.zeros((0, 2), np.int32),
        overlaps=np.zeros((0, m, m), np.float32),
        residuals=np.zeros((1, RESIDUAL_FEATURES)),
    )


def _generous(body: Body, models: LocalModels, orthonormal: Field, nodal: int) -> Array:
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


def _press(trainer: TipTrainer, patch: Patch, rng: np.random.Generator) -> list[_State]:
    """Push the tip in step by step; on tissue that remembers it is also held, slid, and lifted."""
    contacts, states = patch.contacts, list[_State]()
    in_time = isinstance(trainer.past, Remembering)
    for i in farthest(contacts, min(PRESSED, len(contacts))):
        trainer.rest()
        steps = []
        for share in (np.arange(DEPTHS) + rng.uniform(0.3, 1.0, DEPTHS)) / DEPTHS:
            steps.append((i, share, QUICK))
            if in_time:
                steps.append((i, share, 10 ** rng.uniform(-1.5, 0.5)))
        if in_time:
            near = np.flatnonzero(np.linalg.norm(contacts - contacts[i], axis=1) < ASIDE)
            steps += [(rng.choice(near), rng.uniform(0.3, 0.9), QUICK), (i, 0.0, QUICK)]
        for at, share, dt in steps:
            state = trainer.solve(_centre(trainer, patch, at, share), dt)
            if state is None:
                break
            states.append(state)
    return states


def _centre(trainer: TipTrainer, patch: Patch, contact: int, share: float) -> Array:
    """Centre (3,) of the tip at a contact of the patch, at a share of the largest depth there."""
    depth = float(share * patch.ranges[contact, TIP_DEPTH])
    centre: Array = patch.contacts[contact] + (trainer.radius - depth) * patch.normals[contact]
    return centre


def _modes(states: list[_State], count: int) -> Array:
    """Leading directions (r, count) of states and their slopes, each state of size one."""
    vectors = [np.column_stack([state.q, STEP * state.slope]) / state.size for state in states]
    return np.linalg.svd(np.hstack(vectors), full_matrices=False)[0][:, :count]


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
    return cubature.damped_fit(np.array(rows), np.array(answers))


def _answers(
    trained: TipTrainer, patch: Patch, rng: np.random.Generator
) -> list[tuple[float, _State]]:
    """Shares of the largest depth all over the range, and answers of a trained model there."""
    answers = []
    for i in rng.integers(len(patch.contacts), size=ANSWERS):
        share = np.sqrt(rng.random())
        trained.rest()
        answer = trained.solve(_centre(trained, patch, i, share))
        if answer is not None:
            answers.append((share, answer))
    return answers
