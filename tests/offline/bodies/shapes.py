"""Closed shapes made at random, each trained and validated with no hand on its scene: a study.

    python -m tests.offline.bodies.shapes FOLDER --count 10

Blobs, bent plates and thick tubes in turn, of which the lower side is held and the upper one can be
touched. A shape that training refuses is told with its sentence, as is what it says of the mesh.
Results are written to ``shapes.csv`` in the folder; artifacts that are there already are not made
again.
"""

import json
import subprocess
from pathlib import Path

import click
import numpy as np
import pyvista as pv

from palpate.offline.run.tables import write_csv

from ...conftest import PALPATE
from .conftest import SCENE

STEP = 0.8  # mm between points of the grid
SHAPE = """
support.normal = [0.0, 0.0, -1.0]
support.within = 50.0
support.z = [-100.0, 0.0]
surface.normal = [0.0, 0.0, 1.0]
surface.within = 50.0
surface.z = [0.0, 100.0]
geometry.kind = "surface"
geometry.unit = "mm"
geometry.file = "body.stl"
"""
COLUMNS = (
    "shape", "refused", "seconds", "displacement_p95", "von_mises_p95", "covered", "unconverged",
    "mesh_displacement_p95", "mesh_von_mises_p95", "told",
)  # fmt: skip


def blob(points, rng):
    """One large Gaussian with five smaller ones in it."""
    found = np.exp(-0.5 * np.sum((points / [9.0, 8.0, 7.0]) ** 2, axis=1))
    for _ in range(5):
        at, height = rng.normal(0.0, 5.0, 3), rng.uniform(-0.2, 0.3)
        found += height * np.exp(-0.5 * np.sum((points - at) ** 2, axis=1) / 4.0**2)
    return found - 0.45


def plate(points, rng):
    """A plate with rounded edges, bent along a wave of any direction."""
    x, y, z = points.T
    (a, b), thick = rng.uniform(11.0, 14.0, 2), rng.uniform(3.0, 4.0)
    along = rng.uniform(0.0, np.pi)
    wave = rng.uniform(0.5, 1.5) * np.sin((x * np.cos(along) + y * np.sin(along)) / 6.0)
    return 1.0 - (x / a) ** 4 - (y / b) ** 4 - ((z - wave) / thick) ** 4


def tube(points, rng):
    """A tube with a thick wall, open at both ends and slightly bent."""
    x, y, z = points.T
    radius, wall = rng.uniform(7.0, 8.5), rng.uniform(3.0, 3.6)
    bend, length = rng.uniform(-0.01, 0.01), rng.uniform(11.0, 14.0)
    away = np.hypot(y - bend * x**2, z) - radius
    return 1.0 - (away / wall) ** 4 - (x / length) ** 8


KINDS = blob, plate, tube


def write(folder, number, seed):
    """Write the surface of a shape and its scene; return the scene's file."""
    made = KINDS[number % len(KINDS)]
    name, rng = f"{made.__name__}-{number}", np.random.default_rng([seed, number])
    counts = np.rint(2 * np.array([20.0, 20.0, 16.0]) / STEP).astype(int) + 1
    grid = pv.ImageData(dimensions=counts, spacing=(STEP,) * 3, origin=(-20.0, -20.0, -16.0))
    grid["level"] = made(np.array(grid.points), rng)
    surface = grid.contour([0.0], scalars="level", method="flying_edges").extract_largest()
    surface.smooth_taubin(n_iter=20).clean().save(folder / f"{name}.stl")
    file, scene = folder / f"{name}.toml", SCENE.replace("radius = 4.0", "radius = 3.0")
    file.write_text((scene + SHAPE).replace("body", name))
    return file


def palpate(*words):
    """What a command of palpate prints, and how it ends."""
    command = [*PALPATE, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def told(*words):
    """What a command of palpate tells of an artifact."""
    return json.loads(palpate(*words, "--json").stdout)


def study(file, queries):
    """Train and validate one shape: a row of the table."""
    artifact, row = file.with_suffix(".h5"), dict.fromkeys(COLUMNS, "") | {"shape": file.stem}
    if not artifact.exists():
        trained = palpate("train", file, "--out", artifact)
        file.with_suffix(".log").write_text(trained.stderr)
        if not artifact.exists():
            *_, said = trained.stderr.strip().splitlines()
            return row | {"refused": said}
    found = told("validate", artifact, "--queries", queries, "--seed", 1)
    info = told("info", artifact)
    mesh, row["seconds"] = info["training"]["mesh_errors"], info["provenance"]["wall_seconds"]
    row["told"] = info["training"]["mesh_choice"]["why"]
    for key in ("displacement", "von_mises"):
        row |= {f"{key}_p95": found[key]["p95"], f"mesh_{key}_p95": mesh[key]["p95"]}
    return row | {key: found[key] for key in ("covered", "unconverged")}


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--count", default=10, help="Number of shapes.")
@click.option("--queries", default=100, help="Loads that each is validated with.")
@click.option("--seed", default=0, help="Of the shapes.")
def main(folder, count, queries, seed):
    """Make shapes in a FOLDER, train and validate them."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for number in range(count):
        rows.append(study(write(folder, number, seed), queries))
        write_csv(folder / "shapes.csv", rows)
        click.echo(rows[-1])


if __name__ == "__main__":
    main()
