"""The reduced against the full model on queries that training has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from palpate.offline.fem.problem import FullProblem, Load, Step
from palpate.offline.run.streams import Stage, stream
from palpate.offline.run.tables import write_csv
from palpate.offline.run.workers import completed, open_artifact, worker_pool
from palpate.offline.validate.compare import Row, compare, play, summarise
from palpate.offline.validate.kinds import Kind
from palpate.offline.validate.queries import random_loads
from palpate.shared.artifact import read_artifact
from palpate.shared.errors import PalpateError, QueryError
from palpate.shared.model import ReducedModel


def against_full(
    artifact: Path, kind: Kind, count: int, seed: int, csv: Path | None = None
) -> dict[str, Any]:
    """Compare an artifact with its full model on new random queries, written one by one to a CSV.

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
    model = ReducedModel.load(artifact)
    lack = kind.lacks(model.models)
    if lack:
        raise QueryError("scene", f"{model.name!r} {lack}")
    problem = FullProblem.of_artifact(read_artifact(artifact))
    queries = kind.random(model, count, held_out(model, seed))
    tasks = {str(i): reference_task(model, query) for i, query in enumerate(queries)}
    rows = {}
    with worker_pool(open_artifact, artifact) as pool:
        for name, full in tqdm(completed(pool, tasks), "full solutions", count):
            if full is not None:
                rows[int(name)] = compare(kind, problem, model, queries[int(name)], full)
    if not rows:
        raise PalpateError(f"{artifact}: the full model has no equilibrium under any of the loads")
    ordered = [rows[i] for i in sorted(rows)]
    if csv:
        write_rows(csv, kind, ordered)
    return summarise(kind, ordered) | {"without_equilibrium": count - len(ordered)}


def reference_task(model: ReducedModel, query: Sequence[Step]) -> tuple[Any, ...]:
    """Task of a query's full solutions.

    Under the tip a single one is sought near the reduced answer: a free edge can rest on either
    side of it.
    """
    (*_, last) = query
    if len(query) > 1 or isinstance(last, Load):
        return FullProblem.reference, query
    (answer,) = play(model, query)
    return FullProblem.reference, query, model.displacement(answer)


def held_out(model: ReducedModel, seed: int) -> np.random.Generator:
    """Random numbers that training has not drawn, whatever the seed."""
    return stream(model.scene.seed, Stage.UNSEEN, seed)


def held_out_loads(model: ReducedModel, count: int, seed: int) -> list[Load]:
    """Random loads that training has not seen, whatever the seed."""
    return random_loads(model, count, held_out(model, seed))


def write_rows(path: Path, kind: Kind, rows: Sequence[Row]) -> None:
    """Write tables of queries, one line each; single answers with their estimated errors."""
    names = [] if kind.in_time else [f"estimated_{name}" for name in kind.quantities]
    estimated = [dict(zip(names, row.known[0].estimated.tolist(), strict=False)) for row in rows]
    write_csv(path, [row.table | own for row, own in zip(rows, estimated, strict=True)])
