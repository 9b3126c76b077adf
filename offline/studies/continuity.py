"""Whether the answer changes smoothly as the contact glides, step by step beside the full model."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from palpate.offline.bench import STEP, walk
from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.norms import relative
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.validate.compare import OTHER_EQUILIBRIUM, opened
from palpate.offline.validate.queries import Place, held_out_loads
from palpate.shared.arrays import Array
from palpate.shared.model import ReducedModel

STATISTICS = {"median": 50, "p95": 95, "max": 100}


def continuity(
    artifact: Path, paths: int, steps: int, seed: int, tip: bool = False
) -> dict[str, Any]:
    """Compare the changes of both models' answers along paths, in steps of 0.05 mm.

    Returns
    -------
    dict
        ``excess``: the change of the reduced answer that the full model does not show (median, p95
        and max over steps); ``change``: the full model's own.  Of a footprint they are of the
        displacement, largest of all nodes, in mm; of the tip, of its force over the largest force
        on the path.  ``left_out``: steps at which the models rest in different equilibria, or the
        full model in none.
    """
    atlas, problem = opened(artifact)
    rng = np.random.default_rng([seed, 8 if tip else 7])
    found = []
    for start in tqdm(held_out_loads(atlas, paths, seed), desc="paths"):
        loads = walk(atlas, start, steps + 1, rng)
        full, reduced = np.diff((_forces if tip else _displacements)(atlas, problem, loads), axis=1)
        found.append([np.linalg.norm(x, axis=2).max(axis=1) for x in (reduced - full, full)])
    excess, change = np.hstack(found)
    kept = ~np.isnan(excess)
    report = {"step_mm": STEP, "steps": int(kept.sum()), "left_out": int((~kept).sum())}
    return report | {
        name: {key: float(np.percentile(x[kept], q)) for key, q in STATISTICS.items()}
        for name, x in (("excess", excess), ("change", change))
    }


def _displacements(atlas: ReducedModel, problem: FullProblem, loads: Sequence[Load]) -> Array:
    """Displacements (2, t, n, 3) mm of the full and the reduced model."""
    full: list[Array] = []
    for load in loads:
        full.append(problem.solve(load, start=full[-1] if full else None).displacement)
    answers = [atlas.press(load.position, load.pressure, load.direction) for load in loads]
    return np.array([full, [atlas.displacement(answer) for answer in answers]], dtype=float)


def _forces(atlas: ReducedModel, problem: FullProblem, loads: Sequence[Load]) -> Array:
    """Forces (2, t, 1, 3) of both models over the largest, nan where they are not comparable."""
    warm, before = atlas.new_warm(), None
    forces = np.full((2, len(loads), 1, 3), np.nan)
    for i, load in enumerate(loads):
        tip = Place.at(atlas, load.position).touch(0.5)
        answer = atlas.touch(tip.position, warm=warm)
        reduced = atlas.fields.of_mesh(answer).astype(float)
        try:
            full = problem.solve(tip, start=reduced if before is None else before)
        except NoEquilibrium:
            before = None
            continue
        before = full.displacement
        if relative(reduced, before) <= OTHER_EQUILIBRIUM:
            forces[:, i, 0] = full.force, answer.force
    return forces / np.nan_to_num(np.linalg.norm(forces, axis=3)).max()
