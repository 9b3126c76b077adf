"""A table of loads, or of positions of the tip, answered on all cores: CSV in, CSV out."""

import csv
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from palpate.offline.info import percent
from palpate.offline.run.tables import write_csv
from palpate.shared.answer import Answers
from palpate.shared.arrays import Array
from palpate.shared.errors import PalpateError, QueryError
from palpate.shared.files import open_regular
from palpate.shared.model import ReducedModel
from palpate.shared.scene import Tolerance

PLACE, PRESSURE, DIRECTION = ("x", "y", "z"), ("pressure",), ("dx", "dy", "dz")
FOUND = (
    "force", "converged", "in_range", "error_displacement", "error_von_mises", "error_force",
    "limit", "distance", "contact_point", "normal", "contact_displacement", "min_jacobian",
)  # fmt: skip
"""Of ``Answers``; vectors have three columns, such as ``force_x``."""

NOT_OF_TIP = ("contact_displacement",)


def solve_table(
    artifact: Path, table: Path, out: Path, tip: bool, young: float | None = None
) -> dict[str, Any]:
    """Answer every row of a table, each from rest; write them with what was found.

    The tissue has another Young's modulus (kPa) if one is given.
    Its first line names the columns: ``x,y,z`` (mm), and of loads ``pressure`` (kPa), and if wanted
    ``dx,dy,dz``, the direction.  How many answers are not to be trusted goes to stderr.

    Raises
    ------
    PalpateError
        If a file cannot be used, or a row makes no sense; it names the line.
    """
    atlas = ReducedModel.load(artifact)
    names, rows = read_table(table)
    wanted = (PLACE,) if tip else (PLACE + PRESSURE, PLACE + PRESSURE + DIRECTION)
    if not any(set(names) == set(columns) for columns in wanted):
        ways = " or ".join(",".join(columns) for columns in wanted)
        raise PalpateError(f"{table}: its first line must be {ways}, not {','.join(names)}")
    columns = dict(zip(names, rows.T, strict=True))
    at = np.column_stack([columns[name] for name in PLACE])
    started = time.perf_counter()
    try:
        if tip:
            answers = atlas.touch_many(at, young)
        else:
            along = [columns[name] for name in DIRECTION if name in columns]
            towards = np.column_stack(along) if along else None
            answers = atlas.solve_many(at, columns["pressure"], towards, young)
    except QueryError as error:
        field, _, row = error.field.partition(".")
        where = f", line {int(row) + 2}" if row else ""
        raise PalpateError(f"{table}{where}: {field}: {error.message}") from error
    seconds = time.perf_counter() - started
    for said in _cautions(answers, atlas.scene.tolerance, tip):
        print(f"Warning: {said}", file=sys.stderr)
    for name in FOUND:
        if tip and name in NOT_OF_TIP:
            continue
        values = getattr(answers, name)
        parts = values.T if values.ndim == 2 else [values]
        ends = ("_x", "_y", "_z") if values.ndim == 2 else ("",)
        columns |= {f"{name}{end}": part for end, part in zip(ends, parts, strict=True)}
    if rows.size:
        write_csv(
            out,
            [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)],
        )
    return {
        "scene": atlas.name,
        "rows": len(rows),
        "in_range": int(answers.in_range.sum()),
        "without_equilibrium": int((~answers.converged).sum()),
        "seconds": seconds,
        "out": str(out),
    }


def _cautions(answers: Answers, tolerance: Tolerance, tip: bool) -> Iterator[str]:
    """Say of how many answers what is to be known before they are trusted, a sentence each."""
    rows, sound = len(answers.converged), answers.converged & answers.in_range
    if tip and (off := answers.converged & ~answers.force.any(axis=1)).any():
        yield f"the tip touches nothing in {off.sum()} of {rows} rows"
    for name, most in tolerance.of(tip).total._asdict().items():
        errors = getattr(answers, f"error_{name}")
        if (beyond := sound & (errors > most)).any():
            yield (
                f"error_{name} is more than the scene's tolerance of {percent(most)} in "
                f"{beyond.sum()} of {rows} rows, up to {percent(errors[beyond].max())}"
            )


def read_table(table: Path) -> tuple[list[str], Array]:
    """Names of the columns of a CSV file and its numbers (n, columns); empty lines do not count."""
    try:
        with open_regular(table) as file:
            text = file.read().decode()
    except (OSError, UnicodeDecodeError) as error:
        raise PalpateError(f"{table}: cannot be read: {error}") from error
    lines = text.splitlines()
    names, *rows = [[part.strip() for part in row] for row in csv.reader(lines) if row] or [[]]
    numbers = np.empty((len(rows), len(names)))
    for row, values in enumerate(rows):
        try:
            numbers[row] = [float(part) for part in values]
        except ValueError as error:
            what = f"must be {len(names)} numbers, not {','.join(values)[:80]}"
            raise PalpateError(f"{table}, line {row + 2}: {what}") from error
    return names, numbers
