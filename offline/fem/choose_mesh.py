"""How fine a mesh must be: the coarsest whose own error does not dwarf the scene's tolerance.

Meshes of ever smaller elements, about as long as wide, are pressed at the same places as meshes of
twice their divisions.  In linear elasticity: that costs one factorisation each, and under the
footprint the mesh's error is much the same there as under large loads.
"""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from palpate.offline.fem.mesh import build_mesh
from palpate.offline.fem.problem import FullProblem
from palpate.offline.fem.refine import refined
from palpate.offline.reduce.sampling import spread_points
from palpate.offline.run.streams import Stage, stream
from palpate.shared.scene import Block, Divisions, Scene, SceneError, divisions_of, parse_scene

Array = NDArray[np.float64]

SHARE = 3.0
"""Multiple of the tolerance of displacement that the mesh's error may have."""

COARSEST, FINER, SIZES = 1.0, 0.8, 7
"""Edge of the largest elements over the endoscope's radius, ratio of the next, and their number."""

MOST_DOFS = 40_000
"""Of a mesh that is tried; its reference has more than six times as many."""

PLACES = 12


@dataclass(frozen=True)
class MeshTrial:
    """A mesh that was tried: ``error`` is the 95th percentile over all places."""

    divisions: Divisions
    dofs: int
    error: float


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
    tried: list[MeshTrial] = []
    for divisions in tqdm(_candidates(scene), "choosing the mesh"):
        tried.append(_try(_divided(scene, divisions)))
        if tried[-1].error <= allowed or FINER**-3 * tried[-1].dofs > MOST_DOFS:
            break
    chosen = tried[-1]
    if chosen.error <= allowed:
        why = "the coarsest mesh tried with"
    else:
        why = f"no mesh tried, of up to {chosen.dofs} DOFs, has"
    why += f" at most {allowed:.1%} error under the footprint: {chosen.error:.2%}"
    tqdm.write(f"mesh: {chosen.divisions}, {chosen.dofs} DOFs; {why}", file=sys.stderr)
    document = {"why": why, "tried": [vars(trial) for trial in tried]}
    return _divided(scene, chosen.divisions), document


def _divided(scene: Scene, divisions: Divisions) -> Scene:
    """The same scene with divisions, in its text as well."""
    table = re.search(r"^\[geometry\].*\n", scene.text, flags=re.M)
    start, key = (table.end(), "divisions") if table else (0, "geometry.divisions")
    line = f"{key} = {list(divisions)}   # chosen by training\n"
    try:
        return parse_scene(scene.text[:start] + line + scene.text[start:], scene.folder)
    except SceneError as error:
        raise SceneError("geometry.divisions: needed where geometry is an inline table") from error


def _candidates(scene: Scene) -> list[Divisions]:
    """Divisions whose elements are about as long as wide, from coarse to fine."""
    probe = np.array([8, 8, 8])
    geometry = scene.geometry.model_copy(update={"element": "hex8", "divisions": tuple(probe)})
    mesh = build_mesh(scene.model_copy(update={"geometry": geometry}))
    corners = mesh.nodes[mesh.elements]
    # the lattice's axes: of a block x, y, z; of an extrusion along the section, y, through it
    edges = [np.linalg.norm(corners[:, i] - corners[:, 0], axis=1).mean() for i in (1, 3, 4)]
    lengths = probe * np.array(edges)
    if not isinstance(scene.geometry, Block):
        lengths = lengths[[0, 2, 1]]
    found: list[Divisions] = []
    for k in range(SIZES):
        edge = COARSEST * FINER**k * scene.endoscope.radius
        along, second, third = (max(1, round(length / edge)) for length in lengths)
        if (along, second, third) not in found:
            found.append((along, second, third))
    return found


def _try(scene: Scene) -> MeshTrial:
    """Press a mesh and one of more than six times its degrees of freedom at the same places."""
    problem, reference = FullProblem(scene), FullProblem(refined(scene))
    rng = stream(scene.seed, Stage.MESH_CHOICE)
    errors = []
    for point in spread_points(problem.surface, PLACES, rng):
        x, normal, _ = problem.surface.project(point)
        moved, exact = (_moved(body, x, normal) for body in (problem, reference))
        errors.append(abs(moved / exact - 1))
    return MeshTrial(
        divisions_of(scene.geometry), problem.mesh.nodes.size, float(np.percentile(errors, 95))
    )


def _moved(problem: FullProblem, x: Array, normal: Array) -> float:
    """Mean displacement under a footprint of unit pressure, along the normal; linear elasticity."""
    nodal = problem.unit_load_at(x, normal)
    load = (nodal[:, None] * normal).reshape(-1)[problem.model.free]
    u = problem.model.solve_linear(load[:, None])[:, 0]
    return float(load @ u) / float(nodal.sum())
