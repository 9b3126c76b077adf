"""Tasks of training for worker processes; see ``run.workers``.

They are functions of a ``FullProblem`` that take and return plain arrays.  ``load_range``,
``region`` and ``train_patch`` of ``reduce`` and ``FullProblem.reference`` are tasks, too.
"""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.norms import relative
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.reduce.footprint_models import local_trainer, random_load, train_patch
from palpate.offline.reduce.patches import PatchTask
from palpate.offline.reduce.regions import region
from palpate.offline.reduce.size import TrialResult
from palpate.offline.run.streams import Stage, stream
from palpate.shared.local_models import Estimators, LocalModels
from palpate.shared.model import ReducedModel

Array = NDArray[np.float64]

TRIAL_LOADS = 10


def untested(problem: FullProblem, models: LocalModels, limits: Array) -> ReducedModel:
    """Reduced model of local models and a load range, without error estimates."""
    scene = problem.scene
    return ReducedModel(
        scene.name, scene, {}, problem.body, problem.surface, limits, models, Estimators()
    )


@lru_cache(maxsize=1)
def _pickled(problem: FullProblem, path: Path) -> ReducedModel:
    return untested(problem, *pickle.loads(path.read_bytes()))


def ask(
    problem: FullProblem,
    path: Path,
    function: Callable[..., float],
    rows: Sequence[tuple[Any, ...]],
) -> list[float]:
    """Values of a function of a reduced model and of each row of further arguments.

    ``path`` is a pickle of the local models and their load range.
    """
    return [function(_pickled(problem, path), *row) for row in rows]


def trial(problem: FullProblem, task: PatchTask) -> TrialResult:
    """Train a local model by itself and judge it on loads it has not seen."""
    basis = region(problem, task.footprints, task.size.region_modes)
    result = train_patch(problem, basis, task, tip=False)
    trainer = local_trainer(problem, basis, task, result)
    rng, kept = stream(task.seed, Stage.TRIAL_LOADS), problem.beyond_clamped_layer
    displacement: list[float] = []
    von_mises: list[float] = []
    seconds: list[float] = []
    while len(seconds) < TRIAL_LOADS:
        load = Load(*random_load(problem.scene, task, rng))
        known = problem.reference([load])
        if known is None:
            continue
        started = time.perf_counter()
        sample = trainer.solve(load.position, load.direction, load.pressure)
        seconds.append(time.perf_counter() - started)
        if sample is None:
            displacement.append(np.inf)
            von_mises.append(np.inf)
            continue
        found = trainer.displacement(sample.q)
        displacement.append(relative(found, known.u[0]))
        von_mises.append(relative(problem.von_mises(found)[kept], known.s[0][kept]))
    return TrialResult(np.array(displacement), np.array(von_mises), float(np.median(seconds)))


def mesh_error(problem: FullProblem, load: Load) -> tuple[Array, Array]:
    """Degrees of freedom of the scene's mesh, its twin and a finer one, and what a load does.

    Returns
    -------
    dofs, moved : ndarray, shape (3,)
        Mean displacement under the footprint, mm.
    """
    problems = problem, *problem.remeshed
    x, normal, _ = problem.surface.project(load.position)
    moved = []
    for other in problems:
        _, under = other.press_at(x, normal, load.pressure * load.direction)
        moved.append(np.linalg.norm(under))
    return np.array([other.mesh.nodes.size for other in problems]), np.array(moved)
