"""Training of one local model: modes, cubature, first guess."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.model import FullModel
from palpate.offline.reduce.cubature import (
    compress,
    damped_fit,
    nonlinear_forces,
    nonnegative,
    point_forces,
)
from palpate.offline.reduce.ritz import RITZ_VECTORS, Footprint, local_modes, whole_numbers
from palpate.offline.reduce.sampling import cone, fewer, tangents
from palpate.offline.reduce.tip_models import TipResult, compile_tip_query, train_tip
from palpate.shared.compiled import bind
from palpate.shared.geometry.surface import Surface
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.footprint import LIMIT_FIELDS, TIP_DEPTH, footprint, pressure_limit
from palpate.shared.model import Body, LocalModels, State, assemble_patches
from palpate.shared.reduced.press import (
    ERROR_FEATURES,
    FEATURES,
    LANES,
    LEADING,
    NARROW,
    PATH,
    PATH_FEATURES,
    RESIDUAL_FEATURES,
    SECOND_FEATURES,
    STATUS,
    Patches,
    Terms,
    load_features,
    query,
    residual_features,
)
from palpate.shared.scene import Scene, Size

Array = NDArray[np.float64]

LOADS = 20
"""Training loads of the cubature; each gives an equilibrium and a state off equilibrium."""

EXTREME = 0.5
"""Share of them near the largest pressure, half of those at the largest tilt: where cubature errs
most, random loads are rare."""

OFF_EQUILIBRIUM = 0.03
"""Size of the random departure from equilibrium, relative to each mode's part in the states."""

STATES = 24
"""Random loads at each footprint, half of them at the largest tilt, that modes are made for."""

FAINT = 0.1
"""Weight of the Ritz vectors themselves beside their states."""

RESIDUAL_LOADS = 64

RESIDUAL_DAMPING = 0.15
"""Of the fit of their logs: they scatter about any smooth function."""

DEFECT_LOADS, DEFECT_DAMPING = 240, 0.1
"""Equilibria that the defect is fitted to, and the damping of the fit: undamped it goes astray at
the ends of the range, where it is largest."""

GUESS_LOADS = 500

NO_LIMIT = 1e100
"""Largest pressure, kPa, that a local model in training answers for."""

PATH_LOADS, FITTED_TILT = 24, 45.0
"""Directions of load to which a footprint's path derivatives are fitted, and their cone."""

WIDE = 0.4
"""Weight of the forces in the wide space, relative to those that displace the answer."""

WIDE_SKETCH = 24
"""Random combinations that stand for the forces in the wide space; their errors add up alike."""

EQUATIONS = 300
"""Combinations of the reduced internal force that cubature is fitted to.

This, ``LOADS`` and ``RESIDUAL_LOADS`` are for the usual tolerance; see ``reduce.sampling.fewer``.
"""


@dataclass(frozen=True)
class RegionResult:
    """Basis of a region, (M, 3 n) int16 in steps (M,), and what patches learn from.

    ``orthonormal`` (M, M) holds, as columns in the basis, modes orthonormal in the energy of the
    rest state; ``ritz`` (k, M, 19 or more) are Ritz vectors in those, of the relaxed tissue last.
    """

    basis: NDArray[np.int16]
    steps: NDArray[np.float32]
    orthonormal: NDArray[np.float32]
    ritz: NDArray[np.float32]

    def truncate(self, modes: int) -> RegionResult:
        """The leading modes; ``orthonormal`` is triangular, so its leading block stays right."""
        return RegionResult(
            self.basis[:modes],
            self.steps[:modes],
            self.orthonormal[:modes, :modes],
            self.ritz[:, :modes],
        )


@dataclass(frozen=True)
class PatchTask:
    """What a patch is trained from.

    Attributes
    ----------
    centre, normal : ndarray, shape (3,)
    pressure : float, kPa
        Scale of the load.
    footprints : list of Footprint
        In and round the patch; it learns from their Ritz vectors.
    contacts, normals : ndarray, shape (c, 3)
        Contact points the patch answers for.
    ranges : ndarray, shape (c, LIMIT_FIELDS)
        Load range there.
    extent, blend : float, mm
    size : Size
    seed : int
    """

    centre: Array
    normal: Array
    pressure: float
    footprints: list[Footprint]
    contacts: Array
    normals: Array
    ranges: Array
    extent: float
    blend: float
    size: Size
    seed: int


@dataclass(frozen=True)
class PatchResult:
    """A trained patch; shapes as in ``shared.model.LocalModels``."""

    frame: Array
    whole: NDArray[np.int16]
    mix: NDArray[np.float32]
    points: NDArray[np.int32]
    weights: Array
    path: NDArray[np.float16]
    defect: NDArray[np.float16]
    guess: NDArray[np.float16]
    residual: Array
    tip: TipResult | None = None

    def arrays(self) -> dict[str, Any]:
        """All by name, those under the tip after ``tip_``."""
        tip = {} if self.tip is None else vars(self.tip)
        own = {name: value for name, value in vars(self).items() if name != "tip"}
        return own | {f"tip_{name}": value for name, value in tip.items()}

    @classmethod
    def of(cls, arrays: Mapping[str, Any]) -> PatchResult:
        """Inverse of ``arrays``."""
        tip = {k.removeprefix("tip_"): v for k, v in arrays.items() if k.startswith("tip_")}
        own = {k: v for k, v in arrays.items() if not k.startswith("tip_")}
        return cls(**own, tip=TipResult(**tip) if tip else None)


class LocalTrainer:
    """A single-patch atlas that solves training loads, by the compiled query of the service."""

    def __init__(self, scene: Scene, body: Body, surface: Surface, models: LocalModels) -> None:
        self.radius = scene.endoscope.radius
        self.models = models
        self.patches: Patches = assemble_patches(body, models, scene)
        self.state = State(self.patches, surface.clusters)
        no_limit = np.tile(np.eye(LIMIT_FIELDS)[1:4].sum(0), (len(surface.vertices), 1))
        no_limit[:, 0] = NO_LIMIT
        self.terms = bind(
            Terms(
                ground=surface.ground(no_limit),
                reach=scene.endoscope.reach,
                max_tilt=scene.endoscope.max_tilt,
                residuals=models.residuals,
                coefficients=np.zeros((2, ERROR_FEATURES)),
            )
        )

    def solve(self, x: Array, direction: Array, pressure: float) -> bool:
        """Solve a load from rest; False if there is no equilibrium."""
        state = self.state
        state.forget()
        query(self.terms, state.bound, x, direction, pressure, self.radius)
        return bool(state.outcome.scalars[STATUS] == newton.CONVERGED)

    def internal_forces(self, states: Array) -> Array:
        """What the law adds to linear elasticity's force: (k, r) in states (k, r)."""
        patches = self.patches
        rows = patches.gradients[0] * patches.steps[0][:, None]
        law = patches.weights[0], patches.mu[0], patches.lam[0]
        return nonlinear_forces(rows, *law, states)

    @property
    def wide(self) -> Array:
        """Last answer (r,) in the wide space."""
        return self.state.memory.wide[0].copy()

    @property
    def nodal_modes(self) -> NDArray[np.float32]:
        """Wide modes (r, 3 n) at the nodes."""
        modes = self.models.steps[0][:, None] * self.models.modes[0]
        return np.asarray(modes.T @ self.models.basis[0].astype(np.float32))

    @property
    def displacement(self) -> Array:
        """Last answer at the nodes, (n, 3) mm."""
        return np.asarray(self.wide @ self.nodal_modes).reshape(-1, 3)

    @property
    def load_size(self) -> float:
        """Norm of the last load in the wide space."""
        return float(np.linalg.norm(self.state.scratch.wide_load))

    @property
    def narrow_compliance(self) -> Array:
        """``V L^-T`` (r, m): Cholesky factor L of the last tangent in the narrow space V."""
        L = np.tril(self.state.scratch.factor)
        V = np.zeros((self.patches.gradients.shape[1], len(L)))
        V[:LEADING, :LEADING] = np.eye(LEADING)
        V[:, LEADING:] = self.state.scratch.vectors.T
        return np.asarray(np.linalg.solve(L, V.T).T)

    @property
    def beyond_linear(self) -> Array:
        """Last answer (leading + PATH,) in the narrow space less the linear response."""
        n = LEADING + PATH
        return self.state.scratch.q[:n] - self.state.scratch.load[:n]


def compile_query(scene: Scene, body: Body, surface: Surface) -> None:
    """Compile what local models are trained and queried with, on a model of nothing."""
    models = LocalModels(
        basis=np.zeros((1, LANES, 3 * len(body.nodes)), np.int16),
        steps=np.zeros((1, LANES), np.float32),
        region=np.zeros(1, np.int32),
        centres=surface.vertices[:1],
        frames=np.eye(3)[None],
        pressures=np.ones(1),
        whole=np.zeros((1, LANES, NARROW), np.int16),
        mix=np.zeros((1, NARROW, NARROW), np.float32),
        point_from=np.array([0, 1]),
        points=np.zeros(1, np.int32),
        weights=np.ones(1),
        path=np.zeros((1, PATH_FEATURES, NARROW), np.float32),
        defect=np.zeros((1, PATH_FEATURES, NARROW), np.float32),
        guess=np.zeros((1, FEATURES, LEADING + PATH), np.float32),
        residuals=np.zeros((1, RESIDUAL_FEATURES)),
        extent=1.0,
        blend=1.0,
        tips=None,
    )
    trainer = LocalTrainer(scene, body, surface, models)
    trainer.solve(surface.vertices[0], surface.normals[0], 0.0)
    if scene.endoscope.tip:
        compile_tip_query(body, surface, models, scene.tissue.prony)


def train_patch(
    scene: Scene,
    model: FullModel,
    body: Body,
    surface: Surface,
    region: RegionResult,
    task: PatchTask,
) -> PatchResult:
    """Train one patch.

    Parameters
    ----------
    scene : Scene
    model : FullModel
    body : Body
    surface : Surface
        Accessible.
    region : RegionResult
        With the Ritz vectors of the task's footprints.
    task : PatchTask
    """
    rng = np.random.default_rng(task.seed)
    weights = model.weights.ravel()
    frame = np.array([task.normal, *tangents(task.normal)])
    ritz = region.ritz.astype(np.float64)
    leading = local_modes(_expected(scene, ritz, task, rng), task.size.modes)
    whole, mix = whole_numbers(region.orthonormal @ leading, region.orthonormal)
    # stored in these and in half precision, so trained in it
    everywhere = PatchResult(
        frame=frame,
        whole=whole,
        mix=mix,
        points=np.arange(len(weights), dtype=np.int32),
        weights=weights,
        path=_fit_path(leading.T @ ritz[:, :, :RITZ_VECTORS], task, frame).astype(np.float16),
        defect=np.zeros((PATH_FEATURES, leading.shape[1]), np.float16),
        guess=np.zeros((FEATURES, LEADING + PATH), np.float16),
        residual=np.zeros(RESIDUAL_FEATURES),
    )
    galerkin = local_trainer(scene, body, surface, region, task, everywhere)
    contributions = _training_forces(galerkin, scene, task, rng)[: len(weights)]
    most = task.size.cubature_points
    equations = max(most, fewer(EQUATIONS, scene.tolerance))
    points, chosen = _cubature(contributions, weights, equations, most, rng)
    result = replace(everywhere, points=points.astype(np.int32), weights=chosen)
    reduced = local_trainer(scene, body, surface, region, task, result)
    defect = _fit_defect(galerkin, reduced, scene, task, frame, rng)
    result = replace(result, defect=defect.astype(np.float16))
    reduced = local_trainer(scene, body, surface, region, task, result)
    guess = _fit_guess(reduced, scene, task, frame, rng)
    residual = _fit_residual(model, reduced, body, scene, task, frame, rng)
    tip = None
    if scene.endoscope.tip:
        tip = train_tip(
            model, body, surface, weights, reduced.models, region.orthonormal,
            task.contacts, task.normals, task.ranges[:, TIP_DEPTH], rng,
        )  # fmt: skip
    return replace(result, guess=guess.astype(np.float16), residual=residual, tip=tip)


def local_trainer(
    scene: Scene,
    body: Body,
    surface: Surface,
    region: RegionResult,
    task: PatchTask,
    result: PatchResult,
) -> LocalTrainer:
    """A patch by itself, ready to be solved."""
    return LocalTrainer(
        scene,
        body,
        surface,
        LocalModels(
            basis=region.basis[None],
            steps=region.steps[None],
            region=np.zeros(1, np.int32),
            centres=task.centre[None],
            frames=result.frame[None],
            pressures=np.array([task.pressure]),
            whole=result.whole[None],
            mix=result.mix[None],
            point_from=np.array([0, len(result.points)]),
            points=result.points,
            weights=result.weights,
            path=result.path[None].astype(np.float32),
            defect=result.defect[None].astype(np.float32),
            guess=result.guess[None].astype(np.float32),
            residuals=np.zeros((1, RESIDUAL_FEATURES)),
            extent=task.extent,
            blend=task.blend,
            tips=None,
        ),
    )


def _expected(scene: Scene, ritz: Array, task: PatchTask, rng: np.random.Generator) -> Array:
    """What modes are to span (M, k): states under random loads, and faintly all Ritz vectors.

    The states are those of third order in the load, from Ritz vectors (f, M, 19 or more).
    """
    parts = [FAINT * vectors for vectors in ritz]
    tilt = scene.endoscope.max_tilt
    for place, vectors in zip(task.footprints, ritz, strict=True):
        directions = [
            cone(place.normal, tilt, STATES // 2, rng, border) for border in (False, True)
        ]
        loads = place.pressure * np.sqrt(rng.random((STATES, 1))) * np.vstack(directions)
        for first in range(0, vectors.shape[1], RITZ_VECTORS):  # the relaxed tissue's, too
            own = vectors[:, first : first + RITZ_VECTORS]
            one, two, three = place.path_derivatives(own, loads)
            parts.append((one + two / 2 + three / 6).T / np.sqrt(STATES))
    return np.hstack(parts)


def _fit_path(ritz: Array, task: PatchTask, frame: Array) -> Array:
    """Second and third path derivative (PATH_FEATURES, r) from Ritz vectors (k, r, 19)."""
    rng = np.random.default_rng(task.seed)
    rows, second, third = [], [], []
    features = np.zeros(FEATURES)
    for place, vectors in zip(task.footprints, ritz, strict=True):
        loads = place.pressure * cone(place.normal, FITTED_TILT, PATH_LOADS, rng)
        for load in loads:
            load_features(frame, task.centre, place.point, load / task.pressure, features)
            rows.append(features[:PATH_FEATURES].copy())
        _, two, three = place.path_derivatives(vectors, loads)
        second.append(two)
        third.append(three)
    A = np.array(rows)
    return np.vstack(
        [
            damped_fit(A[:, :SECOND_FEATURES], np.vstack(second)),
            damped_fit(A[:, SECOND_FEATURES:], np.vstack(third)),
        ]
    )


def _fit_residual(
    model: FullModel,
    reduced: LocalTrainer,
    body: Body,
    scene: Scene,
    task: PatchTask,
    frame: Array,
    rng: np.random.Generator,
) -> Array:
    """Log of the full model's relative residual (RESIDUAL_FEATURES,), by ``residual_features``."""
    rows, states, loads = [], [], []
    nodal, features = np.zeros(len(body.nodes)), np.zeros(RESIDUAL_FEATURES)
    for _ in range(fewer(RESIDUAL_LOADS, scene.tolerance)):
        x, direction, limit = _limit(scene, task, rng, border=False)
        share = np.sqrt(rng.random())
        if reduced.solve(x, direction, share * limit):
            outcome = reduced.state.outcome
            footprint(body.boundary, outcome.point, outcome.normal, reduced.radius, nodal)
            residual_features(frame, task.centre, x, direction, share, features)
            rows.append(features.copy())
            states.append(reduced.wide)
            loads.append((share * limit * nodal[:, None] * direction).ravel())
    answers = np.array(states) @ reduced.nodal_modes
    residuals = model.relative_residuals(answers[:, model.free], np.array(loads)[:, model.free])
    kept = (residuals > 0) & np.isfinite(residuals)
    logs = np.log(residuals[kept])
    fitted = damped_fit(np.array(rows)[kept], (logs - logs.mean())[:, None], RESIDUAL_DAMPING)[:, 0]
    fitted[0] += logs.mean()
    return fitted


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
    frame: Array,
    draw: Callable[[Scene, PatchTask, np.random.Generator], tuple[Array, Array, float]],
    count: int,
    rng: np.random.Generator,
) -> Iterator[Array]:
    """Features (FEATURES,) of drawn loads, each while the trainer's last answer is to that load.

    Loads that it does not solve are left out.
    """
    features = np.zeros(FEATURES)
    for _ in range(count):
        x, direction, pressure = draw(scene, task, rng)
        if trainer.solve(x, direction, pressure):
            load_features(frame, task.centre, x, direction * pressure / task.pressure, features)
            yield features


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
    """What each point (row) contributes to the wide forces that a query needs (columns).

    First what displaces the answer: the internal force in and off equilibrium in the narrow space,
    times the square root of the compliance there, so that its error is one of displacement in the
    energy norm.  With less weight the same force in the wide space relative to the load, which
    leads to the residual.
    """
    columns = []
    patches = trainer.patches
    gradients = _point_gradients(patches)
    law = patches.weights[0], patches.mu[0], patches.lam[0]
    for _ in range(fewer(LOADS, scene.tolerance)):
        if not trainer.solve(*_training_load(scene, task, rng)):
            continue
        wide, load = trainer.wide, trainer.load_size
        compliance = trainer.narrow_compliance / np.linalg.norm(wide)
        departure = OFF_EQUILIBRIUM * np.abs(wide) * rng.standard_normal(len(wide))
        for state in (wide, wide + departure):
            force = point_forces(gradients, *law, state)
            if force is not None:
                wide_part = rng.standard_normal((len(wide), WIDE_SKETCH)) / np.sqrt(WIDE_SKETCH)
                looks = np.hstack([compliance, WIDE / load * wide_part])
                columns.append(force @ looks.astype(np.float32))
    return np.hstack(columns)


def _point_gradients(patches: Patches) -> NDArray[np.float32]:
    """Gradients (c, 9, r) of the wide modes of a single patch."""
    rows = patches.gradients[0] * patches.steps[0][:, None]
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
    frame: Array,
    rng: np.random.Generator,
) -> Array:
    """Force (PATH_FEATURES, r) that the cubature misses in equilibrium, relative to the answer."""
    rows, states = [], []
    for features in _answered(reduced, scene, task, frame, _training_load, DEFECT_LOADS, rng):
        rows.append(features[:PATH_FEATURES].copy())
        states.append(reduced.wide)
    missed = galerkin.internal_forces(np.array(states)) - reduced.internal_forces(np.array(states))
    scale = 1.0 / np.linalg.norm(states, axis=1, keepdims=True)
    kept = np.isfinite(missed).all(axis=1)
    return damped_fit((scale * rows)[kept], (scale * missed)[kept], DEFECT_DAMPING)


def _fit_guess(
    trainer: LocalTrainer, scene: Scene, task: PatchTask, frame: Array, rng: np.random.Generator
) -> Array:
    """Coefficients (features, m) of what equilibria add to the linear response."""
    rows, targets = [], []
    for features in _answered(trainer, scene, task, frame, random_load, GUESS_LOADS, rng):
        rows.append(features.copy())
        targets.append(trainer.beyond_linear)
    return damped_fit(np.array(rows), np.array(targets))
