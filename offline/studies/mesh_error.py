"""What the mesh costs in accuracy: elements of about the turbinate's 6048 DOFs beside a fine mesh.

Every mesh carries the same loads all over the accessible surface, under which the tissue moves by
``INDENTATION`` of its local thickness (``MAX_PRESSURE`` where that is less). Two displacements are
compared: the largest of all nodes, and the mean under the footprint, which does not depend on where
the nodes happen to lie.  Another fine mesh says how far the reference can be trusted: the clamped
edge slows every element's convergence, so that a few per cent between fine meshes remain.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from palpate.offline.fem.mesh import local_thickness
from palpate.offline.fem.problem import FullProblem
from palpate.offline.reduce.sampling import spread_points
from palpate.offline.run.tables import write_csv
from palpate.offline.scenes import find_scene
from palpate.shared.arrays import Array
from palpate.shared.scene import ElementName

POINTS = 12
INDENTATION = 0.25  # displacement under the footprint over the local thickness
MAX_PRESSURE = 5.0
"""kPa. Beyond it hex20 elements of the reference's size buckle inwardly between their 2x2x2 points
(det F < 0 at 3x3x3 points), which full quadrature does not confirm."""

PRESSURE_STEP = 0.5  # kPa, along the load path


class Discretisation(NamedTuple):
    """How the turbinate is meshed: element, divisions and grading of a scene."""

    element: ElementName
    divisions: tuple[int, int, int]
    grading: float

    def __str__(self) -> str:
        along, through, length = self.divisions
        return f"{self.element} {along}x{through}x{length} graded {self.grading:g}"

    def body(self) -> FullProblem:
        """The turbinate in this mesh."""
        scene = find_scene("turbinate-paper")
        geometry = scene.geometry.model_copy(update=self._asdict())
        return FullProblem(scene.model_copy(update={"geometry": geometry}))


REFERENCE = Discretisation("hex20", (26, 5, 26), 1.7)
SECOND_OPINION = Discretisation("hex20", (20, 3, 20), 1.7)
PROBE = Discretisation("hex20", (13, 2, 13), 1.7)
CANDIDATES = (
    *(Discretisation("hex20", (13, 2, 13), grading) for grading in (1.0, 1.4, 1.7, 1.85)),
    Discretisation("hex20", (14, 2, 12), 1.75),
    Discretisation("hex20", (15, 2, 11), 1.7),
    *(Discretisation("hex8", (23, 3, 20), grading) for grading in (1.0, 1.7)),
)


def contacts(reference: FullProblem, probe: FullProblem) -> list[tuple[Array, Array, Array]]:
    """Contact points all over the reference's surface, normals, and tractions for ``probe``."""
    surface, found = reference.surface, []
    for point in spread_points(surface, POINTS, np.random.default_rng(reference.scene.seed)):
        x, normal, _ = surface.project(point)
        (thickness,) = local_thickness(reference.mesh, x[None], normal[None])
        target, before, pressure, under, u = INDENTATION * thickness, 0.0, 0.0, 0.0, None
        while under < target and pressure < MAX_PRESSURE:
            before, pressure = under, pressure + PRESSURE_STEP
            u, moved = probe.press_at(x, normal, -pressure * normal, u)
            under = float(np.linalg.norm(moved))
        if under > target:
            pressure -= PRESSURE_STEP * (under - target) / (under - before)
        found.append((x, normal, -pressure * normal))
    return found


def mesh_error(report: Path) -> dict[str, Any]:
    """Compare the candidates with the reference; write ``mesh_error.csv`` to a folder.

    Returns
    -------
    dict
        Per mesh: ``dofs``, ``points`` of quadrature, and of the errors (fractions) of either
        displacement the least, mean and greatest.
    """
    reference = REFERENCE.body()
    loads = contacts(reference, PROBE.body())
    rows: dict[str, dict[str, Any]] = {}
    exact = None
    for how in tqdm((REFERENCE, SECOND_OPINION, *CANDIDATES), desc="meshes"):
        body = how.body()
        solved = [body.press_at(*load) for load in loads]
        moved = np.array([[np.linalg.norm(u, axis=1).max(), np.linalg.norm(v)] for u, v in solved])
        exact = moved if exact is None else exact
        errors = zip(("largest", "under_footprint"), (moved / exact - 1).T, strict=True)
        rows[str(how)] = {"dofs": body.mesh.nodes.size, "points": 8 * len(body.mesh.elements)} | {
            f"{name}_{key}": float(of(error))
            for name, error in errors
            for key, of in (("least", np.min), ("mean", np.mean), ("greatest", np.max))
        }
    write_csv(report / "mesh_error.csv", [{"mesh": name} | row for name, row in rows.items()])
    return rows
