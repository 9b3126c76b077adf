"""Training of one local model: modes, cubature, first guess."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from offline.cubature import compress, nonnegative
from offline.sampling import cone, tangents
from offline.spaces import local_modes
from shared import equilibrium, tissue
from shared.atlas import Body, LocalModels, State, assemble_patches
from shared.endoscope import pressure_limit
from shared.reduced import (
    GUESS_FEATURES,
    LEADING,
    PATH,
    STATUS,
    Patches,
    answer,
    guess_features,
    path_stress,
)
from shared.scene import Scene

Array = NDArray[np.float64]

LOADS = 20
"""Training loads of the cubature; each gives an equilibrium and a state off equilibrium."""

OFF_EQUILIBRIUM = 0.1
"""Size of the random departure from equilibrium, relative to each mode's part in the states."""

TEST_LOADS = 6

GUESS_LOADS = 500

WIDE, PATH_DERIVATIVES = 0.2, 0.05
"""Weights of the forces in the wide space, relative to those that displace the answer."""

EQUATIONS = 240
"""Combinations of the reduced internal force that cubature is fitted to."""


@dataclass(frozen=True)
class PatchTask:
    """What a patch is trained from.

    Attributes
    ----------
    centre, normal : ndarray, shape (3,)
    pressure : float, kPa
        Scale of the load.
    basis, steps : ndarray
        Its region's modes, (M, 3 n) int16 and (M,) float32.
    orthonormal : ndarray, shape (M, M), float32
        Orthonormal modes in that basis.
    ritz : ndarray, shape (M, k), float32
        Ritz vectors in and round the patch, in the orthonormal modes.
    contacts, normals : ndarray, shape (c, 3)
        Contact points the patch answers for.
    ranges : ndarray, shape (c, 7)
        Load range there.
    extent, blend : float, mm
    seed : int
    """

    centre: Array
    normal: Array
    pressure: float
    basis: NDArray[np.int16]
    steps: NDArray[np.float32]
    orthonormal: NDArray[np.float32]
    ritz: NDArray[np.float32]
    contacts: Array
    normals: Array
    ranges: Array
    extent: float
    blend: float
    seed: int


@dataclass(frozen=True)
class PatchResult:
    """A trained patch; shapes as in ``shared.atlas.LocalModels``."""

    frame: Array
    modes: NDArray[np.float16]
    points: NDArray[np.int32]
    weights: Array
    guess: NDArray[np.float16]
    residual: float
    error: float


class LocalTrainer:
    """A single-patch atlas that solves training loads."""

    def __init__(self, body: Body, models: LocalModels, radius: float) -> None:
        self.patches: Patches = assemble_patches(body, models, radius)
        self.state = State(self.patches)
        self.radius = radius

    def solve(self, x: Array, normal: Array, direction: Array, pressure: float) -> bool:
        """Solve a load from rest; False if there is no equilibrium."""
        state = self.state
        state.forget()
        answer(
            self.patches, x, normal, direction, pressure, self.radius,
            state.memory, state.scratch, state.outcome,
        )  # fmt: skip
        return bool(state.outcome.scalars[STATUS] == equilibrium.CONVERGED)

    @property
    def wide(self) -> Array:
        """Last answer (r,) in the wide space."""
        return self.state.memory.wide[0].copy()

    @property
    def load_size(self) -> float:
        """Norm of the last load in the wide space."""
        return float(np.linalg.norm(self.state.scratch.wide_load))

    @property
    def narrow_compliance(self) -> Array:
        """``V L^-T`` (r, m): Cholesky factor L of the last tangent in the narrow space V."""
        L = np.tril(self.state.memory.factor[0])
        V = np.zeros((self.patches.gradients.shape[1], len(L)))
        V[:LEADING, :LEADING] = np.eye(LEADING)
        V[:, LEADING:] = self.state.scratch.vectors.T
        return np.linalg.solve(L, V.T).T

    @property
    def beyond_linear(self) -> Array:
        """Last answer (leading + PATH,) in the narrow space less the linear response."""
        n = LEADING + PATH
        return self.state.scratch.q[:n] - self.state.scratch.load[:n]


def train_patch(scene: Scene, body: Body, weights: Array, task: PatchTask) -> PatchResult:
    """Train one patch.

    Parameters
    ----------
    scene : Scene
    body : Body
    weights : ndarray, shape (quadrature points,), mm^3
    task : PatchTask
    """
    rng = np.random.default_rng(task.seed)
    settings = scene.training
    frame = np.array([task.normal, *tangents(task.normal)])
    # stored in half precision, so trained in it
    leading = local_modes(task.ritz.astype(np.float64), settings.modes)
    modes = (task.orthonormal @ leading).astype(np.float16)
    models = LocalModels(
        basis=task.basis[None],
        steps=task.steps[None],
        region=np.zeros(1, np.int32),
        centres=task.centre[None],
        frames=frame[None],
        pressures=np.array([task.pressure]),
        modes=modes[None].astype(np.float32),
        point_from=np.array([0, len(weights)]),
        points=np.arange(len(weights), dtype=np.int32),
        weights=weights,
        guess=np.zeros((1, GUESS_FEATURES, LEADING + PATH), np.float32),
        errors=np.zeros(1),
        extent=task.extent,
        blend=task.blend,
    )
    galerkin = LocalTrainer(body, models, scene.endoscope.radius)
    contributions = _training_forces(galerkin, scene, task, rng)
    points, chosen_weights, residual = _cubature(
        contributions, weights, settings.cubature_points, rng
    )
    models = replace(
        models,
        point_from=np.array([0, len(points)]),
        points=points.astype(np.int32),
        weights=chosen_weights,
    )
    reduced = LocalTrainer(body, models, scene.endoscope.radius)
    guess = _fit_guess(reduced, scene, task, frame, rng)
    error = _cubature_error(galerkin, reduced, scene, task, rng)
    return PatchResult(
        frame, modes, models.points, chosen_weights, guess.astype(np.float16), residual, error
    )


def _cubature_error(
    galerkin: LocalTrainer,
    reduced: LocalTrainer,
    scene: Scene,
    task: PatchTask,
    rng: np.random.Generator,
) -> float:
    """Root mean square of the relative error of the cubature on other loads, energy norm."""
    errors = []
    for _ in range(TEST_LOADS):
        load = random_load(scene, task, rng)
        if galerkin.solve(*load) and reduced.solve(*load):
            exact = galerkin.wide
            errors.append(np.linalg.norm(reduced.wide - exact) / np.linalg.norm(exact))
    return float(np.sqrt(np.mean(np.square(errors))))


def random_load(
    scene: Scene, task: PatchTask, rng: np.random.Generator
) -> tuple[Array, Array, Array, float]:
    """Contact point, normal, direction and pressure, denser towards large pressures."""
    i = rng.integers(len(task.contacts))
    direction = cone(task.normals[i], scene.endoscope.max_tilt, 1, rng)[0]
    limit = pressure_limit(task.ranges[i], task.normals[i], direction)
    return task.contacts[i], task.normals[i], direction, limit * np.sqrt(rng.random())


def _training_forces(
    trainer: LocalTrainer, scene: Scene, task: PatchTask, rng: np.random.Generator
) -> NDArray[np.float32]:
    """What each point (row) contributes to the wide forces that a query needs (columns).

    First what displaces the answer: the internal force in and off equilibrium in the narrow space,
    times the square root of the compliance there, so that its error is one of displacement in the
    energy norm.  With less weight the same force in the wide space relative to the load, which
    leads to the residual, and its second and third derivatives along the load path.
    """
    patches = trainer.patches
    G = patches.gradients
    columns = []
    P = np.empty(len(G))
    for _ in range(LOADS):
        if not trainer.solve(*random_load(scene, task, rng)):
            continue
        wide, load = trainer.wide, trainer.load_size
        compliance = trainer.narrow_compliance / np.linalg.norm(wide)
        departure = OFF_EQUILIBRIUM * np.abs(wide) * rng.standard_normal(len(wide))
        for state in (wide, wide + departure):
            F = (G @ state.astype(np.float32)).astype(np.float64)
            F.reshape(-1, 9)[:, [0, 4, 8]] += 1.0
            if _weighted_stress(F, patches.mu, patches.lam, patches.weights, P):
                force = _contributions(P, G)
                columns += [force @ compliance.astype(np.float32), force * np.float32(WIDE / load)]
        for order in (2, 3):
            H = trainer.state.scratch.H
            path_stress(order, H, patches.mu, patches.lam, patches.weights, P)
            force = _contributions(P, G)
            size = np.linalg.norm(force.sum(axis=0))
            columns.append(force * (np.float32(PATH_DERIVATIVES) / size))
    return np.hstack(columns)


@njit(cache=True, error_model="numpy", nogil=True)
def _weighted_stress(F, mu, lam, weights, P):
    """P (9 c,) times weight at gradients F (9 c,); False where a point is inverted."""
    Finv = np.empty(9)
    for c in range(len(weights)):
        _, J = tissue.stress(F[9 * c : 9 * c + 9], mu[c], lam[c], Finv, P[9 * c : 9 * c + 9])
        if not J > 0.0:
            return False
        for i in range(9):
            P[9 * c + i] *= weights[c]
    return True


def _contributions(P: Array, G: NDArray[np.float32]) -> NDArray[np.float32]:
    """Internal force of every point (c, r) from weighted stresses (9 c,)."""
    points = P.reshape(-1, 1, 9).astype(np.float32)
    return (points @ G.reshape(len(points), 9, -1))[:, 0]


def _cubature(
    contributions: NDArray[np.float32], weights: Array, most: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], Array, float]:
    """Points and weights that reproduce the sums of the contributions and the volume."""
    scale = np.sqrt(np.mean(contributions.sum(axis=0) ** 2))
    volume = (scale * weights / weights.sum()).astype(np.float32)
    A, b = compress(np.column_stack([contributions, volume]), EQUATIONS, rng)
    chosen, x = nonnegative(A, b, most)
    residual = np.linalg.norm(A[:, chosen] @ x - b) / np.linalg.norm(b)
    return chosen, x * weights[chosen], float(residual)


def _fit_guess(
    trainer: LocalTrainer, scene: Scene, task: PatchTask, frame: Array, rng: np.random.Generator
) -> Array:
    """Coefficients (features, m) of what equilibria add to the linear response."""
    rows, targets = [], []
    features = np.zeros(GUESS_FEATURES)
    for _ in range(GUESS_LOADS):
        x, normal, direction, pressure = random_load(scene, task, rng)
        if trainer.solve(x, normal, direction, pressure):
            guess_features(frame, task.centre, x, direction * pressure / task.pressure, features)
            rows.append(features.copy())
            targets.append(trainer.beyond_linear)
    A, B = np.array(rows), np.array(targets)
    scale = np.sqrt(np.mean(A**2, axis=0)) + 1e-300
    A /= scale
    ridge = 1e-4 * np.sqrt(len(A)) * np.eye(A.shape[1])
    solution = np.linalg.lstsq(np.vstack([A, ridge]), np.vstack([B, 0 * ridge[:, : B.shape[1]]]))[0]
    return solution / scale[:, None]
