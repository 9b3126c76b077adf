"""One load on an artifact, beside the full model if wanted, and the fields of either as a file."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.norms import relative
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.vtu import write_vtu
from palpate.shared.answer import describe
from palpate.shared.artifact import read_artifact
from palpate.shared.model import ReducedModel

Array = NDArray[np.float64]


def solve(
    artifact: Path,
    position: Sequence[float],
    pressure: float,
    direction: Sequence[float] | None = None,
    full_model: bool = False,
    vtu: Path | None = None,
) -> dict[str, Any]:
    """Answer one load as the service does, JSON-able, with ``peak`` values of the fields.

    Parameters
    ----------
    position : sequence of 3 floats, mm
        Projected onto the accessible surface.
    pressure : float, kPa
    direction : sequence of 3 floats, optional
        The inward normal if absent.
    full_model : bool
        Solve the full model too and add its answer and the errors of the reduced one against it:
        relative L2 norms over all nodes (displacement) and all nodes outside the clamped layer
        (von Mises stress).
    vtu : Path, optional
        Where to write mesh and fields: those of the full model if it is solved, and then the
        reduced model's deviations from them too.

    Raises
    ------
    PalpateError
        If the artifact is unusable, the load makes no sense or either model finds no equilibrium
        under it.
    """
    atlas = ReducedModel.load(artifact)
    solution, solve_us = _timed(lambda: atlas.press(position, pressure, direction))
    if not solution.converged:
        raise NoEquilibrium(
            "pressure: no equilibrium found under this load; the model was trained for up to "
            f"{solution.pressure_limit:.3g} kPa there"
        )
    (moved, stress), recover_us = _timed(
        lambda: [f(solution).astype(float) for f in (atlas.displacement, atlas.von_mises)]
    )
    report = {"scene": atlas.name} | describe(solution)
    report["peak"] = _peaks(moved, stress)
    report["timing"] = {"solve_us": solve_us, "recover_us": recover_us}
    if not (full_model or vtu):
        return report
    problem = FullProblem.of_artifact(read_artifact(artifact))
    load = Load(solution.contact_point, solution.direction, pressure)
    fields = {"displacement": moved, "von_mises": stress}
    if full_model:
        exact, full_us = _timed(lambda: problem.solve(load))
        exact_stress = problem.von_mises(exact.displacement)
        errors = moved - exact.displacement, stress - exact_stress
        kept = problem.beyond_clamped_layer
        report["full_model"] = {
            "error": {
                "displacement": relative(moved, exact.displacement),
                "von_mises": relative(stress[kept], exact_stress[kept]),
            },
            "peak": _peaks(exact.displacement, exact_stress),
            "iterations": exact.iterations,
            "load_steps": exact.load_steps,
            "min_jacobian": exact.min_jacobian,
            "timing": {"solve_us": full_us},
        }
        fields = {"displacement": exact.displacement, "von_mises": exact_stress}
        fields |= {"displacement_error": errors[0], "von_mises_error": errors[1]}
    if vtu:
        mesh = problem.mesh
        fields |= {"load": problem.load_vector(load), "clamped": mesh.clamped}
        write_vtu(vtu, mesh.nodes, mesh.elements, fields)
    return report


def _timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """Result of a call and its time in µs, the second time round: the first loads compiled code."""
    call()
    started = time.perf_counter()
    result = call()
    return result, 1e6 * (time.perf_counter() - started)


def _peaks(displacement: Array, von_mises: Array) -> dict[str, float]:
    """Largest displacement (mm) and stress (kPa), and the stress's 99th percentile.

    At the edge of the support the largest stress grows with every refinement of the mesh.
    """
    return {
        "displacement": float(np.linalg.norm(displacement, axis=1).max()),
        "von_mises": float(von_mises.max()),
        "von_mises_p99": float(np.percentile(von_mises, 99)),
    }
