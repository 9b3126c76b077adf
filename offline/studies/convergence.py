"""Whether references have converged: graded meshes of three sizes beside each other.

Footprints press tissue so slightly that it is linear, integrated at 2 x 2 x 2 and at 3 x 3 x 3
points of an element.  The latter is stiffer and converges evenly; where both say the same, no
lucky cancellation of coarse elements and few points is in it.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from palpate.offline.fem.body_mesh import own_mesh
from palpate.offline.fem.graded import Graded, Grading
from palpate.offline.fem.mesh import accessible_surface, build_mesh
from palpate.offline.fem.model import FullModel
from palpate.offline.fem.norms import relative
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.reduce.layout import centred_points_and_rim
from palpate.offline.run.tables import write_csv
from palpate.offline.validate.mesh_part import GRADING
from palpate.shared.arrays import Array
from palpate.shared.scene import Scene

EDGES = 2.0, 1.0, 0.5
"""Of elements, in those of ``mesh_part.GRADING``; each is half of the one before."""

RIM = 4
"""One place in so many lies on the rim of the surface."""

SLIGHT = 1e-4
"""Pressure over Young's modulus."""


def convergence(scene: Scene, places: int, report: Path, how: Grading = GRADING) -> dict[str, Any]:
    """Compare references at places of the surface; write ``convergence.csv`` to a folder.

    Returns
    -------
    dict
        By number of points per element: the orders observed, medians over the places, of the mean
        displacement under the footprint and of von Mises stress, L2 over the nodes of the scene's
        own mesh; the largest differences of the middle mesh from the finest.
    """
    rng = np.random.default_rng(scene.seed)
    points = centred_points_and_rim(accessible_surface(build_mesh(scene)), places, RIM, rng)
    rows = [row for x in tqdm(points, desc="places") for row in at_place(scene, x, how)]
    write_csv(report / "convergence.csv", rows)
    return {
        f"{n}x{n}x{n}": {
            key: float(of([row[key] for row in rows if row["points"] == n]))
            for key, of in (
                ("compliance_order", np.median), ("von_mises_order", np.median),
                ("compliance_error", max), ("von_mises_error", max),
            )
        }
        for n in (2, 3)
    }  # fmt: skip


def at_place(scene: Scene, x: Array, how: Grading) -> Iterator[dict[str, Any]]:
    """Rows of all meshes graded towards a point (3,) mm, those of the middle one with orders."""
    at = own_mesh(scene).sites
    seen: dict[int, list[tuple[float, Array, int]]] = {2: [], 3: []}
    kept = FullProblem(scene).counted_volumes > 0.0
    for factor in EDGES:
        edges = how._replace(**{key: factor * getattr(how, key) for key in SCALED})
        reference = Graded(scene, x, edges)
        problem = reference.problem
        for n, found in seen.items():
            problem.model = FullModel(problem.mesh, scene.tissue, quadrature=n)
            moved, stress = _pressed(problem, x)
            found.append((moved, reference.at(at, stress)[kept], problem.mesh.nodes.size))
    for n, ((coarse, rough, _), (middle, fair, dofs), (fine, exact, _)) in seen.items():
        row = {**dict(zip("xyz", x.tolist(), strict=True)), "points": n, "dofs": dofs}
        row["compliance"], row["finest_compliance"] = middle, fine
        row["compliance_order"] = float(np.log2(abs((coarse - middle) / (middle - fine))))
        row["compliance_error"] = abs(middle / fine - 1.0)
        row["von_mises_order"] = float(np.log2(relative(rough, exact) / relative(fair, exact)))
        yield row | {"von_mises_error": relative(fair, exact)}


SCALED = "finest", "growth", "coarsest", "support"
"""What of a grading is in proportion to the edges."""


def _pressed(problem: FullProblem, x: Array) -> tuple[float, Array]:
    """Mean displacement (mm/kPa) under a slight footprint, and von Mises stress (n,) over it."""
    normal, pressure = problem.surface.project(x)[1], SLIGHT * problem.scene.tissue.young
    nodal = problem.unit_load_at(x, normal)
    load = Load(x, -normal, pressure)
    u = problem.model.solve_linear(np.outer(nodal, load.direction).ravel()[problem.model.free])
    u = pressure * problem.model.filled(u).reshape(-1, 3)
    moved = float(np.linalg.norm(nodal @ u) / nodal.sum() / pressure)
    return moved, problem.von_mises(u, contact=problem.footprint(load)) / pressure
