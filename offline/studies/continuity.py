"""Whether the answer glides as the contact does, step by step beside the full model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from offline.bench import STEP, walk
from offline.validate import unseen_loads
from offline.workshop import Workshop
from shared.artifact import read_artifact
from shared.atlas import Atlas


def continuity(artifact: Path, paths: int, steps: int, seed: int) -> dict[str, Any]:
    """Compare the change of the whole displacement field from step to step.

    Parameters
    ----------
    artifact : Path
    paths, steps : int
        Paths over the surface, and steps of 0.05 mm along each.
    seed : int

    Returns
    -------
    dict
        ``excess_mm``: the change of the reduced field that the full model does not show, largest of
        all nodes (median, p95 and max over steps); ``change_mm``: the full model's own;
        ``switches``: steps at which the active patches change.
    """
    atlas = Atlas.load(artifact)
    workshop = Workshop.of_artifact(read_artifact(artifact))
    rng = np.random.default_rng([seed, 7])
    excess, change, switches = [], [], 0
    for start in tqdm(unseen_loads(atlas, paths, seed), desc="paths"):
        before = None
        for load in walk(atlas, start, steps + 1, rng):
            full = workshop.solve(load, None if before is None else before[0]).displacement
            solution = atlas.solve(load.position, load.pressure, load.direction)
            reduced = atlas.displacement(solution).astype(float)
            active = {number for number, _, _ in solution.patches}
            if before is not None:
                moved = full - before[0]
                change.append(np.linalg.norm(moved, axis=1).max())
                excess.append(np.linalg.norm(reduced - before[1] - moved, axis=1).max())
                switches += active != before[2]
            before = full, reduced, active
    quantiles = {"median": 50, "p95": 95, "max": 100}
    return {
        "step_mm": STEP,
        "steps": len(excess),
        "switches": switches,
        "excess_mm": {k: float(np.percentile(excess, q)) for k, q in quantiles.items()},
        "change_mm": {k: float(np.percentile(change, q)) for k, q in quantiles.items()},
    }
