"""The offline commands of ``palpate`` but those of ``palpate study``.

Each imports what it runs when it runs, so that ``--help`` is instant.
"""

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from palpate.offline.options import (
    NUMBER,
    OUTPUT,
    TABLE,
    Output,
    Report,
    artifact_argument,
    count_option,
    json_text,
    load_options,
    reporting,
    seed_option,
    young_option,
)

PATIENCE = 8.0
"""Seconds after which people are told why there is no answer yet."""


@click.command()
@click.argument("name", metavar="SCENE", required=False)
@click.option("--keys", is_flag=True, help="Print a table of all keys that a scene file can have.")
def scene(name: str | None, keys: bool) -> None:
    """Print a scene with every default filled in.

    SCENE is the name of one that comes along, such as pad or turbinate, or a TOML file. What is
    printed, with unit and meaning of each key, is a scene file itself: write your own from it, or
    start from an empty file, for which this command says what is missing.
    """
    from palpate.offline.scenes import filled, find_scene, reference, shipped_scenes

    if keys:
        click.echo(reference(), nl=False)
    elif name is None:
        known = ", ".join(shipped_scenes())
        raise click.UsageError(f"Name a scene: a .toml file or one of {known}")
    else:
        click.echo(filled(find_scene(name)), nl=False)


@click.command()
@click.argument("path", metavar="NAME.toml", type=click.Path(dir_okay=False, path_type=Path))
@click.option(
    "--shape",
    type=click.Choice(["block", "section"]),
    default="block",
    show_default=True,
    help="A box, or a cross-section along y, whose outline NAME.csv is written as well.",
)
def new(path: Path, shape: str) -> None:
    """Write a first scene of your own.

    It holds the keys that a scene must have, each with its unit and meaning: change them to what
    you press. A rigid spherical tip may press it, for sessions.
    """
    from palpate.offline.scenes.new import new_scene

    if path.suffix != ".toml":
        raise click.UsageError(f"{path}: the name of a scene file ends in .toml")
    written = " and ".join(map(str, new_scene(path, shape)))
    click.echo(f"{written} written\nnext: palpate train {path} --check")


@click.command()
@click.argument("scene")
@click.option("--out", type=OUTPUT, help="The artifact to write.  [default: artifacts/NAME.h5]")
@count_option("--workers", None, "Worker processes.  [default: one for each core]")
@click.option(
    "--scheduler",
    metavar="ADDRESS|FILE",
    help="Of dask.distributed: its workers train, instead of processes of this machine.",
)
@click.option("--force", is_flag=True, help="Train even if the artifact is up to date.")
@click.option("--check", "only_check", is_flag=True, help="Only say what is wrong with SCENE.")
def train(
    scene: str,
    out: Path | None,
    workers: int | None,
    scheduler: str | None,
    force: bool,
    only_check: bool,
) -> None:
    """Train the artifact of a scene.

    SCENE is the name of one that comes along, such as pad or turbinate, or a TOML file, which
    palpate new writes. A run that was stopped continues where it was.

    With --scheduler, tcp://HOST:PORT or the file that dask scheduler --scheduler-file wrote, it is
    trained on a cluster, whose workers have the same installation and one thread each.
    """
    from palpate.offline.info import closing
    from palpate.offline.train import check, train

    if scheduler is not None:
        _need({}, {"workers": workers, "check": only_check}, "beside --scheduler")
    if only_check:
        click.echo(f"{check(scene, workers)}\nnothing is wrong; next: palpate train {scene}")
        return
    try:
        artifact = train(scene, out, workers, force, scheduler)
    except KeyboardInterrupt:
        raise click.ClickException("stopped; the same command continues from here") from None
    click.echo("\n".join(closing(artifact)))


@click.command()
@click.argument("scene")
@click.option("--out", type=Output(".png"), metavar="PNG", help="Where to draw.")
def look(scene: str, out: Path | None) -> None:
    """Draw a scene before anything is trained, and say what its body is.

    The body and its mesh, its regions, what is held and what can be touched, and the endoscope to
    scale. SCENE is the name of one that comes along or a TOML file. A body from a file is meshed
    once, and its mesh stored beside the file. Draws artifacts/NAME/report/look.png if not told
    where.

    Needs PyVista: pip install 'palpate[pictures]'.
    """
    from palpate.offline.look import look

    picture, lines = look(scene, out)
    click.echo("\n".join([*lines, f"{picture} drawn"]))


@click.command()
@artifact_argument
@click.option("--errors", is_flag=True, help="Show where errors come from instead.")
@click.option("--json", "as_json", is_flag=True, help="Print all that is known as JSON.")
def info(artifact: Path, errors: bool, as_json: bool) -> None:
    """Show what an artifact holds.

    Its body and tissue, the loads that it is made for, how accurate it is and how it was made. The
    JSON holds the text of the scene as well.
    """
    from palpate.offline.info import budget, info, lines
    from palpate.shared.artifact import ArtifactError

    report = info(artifact)
    try:
        told = budget(report) if errors else lines(report)
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise ArtifactError(f"{artifact}: incomplete or inconsistent: {error!r}") from error
    click.echo(json_text(report) if as_json else "\n".join(told))


@click.command()
@artifact_argument
@load_options
@click.option("--radius", type=NUMBER, help="Of the footprint, mm.  [default: the scene's]")
@young_option
@click.option(
    "--tip",
    is_flag=True,
    help="Press with the rigid tip instead, its centre --at a place; its depth sets the force.",
)
@click.option("--full-model", is_flag=True, help="Solve the full model as well and compare.")
@click.option("--vtu", type=Output(".vtu"), metavar="OUT.vtu", help="Write mesh and fields.")
@click.option("--csv", "table", type=TABLE, metavar="IN.csv", help="Answer every row instead.")
@click.option("--out", type=Output(".csv"), metavar="OUT.csv", help="Where to write the rows.")
@reporting
def solve(table: Path | None, out: Path | None, tip: bool, **request: Any) -> Report:
    """Press the tissue of an artifact once, or with each row of a table.

    The file OUT.vtu holds the mesh at rest with the point data displacement_mm, von_mises_kPa,
    load_mN and clamped (0 or 1); with --full-model also full_displacement_mm, full_von_mises_kPa
    and the deviations of the reduced model from them, displacement_error_mm and
    von_mises_error_kPa.

    The first line of IN.csv is x,y,z,pressure (mm, kPa), or x,y,z,pressure,dx,dy,dz with a
    direction, or with --tip x,y,z. All cores answer, and each row as if it were alone.

    Warnings tell of loads outside the trained range, of estimated errors beyond the tolerance of
    the scene and of a tip that touches nothing.
    """
    if table is not None:
        from palpate.offline.table import solve_table

        artifact, young = request.pop("artifact"), request.pop("young")
        _need({"--out": out}, request, "beside --csv")
        with _patience():
            return solve_table(artifact, table, out or table, tip, young)
    _need({"--at": request["position"]}, {"out": out}, "without --csv")
    if tip:
        loads = {key: request[key] for key in ("pressure", "direction", "radius")}
        _need({}, loads, "beside --tip")
    else:
        _need({"--pressure": request["pressure"]}, {})
    from palpate.offline.solve import solve

    with _patience():
        return solve(**request)


@click.command()
@artifact_argument
@click.argument("recording", type=click.Path(dir_okay=False, path_type=Path))
@reporting
def identify(artifact: Path, recording: Path) -> Report:
    """Find Young's modulus of tissue from forces measured on a tip that touched it.

    The first line of RECORDING, a CSV file, names its columns: x,y,z (centre of the tip, mm) and
    force_x,force_y,force_z (mN, on the tool), of tissue that remembers also time (s); others do not
    matter. The modulus is exact for the tissue law and Poisson's ratio of the ARTIFACT; its
    interval holds noise of the forces, not errors of the model, of which error_force is the median.
    """
    from palpate.offline.identify import identify

    with _patience():
        return identify(artifact, recording)


@contextmanager
def _patience() -> Iterator[None]:
    """Say what takes so long, if it does."""
    words = "Compiling code, which is kept: the first answer of a release takes a minute or two …"
    timer = threading.Timer(PATIENCE, click.echo, [words], {"err": True})
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _need(needed: Mapping[str, object], without: Mapping[str, object], why: str = "") -> None:
    """Refuse options that are missing, and those that make no sense, and say beside what."""
    for option, value in needed.items():
        if value is None:
            raise click.UsageError(f"Missing option '{option}'.")
    for name, value in without.items():
        if value is not None and value is not False:
            option = "at" if name == "position" else name.replace("_", "-")
            raise click.UsageError(f"'--{option}' makes no sense {why}.")


@click.command()
@artifact_argument
@load_options
@click.option("--out", type=Output(".png"), required=True, metavar="PNG", help="Where to draw.")
def picture(**request: Any) -> None:
    """Draw the pressed tissue of an artifact, coloured by von Mises stress.

    Needs PyVista: pip install 'palpate[pictures]'.
    """
    from palpate.offline.pictures import picture

    _need({"--at": request["position"], "--pressure": request["pressure"]}, {})
    picture(**request)


@click.command()
@artifact_argument
@count_option("--queries", 300, "Number of random loads.")
@seed_option
@click.option("--tip", is_flag=True, help="Press with the rigid tip instead of pressures.")
@count_option("--histories", None, "Follow so many histories of visco-elastic tissue instead.")
@click.option("--csv", type=OUTPUT, metavar="OUT", help="Write one row for each load.")
@young_option
@reporting
def validate(tip: bool, queries: int, histories: int | None, **settings: Any) -> Report:
    """Compare an artifact with the full model.

    Both solve new random loads, positions of the tip, or histories of either, over the whole range
    of the artifact. Errors are relative L2 norms as fractions; of histories over all moments.
    """
    from palpate.offline.validate.compare import against_full
    from palpate.offline.validate.queries import KINDS

    (kind,) = (kind for kind in KINDS if (kind.tip, kind.in_time) == (tip, histories is not None))
    return against_full(kind=kind, count=histories or queries, **settings)


@click.command()
@artifact_argument
@reporting
def bench(artifact: Path) -> Report:
    """Time queries on an artifact.

    Medians in µs: a cold query, one on a path of small steps, one of the rigid tip on that path,
    one with the fields on the surface, one with all fields, and a solution of the full model.
    """
    from palpate.offline.bench import bench

    return bench(artifact)
