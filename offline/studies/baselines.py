"""What the artifact's accuracy is worth: simpler reduced models on the same unseen loads.

- Regression: radial basis functions give POD coefficients from contact point, direction and
  pressure alone; no mechanics. Kernel and scales are those that serve best on snapshots held back.
- Galerkin in one global POD basis with all quadrature points: like the artifact's local models, but
  neither local nor with an error of cubature. Newton's method starts from the best that the basis
  can do, the projection of the exact solution, so that the error is the basis's alone.

Both learn from the same full solutions of random loads over the whole surface and range.
"""

from __future__ import annotations

import csv
import hashlib
import itertools
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from palpate.offline.fem.model import FullModel
from palpate.offline.reduce.ritz import energy_pod
from palpate.offline.run.checkpoint import Checkpoint, content_key
from palpate.offline.run.workers import resume, worker_pool
from palpate.offline.run.workshop import Load, Workshop, open_artifact
from palpate.offline.validate.loads import random_loads, unseen_loads
from palpate.offline.validate.norms import statistics
from palpate.shared.artifact import read_artifact
from palpate.shared.errors import PalpateError
from palpate.shared.mechanics import newton
from palpate.shared.model import ReducedModel

Array = NDArray[np.float64]

SNAPSHOTS = 101
"""Sets these random numbers apart, as ``validate.loads.UNSEEN`` does those of the queries."""

GALERKIN_MODES = 80
"""Beside as many as the artifact's local models iterate on and answer with."""

KERNELS = ("linear", "thin_plate_spline", "cubic")
LENGTHS = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Millimetres on the surface that weigh as much as a unit of direction, or of median pressure."""

HELD_BACK = 5
"""Every how many snapshots one is held back to choose by."""

BATCH = 10
TOLERANCE = 1e-6
MAX_ITERATIONS = 60


@dataclass(frozen=True)
class Answers:
    """What one method makes of k loads: displacements (k, 3 n) mm, and where it converged."""

    unknowns: int
    displacements: Array
    converged: NDArray[np.bool_]


def baselines(artifact: Path, snapshots: int, queries: int, seed: int) -> dict[str, dict[str, Any]]:
    """Errors of an artifact and of the baselines on random loads that none of them has seen.

    Parameters
    ----------
    artifact : Path
        The table also goes to ``NAME/report/baselines.csv`` beside it.
    snapshots : int
        Full solutions that the baselines learn from.
    queries, seed : int
        Loads to answer, the same as ``validate.loads.validate`` takes.

    Returns
    -------
    dict
        For each method ``unknowns``, ``unconverged``, ``displacement`` and ``von_mises``:
        statistics of relative errors as in ``validate.norms``.
    """
    atlas = ReducedModel.load(artifact)
    workshop = Workshop.of_artifact(read_artifact(artifact))
    model = workshop.model
    rng = np.random.default_rng([atlas.scene.seed, SNAPSHOTS, seed])
    learned = random_loads(atlas.surface, atlas.limits, atlas.scene, snapshots, rng)
    asked = unseen_loads(atlas, queries, seed)
    settings = artifact.read_bytes() + Path(__file__).read_bytes() + b"%d" % seed
    key = f"{content_key(atlas.scene)}-{hashlib.sha256(settings).hexdigest()[:16]}"
    checkpoint = Checkpoint(artifact.parent / f".{artifact.stem}.baselines", key)
    with worker_pool(open_artifact, artifact) as pool:
        learned, known = full_solutions("snapshots", learned, pool, checkpoint)
        asked, exact = full_solutions("queries", asked, pool, checkpoint)
        modes, _ = energy_pod(model, known[:, model.free].T, len(known))
        sizes = sorted({min(m, modes.shape[1]) for m in (GALERKIN_MODES, *_modes(atlas))})
        methods = {"regression": _regression(model, modes, learned, known, asked)}
        for m in sizes:
            methods[f"Galerkin, {m} global POD modes"] = _galerkin(
                model, modes[:, :m], asked, exact, pool, checkpoint
            )
    methods["artifact"] = _artifact(atlas, asked)
    report = {name: _errors(workshop, answers, exact) for name, answers in methods.items()}
    _write_csv(artifact.parent / atlas.name / "report" / "baselines.csv", report)
    checkpoint.remove()
    return report


def _modes(atlas: ReducedModel) -> tuple[int, int]:
    """Modes of a local model: those it iterates on, chosen anew for each load, and all it has."""
    layout = atlas.info["training"]["layout"]
    return layout["narrow_modes"], layout["wide_modes"]


def full_solutions(
    title: str, loads: Sequence[Load], pool: Executor, checkpoint: Checkpoint
) -> tuple[list[Load], Array]:
    """The loads that have an equilibrium, and their displacements (k, 3 n) mm."""
    tasks = {f"{title}-{len(loads)}-{i}": (Workshop.sample, load) for i, load in enumerate(loads)}
    found = resume(
        title, pool, checkpoint, tasks, lambda u: {"u": np.empty(0) if u is None else u.ravel()}
    )
    pairs = [(load, found[name]["u"]) for name, load in zip(tasks, loads, strict=True)]
    solved = [(load, u.astype(float)) for load, u in pairs if u.size]
    if not solved:
        raise PalpateError(f"{title}: no load has an equilibrium")
    return [load for load, _ in solved], np.stack([u for _, u in solved])


def _regression(
    model: FullModel, modes: Array, learned: list[Load], known: Array, asked: list[Load]
) -> Answers:
    """Radial basis functions through the coefficients of the snapshots in all their modes."""
    coefficients = known[:, model.free] @ (model.rest_stiffness @ modes)
    given, wanted = _features(learned), _features(asked)
    back = np.arange(len(given)) % HELD_BACK == 0

    def error(kernel: str, lengths: tuple[float, float]) -> float:
        guess = _interpolate(given[~back], coefficients[~back], given[back], kernel, lengths)
        off = np.linalg.norm(guess - coefficients[back], axis=1)
        return float(np.mean(off / np.linalg.norm(coefficients[back], axis=1)))

    choices = itertools.product(KERNELS, itertools.product(LENGTHS, LENGTHS))
    kernel, lengths = min(choices, key=lambda choice: error(*choice))
    found = _interpolate(given, coefficients, wanted, kernel, lengths)
    displacements = np.zeros((len(asked), known.shape[1]))
    displacements[:, model.free] = found @ modes.T
    return Answers(modes.shape[1], displacements, np.ones(len(asked), dtype=bool))


def _features(loads: Sequence[Load]) -> Array:
    """Contact point (mm), direction, and pressure (kPa), (k, 7)."""
    return np.array([[*load.position, *load.direction, load.pressure] for load in loads])


def _interpolate(
    given: Array, values: Array, wanted: Array, kernel: str, lengths: tuple[float, float]
) -> Array:
    """Interpolate values per pressure: that takes the main trend off the kernels."""
    scales = np.repeat([1.0, *lengths], [3, 3, 1])
    scales[-1] /= np.median(given[:, -1])
    scaled = given * scales
    # on a flat surface a coordinate never changes, and polynomials in it cannot be told apart
    _, spread, axes = np.linalg.svd(scaled - scaled.mean(axis=0), full_matrices=False)
    axes = axes[spread > 1e-6 * spread[0]].T
    rbf = RBFInterpolator(scaled @ axes, values / given[:, -1:], kernel=kernel, degree=1)
    return rbf(wanted * scales @ axes) * wanted[:, -1:]


def _galerkin(
    model: FullModel,
    modes: Array,
    loads: Sequence[Load],
    exact: Array,
    pool: Executor,
    checkpoint: Checkpoint,
) -> Answers:
    m = modes.shape[1]
    starts = exact[:, model.free] @ (model.rest_stiffness @ modes)
    tasks = {
        f"galerkin-{m}-{len(loads)}-{i}": (
            solve_galerkin, modes, loads[i : i + BATCH], starts[i : i + BATCH],
        )
        for i in range(0, len(loads), BATCH)
    }  # fmt: skip
    found = resume(
        f"Galerkin, {m} modes",
        pool,
        checkpoint,
        tasks,
        lambda pair: dict(zip("qc", pair, strict=True)),
    )
    displacements = np.zeros_like(exact)
    displacements[:, model.free] = np.vstack([found[name]["q"] for name in tasks]) @ modes.T
    return Answers(m, displacements, np.concatenate([found[name]["c"] for name in tasks]))


def solve_galerkin(
    workshop: Workshop, modes: Array, loads: Sequence[Load], starts: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Equilibria in the span of modes (free dofs, m): coordinates (k, m) and successes (k,)."""
    system = _GalerkinSystem(workshop.model, modes)
    coordinates, converged = starts.copy(), []
    work = np.zeros((4, modes.shape[1]))
    for load, q in zip(loads, coordinates, strict=True):
        system.load = modes.T @ workshop.load_vector(load).ravel()[workshop.model.free]
        target = TOLERANCE * float(np.linalg.norm(system.load))
        status, *_ = newton.newton(system, q, work, target, 0.0, MAX_ITERATIONS, False)
        converged.append(status == newton.CONVERGED)
    return coordinates, np.array(converged)


class _GalerkinSystem:
    """The full model in the span of modes (free dofs, m); see ``mechanics.newton``."""

    def __init__(self, model: FullModel, modes: Array) -> None:
        self.load = np.zeros(modes.shape[1])
        self._model, self._modes = model, modes
        self._full = np.zeros(3 * len(model.mesh.nodes))
        self._force = np.zeros_like(self._full)

    def potential(self, q: Array, residual: Array) -> tuple[float, float]:
        """Total potential energy (mN mm), its gradient and the smallest det F."""
        self._full[self._model.free] = self._modes @ q
        energy, smallest = self._model.internal(self._full, self._force)
        residual[:] = self._modes.T @ self._force[self._model.free] - self.load
        return energy - float(self.load @ q), smallest

    def factorise(self, q: Array, shift: float) -> bool:
        """Factorise the tangent; the rest stiffness, which shifts it, is the identity here."""
        self._full[self._model.free] = self._modes @ q
        tangent = self._modes.T @ (self._model.stiffness(self._full) @ self._modes)
        try:
            self._factor = cho_factor(tangent + shift * np.eye(len(q)))
        except LinAlgError:
            return False
        return True

    def correct(self, residual: Array, step: Array) -> None:
        """Newton's step."""
        step[:] = -cho_solve(self._factor, residual)


def _artifact(atlas: ReducedModel, loads: Sequence[Load]) -> Answers:
    solutions = [atlas.solve(load.position, load.pressure, load.direction) for load in loads]
    return Answers(
        _modes(atlas)[0],
        np.stack([atlas.displacement(solution).ravel() for solution in solutions]).astype(float),
        np.array([solution.converged for solution in solutions]),
    )


def _errors(workshop: Workshop, answers: Answers, exact: Array) -> dict[str, Any]:
    displacement, von_mises = [], []
    for answer, reference in zip(answers.displacements, exact, strict=True):
        errors = workshop.errors(answer.reshape(-1, 3), reference.reshape(-1, 3))
        displacement.append(errors[0])
        von_mises.append(errors[1])
    return {
        "unknowns": answers.unknowns,
        "unconverged": int((~answers.converged).sum()),
        "displacement": statistics(displacement),
        "von_mises": statistics(von_mises),
    }


def _write_csv(path: Path, report: Mapping[str, Mapping[str, Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        figures = [
            f"{name}_{key}"
            for name in ("displacement", "von_mises")
            for key in ("mean", "p95", "max")
        ]
        writer.writerow(["method", "unknowns", "unconverged", *figures])
        for method, row in report.items():
            errors = [*row["displacement"].values(), *row["von_mises"].values()]
            writer.writerow(
                [method, row["unknowns"], row["unconverged"], *(f"{error:.4g}" for error in errors)]
            )
