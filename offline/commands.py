"""The offline commands of ``palpate``.

Each imports what it runs when it runs, so that ``--help`` is instant.
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path

import click

ARTIFACT = click.Path(exists=True, dir_okay=False, path_type=Path)
OUTPUT = click.Path(dir_okay=False, writable=True, path_type=Path)
VECTOR = (float, float, float)

artifact_argument = click.argument("artifact", metavar="F", type=ARTIFACT)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")

LOAD_OPTIONS = (
    click.option(
        "--at", "position", type=VECTOR, required=True, metavar="X Y Z", help="Contact, mm."
    ),
    click.option("--pressure", type=float, required=True, help="Pressure at the contact, kPa."),
    click.option(
        "--direction",
        type=VECTOR,
        metavar="X Y Z",
        help="Where the load pushes; any length  [default: the inward normal]",
    ),
)


def load_options(command: Callable[..., None]) -> Callable[..., None]:
    """Options of a command that presses the tissue once."""
    for option in reversed(LOAD_OPTIONS):
        command = option(command)
    return command


@click.command()
@click.argument("scene")
@click.option("--out", type=OUTPUT, help="The artifact to write  [default: artifacts/NAME.h5]")
@click.option(
    "--workers", type=click.IntRange(min=1), help="Worker processes  [default: one per core]"
)
def train(scene: str, out: Path | None, workers: int | None) -> None:
    """Train the artifact of a scene.

    SCENE is one that comes along, such as turbinate, or a TOML file. A run that was killed goes on
    where it stopped.
    """
    from palpate.offline.train import train

    train(scene, out, workers)


@click.command()
@artifact_argument
@json_option
def info(artifact: Path, as_json: bool) -> None:
    """Show what the artifact F holds.

    How it was made, how accurate it is, its range of loads (kPa, degrees, mm) and the quality of
    its mesh.
    """
    from palpate.shared.model import ReducedModel

    atlas = ReducedModel.load(artifact)
    endoscope = atlas.scene.endoscope
    loads = {
        "largest_pressure": atlas.pressure_max,
        "largest_tilt": endoscope.max_tilt,
        "radius": endoscope.radius,
    }
    head = {"scene": atlas.name, "description": atlas.scene.description, "loads": loads}
    _show(head | atlas.info, as_json)


@click.command()
@artifact_argument
@load_options
@click.option("--full-model", is_flag=True, help="Solve the full model too and compare.")
@click.option("--vtu", type=OUTPUT, metavar="OUT.vtu", help="Write mesh and fields.")
@json_option
def solve(
    artifact: Path,
    position: tuple[float, float, float],
    pressure: float,
    direction: tuple[float, float, float] | None,
    full_model: bool,
    vtu: Path | None,
    as_json: bool,
) -> None:
    """Press the tissue of the artifact F once.

    The file OUT.vtu holds the mesh at rest with point data displacement (mm), von_mises (kPa),
    load (mN) and clamped (0 or 1). With --full-model they are the full model's, beside them stand
    displacement_error and von_mises_error of the reduced one, and its relative errors are printed.
    """
    from palpate.offline.solve import solve

    _show(solve(artifact, position, pressure, direction, full_model, vtu), as_json)


@click.command()
@artifact_argument
@load_options
@click.option("--out", type=OUTPUT, required=True, metavar="PNG", help="Where to draw.")
def picture(
    artifact: Path,
    position: tuple[float, float, float],
    pressure: float,
    direction: tuple[float, float, float] | None,
    out: Path,
) -> None:
    """Draw the pressed tissue of the artifact F, coloured by von Mises stress.

    Needs PyVista: pip install -e '.[pictures]'.
    """
    from palpate.offline.pictures import picture

    picture(artifact, position, pressure, direction, out)


@click.command()
@artifact_argument
@click.option(
    "--queries",
    type=click.IntRange(min=1),
    default=300,
    show_default=True,
    help="How many loads.",
)
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Of the random loads.",
)
@click.option("--tip", is_flag=True, help="Push with the rigid tip, not with pressures.")
@click.option(
    "--histories",
    type=click.IntRange(min=1),
    metavar="N",
    help="Follow so many histories of visco-elastic tissue, not single loads.",
)
@click.option("--csv", type=OUTPUT, metavar="OUT", help="Write one row per query.")
@json_option
def validate(
    artifact: Path,
    queries: int,
    seed: int,
    tip: bool,
    histories: int | None,
    csv: Path | None,
    as_json: bool,
) -> None:
    """Compare the artifact F with the full model.

    Both solve new random loads, positions of the tip, or histories of either, over the artifact's
    whole range. Errors are relative L2 norms, as fractions; of histories, over all moments too.
    """
    from palpate.offline.validate.histories import validate_histories
    from palpate.offline.validate.loads import validate
    from palpate.offline.validate.tip import validate_touches
    from palpate.offline.validate.tip_histories import validate_courses

    if histories is not None:
        follow = validate_courses if tip else validate_histories
        _show(follow(artifact, histories, seed, csv), as_json)
        return
    _show((validate_touches if tip else validate)(artifact, queries, seed, csv), as_json)


@click.command()
@artifact_argument
@json_option
def bench(artifact: Path, as_json: bool) -> None:
    """Time queries on the artifact F.

    Median µs of a cold query, on a warm path of small steps, of the rigid tip on that path, with
    the fields on the surface, with all fields, and of the full model.
    """
    from palpate.offline.bench import bench

    _show(bench(artifact), as_json)


@click.group()
def study() -> None:
    """Measure what the choice of mesh and solver rests on."""


@study.command("mesh-error")
@click.option(
    "--report",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("artifacts/turbinate/report"),
    show_default=True,
    help="Folder for the tables and the chart.",
)
@json_option
def mesh_error(report: Path, as_json: bool) -> None:
    """Compare elements of about 6048 DOFs with a fine mesh.

    Errors are fractions of the displacement that the turbinate shows in the reference mesh; takes
    a few minutes.
    """
    from palpate.offline.studies.mesh_error import mesh_error

    _show(mesh_error(report), as_json)


@study.command()
@click.argument("scene")
@click.option("--artifact", type=ARTIFACT, metavar="F", help="[default: artifacts/NAME.h5]")
@click.option("--snapshots", type=click.IntRange(min=20), default=1000, show_default=True)
@click.option("--queries", type=click.IntRange(min=1), default=300, show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@json_option
def baselines(
    scene: str, artifact: Path | None, snapshots: int, queries: int, seed: int, as_json: bool
) -> None:
    """Compare the artifact of SCENE with simpler reduced models.

    Regression of POD coefficients and Galerkin in global POD bases learn from full solutions of
    SNAPSHOTS random loads; all answer the QUERIES that palpate validate asks with this seed. The
    table goes to NAME/report/baselines.csv beside the artifact. A killed run goes on where it
    stopped.
    """
    from palpate.offline.scenes import default_artifact, find_scene
    from palpate.offline.studies.baselines import baselines

    path = artifact or default_artifact(find_scene(scene))
    _show(baselines(path, snapshots, queries, seed), as_json)


@study.command()
@click.argument("scene")
@click.option("--artifact", type=ARTIFACT, metavar="F", help="[default: artifacts/NAME.h5]")
@click.option("--snapshots", type=click.IntRange(min=20), default=200, show_default=True)
@click.option("--queries", type=click.IntRange(min=1), default=100, show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@json_option
def chart(
    scene: str, artifact: Path | None, snapshots: int, queries: int, seed: int, as_json: bool
) -> None:
    """Set speed and accuracy of many methods side by side.

    Those that learn do so from full solutions of SNAPSHOTS random loads; all answer the QUERIES
    that palpate validate asks with this seed. Times are of one core. Table, picture and page go to
    NAME/report/chart.csv, .png and .html beside the artifact. Takes half an hour; a killed run
    goes on where it stopped.
    """
    from palpate.offline.scenes import default_artifact, find_scene
    from palpate.offline.studies.chart import chart

    found = find_scene(scene)
    path = artifact or default_artifact(found)
    _show(chart(found, path, snapshots, queries, seed), as_json)


@study.command()
@artifact_argument
@click.option("--paths", type=click.IntRange(min=1), default=10, show_default=True)
@click.option("--steps", type=click.IntRange(min=1), default=60, show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option("--tip", is_flag=True, help="Glide with a rigid tip; change of the force on it.")
@json_option
def continuity(artifact: Path, paths: int, steps: int, seed: int, tip: bool, as_json: bool) -> None:
    """Measure jumps of the artifact F as the contact glides.

    Largest change of the displacement field over steps of 0.05 mm that the full model does not
    show, in mm.
    """
    from palpate.offline.studies.continuity import continuity, tip_continuity

    measure = tip_continuity if tip else continuity
    _show(measure(artifact, paths, steps, seed), as_json)


@study.command("mesh-independence")
@click.option("--queries", type=click.IntRange(min=20), default=1000, show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@json_option
def mesh_independence(queries: int, seed: int, as_json: bool) -> None:
    """Time the same queries on turbinate and turbinate-fine.

    Both with one sparse atlas of equal layout, modes and cubature points; takes a few minutes.
    """
    import tempfile

    from palpate.offline.studies.mesh_independence import compare

    with tempfile.TemporaryDirectory() as folder:
        _show(compare(queries, seed, Path(folder)), as_json)


paper_report = click.option(
    "--report",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder for table and pictures  [default: artifacts/SCENE/report]",
)


@study.command()
@click.argument("scene", type=click.Choice(["cube", "cube-visco"]), default="cube")
@paper_report
@json_option
def cube(scene: str, report: Path | None, as_json: bool) -> None:
    """Redraw figure 1 of Radermacher & Reese.

    A cube under compression in modal, Ritz and POD bases: relative error at a point and ratio of
    CPU times against the number of bases, and which of the paper's claims hold. SCENE cube-visco is
    of tissue that knows time: pressed, held and let go.
    """
    from palpate.offline.studies import paper, paper_in_time

    study = paper_in_time if scene == "cube-visco" else paper
    _show(study.cube(report or Path("artifacts", scene, "report")), as_json)


@study.command()
@click.argument("scene", type=click.Choice(["turbinate", "turbinate-visco"]), default="turbinate")
@paper_report
@json_option
def turbinate(scene: str, report: Path | None, as_json: bool) -> None:
    """Redraw figures 1, 2c and 2d of Radermacher & Reese.

    The turbinate under one footprint in modal, Ritz and POD bases, and contours of the relative
    errors in five POD bases, for which PyVista is needed: pip install -e '.[pictures]'. SCENE
    turbinate-visco is of tissue that knows time, pressed, held and let go; without contours.
    """
    from palpate.offline.studies import paper, paper_in_time

    study = paper_in_time if scene == "turbinate-visco" else paper
    _show(study.turbinate(report or Path("artifacts", scene, "report")), as_json)


@study.command("newton-step")
@click.option("--element", type=click.Choice(["hex8", "hex20"]), default="hex20", show_default=True)
@click.option("--repeats", type=click.IntRange(min=1), default=20, show_default=True)
@json_option
def newton_step(element: str, repeats: int, as_json: bool) -> None:
    """Time a Newton step of the full model beside FElupe's.

    Medians in ms on one thread; ratio is FElupe with its default solver over palpate, ratio_best
    with the fastest solver at hand.
    """
    from palpate.offline.studies.newton_step import compare

    _show(compare(element, repeats), as_json)


@study.command()
@click.argument("scene")
@click.option("--artifact", type=ARTIFACT, metavar="F", help="[default: artifacts/NAME.h5]")
@click.option("--cases", type=click.IntRange(min=1), default=20, show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@json_option
def stability(scene: str, artifact: Path | None, cases: int, seed: int, as_json: bool) -> None:
    """Map which methods fail under what, and whether they say so.

    The artifact of SCENE and other methods answer CASES loads of every stressor, in range and far
    beyond it, for which the full model's answer is known. The map goes to
    NAME/report/stability.csv and .png beside the artifact, the artifact's silent errors to
    stability_silent.csv. A killed run goes on where it stopped.
    """
    from palpate.offline.scenes import default_artifact, find_scene
    from palpate.offline.studies.stability import stability

    path = artifact or default_artifact(find_scene(scene))
    _show(stability(path, cases, seed), as_json)


@study.command("chart-in-time")
@artifact_argument
@click.option(
    "--histories",
    type=click.IntRange(min=1),
    default=20,
    show_default=True,
    help="That all methods answer.",
)
@click.option(
    "--lessons",
    type=click.IntRange(min=1),
    default=20,
    show_default=True,
    help="Histories that POD learns from.",
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@json_option
def chart_in_time(artifact: Path, histories: int, lessons: int, seed: int, as_json: bool) -> None:
    """Set speed and accuracy of methods over histories side by side.

    The visco-elastic artifact F, its twin without memory, the full model and Galerkin models with
    all quadrature points in modal, Ritz and POD bases answer the HISTORIES that palpate validate
    asks with this seed. Table and picture go to NAME/report/chart_in_time.csv and .png beside the
    artifact.
    """
    from palpate.offline.studies.chart_in_time import chart_in_time

    _show(chart_in_time(artifact, histories, lessons, seed), as_json)


@study.command("stability-in-time")
@artifact_argument
@click.option("--cases", type=click.IntRange(min=1), default=4, show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option(
    "--many",
    type=click.IntRange(min=100),
    default=100_000,
    show_default=True,
    help="Steps of the longest history.",
)
@json_option
def stability_in_time(artifact: Path, cases: int, seed: int, many: int, as_json: bool) -> None:
    """Map which methods fail under which histories, and whether they say so.

    The visco-elastic artifact F, under footprints and its rigid tip, and other methods answer
    histories in CASES places: very small and large steps, long holds, sudden reversals, contacts
    that teleport and more. The map goes to NAME/report/stability_in_time.csv and .png beside the
    artifact.
    """
    from palpate.offline.studies.stability_in_time import stability_in_time

    _show(stability_in_time(artifact, cases, seed, many), as_json)


@study.command()
@artifact_argument
@click.option("--at", "position", type=VECTOR, metavar="X Y Z", help="mm  [default: the middle]")
@json_option
def relaxation(artifact: Path, position: tuple[float, float, float] | None, as_json: bool) -> None:
    """Press the visco-elastic tissue of the artifact F, hold, release, wait.

    Force and depth over time, of the full and the reduced model, go to NAME/report/relaxation.csv
    and .png beside the artifact.
    """
    import numpy as np

    from palpate.offline.studies.relaxation import relaxation

    at = None if position is None else np.array(position)
    _show(relaxation(artifact, at), as_json)


@study.command()
@artifact_argument
@click.option(
    "--many",
    type=click.IntRange(min=50),
    default=100_000,
    show_default=True,
    help="Steps of the longest case.",
)
@json_option
def steps(artifact: Path, many: int, as_json: bool) -> None:
    """Stress the visco-elastic artifact F with time steps, under its rigid tip.

    Very small and large steps, long holds, sudden reversals and more, against the full model, go to
    NAME/report/steps.csv and .png beside the artifact.
    """
    from palpate.offline.studies.steps import steps

    _show(steps(artifact, many - many % 50), as_json)


def _show(report: Mapping[str, object], as_json: bool) -> None:
    """Print a report as JSON, or as one ``name value`` line per leaf."""
    if as_json:
        click.echo(json.dumps(report))
        return
    leaves = list(_leaves(report))
    width = max(len(name) for name, _ in leaves)
    for name, value in leaves:
        text = f"{value:.4g}" if isinstance(value, float) else str(value)
        click.echo(f"{name:<{width}}  {text}")


def _leaves(report: Mapping[str, object], prefix: str = "") -> list[tuple[str, object]]:
    leaves: list[tuple[str, object]] = []
    for name, value in report.items():
        leaves += (
            _leaves(value, f"{prefix}{name}.")
            if isinstance(value, Mapping)
            else [(prefix + name, value)]
        )
    return leaves
