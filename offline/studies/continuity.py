"""Whether the answer glides as the contact does, step by step beside the full model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from palpate.offline.bench import STEP, tip_at, walk
from palpate.offline.run.workshop import Workshop
from palpate.offline.validate.loads import unseen_loads
from palpate.offline.validate.norms import relative
from palpate.offline.validate.tip import OTHER_EQUILIBRIUM
from palpate.shared.artifact import read_artifact
from palpate.shared.model import ReducedModel


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
    atlas = ReducedModel.load(artifact)
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
    return {
        "step_mm": STEP,
        "steps": len(excess),
        "switches": switches,
        "excess_mm": _quantiles(excess),
        "change_mm": _quantiles(change),
    }


def tip_continuity(artifact: Path, paths: int, steps: int, seed: int) -> dict[str, Any]:
    """Compare the change of the force on a rigid tip from step to step.

    Parameters
    ----------
    artifact : Path
    paths, steps : int
        Paths over the surface, and steps of 0.05 mm along each.
    seed : int

    Returns
    -------
    dict
        ``excess``: the change of the reduced model's force that the full model does not show, over
        the largest force on the path (median, p95 and max over steps); ``change``: the full model's
        own. ``left_out``: steps at which the models rest in different equilibria, or the full model
        in none.
    """
    atlas = ReducedModel.load(artifact)
    workshop = Workshop.of_artifact(read_artifact(artifact))
    rng = np.random.default_rng([seed, 8])
    excess: list[float] = []
    change: list[float] = []
    for start in tqdm(unseen_loads(atlas, paths, seed), desc="paths"):
        state, before = atlas.new_state(), None
        forces = []
        for load in walk(atlas, start, steps + 1, rng):
            answer = atlas.touch(tip_at(atlas, load), state)
            reduced = atlas.displacement(answer).astype(float)
            full = workshop.touch(answer.position, reduced if before is None else before)
            before = full.displacement.astype(float) if full.displacement.size else None
            if before is None or relative(reduced, before) > OTHER_EQUILIBRIUM:
                forces.append(np.full((2, 3), np.nan))
            else:
                forces.append(np.array([full.force, answer.force]))
        moved = np.diff(forces, axis=0)  # (steps, 2, 3)
        largest = np.nan_to_num(np.linalg.norm(forces, axis=2)).max()
        change += (np.linalg.norm(moved[:, 0], axis=1) / largest).tolist()
        excess += (np.linalg.norm(moved[:, 1] - moved[:, 0], axis=1) / largest).tolist()
    kept = [e for e in excess if not np.isnan(e)]
    return {
        "step_mm": STEP,
        "steps": len(kept),
        "left_out": len(excess) - len(kept),
        "excess": _quantiles(kept),
        "change": _quantiles([c for c in change if not np.isnan(c)]),
    }


def _quantiles(values: list[float]) -> dict[str, float]:
    named = {"median": 50, "p95": 95, "max": 100}
    return {name: float(np.percentile(values, q)) for name, q in named.items()}
