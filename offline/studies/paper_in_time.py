"""Figure 1 of Radermacher & Reese for visco-elastic tissue: bodies pressed, held and let go.

The bodies, methods and claims are those of ``offline.studies.paper``; what differs:

- The load is a history: it grows, is held, is taken off, and the tissue recovers.  Full and reduced
  models take the same time steps, each from its own past, in turns.
- POD learns from one history and is asked another: less pressure, and slower.
- Errors are relative L2 norms over all moments of that history, since at its end there is nothing
  left to be relative to; the largest is that of a moment, over the largest value in the history.
- CPU times are those of time steps, each warm: from what the step before has left.
- On the cube the tissue, once relaxed, is softer, and would sway under less: the pressure is
  smaller by what the modulus of shear loses.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from palpate.offline.methods.galerkin_in_time import GalerkinInTime
from palpate.offline.methods.in_time import FullInTime, InTime
from palpate.offline.methods.spaces import pod
from palpate.offline.run.workshop import Workshop
from palpate.offline.scenes import find_scene
from palpate.offline.studies.paper import (
    CONTOUR_BASES,
    CUBE_PRESSURE,
    MEDIAL,
    ROUNDS,
    SIZES,
    Example,
    FieldErrors,
    claims_of_figure_1,
    claims_of_figure_2,
    covered,
    footprint,
    publish_figure_1,
    spaces,
)
from palpate.offline.studies.relaxation import Phases, course
from palpate.offline.validate.norms import relative

Array = NDArray[np.float64]

LEARNT: Phases = ((0.2, 10, 1.0), (2.0, 14, 1.0), (0.1, 5, 0.0), (2.0, 14, 0.0))
ASKED: Phases = ((0.3, 10, 0.9), (1.5, 14, 0.9), (0.15, 5, 0.0), (1.5, 14, 0.0))
"""Press, hold, release, rest: what POD learns from, and what all methods are asked."""

HELD = 23
"""Step at whose end the load has been held, in both."""

EXACT = 1e-6
"""Tolerance of the reduced solver where fields are looked at."""


@dataclass(frozen=True)
class Played:
    """What a method makes of a history of t moments."""

    displacements: Array  # (t, n, 3) mm
    stresses: Array  # (t, n) kPa, von Mises
    seconds: float  # median of a step
    unconverged: int


def cube(report: Path) -> dict[str, Any]:
    """Figure 1: the cube under compression; see ``compare``."""
    workshop = Workshop(find_scene("cube-visco"))
    left = 1.0 - sum(share for share, _ in workshop.model.prony)
    return compare(covered(workshop, left * CUBE_PRESSURE), report)


def turbinate(report: Path) -> dict[str, Any]:
    """Figure 1 for the turbinate under a footprint; see ``compare``."""
    return compare(footprint(Workshop(find_scene("turbinate-visco")), MEDIAL), report)


def compare(example: Example, report: Path, sizes: Sequence[int] = SIZES) -> dict[str, Any]:
    """Errors and times of the three methods, and what becomes of the paper's claims.

    Parameters
    ----------
    example : Example
        Of visco-elastic tissue.
    report : Path
        Folder to write ``paper_NAME.csv`` and ``paper_NAME.png`` to.
    sizes : sequence of int
        Numbers of bases.

    Returns
    -------
    dict
        As ``offline.studies.paper.compare``, but for claims with fewer bases; those of figure 2 are
        of the moment when the load has been held.
    """
    known = snapshots(example)
    rows = measure(example, known, sizes)
    moved = float(np.linalg.norm(known[:, example.point], axis=1).max())
    title = (
        f"{example.name}, pressed with up to {example.pressure:.3g} kPa, held and let go: "
        f"P moves {moved:.1f} mm"
    )
    figure = publish_figure_1(example, rows, moved, title, report)
    held = field_errors(example, known, CONTOUR_BASES)
    return figure | {"claims": claims_of_figure_1(rows) | claims_of_figure_2(held)}


def snapshots(example: Example) -> Array:
    """Displacements (t, n, 3) mm of the full model in the history that POD learns from."""
    full = FullInTime(example.workshop)
    past, found = full.at_rest(), []
    for dt, share in tqdm(course(LEARNT), "snapshots"):
        _, past = full.step(past, example.case(share), dt)
        found.append(full.displacement(past))
    return np.array(found)


def measure(example: Example, known: Array, sizes: Sequence[int]) -> list[dict[str, Any]]:
    """Rows of the table: a method and number of bases each."""
    methods: list[InTime] = [FullInTime(example.workshop)]
    for name, basis in spaces(example, known, max(sizes)).items():
        methods += [
            GalerkinInTime(name, str(size), example.workshop, basis[:, :size].copy())
            for size in sizes
            if size <= basis.shape[1]
        ]
    full, *played = _in_turns(example, methods)
    return [
        _row(example, method, own, full) for method, own in zip(methods[1:], played, strict=True)
    ]


def _in_turns(example: Example, methods: Sequence[InTime]) -> list[Played]:
    """Every method's answers to the history that is asked, one step after the other."""
    steps = course(ASKED)
    for method in methods:
        method.step(method.at_rest(), example.case(steps[0][1]), steps[0][0])  # compiles
    seconds: list[list[float]] = [[] for _ in methods]
    missed = [0] * len(methods)
    for _ in range(ROUNDS):
        pasts = [[method.at_rest()] for method in methods]
        for dt, share in tqdm(steps, "full and reduced steps"):
            case = example.case(share)
            for i, method in enumerate(methods):
                started = time.perf_counter()
                converged, past = method.step(pasts[i][-1], case, dt)
                seconds[i].append(time.perf_counter() - started)
                missed[i] += not converged
                pasts[i].append(past)
    return [
        Played(
            np.array([method.displacement(past) for past in own[1:]]),
            np.array([method.von_mises(past) for past in own[1:]]),
            float(np.median(times)),
            count // ROUNDS,
        )
        for method, own, times, count in zip(methods, pasts, seconds, missed, strict=True)
    ]


def _row(example: Example, method: InTime, found: Played, full: Played) -> dict[str, Any]:
    P, kept = example.point, example.workshop.beyond_clamped_layer
    at_point, exact = found.displacements[:, P], full.displacements[:, P]
    away = np.linalg.norm(at_point - exact, axis=1)
    return {
        "method": method.family,
        "bases": method.unknowns,
        "error_at_P_mean": relative(at_point, exact),
        "error_at_P_max": float(away.max() / np.linalg.norm(exact, axis=1).max()),
        "displacement_error_mean": relative(found.displacements, full.displacements),
        "von_mises_error_mean": relative(found.stresses[:, kept], full.stresses[:, kept]),
        "full_ms": 1e3 * full.seconds,
        "reduced_ms": 1e3 * found.seconds,
        "cpu_ratio": full.seconds / found.seconds,
        "unconverged": found.unconverged,
    }


def field_errors(example: Example, known: Array, bases: int) -> FieldErrors:
    """Errors in POD bases when the load has been held."""
    workshop = example.workshop
    basis = pod(workshop.model, known.reshape(len(known), -1), bases)
    methods: list[InTime] = [
        GalerkinInTime("POD", "", workshop, basis, EXACT),
        FullInTime(workshop),
    ]
    fields = []
    for method in methods:
        past = method.at_rest()
        for dt, share in course(ASKED)[: HELD + 1]:
            _, past = method.step(past, example.case(share), dt)
        fields.append((method.displacement(past), method.von_mises(past)))
    return FieldErrors.of(workshop, *fields)
