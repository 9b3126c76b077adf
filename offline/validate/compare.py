"""The reduced against the full model, query by query, on queries that training has not seen.

A query is a list of time steps; without time its length is one.  The errors found calibrate the
reduced model's estimate of them.
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta
from tqdm import tqdm

from palpate.offline.fem.norms import relative, statistics
from palpate.offline.fem.problem import FullProblem, Load, Reference, Step
from palpate.offline.run.tables import write_csv
from palpate.offline.run.workers import open_artifact, run, worker_pool
from palpate.offline.validate.queries import LOADS, Kind, held_out
from palpate.shared.answer import Answer
from palpate.shared.arrays import Array, Flags
from palpate.shared.errors import PalpateError, QueryError
from palpate.shared.model import ReducedModel
from palpate.shared.query import stiffness
from palpate.shared.reduced.transfer import REST
from palpate.shared.scene import Errors, Tolerance

OTHER_EQUILIBRIUM = 0.1
"""Displacement error beyond which the models rest in different equilibria: a free edge can slip off
the tip or not, and where it just does not in one model, it does in the other."""


def play(model: ReducedModel, query: Sequence[Step], young: float | None = None) -> list[Answer]:
    """Answers of the reduced model at the ends of time steps; a single one may take no time.

    Of tissue with another Young's modulus (kPa), if one is given.
    """
    in_time = len(query) > 1 or query[0].dt > 0.0
    past, warm = (REST, model.new_warm()) if in_time else (None, None)
    answers: list[Answer] = []
    for step in query:
        more: dict[str, Any] = {"young": young, "past": past, "dt": step.dt, "warm": warm}
        if isinstance(step, Load):
            answers.append(model.press(step.position, step.pressure, step.direction, **more))
        else:
            answers.append(model.touch(step.position, **more))
        past = answers[-1].past
    return answers


class Compared(NamedTuple):
    """A quantity at the ends of time steps, by both models, each (t, k)."""

    reduced: Array
    full: Array
    weights: Array  # (k,) of squares in norms: volumes that values stand for, mm^3, or ones

    @property
    def error(self) -> float:
        """Relative L2 norm over everything."""
        return relative(self.reduced.T, self.full.T, self.weights)

    @property
    def away(self) -> Array:
        """Size of the error (t,) at each moment."""
        return np.sqrt((self.reduced - self.full) ** 2 @ self.weights)

    @property
    def largest(self) -> Array:
        """Largest norm (t,) until each moment."""
        return np.asarray(np.maximum.accumulate(np.sqrt(self.full**2 @ self.weights)))

    @property
    def so_far(self) -> Array:
        """Largest error (t,) until each moment over the largest norm until then.

        It does not vanish where the error changes its sign.
        """
        floor = 1e-9 * max(float(self.largest[-1]), 1e-300)
        return np.asarray(np.maximum.accumulate(self.away) / np.maximum(self.largest, floor))

    def at(self, moments: Flags) -> Self:
        """Only of some moments (t,)."""
        return self._replace(reduced=self.reduced[moments], full=self.full[moments])


@dataclass
class KnownAnswer:
    """An answer of the reduced model whose errors are known."""

    errors: Array  # (quantities,), the largest so far: see ``Compared.so_far``
    features: Array  # of the error estimate
    converged: bool
    comparable: bool  # counts for the estimate: both models rest in the same equilibrium
    near_rim: bool = False  # as its last feature says, if there is such a one
    mesh: Array = field(default_factory=lambda: np.zeros(3))  # estimated errors of the mesh
    estimated: Array = field(default_factory=lambda: np.empty(0))  # (quantities,), of ``errors``


class Row(NamedTuple):
    """One query answered by both models.

    Errors in its table are relative L2 norms over the volume (of stress outside the clamped layer
    and regions) and all moments.
    """

    table: dict[str, float]
    known: list[KnownAnswer]  # answers at the ends of its time steps


def compare(
    kind: Kind, problem: FullProblem, model: ReducedModel, query: Sequence[Step], full: Reference
) -> Row:
    """Answer a query with the reduced model and compare with full solutions."""
    answers = play(model, query, problem.scene.tissue.young)
    moved, stress = map(model.displacement, answers), map(model.von_mises, answers)
    compared = {
        "displacement": _compared(moved, full.u, np.repeat(problem.nodal_volumes, 3)),
        "von_mises": _compared(stress, full.s, problem.counted_volumes),
        "force": _compared((answer.force for answer in answers), full.f, np.ones(3)),
    }
    compared = {name: compared[name] for name in kind.quantities}
    errors = np.transpose([quantity.so_far for quantity in compared.values()])
    known = [
        KnownAnswer(
            errors=own,
            features=answer.features,
            converged=answer.converged,
            # a pressed footprint has one equilibrium within the range of loads
            comparable=answer.converged and (kind is LOADS or own[0] <= OTHER_EQUILIBRIUM),
            near_rim=not kind.in_time and answer.features[-1] > 0.0,
            mesh=answer.error_mesh[: len(kind.quantities)],
            estimated=answer.error_reduction[: len(kind.quantities)],
        )
        for own, answer in zip(errors, answers, strict=True)
    ]
    table = (
        _history(kind, problem, query, answers, compared)
        if kind.in_time
        else _single(model, answers[0], compared, full)
    )
    return Row(table, known)


def _compared(reduced: Iterable[NDArray[Any]], full: NDArray[Any], weights: Array) -> Compared:
    """A quantity by both models, of any shape at each moment."""
    own = np.array([*reduced], float)
    return Compared(own.reshape(len(full), -1), full.astype(float).reshape(len(full), -1), weights)


def _single(
    model: ReducedModel, answer: Answer, compared: Mapping[str, Compared], full: Reference
) -> dict[str, float]:
    """What there is to tell of a load or a position; ``load`` and ``tilt`` are shares of limits."""
    errors = {name: quantity.error for name, quantity in compared.items()}
    if answer.tip:
        at, names = answer.position, ("depth", "depth_limit", "penetration")
        errors["tangent"] = relative(answer.tangent, full.tangent[0])
        shares = {}
    else:
        at, names = answer.contact_point, ("pressure", "departure", "residual")
        *stresses, counted = compared["von_mises"]
        found, exact = (np.percentile(stress[0][counted > 0.0], 99) for stress in stresses)
        errors["von_mises_p99"] = float(abs(found - exact) / exact)
        errors["peak_displacement"] = float(np.linalg.norm(full.u[0], axis=1).max())
        shares = {
            "limit": answer.pressure_limit,
            "load": answer.pressure / answer.pressure_limit,
            "tilt": answer.tilt / model.scene.endoscope.max_tilt,
        }
    said = {name: getattr(answer, name) for name in (*names, "converged", "in_range", "iterations")}
    return dict(zip("xyz", at.tolist(), strict=True)) | shares | said | errors


def _history(
    kind: Kind,
    problem: FullProblem,
    query: Sequence[Step],
    answers: Sequence[Answer],
    compared: Mapping[str, Compared],
) -> dict[str, float]:
    """What there is to tell of a history.

    ``apart`` are moments at which the models rest in different equilibria, as where tissue has
    slipped off the tip in one and is about to in the other; ``together_`` are errors over others.
    ``depth`` is the error of how far a footprint has moved.
    """
    positions = np.array([step.position for step in query])
    table = {
        "steps": len(query),
        "seconds": float(sum(step.dt for step in query)),
        "travel": float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()),
        "unconverged": sum(not answer.converged for answer in answers),
    }
    for name, quantity in compared.items():
        table[name] = quantity.error
        table[f"worst_{name}"] = float(quantity.so_far.max() if kind.tip else quantity.so_far[-1])
    moved = compared["displacement"]
    if kind.tip:
        apart = moved.away > OTHER_EQUILIBRIUM * moved.largest
        table["apart"] = int(apart.sum())
        for name, quantity in compared.items():
            table[f"together_{name}"] = quantity.at(~apart).error
        return table
    exact = moved.full.reshape(len(query), -1, 3)
    under = [problem.under(*pair) for pair in zip(positions, exact, strict=True)]
    contact = np.array([answer.contact_displacement for answer in answers])
    table["depth"] = relative(contact, np.array(under))
    table["last_displacement"] = float(moved.away[-1] / moved.largest[-1])
    return table


def summarise(kind: Kind, rows: Sequence[Row], tolerance: Tolerance) -> dict[str, Any]:
    """Statistics over queries of one kind.

    ``unconverged`` counts answers, and ``covered`` is the share of all others that are within their
    estimates, of single ones told of those ``near_rim``, too; ``flagged`` is what ``flags`` finds.
    Single answers that did not converge count in nothing else.  Under the tip queries that the
    models spend in different equilibria, ``other_equilibrium``, are left out of all errors but
    ``together_...``, which are those of moments at which they do not.
    """
    known = [answer for row in rows for answer in row.known]
    converged = [answer for answer in known if answer.converged]
    covered, ratios = coverage(converged)
    answered = [row.table for row in rows if any(answer.converged for answer in row.known)]
    alike = [row for row in answered if not kind.tip or row["displacement"] <= OTHER_EQUILIBRIUM]
    summary: dict[str, Any] = {"histories" if kind.in_time else "queries": len(rows)}
    if kind.in_time:
        summary["steps"] = len(known)
    summary["unconverged"] = len(known) - len(converged)
    if kind.tip:
        summary["other_equilibrium"] = len(answered) - len(alike)
    summary["covered"] = covered
    if rim := [answer for answer in converged if answer.near_rim]:
        summary["near_rim"] = {"queries": len(rim), "covered": coverage(rim)[0]}
    summary["flagged"] = flags(converged, tolerance.of(kind.tip))
    if kind.tip and kind.in_time:
        moments = [row["apart"] for row in answered]
        summary["apart"] = {"histories": int(np.count_nonzero(moments)), "moments": sum(moments)}
    for name in (*kind.quantities, *kind.others):
        counted = answered if name.startswith("together") else alike
        summary[name] = statistics([row[name] for row in counted])
    medians = dict(zip(kind.quantities, ratios.tolist(), strict=True))
    return summary | {"estimate_over_error_median": medians}


def write_rows(path: Path, kind: Kind, rows: Sequence[Row]) -> None:
    """Write tables of queries, one line each; single answers with their estimated errors."""
    names = [] if kind.in_time else [f"estimated_{name}" for name in kind.quantities]
    estimated = [dict(zip(names, row.known[0].estimated.tolist(), strict=False)) for row in rows]
    write_csv(path, [row.table | own for row, own in zip(rows, estimated, strict=True)])


def opened(
    artifact: Path, *kinds: Kind, young: float | None = None
) -> tuple[ReducedModel, FullProblem]:
    """Reduced and full model of an artifact; see ``FullProblem.of_artifact``.

    Raises
    ------
    QueryError
        If the artifact has no answers to queries of one of the kinds.
    """
    model = ReducedModel.load(artifact)
    for kind in kinds:
        if lack := kind.lacks(model.scene):
            raise QueryError("scene", f"{model.name!r} {lack}")
    return model, FullProblem.of_artifact(artifact, young)


def against_full(
    artifact: Path,
    kind: Kind,
    count: int,
    seed: int,
    csv: Path | None = None,
    young: float | None = None,
) -> dict[str, Any]:
    """Compare an artifact with its full model on new random queries, written one by one to a CSV.

    The tissue of both has another Young's modulus (kPa) if one is given.

    Returns
    -------
    dict
        As ``summarise``, and ``without_equilibrium``: queries that the full model had no answer to,
        and which count in nothing else.

    Raises
    ------
    PalpateError
        If the full model has no answer to any of them.
    QueryError
        If the artifact has none to this kind.
    """
    model, problem = opened(artifact, kind, young=young)
    queries = kind.random(model, count, held_out(model, seed))
    queries = kind.of_young(queries, stiffness(model.scene.tissue.young, young))
    tasks = [reference_task(model, query, young) for query in queries]
    with worker_pool(open_artifact, artifact, young) as pool:
        solved = tqdm(pool.map(run, *zip(*tasks, strict=True)), "full solutions", count)
        rows = [
            compare(kind, problem, model, query, full)
            for query, full in zip(queries, solved, strict=True)
            if full is not None
        ]
    if not rows:
        raise PalpateError(f"{artifact}: the full model has no equilibrium under any of the loads")
    if csv:
        write_rows(csv, kind, rows)
    return summarise(kind, rows, model.scene.tolerance) | {"without_equilibrium": count - len(rows)}


def reference_task(
    model: ReducedModel, query: Sequence[Step], young: float | None = None
) -> tuple[Any, ...]:
    """Task of a query's full solutions.

    A single one is sought near the reduced answer: that is quicker, and under the tip a free edge
    can rest on either side of it.
    """
    if len(query) > 1:
        return FullProblem.reference, query
    return FullProblem.reference, query, reduced_guess(model, query[0], young)


def reduced_guess(model: ReducedModel, step: Step, young: float | None = None) -> Array:
    """Displacement (n, 3) mm of the reduced answer to a single step, at the nodes of the mesh."""
    (answer,) = play(model, [step], young)
    return model.fields.of_mesh(answer).astype(float)


COVERAGE, CONFIDENCE = 0.95, 0.95
"""Share of errors that estimates are to cover, and how sure it is that they cover so many."""


def covering(count: int) -> tuple[float, float]:
    """Quantile of so many known scores that covers unseen ones, and the confidence.

    Those below the k-th of n are a share of all scores that has the beta distribution of k and
    n + 1 - k, whatever they are; its mean is the quantile k / (n + 1).  The k is the least that is
    sure enough; of few scores, the last.
    """
    rank = np.arange(1, count + 1)
    sure = beta.sf(COVERAGE, rank, count + 1 - rank)
    k = min(int(np.searchsorted(sure, CONFIDENCE)), count - 1)
    return float(rank[k] / (count + 1)), float(sure[k])


def calibrate(queries: Sequence[Sequence[KnownAnswer]], damping: float) -> tuple[Array, float]:
    """Fit the error estimate (quantities, features), conformally; return its confidence, too.

    A least-squares fit of the logs of errors is raised until the scores that ``covering`` asks for
    are covered.  A score is how far an answer lies above the fit, over the root of how far they
    usually do, in the quantity in which that is most: between raising all quantities alike and each
    as it scatters.  Answers near the rim are raised by themselves, through their last feature.
    What counts is how far an answer lies from a fit to the others, or the estimate would cover
    fewer of new ones.  The answers to one query are alike: for the confidence they count as one,
    and the quantile is that of all of them.
    ``damping`` holds the coefficients back, since known errors are few for many features.
    """
    own = [(i, answer) for i, query in enumerate(queries) for answer in query if answer.comparable]
    query, known = np.array([i for i, _ in own]), [answer for _, answer in own]
    X = np.array([answer.features for answer in known])
    spread = X.std(axis=0)
    scale = np.where(spread > 1e-9, spread, np.inf)  # the constant one; others may be, too
    middle = X.mean(axis=0)
    A = np.column_stack([(X - middle) / scale, np.ones(len(known))])
    ridge = np.diag([damping] * len(middle) + [0.0])
    inverse = np.linalg.pinv(np.vstack([A, ridge]))[:, : len(A)]
    leverage = np.sum(A * inverse.T, axis=1)
    Y = np.log(np.maximum([answer.errors for answer in known], 1e-8))
    coefficients = (inverse @ Y)[:-1] / scale[:, None]
    rest = Y - X @ coefficients
    coefficients[0] = np.median(rest, axis=0)
    rest = (rest - coefficients[0]) / (1 - leverage)[:, None]
    above = np.mean(np.maximum(rest, 1e-9) ** 2, axis=0) ** 0.25
    score, near_rim = (rest / above).max(axis=1), np.array([answer.near_rim for answer in known])
    raised, sure = list[Array](), 1.0
    for group in (~near_rim, near_rim):
        if group.any():
            share, confidence = covering(len(np.unique(query[group])))
            rank = math.ceil(share * (group.sum() + 1) - 1e-9)
            covered = np.sort(score[group])[rank - 1]
            raised.append(covered * above)
            sure = min(sure, confidence)
    coefficients[0] += raised[0]
    if len(raised) == 2:
        coefficients[-1] += raised[1] - raised[0]
    return np.ascontiguousarray(coefficients.T), sure


def calibrate_by_halves(
    queries: Sequence[Sequence[KnownAnswer]], damping: float
) -> tuple[Array, float]:
    """Fit an estimate to the answers to all queries, as ``calibrate`` does.

    What an answer itself is estimated to err by comes from a fit to the other half of the queries.
    """
    for half in (0, 1):
        estimator, _ = calibrate(queries[1 - half :: 2], damping)
        for answers in queries[half::2]:
            for answer in answers:
                answer.estimated = np.exp(estimator @ answer.features)
    return calibrate(queries, damping)


def coverage(known: Sequence[KnownAnswer]) -> tuple[float, Array]:
    """Share of answers within all their estimates; medians (quantities,) of estimate over error.

    Of the answers in range: outside it there is no estimate.
    """
    known = [answer for answer in known if answer.estimated[0] != np.inf]
    errors = np.array([answer.errors for answer in known])
    estimated = np.array([answer.estimated for answer in known])
    ratios = np.median(estimated / np.maximum(errors, 1e-12), axis=0)
    return float(np.mean(np.all(errors <= estimated, axis=1))), ratios


def flags(known: Sequence[KnownAnswer], tolerance: Tolerance) -> dict[str, Any]:
    """Share of right answers that would be doubted, of how many, and what is to blame most often.

    Right are those in range that are within the tolerance with all that the mesh is estimated to
    err by; they are doubted where the estimates of mesh and reduction together exceed it.
    """
    right, doubted, blamed = 0, 0, Counter[str]()
    for answer in known:
        if answer.estimated[0] == np.inf:
            continue
        is_right = not tolerance.exceeded(np.hypot(answer.errors, answer.mesh))
        names = tolerance.exceeded(np.hypot(answer.estimated, answer.mesh))
        right += is_right
        doubted += is_right and bool(names)
        for name in names:
            i = Errors._fields.index(name)
            larger = "mesh" if answer.mesh[i] > answer.estimated[i] else "reduction"
            blamed[f"the {larger}'s {name}"] += 1
    most = blamed.most_common(1)
    return {
        "share": doubted / max(right, 1),
        "right": right,
        "mostly": most[0][0] if most else None,
    }
