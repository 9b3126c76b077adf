"""Whether a query's time knows the mesh: one sparse atlas on a coarse and on a fine mesh.

The atlas is laid out the same on both (few patches, far apart, so that the fine mesh is trained in
minutes); modes and cubature points per patch are those of the scenes.  Accuracy is not the point.
"""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from palpate.offline.reduce.sampling import random_points
from palpate.offline.run.checkpoint import Checkpoint
from palpate.offline.run.workshop import Workshop
from palpate.offline.scenes import find_scene
from palpate.offline.train import Pipeline
from palpate.shared.mechanics.footprint import LIMIT_FIELDS
from palpate.shared.model import ReducedModel
from palpate.shared.scene import Size

SIZE = Size(patch_spacing=9.0, modes=64, cubature_points=128, region_modes=150)
REGION_SPACING = 30.0  # mm
PRESSURE = 1.0  # kPa


class _Inline(ThreadPoolExecutor):
    """One worker in this process, on the pipeline's own workshop."""

    def __init__(self, workshop: Workshop) -> None:
        super().__init__(1)
        self._workshop = workshop

    def submit(self, _run, task, *args):  # type: ignore[override]
        return super().submit(task, self._workshop, *args)


def _sparse_atlas(name: str, checkpoint: Checkpoint) -> ReducedModel:
    scene = find_scene(name)
    training = scene.training.model_copy(update={"region_spacing": REGION_SPACING})
    endoscope = scene.endoscope.model_copy(update={"tip": False})
    scene = scene.model_copy(update={"training": training, "endoscope": endoscope})
    pipeline = Pipeline(scene, None, checkpoint)  # type: ignore[arg-type]
    pipeline.executor = _Inline(pipeline.workshop)
    limits = np.zeros((len(pipeline.surface.vertices), LIMIT_FIELDS))
    limits[:, 0], limits[:, 1:4] = PRESSURE, 1.0
    layout = pipeline.layout(SIZE)
    return pipeline.untested_atlas(limits, layout)


def compare(queries: int, seed: int, folder: Any) -> dict[str, Any]:
    """Time the same cold queries on both meshes, in turns.

    Returns
    -------
    dict
        ``dofs`` and median ``cold_us`` of each scene, and ``ratio`` fine over coarse.
    """
    names = ("turbinate", "turbinate-fine")
    atlases = [_sparse_atlas(name, Checkpoint(folder / name, "sparse")) for name in names]
    rng = np.random.default_rng(seed)
    positions = random_points(atlases[0].surface, queries, rng)
    times: list[list[float]] = [[], []]
    states = [atlas.new_state() for atlas in atlases]
    for position in positions:
        pressure = PRESSURE * rng.random()
        for atlas, state, taken in zip(atlases, states, times, strict=True):
            state.forget()
            started = time.perf_counter()
            atlas.solve(position, pressure, state=state)
            taken.append(1e6 * (time.perf_counter() - started))
    medians = [float(np.median(taken[queries // 10 :])) for taken in times]
    return {
        name: {"dofs": 3 * len(atlas.nodes), "cold_us": median}
        for name, atlas, median in zip(names, atlases, medians, strict=True)
    } | {"ratio": medians[1] / medians[0]}
