"""What a mesh errs by, and how fine it must be so that this does not dwarf the tolerance.

Meshes of ever smaller elements, about as long as wide, are pressed at the same places as meshes of
twice their divisions.  In linear elasticity: that costs one factorisation each, and under the
footprint the mesh's error is much the same there as under large loads.
"""

import re
import sys
from typing import Any

import numpy as np
from tqdm import tqdm

from palpate.offline.fem.mesh import build_mesh, cells_of, divided, in_order, ticks_of
from palpate.offline.fem.problem import FullProblem
from palpate.offline.fem.shapes import shape_of
from palpate.offline.reduce.sampling import spread_points
from palpate.offline.run.streams import Stage, stream
from palpate.shared.arrays import Array
from palpate.shared.scene import Divisions, Scene, SceneError, parse_scene

SHARE = 3.0
"""Multiple of the tolerance of displacement that the mesh's error may have."""

COARSEST, FINER, SIZES = 1.0, 0.8, 7
"""Edge of the largest elements over the endoscope's radius, ratio of the next, and their number."""

MOST_DOFS = 40_000
"""Of a mesh that is tried; its reference has more than six times as many."""

PLACES = 12

PROBE = 8
"""Steps along each axis in which a body is measured."""


def with_mesh(scene: Scene) -> tuple[Scene, dict[str, Any] | None]:
    """The scene with divisions in its text, chosen if it has none, and what was tried.

    Raises
    ------
    SceneError
        If the text has its geometry as an inline table, which they cannot be written to.
    """
    if scene.geometry.divisions is not None:
        return scene, None
    allowed = SHARE * scene.tolerance.displacement
    tried: list[dict[str, Any]] = []
    for divisions in tqdm(_candidates(scene), "choosing the mesh"):
        chosen = _divided(scene, divisions)
        dofs, error = _try(chosen)
        tried.append({"divisions": divisions, "dofs": dofs, "error": error})
        if error <= allowed or FINER**-3 * dofs > MOST_DOFS:
            break
    why = "the coarsest mesh tried with"
    if error > allowed:
        why = f"no mesh tried, of up to {dofs} DOFs, has"
    why += f" at most {allowed:.1%} error under the footprint: {error:.2%}"
    tqdm.write(f"mesh: {divisions}, {dofs} DOFs; {why}", file=sys.stderr)
    return chosen, {"why": why, "tried": tried}


def _divided(scene: Scene, divisions: Divisions) -> Scene:
    """The same scene with divisions, in its text as well."""
    table = re.search(r"^\[geometry\].*\n", scene.text, flags=re.M)
    start, key = (table.end(), "divisions") if table else (0, "geometry.divisions")
    line = f"{key} = {list(divisions)}   # chosen by training\n"
    try:
        return parse_scene(scene.text[:start] + line + scene.text[start:], scene.folder)
    except SceneError as error:
        if table:
            raise
        raise SceneError("geometry.divisions: needed where geometry is an inline table") from error


def _candidates(scene: Scene) -> list[Divisions]:
    """Divisions whose elements are about as long as wide, from coarse to fine."""
    even = np.linspace(0, 1, PROBE + 1)
    grid = shape_of(scene).grid(even, even, even)
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).mean() for axis in range(3)]
    lengths = PROBE * np.array(in_order(scene.geometry, steps))
    found: list[Divisions] = []
    for k in range(SIZES):
        edge = COARSEST * FINER**k * scene.endoscope.radius
        along, second, third = (max(1, round(length / edge)) for length in lengths)
        if (along, second, third) not in found:
            found.append((along, second, third))
    return found


def _try(scene: Scene) -> tuple[int, float]:
    """Degrees of freedom of a mesh, and the 95th percentile of its errors beside a finer one."""
    ticks = ticks_of(scene.geometry)
    a, b, c = cells_of(ticks)
    finer = build_mesh(scene, divided(ticks, (2 * a, 2 * b, 2 * c)))
    problem, reference = FullProblem(scene), FullProblem(scene, finer)
    rng = stream(scene.seed, Stage.MESH_CHOICE)
    errors = []
    for point in spread_points(problem.surface, PLACES, rng):
        x, normal, _ = problem.surface.project(point)
        moved, exact = (_moved(body, x, normal) for body in (problem, reference))
        errors.append(abs(moved / exact - 1))
    return problem.mesh.nodes.size, float(np.percentile(errors, 95))


def _moved(problem: FullProblem, x: Array, normal: Array) -> float:
    """Mean displacement under a footprint of unit pressure, along the normal; linear elasticity."""
    nodal = problem.unit_load_at(x, normal)
    load = (nodal[:, None] * normal).reshape(-1)[problem.model.free]
    u = problem.model.solve_linear(load[:, None])[:, 0]
    return float(load @ u) / float(nodal.sum())
