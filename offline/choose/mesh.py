"""How fine a mesh must be so that its errors leave the reduction its share of the tolerance.

Meshes of ever smaller elements, about as long as wide, are pressed at the same places as meshes
graded towards each of these, in all that the scene asks: displacement, von Mises stress, and under
a tip the compliance of its footprint, beyond which its force does not err.  By a small load: linear
elasticity costs one factorisation a mesh, and the errors of larger loads are those with a margin.
"""

import itertools
import re
import sys
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from palpate.offline.bodies.regions import RegionsTooSmall
from palpate.offline.fem.body_mesh import BodyMesh, own_mesh
from palpate.offline.fem.graded import Graded
from palpate.offline.fem.mesh import Inverted, build_mesh, in_order
from palpate.offline.fem.norms import relative
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.fem.shapes import shape_of
from palpate.offline.reduce.sampling import spread_points
from palpate.offline.run.streams import Stage, stream
from palpate.offline.validate import mesh_part
from palpate.shared.anatomy import FileBody
from palpate.shared.arrays import Array
from palpate.shared.scene import Divisions, Errors, Scene, SceneError, parse_scene

COARSEST, FINER, SIZES = 1.0, 0.8, 7
"""Edge of the largest elements over the endoscope's radius, ratio of the next, and their number."""

AS_STORED = 2.0
"""The same of a body from a file, over that: its stored mesh is about so coarse."""

MOST_DOFS = 40_000
"""Of a mesh that is tried."""

MOST_PLACES = 12

REFERENCE = mesh_part.GRADING._replace(coarsest=1.0, growth=0.6)
"""Of references: in linear elasticity they may be finer."""

MARGIN = 1.4
"""Errors to be expected over those found: footprints across an edge of the body, near which few of
these places are, and loads that tissue hardly bears err by more, and references themselves by 5 %
of stress."""

LARGE_LOADS = 2.4
"""Errors of stress that training finds later, with large loads, over those expected, at most: .5 to
2.4 on nine shapes made at random and a liver, where those of displacement are .6 to 1.3."""

SLIGHT = 1e-4
"""Pressure over Young's modulus."""

PROBE = 8
"""Steps along each axis in which a body is measured."""


class Response(NamedTuple):
    """What a mesh says of a small load at a place."""

    displacement: Array  # (n, 3) mm
    von_mises: Array  # (n,) kPa
    depth: float  # mm, of the footprint


class Reference(NamedTuple):
    """What a mesh graded towards a place says there."""

    place: Array  # (3,) mm
    mesh: BodyMesh  # without the full model, whose factorisations take gigabytes in large bodies
    response: Response


def with_mesh(scene: Scene) -> tuple[Scene, dict[str, Any] | None]:
    """The scene with the fineness of its mesh in its text, chosen if not given; what was tried.

    Raises
    ------
    SceneError
        If the text has its geometry as an inline table, which it cannot be written to.
    """
    if scene.fineness_of_mesh is not None:
        return scene, None
    allowed, tried = scene.tolerance.mesh, list[dict[str, Any]]()
    coarsest, *_ = meshes = candidates(scene)
    references = _references(scene, FullProblem(as_fine(scene, coarsest)))
    for fineness in tqdm(meshes, "choosing the mesh"):
        chosen = as_fine(scene, fineness)
        problem = FullProblem(chosen)
        errors = _errors(problem, references)
        dofs = problem.mesh.nodes.size
        tried.append({chosen.geometry.fineness: fineness, "dofs": dofs, "errors": errors._asdict()})
        beyond = [
            name for name, e, most in zip(Errors._fields, errors, allowed, strict=True) if e > most
        ]
        if not beyond or FINER**-3 * dofs > MOST_DOFS:
            break
    why = "the coarsest mesh tried that leaves the reduction its share"
    if beyond:
        why = f"no mesh tried, of up to {dofs} DOFs, does so in {' and '.join(beyond)}"
    why += (
        f": it errs by {errors.displacement:.1%} of displacement, {errors.von_mises:.1%} of stress "
        f"(with the largest loads up to {LARGE_LOADS * errors.von_mises:.0%})"
    )
    why += f", {errors.force:.1%} of the tip's force" if scene.endoscope.tip else ""
    tqdm.write(f"mesh: {chosen.geometry.fineness} {fineness}, {dofs} DOFs; {why}", file=sys.stderr)
    return chosen, {"why": why, "tried": tried}


def as_fine(scene: Scene, fineness: Divisions | float) -> Scene:
    """The same scene with divisions of its mesh or the finest edge (mm), in its text as well."""
    table, key = re.search(r"^\[geometry\].*\n", scene.text, re.M), scene.geometry.fineness
    start = table.end() if table else 0
    value = fineness if isinstance(fineness, float) else list(fineness)
    line = f"{'' if table else 'geometry.'}{key} = {value}   # chosen by training\n"
    try:
        return parse_scene(scene.text[:start] + line + scene.text[start:], scene.folder)
    except SceneError as error:
        if table:
            raise
        raise SceneError(f"geometry.{key}: needed where geometry is an inline table") from error


def candidates(scene: Scene) -> Sequence[Divisions | float]:
    """From coarse to fine: divisions whose elements are about as long as wide, or finest edges."""
    edges = [COARSEST * FINER**k * scene.endoscope.radius for k in range(SIZES)]
    if isinstance(scene.geometry, FileBody):
        return [round(AS_STORED * edge, 4) for edge in edges]
    even = np.linspace(0, 1, PROBE + 1)
    grid = shape_of(scene).grid(even, even, even)
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).mean() for axis in range(3)]
    lengths = PROBE * np.array(in_order(scene.lattice, steps))
    found: list[Divisions] = []
    for edge in edges:
        along, second, third = (max(1, round(length / edge)) for length in lengths)
        if (along, second, third) not in found:
            found.append((along, second, third))
    fit = itertools.dropwhile(lambda own: _too_coarse(as_fine(scene, own)), found)
    return list(fit) or found


def _too_coarse(scene: Scene) -> bool:
    """Whether a mesh is inverted somewhere, or has no elements for the regions of the tissue."""
    try:
        build_mesh(scene)
    except (Inverted, RegionsTooSmall):
        return True
    return False


def _references(scene: Scene, problem: FullProblem) -> list[Reference]:
    """What graded meshes say at places all over the surface."""
    count = min(mesh_part.places_of(scene, problem.surface), MOST_PLACES)
    places = spread_points(problem.surface, count, stream(scene.seed, Stage.MESH_CHOICE))
    found = []
    for x in tqdm(places, "fine meshes to choose by"):
        fine = Graded(scene, x, REFERENCE)
        found.append(Reference(x, fine.mesh, _pressed(fine.problem, x)))
    return found


def _errors(problem: FullProblem, references: list[Reference]) -> Errors:
    """A mesh's errors to be expected, by their 95th percentiles; without a tip none of force."""
    at, found = own_mesh(problem.scene).sites, []
    for place, fine, exact in references:
        own = _pressed(problem, place)
        u, stress = (fine.at(at, field) for field in exact[:2])
        force = abs(own.depth / exact.depth - 1) if problem.scene.endoscope.tip else 0.0
        moved = relative(own.displacement, u, problem.nodal_volumes)
        off = moved, relative(own.von_mises, stress, problem.counted_volumes), force
        found.append(off)
    return Errors(*(MARGIN * np.percentile(found, 95, axis=0)).tolist())


def _pressed(problem: FullProblem, place: Array) -> Response:
    """Press a small footprint along the normal; linear elasticity."""
    x, normal, _ = problem.surface.project(place)
    load = Load(x, -normal, SLIGHT * problem.scene.tissue.young)
    nodal, u = problem.load_vector(load), np.zeros(problem.mesh.nodes.size)
    free = problem.model.free
    u[free] = problem.model.solve_linear(nodal.reshape(-1)[free, None])[:, 0]
    displacement = u.reshape(-1, 3)
    stress = problem.von_mises(displacement, contact=problem.footprint(load))
    depth = float(np.linalg.norm(problem.under(x, displacement)))
    return Response(displacement, stress, depth)
