"""One load on an artifact, beside the full model if wanted, and the fields of either as a file.

The file is VTK's XML (.vtu), which ParaView and its kin read: VTK file formats,
https://docs.vtk.org/en/latest/design_documents/VTKFileFormats.html
"""

import sys
import time
from base64 import b64encode
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.mesh import least_volume_ratio
from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.norms import relative
from palpate.offline.fem.problem import FullProblem, Load, Step, TipPosition
from palpate.offline.info import percent
from palpate.shared.answer import Answer, describe, peak
from palpate.shared.arrays import Array
from palpate.shared.errors import QueryError
from palpate.shared.geometry.elements import kind_of
from palpate.shared.model import ReducedModel

TYPE_NAMES = {"f": "Float64", "i": "Int64", "u": "UInt8"}


def solve(
    artifact: Path,
    position: Sequence[float],
    pressure: float | None,
    direction: Sequence[float] | None = None,
    radius: float | None = None,
    young: float | None = None,
    full_model: bool = False,
    vtu: Path | None = None,
) -> dict[str, Any]:
    """Answer one load as the service does, JSON-able, with ``peak`` values of the fields.

    Or, without a pressure, a position of the rigid tip.  What is to be known before it is trusted
    goes to stderr.

    Parameters
    ----------
    position : sequence of 3 floats, mm
        Projected onto the accessible surface; of a tip, that of its centre.
    pressure : float, kPa
    direction : sequence of 3 floats, optional
        The inward normal if absent.
    radius : float, mm, optional
        Of the footprint; the scene's if absent.
    young : float, kPa, optional
        Young's modulus of the tissue; the scene's if absent.
    full_model : bool
        Solve the full model too and add its answer and the errors of the reduced one against it:
        relative L2 norms over the volume (displacement), outside the clamped layer and regions
        (von Mises stress).
    vtu : Path, optional
        Where to write mesh and fields; of the full model too if it is solved, and the reduced
        model's deviations from them.

    Raises
    ------
    PalpateError
        If the artifact is unusable, the load makes no sense or either model finds no equilibrium
        under it.
    """
    atlas = ReducedModel.load(artifact)
    if pressure is None:
        solution, solve_us = _timed(lambda: atlas.touch(position, young=young))
        limit = f"depth: no equilibrium found; trained for up to {solution.depth_limit:.3g} mm"
        step: Step = TipPosition(np.asarray(position, float))
    else:
        solution, solve_us = _timed(
            lambda: atlas.press(position, pressure, direction, radius, young=young)
        )
        limit = (
            "pressure: no equilibrium found under this load; the model was trained for up to "
            f"{solution.pressure_limit:.3g} kPa"
        )
        step = Load(solution.contact_point, solution.direction, pressure)
    if not solution.converged:
        raise NoEquilibrium(f"{limit} there")
    for said in cautions(atlas, solution):
        print(f"Warning: {said}", file=sys.stderr)
    fields, recover_us = _timed(
        lambda: {
            name: getattr(atlas, name)(solution).astype(float)
            for name in ("displacement", "von_mises")
        }
    )
    report = {"scene": atlas.name} | describe(solution)
    moved = atlas.displacement(solution)
    report["peak"] = atlas.peak(solution, moved)
    report["timing"] = {"solve_us": solve_us, "recover_us": recover_us}
    if not (full_model or vtu):
        return report
    if radius not in (None, atlas.scene.endoscope.radius):
        raise QueryError("radius", "the full model presses with the scene's")
    problem = FullProblem.of_artifact(artifact, young)
    if full_model:
        exact, full_us = _timed(lambda: problem.solve(step))
        contact = problem.footprint(step, exact)
        u = problem.displaced(exact, contact)
        stress = problem.von_mises(u, contact=contact)
        regions = [region.name for region in problem.scene.tissue.region]
        peaks = problem.stress_field.peaks_by_region(u, None, contact)
        volumes, counted = problem.nodal_volumes, problem.counted_volumes
        report["full_model"] = {
            "error": {
                "displacement": relative(fields["displacement"], u, volumes),
                "von_mises": relative(fields["von_mises"], stress, counted),
            },
            "peak": peak(u, peaks, regions),
            "iterations": exact.iterations,
            "load_steps": exact.load_steps,
            "min_jacobian": least_volume_ratio(problem.mesh, exact.displacement),
            "timing": {"solve_us": full_us},
        }
        found = {"displacement": u, "von_mises": stress}
        fields |= {f"full_{name}": own for name, own in found.items()}
        fields |= {f"{name}_error": fields[name] - own for name, own in found.items()}
    if vtu:
        mesh = problem.mesh
        units = {name: "mm" if "displacement" in name else "kPa" for name in fields}
        named = {f"{name}_{units[name]}": own for name, own in fields.items()}
        if isinstance(step, Load):
            named["load_mN"] = problem.load_vector(step)
        write_vtu(vtu, mesh.nodes, mesh.elements, named | {"clamped": mesh.clamped})
    return report


def cautions(atlas: ReducedModel, answer: Answer) -> Iterator[str]:
    """Say what to know of an answer with an equilibrium before it is trusted, a sentence each."""
    if answer.tip and not answer.contact:
        at = ", ".join(f"{x:.4g}" for x in answer.contact_point)
        yield (
            f"the tip touches nothing: it is {-answer.depth:.3g} mm away from the surface, "
            f"which is nearest at ({at}) mm"
        )
    for name in answer.out_of_range:
        limit = f" of {answer.pressure_limit:.3g} kPa" if name == "pressure" else ""
        limit = f" of {answer.depth_limit:.3g} mm" if name == "depth" else limit
        yield f"{name} is outside the trained range{limit}: the error is unknown"
    most = atlas.scene.tolerance.of(answer.tip)
    beyond = [
        f"{name} {percent(getattr(answer, f'error_{name}'))} "
        f"(tolerance {percent(getattr(most, name))})"
        for name in atlas.doubts(answer)
        if name not in answer.out_of_range
    ]
    if beyond:
        yield f"error_estimate is beyond the scene's tolerance: {', '.join(beyond)}"


def _timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """Result of a call and its time in µs, the second time round: the first loads compiled code."""
    call()
    started = time.perf_counter()
    result = call()
    return result, 1e6 * (time.perf_counter() - started)


def write_vtu(
    path: Path,
    nodes: Array,
    elements: NDArray[np.integer[Any]],
    point_data: Mapping[str, NDArray[Any]],
) -> None:
    """Write a mesh of elements (e, k) and fields (n,) or (n, k) on its nodes (n, 3).

    Floats are written with 8 bytes, truth values as 0 and 1.
    """
    count, size = elements.shape
    order = "LittleEndian" if sys.byteorder == "little" else "BigEndian"
    root = ET.Element(
        "VTKFile", type="UnstructuredGrid", version="1.0", byte_order=order, header_type="UInt64"
    )
    grid = ET.SubElement(root, "UnstructuredGrid")
    piece = ET.SubElement(grid, "Piece", NumberOfPoints=str(len(nodes)), NumberOfCells=str(count))
    _add(ET.SubElement(piece, "Points"), "points", nodes)
    cells = ET.SubElement(piece, "Cells")
    _add(cells, "connectivity", elements.ravel())
    _add(cells, "offsets", size * np.arange(1, count + 1))
    _add(cells, "types", np.full(count, kind_of(elements).vtk, np.uint8))
    fields = ET.SubElement(piece, "PointData")
    for name, values in point_data.items():
        _add(fields, name, values)
    path.parent.mkdir(parents=True, exist_ok=True)
    ET.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def _add(parent: ET.Element, name: str, values: NDArray[Any]) -> None:
    kind = values.dtype.kind.replace("b", "u")
    data = np.ascontiguousarray(values, dtype=TYPE_NAMES[kind].lower()).tobytes()
    element = ET.SubElement(parent, "DataArray", type=TYPE_NAMES[kind], Name=name, format="binary")
    if values.ndim == 2:
        element.set("NumberOfComponents", str(values.shape[1]))
    # the length of the data goes before them, into the same base64
    element.text = b64encode(np.uint64(len(data)).tobytes() + data).decode()
