"""What a mesh errs by, and how fine it must be so that this does not dwarf the tolerance.

Meshes of ever smaller elements, about as long as wide, are pressed at the same places as meshes of
twice their divisions.  In linear elasticity: that costs one factorisation each, and under the
footprint the mesh's error is much the same there as under large loads.
"""

from __future__ import annotations

import re
import sys
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from palpate.offline.fem.mesh import build_mesh
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.reduce.sampling import spread_points
from palpate.offline.run.streams import Stage, stream
from palpate.shared.scene import (
    Block,
    Divisions,
    ElementName,
    Scene,
    SceneError,
    divisions_of,
    parse_scene,
)

Array = NDArray[np.float64]

SHARE = 3.0
"""Multiple of the tolerance of displacement that the mesh's error may have."""

COARSEST, FINER, SIZES = 1.0, 0.8, 7
"""Edge of the largest elements over the endoscope's radius, ratio of the next, and their number."""

MOST_DOFS = 40_000
"""Of a mesh that is tried; its reference has more than six times as many."""

PLACES = 12

MOST_DOFS_REFINED = 15_000
"""Of a scene whose refinement training can afford."""

LINEAR_PER_QUADRATIC = 1.62
"""Linear elements per quadratic one along each axis, for as many degrees of freedom."""


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


def _try(scene: Scene) -> tuple[int, float]:
    """Degrees of freedom of a mesh, and the 95th percentile of its errors over some places.

    They are relative to a mesh of more than six times its degrees of freedom.
    """
    problem, reference = FullProblem(scene), _remeshed(scene, scene.geometry.element, 2.0)
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


def _remeshed(scene: Scene, element: ElementName, factor: float) -> FullProblem:
    """The scene in another element, with so many times as many of them along every axis."""
    divisions = tuple(max(1, round(factor * n)) for n in divisions_of(scene.geometry))
    geometry = scene.geometry.model_copy(update={"element": element, "divisions": divisions})
    return FullProblem(scene.model_copy(update={"geometry": geometry}))


@lru_cache(maxsize=1)
def _others(problem: FullProblem) -> list[FullProblem]:
    """The scene with as many degrees of freedom in the other element that does not lock; finer."""
    scene, element = problem.scene, problem.scene.geometry.element
    if element == "hex20":
        other = _remeshed(scene, "hex8-mean-dilatation", LINEAR_PER_QUADRATIC)
    else:
        other = _remeshed(scene, "hex20", 1 / LINEAR_PER_QUADRATIC)
    return [other, _remeshed(scene, element, 2.0)]


def mesh_error(problem: FullProblem, load: Load) -> list[tuple[str, int, float]]:
    """Element, degrees of freedom and mean displacement (mm) under a footprint on three meshes.

    They are the scene's, one of another element, and a finer one.
    """
    x, normal, _ = problem.surface.project(load.position)
    traction = load.pressure * load.direction
    problems = [problem, *_others(problem)]
    moved = [np.linalg.norm(own.press_at(x, normal, traction)[1]) for own in problems]
    return [
        (own.scene.geometry.element, own.mesh.nodes.size, float(u))
        for own, u in zip(problems, moved, strict=True)
    ]


def mesh_error_document(found: list[list[tuple[str, int, float]]]) -> dict[str, Any]:
    """What an artifact keeps of ``mesh_error`` for some loads, relative to the finer mesh."""
    moved = np.array([[u for *_, u in meshes] for meshes in found])
    errors, (*meshes, (_, reference_dofs, _)) = moved[:, :2] / moved[:, 2:] - 1, found[0]
    return {
        "loads": len(found),
        "reference_dofs": reference_dofs,
        "elements": {
            element: {
                "dofs": dofs,
                "mean": float(own.mean()),
                "least": float(own.min()),
                "greatest": float(own.max()),
            }
            for (element, dofs, _), own in zip(meshes, errors.T, strict=True)
        },
    }
