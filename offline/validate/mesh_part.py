"""What the mesh errs by: full solutions beside others on meshes graded towards the contact.

The errors found make the mesh's part of every answer's error estimate, as those of random queries
make the reduction's.
"""

from typing import Any

import numpy as np

from palpate.offline.fem.graded import Graded, Grading, parameters_of
from palpate.offline.fem.mesh import ticks_of
from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.norms import relative, statistics
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.reduce.layout import centred_points_and_rim
from palpate.offline.reduce.sampling import spacing_count
from palpate.offline.validate.compare import KnownAnswer, calibrate
from palpate.offline.validate.queries import Place
from palpate.shared.arrays import Array
from palpate.shared.model import ReducedModel

GRADING = Grading(finest=0.25, even=0.6, growth=0.9, support=0.15)
"""Of references: under a footprint, which is smooth, their own error is a fifth of that of meshes
that serve."""

APART, LEAST, RIM = 4.0, 6, 6
"""Distance of the places looked at, in radii, and their least number; one in so many is on the rim
of the surface."""

LEVELS = 0.3, 1.0
"""Shares of the limit at which footprints press there."""

GIVEN_WAY = 0.3
"""Error of displacement, of all or under the footprint, beyond which the finer mesh has given way
where the scene's own has not: that is no error of a size, and the limit there is too high.
Training says how many there are."""

COVERED, DAMPING = 0.96, 0.3
"""Of the fit, see ``compare.calibrate``."""

NAMES = "displacement", "von_mises", "force"


def places(model: ReducedModel, rng: np.random.Generator) -> list[list[Load]]:
    """Loads along the normal at places all over the surface."""
    surface = model.surface
    count = max(LEAST, spacing_count(surface, APART * model.scene.endoscope.radius))
    points = centred_points_and_rim(surface, count, RIM, rng)
    found = [Place.at(model, point) for point in points]
    return [[place.press(-place.normal, level) for level in LEVELS] for place in found]


def mesh_errors(problem: FullProblem, loads: list[Load]) -> list[Array]:
    """Errors (NAMES,) of a scene's mesh under loads at one place; a task for ``run.workers``.

    Relative L2 norms at its nodes, of stress outside the clamped layer; and the relative error of
    the mean displacement under the footprint, beyond which a tip's force at a depth does not err.
    """
    scene, kept = problem.scene, problem.beyond_clamped_layer
    fine = Graded(scene, loads[0].position, GRADING)
    at, found = parameters_of(scene, ticks_of(scene.geometry)), []
    for load in loads:
        where = load.position, -load.direction, load.pressure * load.direction
        try:
            (u, under), (exact, mean) = (x.press_at(*where) for x in (problem, fine.problem))
        except NoEquilibrium:
            continue
        stress, other = (
            x.von_mises(v, contact=x.footprint(load))
            for x, v in ((problem, u), (fine.problem, exact))
        )
        errors = (
            relative(u, fine.at(at, exact)),
            relative(stress[kept], fine.at(at, other)[kept]),
            abs(float(np.linalg.norm(under) / np.linalg.norm(mean)) - 1.0),
        )
        found.append(np.array([load.pressure, *errors]))
    return found


def fit(loads: list[list[Load]], found: list[list[Array]]) -> tuple[Array, dict[str, Any]]:
    """Coefficients (NAMES, 2) of the log of the mesh's errors in 1 and the share of the limit.

    And what an artifact tells of these errors.
    """
    shares = {
        load.pressure: level for own in loads for load, level in zip(own, LEVELS, strict=True)
    }
    rows = [row for own in found for row in own]
    known = [
        KnownAnswer(
            row[1:],
            np.array([1.0, shares[row[0]]]),
            True,
            comparable=max(row[1], row[3]) < GIVEN_WAY,
        )
        for row in rows
    ]
    table = np.array([answer.errors for answer in known if answer.comparable])
    told = {name: statistics(errors) for name, errors in zip(NAMES, table.T, strict=True)}
    counts = {"loads": len(rows), "given_way": len(rows) - len(table)}
    return calibrate(known, COVERED, DAMPING), counts | told
