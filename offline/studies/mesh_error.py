"""What the mesh costs in accuracy: elements of about the turbinate's 6048 DOFs beside a fine mesh.

Every mesh carries the same loads: one pressure, position and direction per contact point, spread
over the whole accessible surface, its ends included, at which the tissue moves by ``INDENTATION``
of its local thickness (``MAX_PRESSURE`` where that is less). Two displacements are compared: the
largest of all nodes, and the mean under the footprint, which does not depend on where the nodes
happen to lie.

The reference is refined all over but keeps the scene's geometry; other fine meshes say how far it
can be trusted. The clamped edge slows every element's convergence, so that a few per cent between
fine meshes remain.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from palpate.offline.fem.mesh import local_thickness
from palpate.offline.fem.problem import FullProblem
from palpate.offline.reduce.sampling import spread_points
from palpate.offline.run.tables import write_csv
from palpate.offline.scenes import find_scene
from palpate.shared.scene import ElementName

Array = NDArray[np.float64]

POINTS = 12
INDENTATION = 0.25
"""Displacement under the footprint over the local thickness."""

MAX_PRESSURE = 5.0
"""kPa. Beyond it hex20 elements of the reference's size buckle inwardly between their 2x2x2 points
(det F < 0 at 3x3x3 points), which neither mean dilatation nor full quadrature confirms."""

PRESSURE_STEP = 0.5
"""kPa, along the load path."""

VALUES = {"hex8": 9, "hex8-mean-dilatation": 72, "hex8-fbar": 18, "hex20": 9}
"""Displacement gradients (9 numbers each) that one sample of a cubature needs: a point its own,
with F-bar the element's mean beside it, with mean dilatation all eight of the element."""


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
        scene = find_scene("turbinate")
        geometry = scene.geometry.model_copy(update=self._asdict())
        return FullProblem(scene.model_copy(update={"geometry": geometry}))


REFERENCE = Discretisation("hex20", (26, 5, 26), 1.7)
SECOND_OPINIONS = (
    Discretisation("hex20", (20, 3, 20), 1.7),
    Discretisation("hex8-mean-dilatation", (40, 6, 36), 1.7),
)
PROBE = Discretisation("hex20", (13, 2, 13), 1.7)
CANDIDATES = (
    *(Discretisation("hex20", (13, 2, 13), grading) for grading in (1.0, 1.4, 1.7, 1.85)),
    Discretisation("hex20", (14, 2, 12), 1.75),
    Discretisation("hex20", (15, 2, 11), 1.7),
    *(
        Discretisation(element, (23, 3, 20), grading)
        for element in ("hex8-mean-dilatation", "hex8-fbar", "hex8")
        for grading in (1.0, 1.7)
    ),
)


Contact = tuple[Array, Array, float, float]
"""A contact point with its outward normal, local thickness (mm) and pressure (kPa)."""


def press(
    body: FullProblem, position: Array, normal: Array, pressure: float, start: Array | None = None
) -> tuple[float, float, Array]:
    """Press straight in: largest displacement, mean under the footprint (mm), and all (n, 3)."""
    u, under = body.press_at(position, normal, -pressure * normal, start)
    return float(np.linalg.norm(u, axis=1).max()), float(np.linalg.norm(under)), u


def contacts(reference: FullProblem, probe: FullProblem) -> list[Contact]:
    """Contact points all over the reference's surface, with the pressures that ``probe`` needs."""
    surface, found = reference.surface, []
    for point in spread_points(surface, POINTS, np.random.default_rng(reference.scene.seed)):
        x, normal, _ = surface.project(point)
        (thickness,) = local_thickness(reference.mesh, x[None], normal[None])
        target, before, pressure, under, u = INDENTATION * thickness, 0.0, 0.0, 0.0, None
        while under < target and pressure < MAX_PRESSURE:
            before, pressure = under, pressure + PRESSURE_STEP
            _, under, u = press(probe, x, normal, pressure, u)
        if under > target:
            pressure -= PRESSURE_STEP * (under - target) / (under - before)
        found.append((x, normal, float(thickness), pressure))
    return found


def mesh_error(report: Path) -> dict[str, Any]:
    """Compare the candidates with the reference.

    Parameters
    ----------
    report : Path
        Folder to write ``mesh_error.csv`` (a row per mesh), ``mesh_error_points.csv`` (a row per
        contact point) and ``mesh_error.png`` to.

    Returns
    -------
    dict
        Per mesh: ``dofs``, ``points`` of quadrature, ``values`` that a cubature samples at once,
        and of the errors (fractions) of either displacement the least, mean and greatest.
    """
    reference = REFERENCE.body()
    loads = contacts(reference, PROBE.body())
    rows: dict[str, dict[str, Any]] = {}
    moved: dict[str, Array] = {}
    for how in tqdm((REFERENCE, *SECOND_OPINIONS, *CANDIDATES), desc="meshes"):
        body, name = how.body(), str(how)
        moved[name] = np.array([press(body, x, n, pressure)[:2] for x, n, _, pressure in loads])
        error = moved[name] / moved[str(REFERENCE)] - 1
        rows[name] = {
            "dofs": body.mesh.nodes.size,
            "points": 8 * len(body.mesh.elements),
            "values": VALUES[how.element],
        } | {
            f"{name}_{key}": float(of(column))
            for name, column in zip(("largest", "under_footprint"), error.T, strict=True)
            for key, of in (("least", np.min), ("mean", np.mean), ("greatest", np.max))
        }
    write_csv(report / "mesh_error.csv", [{"mesh": name} | row for name, row in rows.items()])
    exact = moved[str(REFERENCE)]
    errors = {name: own[:, 0] / exact[:, 0] - 1 for name, own in moved.items()}
    table = [
        dict(zip(("x_mm", "y_mm", "z_mm"), x.tolist(), strict=True))
        | {"thickness_mm": thickness, "pressure_kPa": pressure}
        | {"largest_mm": exact[i, 0], "under_footprint_mm": exact[i, 1]}
        | {name: error[i] for name, error in errors.items()}
        for i, (x, _, thickness, pressure) in enumerate(loads)
    ]
    write_csv(report / "mesh_error_points.csv", table)
    _draw(report / "mesh_error.png", errors)
    return rows


def _draw(path: Path, errors: dict[str, Array]) -> None:
    """Bars from the least to the greatest error of the largest displacement, a dot per point."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 0.4 * len(errors) + 1.4), layout="constrained")
    axes = figure.add_subplot()
    axes.axvspan(-5, 5, color="0.92")
    axes.axvline(0, color="0.5", linewidth=0.8)
    for row, error in enumerate(errors.values()):
        percent = 100 * error
        axes.barh(row, np.ptp(percent), left=percent.min(), height=0.5, color="tab:blue", alpha=0.5)
        axes.plot(percent, np.full(len(percent), row), ".", color="tab:blue")
    axes.set_yticks(range(len(errors)), list(errors))
    axes.invert_yaxis()
    axes.margins(x=0.03)
    axes.set_xlabel(f"error of the largest displacement against {REFERENCE}, %")
    figure.savefig(path, dpi=110)
