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
from palpate.offline.reduce.cubature import (
    compress,
    damped_fit,
    linear_forces,
    nonnegative,
    point_forces,
)
from palpate.offline.reduce.sampling import farthest
from palpate.offline.reduce.transfer import neighbours, overlaps
from palpate.offline.reduce.viscous import deviatoric_of
from palpate.shared.geometry.surface import Surface
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.viscosity import step_weights
from palpate.shared.model import Body, LocalModels, assemble_tips
from palpate.shared.reduced.history import HISTORY_FEATURES, History, ViscousModels
from palpate.shared.reduced.press import LANES, RESIDUAL_FEATURES
from palpate.shared.reduced.press_in_time import SYMMETRIC, predict_points
from palpate.shared.reduced.tip_history import TipTimeStepper, step
from palpate.shared.reduced.touch import (
    MAX_ITERATIONS,
    STATUS,
    TIP_ERROR_FEATURES,
    TIP_FEATURES,
    LocalTips,
    TipState,
    query,
    tip_features,
)
from palpate.shared.reduced.touch_in_time import TipMemory

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

EQUATIONS = 800

RESPONSES, LINEAR = 40, 0.01
"""Random displacements in which the points have to do what linear elasticity does, and how much
that counts beside a training state."""

GUESSED = 240
"""Answers that the first guess is fitted to."""

NEIGHBOURS = 1.6
"""Distance of centres, in extents of a patch, up to which one takes over the other's answer."""


@dataclass(frozen=True)
class TipResult:
    """A trained local model of the tip; shapes as in ``reduced.touch.LocalTips``."""

    modes: NDArray[np.float32]
    points: NDArray[np.int32]
    weights: Array
    guess: NDArray[np.float16]


class TipTrainer:
    """Local models of the tip that solve training positions by the query of the service."""

    def __init__(
        self,
        body: Body,
        surface: Surface,
        models: LocalModels,
        tips: LocalTips,
        tangent: LocalTips | None = None,
    ) -> None:
        self.models = assemble_tips(body, models, tips, tangent)
        depths = np.full((len(surface.vertices), 1), np.inf)
        none = np.zeros((3, TIP_ERROR_FEATURES))
        self.state = TipState(self.models, surface.ground(depths), none)

    def solve(self, position: Array) -> bool:
        """Solve a position, from the last one if that was solved."""
        query(self.state.bound, position, MAX_ITERATIONS)
        return bool(self.state.outcome.scalars[STATUS] == newton.CONVERGED)

    @property
    def gradients(self) -> NDArray[np.float32]:
        """Gradients (c, 9, m) of the modes at the points."""
        rows = self.models.points.gradients[0]
        tiles = rows.reshape(len(rows), -1, 9, LANES)
        return np.ascontiguousarray(tiles.transpose(1, 3, 2, 0).reshape(-1, 9, len(rows)))

    def last(self, position: Array, depth: float) -> _State:
        """The last answer, which was to this position."""
        memory = self.state.memory
        return _State(
            position=position,
            depth=depth,
            q=memory.q[0].copy(),
            factor=np.tril(memory.factor[0]),
            coupling=memory.coupling[0].T.copy(),
            force=self.state.outcome.force.copy(),
        )


class TipClock:
    """A trainer of one model whose tissue remembers.

    Parameters
    ----------
    trainer : TipTrainer
    prony : sequence of (float, float)
    deviatoric : ndarray, shape (m, m)
        Of ``reduced.history.ViscousModels``.
    """

    def __init__(
        self, trainer: TipTrainer, prony: Sequence[tuple[float, float]], deviatoric: Array
    ) -> None:
        self.trainer = trainer
        self._prony = prony
        law = trainer.models.points
        self._mu, self._points = law.mu[0], law.weights.shape[1]
        none = np.zeros((0, 2), np.int32)
        viscous = ViscousModels(
            deviatoric[None].astype(np.float32), none, np.zeros((0, *deviatoric.shape), np.float32)
        )
        self._stepper = TipTimeStepper(trainer.state.bound, viscous, prony, self._points)
        self._unknown = np.zeros((3, HISTORY_FEATURES))
        self.rest()

    def rest(self) -> None:
        """Go back to where nothing has happened."""
        self._history = History()
        self._most = 0.0, 0.0

    def step(self, dt: float, position: Array, depth: float) -> _State | None:
        """Go ``dt`` (s) on to a position of the tip; None where there is no equilibrium."""
        touch, history = step(
            self.trainer.state, self._stepper, self._history, dt,
            step_weights(self._prony, dt), position, self._unknown, 0.0,
        )  # fmt: skip
        if not touch.converged:
            return None
        self._history = history
        memory = self._stepper.opened(history.locals[0].record)
        size, pushed = float(np.linalg.norm(memory.wide)), float(np.linalg.norm(touch.force))
        self._most = max(self._most[0], size), max(self._most[1], pushed)
        return _State(
            position=position,
            depth=depth,
            q=memory.wide.copy(),
            factor=np.tril(memory.factor[0]),
            coupling=memory.coupling[0].T.copy(),
            force=touch.force,
            past=self._past(memory),
            most=self._most,
        )

    def _past(self, memory: TipMemory) -> Past:
        """What the points remember now."""
        now = step_weights(self._prony, 0.0)
        B, S = np.zeros((2, SYMMETRIC * self._points), np.float32)
        predict_points(memory.points, memory.linear, now, self._mu, B, S)
        return B, S


@dataclass(frozen=True)
class _State:
    """Answer of a local model."""

    position: Array  # (3,)
    depth: float
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
    model: FullModel,
    body: Body,
    surface: Surface,
    weights: Array,
    models: LocalModels,
    orthonormal: NDArray[np.float32],
    contacts: Array,
    normals: Array,
    depths: Array,
    rng: np.random.Generator,
) -> TipResult:
    """Train one local model of the tip.

    Parameters
    ----------
    model : FullModel
        Of the tissue.
    body : Body
    surface : Surface
        Accessible.
    weights : ndarray, shape (quadrature points,), mm^3
    models : LocalModels
        The patch by itself, trained for footprints.
    orthonormal : ndarray, shape (M, M)
        Orthonormal modes in the basis of its region.
    contacts, normals : ndarray, shape (c, 3)
        Points that it answers for.
    depths : ndarray, shape (c,), mm
        Largest depths there.
    """
    count, most, nodal = (
        (HISTORY_MODES, HISTORY_POINTS, HISTORY_NODAL)
        if model.prony
        else (TIP_MODES, TIP_POINTS, NODAL)
    )
    space = _generous(body, models, orthonormal, nodal)
    trainer = TipTrainer(
        body,
        surface,
        models,
        _untrained(space, np.arange(len(weights)), weights),
        _untrained(space, models.points, models.weights),
    )
    if model.prony:
        clock = TipClock(trainer, model.prony, deviatoric_of(model, models, space))
        pressed = _press_in_time(clock, contacts, normals, depths, rng)
    else:
        pressed = _press(trainer, contacts, normals, depths, rng)
    if not pressed:
        raise NoEquilibrium("endoscope.tip: no equilibrium found under it; is the load too large?")
    V = _modes(pressed, count)
    states = [state.within(V) for state in pressed]
    modes = (space @ V).astype(np.float32)
    gradients = trainer.gradients @ V.astype(np.float32)
    law = trainer.models.points
    forces = _training_forces(gradients, (law.weights[0], law.mu[0], law.lam[0]), states, rng)
    A, b = compress(forces[: len(weights)], EQUATIONS, rng)
    points, chosen = nonnegative(A, b, most)
    chosen *= weights[points]
    trained = TipTrainer(body, surface, models, _untrained(modes, points, chosen))
    return TipResult(
        modes=modes,
        points=points.astype(np.int32),
        weights=chosen,
        guess=_fit_guess(trained, contacts, normals, depths, rng).astype(np.float16),
    )


def local_tips(model: FullModel, models: LocalModels, results: Sequence[TipResult]) -> LocalTips:
    """Local models of the tip for all patches but for ``LocalTips.residuals``."""
    modes = np.stack([r.modes for r in results])
    pairs = neighbours(models, NEIGHBOURS * models.extent)
    return LocalTips(
        modes=modes,
        point_from=np.concatenate([[0], np.cumsum([len(r.points) for r in results])]),
        points=np.concatenate([r.points for r in results]),
        weights=np.concatenate([r.weights for r in results]),
        guess=np.stack([r.guess for r in results]).astype(np.float32),
        pairs=pairs,
        overlaps=overlaps(model, models, modes, pairs),
        residuals=np.zeros((len(modes), RESIDUAL_FEATURES)),
    )


def compile_tip_query(
    body: Body,
    surface: Surface,
    models: LocalModels,
    prony: Sequence[tuple[float, float]],
) -> None:
    """Compile what ``train_tip`` runs, on a model of nothing."""
    modes = np.zeros((models.basis.shape[1], 4))
    trainer = TipTrainer(body, surface, models, _untrained(modes, models.points, models.weights))
    over = surface.vertices[0] + 0.9 * body.tip.radius * surface.normals[0]
    trainer.solve(over)
    if prony:
        TipClock(trainer, prony, np.zeros((4, 4))).step(0.0, over, 0.0)


def _untrained(
    modes: NDArray[np.floating[Any]], points: NDArray[np.integer[Any]], weights: Array
) -> LocalTips:
    """A model in modes (M, m) with given points and no first guess."""
    return LocalTips(
        modes=modes[None].astype(np.float32),
        point_from=np.array([0, len(points)]),
        points=points.astype(np.int32),
        weights=weights,
        guess=np.zeros((1, TIP_FEATURES, modes.shape[1]), np.float32),
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


def _press(
    trainer: TipTrainer,
    contacts: Array,
    normals: Array,
    depths: Array,
    rng: np.random.Generator,
) -> list[_State]:
    """Push the tip in at contacts far apart, step by step to about the largest depth."""
    states = []
    for i in farthest(contacts, min(PRESSED, len(contacts))):
        trainer.state.forget()
        for share in (np.arange(DEPTHS) + rng.uniform(0.3, 1.0, DEPTHS)) / DEPTHS:
            depth = float(share * depths[i])
            position = contacts[i] + (trainer.state.radius - depth) * normals[i]
            if not trainer.solve(position):
                break
            states.append(trainer.last(position, depth))
    return states


def _press_in_time(
    clock: TipClock,
    contacts: Array,
    normals: Array,
    depths: Array,
    rng: np.random.Generator,
) -> list[_State]:
    """Push the tip in at contacts far apart, hold it, slide to another contact and lift it."""
    states: list[_State] = []
    radius = clock.trainer.state.radius
    for i in farthest(contacts, min(PRESSED, len(contacts))):
        clock.rest()
        course = []
        for share in (np.arange(DEPTHS) + rng.uniform(0.3, 1.0, DEPTHS)) / DEPTHS:
            course += [(i, share, QUICK), (i, share, 10 ** rng.uniform(-1.5, 0.5))]
        near = np.flatnonzero(np.linalg.norm(contacts - contacts[i], axis=1) < ASIDE)
        course += [(rng.choice(near), rng.uniform(0.3, 0.9), QUICK), (i, 0.0, QUICK)]
        for place, share, dt in course:
            depth = float(share * depths[place])
            position = contacts[place] + (radius - depth) * normals[place]
            state = clock.step(dt, position, depth)
            if state is None:
                break
            states.append(state)
    return states


def _modes(states: list[_State], count: int) -> Array:
    """Leading directions (r, count) of states and their slopes, each state of size one."""
    vectors = [np.column_stack([state.q, STEP * state.slope]) / state.size for state in states]
    return np.linalg.svd(np.hstack(vectors), full_matrices=False)[0][:, :count]


def _training_forces(
    gradients: NDArray[np.float32],
    law: tuple[Array, Array, Array],
    states: list[_State],
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """What each point (row) contributes to displacement and force of answers (columns).

    Times the square root of the compliance, an error of the internal force counts by the
    displacement it causes in the energy norm; times the slope, by the change of the force on the
    tool.

    The model adds to linear elasticity what the points have beyond it.  Points of great weight do
    that well in training states and are far too stiff for linear elasticity in other directions, in
    which the potential then falls without end.  So the points shall have its stiffness, too.
    """
    columns = []
    for state in states:
        looks = np.hstack(
            [
                np.linalg.inv(state.factor).T / state.size,
                state.slope / state.pushed,
            ]
        )
        departure = DEPARTURE * np.abs(state.q) * rng.standard_normal(len(state.q))
        for q in (state.q, state.q + departure):
            force = point_forces(gradients, *law, q, state.past)
            if force is not None:
                columns.append(force @ looks.astype(np.float32))
    forces = np.hstack(columns)
    size = np.linalg.norm(forces.sum(axis=0)) / np.sqrt(forces.shape[1])
    responses = rng.standard_normal((RESPONSES, gradients.shape[2]))
    responses *= LINEAR * size / np.linalg.norm(responses, axis=1, keepdims=True)
    return np.hstack([forces, linear_forces(gradients, *law, responses)])


def _fit_guess(
    trainer: TipTrainer,
    contacts: Array,
    normals: Array,
    depths: Array,
    rng: np.random.Generator,
) -> Array:
    """Polynomials (TIP_FEATURES, m) of the answers, over all contacts and depths."""
    models, features = trainer.models, np.zeros(TIP_FEATURES)
    rows, answers = [], []
    for i in rng.integers(len(contacts), size=GUESSED):
        depth = depths[i] * np.sqrt(rng.random())
        position = contacts[i] + (trainer.state.radius - depth) * normals[i]
        trainer.state.forget()
        if trainer.solve(position):
            tip_features(models.frames[0], models.centres[:, 0], position, depth, features)
            rows.append(features.copy())
            answers.append(trainer.state.memory.q[0].copy())
    return damped_fit(np.array(rows), np.array(answers))
