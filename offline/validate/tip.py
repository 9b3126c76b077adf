"""The reduced against the full model under the rigid tip, at positions it has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.offline.reduce.sampling import random_points_and_rim
from palpate.offline.run.workshop import TouchSample, Workshop
from palpate.offline.validate.loads import calibrate, coverage, unseen, verdict
from palpate.offline.validate.norms import relative, statistics
from palpate.shared.answer import Answer
from palpate.shared.geometry.surface import Surface
from palpate.shared.local_models import Estimator
from palpate.shared.mechanics.footprint import TIP_DEPTH
from palpate.shared.model import ReducedModel
from palpate.shared.scene import Scene

Array = NDArray[np.float64]

QUANTITIES = ("displacement", "von_mises", "force")

COVERAGE, DAMPING = 0.96, 1.0
"""Of the error estimate: they scatter more than those of loads."""

OTHER_EQUILIBRIUM = 0.1
"""Displacement error beyond which the models rest in different equilibria: a free edge can slip off
the tip or not, and where it just does not in one model, it does in the other."""


@dataclass
class TouchComparison:
    """One position answered by both models; errors are relative L2 norms.

    Attributes
    ----------
    x, y, z : float, mm
        Centre of the tip.
    depth, depth_limit, penetration : float, mm
    displacement, von_mises, force, tangent : float
        Errors over all nodes, over all nodes outside the clamped layer, and of the force and the
        matrix.
    features : ndarray
        Of the error estimate.
    estimated_displacement, estimated_von_mises, estimated_force : float
    converged, in_range : bool
    iterations : int
    """

    x: float
    y: float
    z: float
    depth: float
    depth_limit: float
    penetration: float
    displacement: float
    von_mises: float
    force: float
    tangent: float
    converged: bool
    in_range: bool
    iterations: int
    features: Array = field(repr=False)
    estimated_displacement: float = field(default=float("nan"))
    estimated_von_mises: float = field(default=float("nan"))
    estimated_force: float = field(default=float("nan"))

    @property
    def typical(self) -> bool:
        """Whether it counts for the error estimate: both models rest in the same equilibrium."""
        return self.converged and self.displacement <= OTHER_EQUILIBRIUM

    def estimate(self, estimator: Estimator) -> None:
        """Fill in the estimated errors."""
        self.estimated_displacement, self.estimated_von_mises, self.estimated_force = estimator(
            self.features
        )


def calibrate_touches(rows: Sequence[TouchComparison]) -> Estimator:
    """Fit the error estimate of the tip to known errors."""
    return calibrate(rows, QUANTITIES, COVERAGE, DAMPING)


def random_positions(
    surface: Surface, limits: Array, scene: Scene, count: int, rng: np.random.Generator
) -> Array:
    """Centres of the tip (count, 3) mm over the whole surface and range of depths.

    Contact points are uniform over the area, one in eight on the rim of the surface; depths are
    denser towards the limit.
    """
    radius = scene.endoscope.radius
    positions = []
    for point in random_points_and_rim(surface, count, rng):
        x, normal, _, fields = surface.locate(point, limits)
        positions.append(x + (radius - fields[TIP_DEPTH] * np.sqrt(rng.random())) * normal)
    return np.array(positions)


def compare_touch(
    workshop: Workshop, atlas: ReducedModel, answer: Answer, sample: TouchSample
) -> TouchComparison:
    """Compare an answer with the full solution."""
    displacement = atlas.displacement(answer).astype(float)
    stress = atlas.von_mises(answer).astype(float)
    reference = sample.displacement.astype(float)
    exact = workshop.von_mises(reference)
    kept = workshop.beyond_clamped_layer
    x, y, z = answer.position.tolist()
    return TouchComparison(
        x=x,
        y=y,
        z=z,
        depth=answer.depth,
        depth_limit=answer.depth_limit,
        penetration=answer.penetration,
        displacement=relative(displacement, reference),
        von_mises=relative(stress[kept], exact[kept]),
        force=relative(answer.force, sample.force),
        tangent=relative(answer.tangent, sample.tangent),
        converged=answer.converged,
        in_range=answer.in_range,
        iterations=answer.iterations,
        features=answer.features,
        estimated_displacement=answer.error_displacement,
        estimated_von_mises=answer.error_von_mises,
        estimated_force=answer.error_force,
    )


def summarise_touches(rows: Sequence[TouchComparison]) -> dict[str, Any]:
    """Errors of the converged answers in the full model's equilibrium.

    ``covered``: the share of all converged ones that are within their three estimates.
    """
    queries = len(rows)
    rows = [r for r in rows if r.converged]
    unconverged = queries - len(rows)
    covered, ratios = coverage(rows, QUANTITIES)
    converged = len(rows)
    rows = [r for r in rows if r.typical]
    return {
        "queries": queries,
        "unconverged": unconverged,
        "other_equilibrium": converged - len(rows),
        "covered": covered,
        **{name: statistics([getattr(r, name) for r in rows]) for name in (*QUANTITIES, "tangent")},
        "penetration_over_depth": statistics([r.penetration / r.depth for r in rows]),
        "estimate_over_error_median": ratios,
    }


def validate_touches(
    artifact: Path, queries: int, seed: int, csv: Path | None = None
) -> dict[str, Any]:
    """Compare an artifact with its full model at new random positions of the tip.

    Parameters
    ----------
    artifact : Path
    queries : int
        Positions, over the whole surface and range of depths.
    seed : int
        Of the positions; those of training come from none.
    csv : Path, optional
        Where to write one row per position.

    Returns
    -------
    dict
        As ``summarise_touches``, and ``without_equilibrium``: positions at which the full model
        found none, and which count in nothing else.
    """
    atlas, workshop, rng = unseen(artifact, seed)
    positions = random_positions(atlas.surface, atlas.limits, atlas.scene, queries, rng)
    answers = [atlas.touch(position) for position in positions]

    def judge(i: int, sample: TouchSample) -> TouchComparison | None:
        known = sample.displacement.size > 0
        return compare_touch(workshop, atlas, answers[i], sample) if known else None

    tasks = [(Workshop.touch, answer.position, atlas.displacement(answer)) for answer in answers]
    nothing = "the full model has no equilibrium at any position"
    return verdict(artifact, tasks, judge, summarise_touches, nothing, csv)
