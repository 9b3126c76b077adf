"""What answers err by in all, mesh and reduction together.

At places all over the surface the scene is solved on meshes graded towards each of them, the rigid
tip as a sphere integrated over their faces (``fem.contact``).  The mesh's part of an error is what
the full model on the scene's own mesh errs by, the reduction's what the answer differs from that.
"""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from palpate.offline.fem.graded import FIT_FOR_THE_TIP, Graded, parameters_of
from palpate.offline.fem.mesh import ticks_of
from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.norms import relative, statistics
from palpate.offline.fem.problem import FullProblem, Load, TipPosition
from palpate.offline.reduce.layout import centred_points_and_rim
from palpate.offline.run.tables import write_csv
from palpate.offline.studies.references import in_parallel, kept_results
from palpate.offline.validate.compare import opened
from palpate.offline.validate.queries import LOADS, TIP, Place, held_out
from palpate.shared.arrays import Array, Flags
from palpate.shared.mechanics.footprint import TIP_DEPTH
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

CLOSE = 1e-4
"""Residual of the integrated sphere, relative to its force, which then errs by as little."""

Row = dict[str, Any]


class Seen(NamedTuple):
    """What one model says of a load or a position of the tip."""

    displacement: Array  # (n, 3) mm, at the nodes of the scene's own mesh
    von_mises: Array  # (n,) kPa
    peaks: tuple[float, float]  # kPa, see ``StressField.peaks``
    force: Array  # (3,) mN


def truth(artifact: Path, scene: Scene, places: int, seed: int) -> dict[str, Any]:
    """Compare answers with references; write ``truth.csv`` to the report beside the artifact.

    Returns
    -------
    dict
        Statistics of relative errors: ``total``, ``mesh`` and ``reduction`` by quantity, of loads
        and of the tip; ``covered``, the share of total errors within the estimates, by
        quantity.
    """
    atlas, _ = opened(artifact)
    points = centred_points_and_rim(atlas.surface, places, RIM, held_out(atlas, seed))
    tasks = {"place": [(at_place, artifact, scene.folder, x) for x in points]}
    checkpoint = kept_results(artifact, scene, "truth", (places, seed))
    found = in_parallel(artifact, checkpoint, "references", tasks)["place"]
    rows = [row for own in found for row in own]
    write_csv(artifact.parent / artifact.stem / "report" / "truth.csv", rows)
    checkpoint.remove()
    return {
        name: _summary([row for row in rows if row["kind"] == name], kind.quantities)
        for name, kind in KINDS.items()
    }


KINDS = {"load": LOADS, "tip": TIP}


def at_place(problem: FullProblem, artifact: Path, folder: Path | None, x: Array) -> list[Row]:
    """Errors at a point (3,) mm of the surface; a task for ``run.workers``."""
    atlas = _opened(artifact)
    scene = parse_scene(problem.scene.text, folder)
    reference = Graded(scene, x, FIT_FOR_THE_TIP)
    at = parameters_of(scene, ticks_of(scene.geometry))
    fine, coarse = Pressed(reference.problem, integrated=True), Pressed(problem)
    away = np.linalg.norm(problem.mesh.nodes - x, axis=1)
    kept, rows = problem.beyond_clamped_layer, []
    near = kept & (away < NEAR * atlas.body.tip.radius)
    for kind, level, step in _steps(atlas, x):
        try:
            exact, own = fine.harder(kind, level, step), coarse.harder(kind, level, step)
        except NoEquilibrium:
            continue
        u, stress = (reference.at(at, field) for field in (exact.displacement, exact.von_mises))
        exact = exact._replace(displacement=u, von_mises=stress)
        answer, reduced = _reduced(atlas, step)
        row: Row = {"kind": kind, **dict(zip("xyz", x.tolist(), strict=True)), "level": level}
        for name, one, other in (
            ("total", reduced, exact), ("mesh", own, exact), ("reduction", reduced, own)
        ):  # fmt: skip
            row |= {f"{name}_{key}": value for key, value in _errors(one, other, kept, near)}
        row |= {
            f"estimated_{key}": getattr(answer, f"error_{key}")
            for key in ("displacement", "von_mises", "force")
        }
        rows.append(row)
    return rows


@lru_cache(maxsize=1)
def _opened(artifact: Path) -> ReducedModel:
    return ReducedModel.load(artifact)


def _steps(atlas: ReducedModel, x: Array) -> Iterator[tuple[str, float, Load | TipPosition]]:
    """What presses at a point: kind, growing level (share of the limit, or mm) and step."""
    place = Place.at(atlas, x)
    for level in LEVELS:
        yield "load", level, place.press(-place.normal, level)
    if atlas.has_tip:
        for depth in np.array(DEPTHS) * place.radius:
            if depth <= place.limits[TIP_DEPTH]:
                share = float(depth / place.limits[TIP_DEPTH])
                yield "tip", float(depth), place.touch(share)


class Pressed:
    """A full model pressed harder and harder; the tip is integrated over its faces if wanted."""

    def __init__(self, problem: FullProblem, integrated: bool = False) -> None:
        self._problem, self._integrated = problem, integrated
        self._last: dict[str, tuple[float, Array]] = {}

    def harder(self, kind: str, level: float, step: Load | TipPosition) -> Seen:
        """What it says at a level, sought from what the last one's of that kind grows to."""
        problem, before = self._problem, self._last.get(kind)
        start = None if before is None else level / before[0] * before[1]
        if self._integrated and isinstance(step, TipPosition):
            load, contact = problem.sphere_at(step.position), None
            found = problem.model.solve(load, start=start, tolerance=CLOSE)
        else:
            found = problem.solve(step, start=start)
            contact = problem.footprint(step, found)
        u = found.displacement
        self._last[kind] = level, u
        stress, peaks = problem.von_mises(u, contact=contact), problem.stress_field.peaks
        return Seen(u, stress, peaks(u, None, contact), found.force)


def _reduced(atlas: ReducedModel, step: Load | TipPosition) -> tuple[Any, Seen]:
    """What is answered."""
    if isinstance(step, Load):
        answer = atlas.press(step.position, step.pressure, step.direction)
    else:
        answer = atlas.touch(step.position)
    u = atlas.displacement(answer)
    peaks = atlas.peaks(answer, u)
    return answer, Seen(u.astype(float), atlas.von_mises(answer).astype(float), peaks, answer.force)


def _errors(one: Seen, other: Seen, kept: Flags, near: Flags) -> Iterator[tuple[str, float]]:
    """Relative errors of what one model says, beside another."""
    yield "displacement", relative(one.displacement, other.displacement)
    yield "von_mises", relative(one.von_mises[kept], other.von_mises[kept])
    yield "von_mises_near", relative(one.von_mises[near], other.von_mises[near])
    yield "peak", abs(one.peaks[0] / other.peaks[0] - 1)
    yield "p99", abs(one.peaks[1] / other.peaks[1] - 1)
    yield "force", relative(one.force, other.force)


def _summary(rows: Sequence[Row], estimated: Sequence[str]) -> dict[str, Any]:
    """Statistics over the rows of one kind, with estimates of some quantities."""
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
    return {"answers": len(rows), "covered": covered} | found
