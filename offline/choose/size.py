"""How large a reduced model must be: the smallest that meets the scene's tolerance.

Sizes are tried on a few patches spread over the surface, each trained by itself and judged on loads
that it has not seen, by what its errors there would be estimated at, until the smallest of the
ladder is found that is good enough.  The tolerance says where to begin, and each trial how far from
there to go on: a loose tolerance is not made to pay for trials of large models.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np

from palpate.offline.fem.norms import statistics
from palpate.offline.fem.problem import FullProblem
from palpate.offline.reduce.footprint_models import RandomLoads, trained_patch
from palpate.offline.reduce.layout import Patch
from palpate.offline.reduce.load_range import bears, untested
from palpate.offline.reduce.ritz import region
from palpate.offline.run.streams import Stage, stream
from palpate.offline.validate.compare import (
    KnownAnswer,
    calibrate,
    compare,
    play,
    reference_task,
)
from palpate.offline.validate.queries import LOADS
from palpate.shared.arrays import Array
from palpate.shared.mechanics.tissue import lame
from palpate.shared.scene import Budget, Scene, Size, Tolerance

LADDER = (
    Size(patch_spacing=1.3, modes=28, cubature_points=64, region_modes=120),
    Size(patch_spacing=1.0, modes=32, cubature_points=80, region_modes=150),
    Size(patch_spacing=1.1, modes=44, cubature_points=96, region_modes=190),
    Size(patch_spacing=1.0, modes=56, cubature_points=112, region_modes=246),
    Size(patch_spacing=0.75, modes=80, cubature_points=176, region_modes=300),
)
"""Sizes from the smallest to the largest for an endoscope of radius one: the error falls by about
``RUNG`` from each to the next.

What limits the smallest is how far apart its patches, and the footprints that they learn from, lie.
At 1.6 radii stress errs by half as much again, with 96 points, too.
"""

RUNG = 2 / 3

COMPRESSIBLE = 0.45
"""Poisson's ratio up to which the ladder has points enough."""

PLACE = 3
"""On the ladder, of the size that the turbinate takes at the usual tolerance."""

DAMPING = 3.0
"""Of the fit of estimates to the few errors of a trial, see ``compare.calibrate``."""

TRIAL_LOADS = 10


class TrialResult(NamedTuple):
    """One patch on loads it has not seen."""

    known: list[KnownAnswer]
    seconds: float  # median time of an answer
    given_way: int = 0  # loads left out, under which the tissue gives way


def try_patch(problem: FullProblem, patch: Patch, limits: Array) -> TrialResult:
    """Train a local model by itself and judge it on loads it has not seen.

    ``limits`` is the load range at the surface's vertices, which is lowered only after training:
    loads under which the tissue gives way say nothing about a size.
    """
    basis = region(problem, patch.footprints, patch.size.region_modes)
    model = untested(problem, trained_patch(problem, basis, patch), limits)
    loads = RandomLoads(problem.scene, patch, stream(patch.seed, Stage.TRIAL_LOADS))
    known, seconds, given_way = list[KnownAnswer](), list[float](), 0
    while len(known) < TRIAL_LOADS:
        query = [loads.any()]
        if not bears(model, query[0]):
            given_way += 1
            continue
        started = time.perf_counter()
        play(model, query)
        spent = time.perf_counter() - started
        solve, *given = reference_task(model, query)
        full = solve(problem, *given)
        if full is not None:
            seconds.append(spent)
            known += compare(LOADS, problem, model, query, full).known
    return TrialResult(known, float(np.median(seconds)), given_way)


@dataclass(frozen=True)
class Trial:
    """A size on all the patches it was tried on, as an artifact keeps it."""

    size: Size
    displacement: dict[str, float]
    von_mises: dict[str, float]
    estimates: tuple[float, float]  # 95th percentiles of what would be estimated of these
    loads: int
    given_way: int  # loads beside these under which the tissue gives way
    solve_us: float

    @classmethod
    def of(cls, size: Size, results: Sequence[TrialResult]) -> Self:
        """Gather the results of the patches."""
        known = [answer for result in results for answer in result.known]
        given_way = sum(result.given_way for result in results)
        displacement, von_mises = map(statistics, _errors(known).T)
        seconds = round(1e6 * float(np.median([result.seconds for result in results])), 1)
        return cls(size, displacement, von_mises, _estimates(known), len(known), given_way, seconds)

    def over(self, tolerance: Tolerance) -> float:
        """Largest ratio of an estimate to what the reduction may err by.

        An answer whose estimates are within the tolerance is trusted, so these count, not errors.
        """
        return max(np.divide(self.estimates, tolerance.reduction[:2]).tolist())

    def __str__(self) -> str:
        return (
            f"95th percentile of errors on {self.loads} trial loads "
            f"{self.displacement['p95']:.2%} displacement, {self.von_mises['p95']:.2%} von Mises, "
            "of their estimates {:.2%} and {:.2%}".format(*self.estimates)
        )


def _errors(known: Sequence[KnownAnswer]) -> Array:
    """Errors (k, 2) of answers, all of it where there is none."""
    return np.array([answer.errors if answer.converged else [1.0, 1.0] for answer in known])


def _estimates(known: Sequence[KnownAnswer]) -> tuple[float, float]:
    """95th percentiles of what would be estimated, calibrated by these answers themselves."""
    if not all(answer.converged for answer in known):
        return 1.0, 1.0
    estimator, _ = calibrate([[answer] for answer in known], DAMPING)
    estimates = np.exp([estimator @ answer.features for answer in known])
    displacement, von_mises = np.percentile(estimates, 95, axis=0).tolist()
    return displacement, von_mises


def ladder(scene: Scene) -> tuple[Size, ...]:
    """Sizes for a scene.

    Patches are as far apart as the endoscope is large, whose footprints they answer.  The less
    compressible the tissue, the more points take its volume's energy.  They go with the cube root
    of the ratio of Lame's constants: at a Poisson's ratio of 0.49 56 modes err by 2.1 % on 112
    points and by 0.6 % on 192, and 80 modes by 1.5 % on 176.
    """
    (mu, lam), (usual_mu, usual_lam) = (lame(1.0, p) for p in (scene.tissue.poisson, COMPRESSIBLE))
    more = max(1.0, (lam / mu) / (usual_lam / usual_mu)) ** (1 / 3)
    own = []
    for size in LADDER:
        points = 16 * math.ceil(more * size.cubature_points / 16)
        spacing = round(scene.endoscope.radius * size.patch_spacing, 3)
        new = {"patch_spacing": spacing, "cubature_points": points}
        own.append(size.model_copy(update=new))
    return tuple(own)


def first_place(tolerance: Tolerance) -> int:
    """Place on the ladder of the size that is tried first, negative where none is small enough."""
    return PLACE + round(math.log(tolerance.looseness) / math.log(RUNG))


def choose(
    sizes: Sequence[Size], tolerance: Tolerance, budget: Budget, attempt: Callable[[Size], Trial]
) -> tuple[Size, dict[str, Any]]:
    """Find the smallest of sizes in ascending order that meets the tolerance.

    A size over the budget is chosen all the same, and the reason says so.

    Returns
    -------
    size : Size
    document : dict
        What an artifact keeps of the choice: ``why`` in words, and all that was ``tried``, the
        smallest first.
    """
    trials: dict[int, Trial] = {}
    low, high = 0, len(sizes) - 1
    guess = first_place(tolerance)
    while low < high:
        place = min(max(guess, low), high - 1)
        trials[place] = attempt(sizes[place])
        over = trials[place].over(tolerance)
        if over <= 1.0:
            high = place
        else:
            low = place + 1
        rungs = math.log(over) / -math.log(RUNG) if 0 < over < math.inf else 1
        guess = place + math.ceil(rungs)
    if low not in trials:  # the largest: nothing smaller will do
        trials[low] = attempt(sizes[low])
    tried = [trials[i] for i in sorted(trials)]
    why = _reason(tolerance, budget, trials[low], tried, len(sizes))
    said = [vars(trial) | {"size": trial.size.model_dump()} for trial in tried]
    return sizes[low], {"why": why, "tried": said}


def _reason(
    tolerance: Tolerance, budget: Budget, chosen: Trial, tried: list[Trial], sizes: int
) -> str:
    if chosen.over(tolerance) <= 1.0:
        why = f"the smallest of {sizes} sizes that meets the tolerance: {chosen}"
    else:
        why = (
            "no size's estimates are within the reduction's share of "
            f"{tolerance.reduction.displacement:.2%} and {tolerance.reduction.von_mises:.2%}; "
            f"this is the most accurate: {chosen}"
        )
    allowed = 1e6 * budget.query
    if chosen.solve_us > allowed:
        why += f"; it takes {chosen.solve_us:.0f} µs to solve, over the budget of "
        why += f"{allowed:.0f} µs (budget.query), which a looser tolerance keeps"
        within = [trial for trial in tried if trial.solve_us <= allowed]
        if within:
            why += f"; the best within it: {within[-1]} in {within[-1].solve_us:.0f} µs"
    return why
