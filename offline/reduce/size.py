"""How large a reduced model must be: the smallest that meets the scene's tolerance.

Sizes are tried on a few patches spread over the surface, each trained by itself and judged on loads
that it has not seen, until the smallest of the ladder is found that is good enough.  The tolerance
says where to begin, and each trial how far from there to go on: a loose tolerance is not made to
pay for trials of large models.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.offline.fem.norms import statistics
from palpate.shared.mechanics.laws import AnyTissue
from palpate.shared.mechanics.tissue import lame
from palpate.shared.scene import Budget, Size, Tolerance

Array = NDArray[np.float64]

LADDER = (
    Size(patch_spacing=2.6, modes=28, cubature_points=64, region_modes=120),
    Size(patch_spacing=2.0, modes=32, cubature_points=80, region_modes=150),
    Size(patch_spacing=2.2, modes=44, cubature_points=96, region_modes=190),
    Size(patch_spacing=2.0, modes=56, cubature_points=112, region_modes=246),
    Size(patch_spacing=1.5, modes=80, cubature_points=176, region_modes=300),
)
"""Sizes from the smallest to the largest: the error falls by about ``RUNG`` from each to the next.

What limits the smallest is how far apart its patches, and the footprints that they learn from, lie.
At 3.2 mm stress errs by half as much again, with 96 points, too.
"""

RUNG = 2 / 3

COMPRESSIBLE = 0.45
"""Poisson's ratio up to which the ladder has points enough."""

PLACE = 3
"""On the ladder, of the size that the turbinate takes at the usual tolerance."""

MARGIN = 0.8
"""Share of the tolerance that the 95th percentile of a trial's errors may reach."""

WORST = 3.0
"""Multiple of the tolerance that its largest error may reach."""


@dataclass(frozen=True)
class TrialResult:
    """One patch on loads it has not seen: relative errors (k,) and median time of a solve, s."""

    displacement: Array
    von_mises: Array
    seconds: float


@dataclass(frozen=True)
class Trial:
    """A size on all the patches it was tried on."""

    size: Size
    displacement: dict[str, float]
    von_mises: dict[str, float]
    loads: int
    solve_us: float

    @classmethod
    def of(cls, size: Size, results: list[TrialResult]) -> Trial:
        """Gather the results of the patches, without the one of the largest error.

        Where the tissue gives way the load range is lowered only after training: loads beyond that
        say nothing about a size.
        """
        worst = np.argmax([r.displacement.max() for r in results])
        kept = [r for i, r in enumerate(results) if i != worst] or results
        displacement = np.concatenate([r.displacement for r in kept])
        return cls(
            size,
            statistics(displacement),
            statistics(np.concatenate([r.von_mises for r in kept])),
            len(displacement),
            1e6 * float(np.median([r.seconds for r in results])),
        )

    def meets(self, tolerance: Tolerance) -> bool:
        """Whether errors are within tolerance, with a margin."""
        return max(self._shares(tolerance)) <= 1.0

    def _shares(self, tolerance: Tolerance) -> list[float]:
        """Errors over what they may be."""
        return [
            errors[key] / (share * allowed)
            for errors, allowed in (
                (self.displacement, tolerance.displacement),
                (self.von_mises, tolerance.von_mises),
            )
            for key, share in (("p95", MARGIN), ("max", WORST))
        ]

    def rungs_to(self, tolerance: Tolerance) -> int:
        """How many sizes further up a tolerance may just be met, by the fall of the error."""
        worst = max(self._shares(tolerance))
        return math.ceil(math.log(worst) / -math.log(RUNG)) if 0 < worst < math.inf else 1

    @property
    def document(self) -> dict[str, Any]:
        """What an artifact keeps of it."""
        return {
            "size": self.size.model_dump(),
            "displacement": self.displacement,
            "von_mises": self.von_mises,
            "loads": self.loads,
            "solve_us": round(self.solve_us, 1),
        }


@dataclass(frozen=True)
class Choice:
    """A chosen size, the trials from the smallest to the largest, and why in words."""

    size: Size
    trials: list[Trial]
    why: str

    @property
    def document(self) -> dict[str, Any]:
        """What an artifact keeps of it."""
        return {"why": self.why, "tried": [trial.document for trial in self.trials]}


def ladder(tissue: AnyTissue) -> tuple[Size, ...]:
    """Sizes for a tissue: the less compressible, the more points take its volume's energy.

    They go with the cube root of the ratio of Lame's constants: at a Poisson's ratio of 0.49 56
    modes err by 2.1 % on 112 points and by 0.6 % on 192, and 80 modes by 1.5 % on 176.
    """
    (mu, lam), (usual_mu, usual_lam) = (lame(1.0, p) for p in (tissue.poisson, COMPRESSIBLE))
    more = max(1.0, (lam / mu) / (usual_lam / usual_mu)) ** (1 / 3)
    return tuple(
        size.model_copy(
            update={"cubature_points": 16 * math.ceil(more * size.cubature_points / 16)}
        )
        for size in LADDER
    )


def first_place(tolerance: Tolerance) -> int:
    """Place on the ladder of the size that is tried first, negative where none is small enough."""
    return PLACE + round(math.log(tolerance.looseness) / math.log(RUNG))


def choose(
    sizes: Sequence[Size], tolerance: Tolerance, budget: Budget, attempt: Callable[[Size], Trial]
) -> Choice:
    """Find the smallest size of a ladder that meets the tolerance.

    Parameters
    ----------
    sizes : sequence of Size
        From the smallest to the largest.
    tolerance : Tolerance
    budget : Budget
        A size over it is chosen all the same, and the reason says so.
    attempt : callable
        Tries a size.
    """
    trials: dict[int, Trial] = {}
    low, high = 0, len(sizes) - 1
    guess = first_place(tolerance)
    while low < high:
        place = min(max(guess, low), high - 1)
        trials[place] = attempt(sizes[place])
        if trials[place].meets(tolerance):
            high = place
        else:
            low = place + 1
        guess = place + trials[place].rungs_to(tolerance)
    if low not in trials:  # the largest: nothing smaller will do
        trials[low] = attempt(sizes[low])
    tried = [trials[i] for i in sorted(trials)]
    reason = _reason(tolerance, budget, trials[low], tried, len(sizes))
    return Choice(sizes[low], tried, reason)


def _reason(
    tolerance: Tolerance, budget: Budget, chosen: Trial, tried: list[Trial], sizes: int
) -> str:
    if chosen.meets(tolerance):
        why = f"the smallest of {sizes} sizes that meets the tolerance: {_errors(chosen)}"
    else:
        why = (
            f"no size meets the tolerance of {tolerance.displacement:.2%} and "
            f"{tolerance.von_mises:.2%}; this is the most accurate: {_errors(chosen)}"
        )
    allowed = 1e6 * budget.query
    if chosen.solve_us > allowed:
        why += f"; it takes {chosen.solve_us:.0f} µs to solve, over the budget of {allowed:.0f} µs"
        within = [trial for trial in tried if trial.solve_us <= allowed]
        if within:
            best = within[-1]
            why += f"; the best within it: {_errors(best)} in {best.solve_us:.0f} µs"
    return why


def _errors(trial: Trial) -> str:
    return (
        f"95th percentile of errors on {trial.loads} trial loads "
        f"{trial.displacement['p95']:.2%} displacement, {trial.von_mises['p95']:.2%} von Mises"
    )
