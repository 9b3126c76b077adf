"""Slabs of one thickness and ever more surface, trained with one size of local models: a study.

    python -m tests.offline.growth FOLDER --side 16 --side 32 --side 64

What training and its artifact take for each local model must not depend on the body. The table is
written to ``growth.csv`` in the folder; artifacts that are there already are not made again.
"""

import json
import subprocess
from pathlib import Path

import click

from palpate.offline.run.tables import write_csv

from ..conftest import PALPATE

SCENE = """
name = "slab-{side:g}"
description = "A bonded slab"
geometry.kind = "block"
geometry.size = [{side}, {side}, 12.0]
tissue.law = "neo-hookean"
tissue.young = 4.0
tissue.poisson = 0.45
support.side = "bottom"
surface.side = "top"
endoscope.radius = 3.0
endoscope.max_tilt = 30.0
endoscope.tip = false
load.max_indentation = 0.3
training.size.patch_spacing = 3.0
training.size.modes = 44
training.size.cubature_points = 96
training.size.region_modes = 190
"""


def told(command, artifact):
    """What a command of palpate tells of an artifact."""
    run = [*PALPATE, command, str(artifact), "--json"]
    return json.loads(subprocess.run(run, check=True, capture_output=True, text=True).stdout)


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--side", "sides", type=float, multiple=True, default=[16, 32, 64], help="In mm.")
def main(folder, sides):
    """Train slabs in a FOLDER, one after the other."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for side in sides:
        file = folder / f"slab-{side:g}.toml"
        file.write_text(SCENE.format(side=side))
        artifact = file.with_suffix(".h5")
        subprocess.run([*PALPATE, "train", str(file), "--out", str(artifact)], check=True)
        info, bench = told("info", artifact), told("bench", artifact)
        layout, seconds = info["training"]["layout"], info["provenance"]["wall_seconds"]
        models = layout["patches"]
        rows.append(
            {
                "side": side,
                "dofs": layout["dofs"],
                "models": models,
                "seconds": seconds,
                "seconds_per_model": round(seconds / models, 3),
                "kB_per_model": round(info["bytes"] / models / 1000, 1),
                "cold_us": round(bench["cold_us"], 1),
            }
        )
        write_csv(folder / "growth.csv", rows)
        click.echo(rows[-1])


if __name__ == "__main__":
    main()
