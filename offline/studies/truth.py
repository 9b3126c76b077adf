"""What answers err by in all, mesh and reduction together.

At places all over the surface the scene is solved on meshes graded towards each of them, the rigid
tip as a sphere integrated over their faces (``fem.contact``).  The mesh's part of an error is what
the full model on the scene's own mesh errs by, the reduction's what the answer differs from that.
"""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from palpate.offline.fem.graded import FIT_FOR_FOOTPRINTS, FIT_FOR_THE_TIP
from palpate.offline.fem.norms import relative, statistics
from palpate.offline.fem.problem import FullProblem, Load, TipPosition
from palpate.offline.reduce.layout import centred_points_and_rim
from palpate.offline.run.tables import write_csv
from palpate.offline.studies.references import in_parallel, kept_results
from palpate.offline.validate.compare import opened
from palpate.offline.validate.mesh_part import Levels, Seen, answered, compared
from palpate.offline.validate.queries import LOADS, TIP, Place, held_out
from palpate.shared.arrays import Array
from palpate.shared.model import ReducedModel
from palpate.shared.scene import Scene, parse_scene

RIM = 4
"""One place in so many lies on the rim of the surface."""

LEVELS = 0.5, 1.0
"""Shares of the limit at which footprints press, along the normal."""

DEPTHS = 0.05, 0.1, 0.2, 0.4, 0.6
"""Of the tip, in radii, as far as its range goes."""

NEAR = 1.5
"""Distance from the contact, in radii, within which stress is also compared by itself."""

Row = dict[str, Any]


def truth(artifact: Path, scene: Scene, places: int, seed: int) -> dict[str, Any]:
    """Compare answers with references; write ``truth.csv`` to the report beside the artifact.

    Returns
    -------
    dict
        Statistics of relative errors: ``total``, ``mesh`` and ``reduction`` by quantity, of loads
        and of the tip; ``covered``, the share of total errors within the estimates, by
        quantity; ``out_of_range``, answers that say so, as of a tip that slides: they do not count.
    """
    atlas, _ = opened(artifact)
    points = centred_points_and_rim(atlas.surface, places, RIM, held_out(atlas, seed))
    tasks = {"place": [(at_place, artifact, scene.folder, x) for x in points]}
    with kept_results(artifact, scene, "truth", (places, seed)) as checkpoint:
        found = in_parallel(artifact, checkpoint, "references", tasks)["place"]
        rows = [row for own in found for row in own]
        write_csv(artifact.parent / artifact.stem / "report" / "truth.csv", rows)
    return {
        name: _summary([row for row in rows if row["kind"] == name], kind.quantities)
        for name, kind in KINDS.items()
    }


KINDS = {"load": LOADS, "tip": TIP}
GRADINGS = {"load": FIT_FOR_FOOTPRINTS, "tip": FIT_FOR_THE_TIP}


def at_place(problem: FullProblem, artifact: Path, folder: Path | None, x: Array) -> list[Row]:
    """Errors at a point (3,) mm of the surface; a task for ``run.workers``."""
    atlas = _opened(artifact)
    scene = parse_scene(problem.scene.text, folder)
    away = np.linalg.norm(problem.mesh.nodes - x, axis=1)
    volumes, rows = problem.nodal_volumes, []
    kept = problem.counted_volumes
    near = kept * (away < NEAR * atlas.body.tip.radius)
    for kind, levels in _levels(atlas, x):
        for level, step, own, exact in compared(problem, scene, levels, GRADINGS[kind]):
            answer, reduced = _reduced(atlas, step)
            row: Row = {"kind": kind, **dict(zip("xyz", x.tolist(), strict=True)), "level": level}
            for name, one, other in (
                ("total", reduced, exact), ("mesh", own, exact), ("reduction", reduced, own)
            ):  # fmt: skip
                row |= {
                    f"{name}_{key}": value
                    for key, value in _errors(one, other, volumes, kept, near)
                }
            row |= {
                f"estimated_{key}": getattr(answer, f"error_{key}")
                for key in ("displacement", "von_mises", "force")
            }
            rows.append(row)
    return rows


@lru_cache(maxsize=1)
def _opened(artifact: Path) -> ReducedModel:
    return ReducedModel.load(artifact)


def _levels(atlas: ReducedModel, x: Array) -> Iterator[tuple[str, Levels]]:
    """What presses at a point, by kind: growing levels (share of the limit, or mm) and steps."""
    place = Place.at(atlas, x)
    pressed = [(level, place.press(-place.normal, level)) for level in LEVELS]
    yield "load", answered(atlas, pressed)
    depths = [depth * place.radius for depth in DEPTHS if depth * place.radius <= place.depth]
    if depths:
        steps = [(depth, place.touch(depth / place.depth)) for depth in depths]
        yield "tip", answered(atlas, steps)


def _reduced(atlas: ReducedModel, step: Load | TipPosition) -> tuple[Any, Seen]:
    """What is answered."""
    if isinstance(step, Load):
        answer = atlas.press(step.position, step.pressure, step.direction)
    else:
        answer = atlas.touch(step.position)
    u = atlas.displacement(answer)
    stress, peaks = atlas.von_mises(answer, displacement=u), atlas.peaks(answer, u)
    felt = answer.contact_displacement if isinstance(step, Load) else answer.force
    return answer, Seen(u.astype(float), stress.astype(float), peaks, felt)


def _errors(
    one: Seen, other: Seen, volumes: Array, kept: Array, near: Array
) -> Iterator[tuple[str, float]]:
    """Relative errors of what one model says, beside another.

    Volumes (n,) mm^3 of all nodes, of those where stress is compared, of those near the contact.
    """
    yield "displacement", relative(one.displacement, other.displacement, volumes)
    yield "von_mises", relative(one.von_mises, other.von_mises, kept)
    yield "von_mises_near", relative(one.von_mises, other.von_mises, near)
    yield "peak_near", abs(one.von_mises[near > 0].max() / other.von_mises[near > 0].max() - 1)
    yield "peak", abs(one.peaks[0] / other.peaks[0] - 1)
    yield "p99", abs(one.peaks[1] / other.peaks[1] - 1)
    yield "force", relative(one.felt, other.felt)  # of a footprint: what it moves


def _summary(rows: Sequence[Row], estimated: Sequence[str]) -> dict[str, Any]:
    """Statistics over the rows of one kind, with estimates of some quantities."""
    asked, rows = len(rows), [row for row in rows if np.isfinite(row["estimated_displacement"])]
    if not rows:
        return {}
    names = [key.removeprefix("total_") for key in rows[0] if key.startswith("total_")]
    found: dict[str, Any] = {
        part: {name: statistics([row[f"{part}_{name}"] for row in rows]) for name in names}
        for part in ("total", "mesh", "reduction")
    }
    covered = {
        name: float(np.mean([row[f"total_{name}"] <= row[f"estimated_{name}"] for row in rows]))
        for name in estimated
    }
    counts = {"answers": len(rows), "out_of_range": asked - len(rows)}
    return counts | {"covered": covered} | found
