"""Tables on disk."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from palpate.shared.files import named


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows of equal keys, floats with six digits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with named(path), path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        for row in rows:
            digits = {key: f"{x:.6g}" for key, x in row.items() if isinstance(x, float)}
            writer.writerow({**row, **digits})
