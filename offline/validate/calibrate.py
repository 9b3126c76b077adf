"""The estimate of a reduced model's errors, fitted to errors that are known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from palpate.shared.local_models import Estimator

Array = NDArray[np.float64]


@dataclass
class KnownAnswer:
    """An answer of the reduced model whose errors are known.

    The errors are the largest until then, relative to the largest norms until then, which do not
    vanish where an error changes its sign.
    """

    errors: Array  # (quantities,)
    features: Array  # of the error estimate
    converged: bool
    comparable: bool  # counts for the estimate: both models rest in the same equilibrium
    estimated: Array = field(default_factory=lambda: np.empty(0))  # (quantities,)


def calibrate(known: Sequence[KnownAnswer], share: float, damping: float) -> Estimator:
    """Fit the error estimate: it covers a share of the known errors in all quantities.

    A least-squares fit of their logs is raised by a constant for each quantity.  The answers that
    need not be covered are those that would raise one most.  What counts is how far an answer lies
    from a fit to the others, or the estimate would cover fewer of new ones.  ``damping`` holds the
    coefficients back, since known errors are few for many features.
    """
    known = [answer for answer in known if answer.comparable]
    X = np.array([answer.features for answer in known])
    spread = X.std(axis=0)
    scale = np.where(spread > 1e-9, spread, np.inf)  # the constant one; others may be, too
    middle = X.mean(axis=0)
    A = np.column_stack([(X - middle) / scale, np.ones(len(known))])
    ridge = np.diag([damping] * len(middle) + [0.0])
    leverage = np.sum(A * np.linalg.pinv(np.vstack([A, ridge])).T[: len(A)], axis=1)
    coefficients, rests = [], []
    for errors in np.transpose([answer.errors for answer in known]):
        y = np.log(np.maximum(errors, 1e-8))
        c = np.linalg.lstsq(np.vstack([A, ridge]), np.append(y, np.zeros(len(ridge))))[0]
        c, constant = c[:-1] / scale, c[-1]
        c[0] = constant - c @ middle
        rest = y - X @ c
        c[0] += np.median(rest)
        coefficients.append(c)
        rests.append((rest - np.median(rest)) / (1 - leverage))
    covered = np.argsort(np.max(rests, axis=0))[: int(np.ceil(share * (len(known) + 1)))]
    for c, rest in zip(coefficients, rests, strict=True):
        c[0] += rest[covered].max()
    return Estimator(np.array(coefficients))


def calibrate_by_halves(
    queries: Sequence[Sequence[KnownAnswer]], fit: Callable[[Sequence[KnownAnswer]], Estimator]
) -> Estimator:
    """Fit an estimate to the answers to all queries.

    What an answer itself is estimated to err by comes from a fit to the other half of the queries.
    """
    for half in (0, 1):
        estimator = fit([answer for answers in queries[1 - half :: 2] for answer in answers])
        for answers in queries[half::2]:
            for answer in answers:
                answer.estimated = np.array(estimator(answer.features))
    return fit([answer for answers in queries for answer in answers])


def coverage(known: Sequence[KnownAnswer]) -> tuple[float, Array]:
    """Share of answers within all their estimates; medians (quantities,) of estimate over error.

    Of the answers in range: outside it there is no estimate.
    """
    known = [answer for answer in known if answer.estimated[0] != np.inf]
    errors = np.array([answer.errors for answer in known])
    estimated = np.array([answer.estimated for answer in known])
    ratios = np.median(estimated / np.maximum(errors, 1e-12), axis=0)
    return float(np.mean(np.all(errors <= estimated, axis=1))), ratios
