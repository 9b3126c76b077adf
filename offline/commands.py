"""The offline commands of ``palpate``.

Each imports what it runs when it runs, so that ``--help`` is instant.
"""

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any

import click
import orjson

from palpate.shared.cli import Finite

PATIENCE = 8.0
"""Seconds after which people are told why there is no answer yet."""


class _Artifact(click.Path):
    """The file of an artifact, or the name of a scene whose artifact lies where training put it."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        named = Path("artifacts", f"{value}.h5")
        if Path(value).suffix == ".toml":
            self.fail(f"{value!r} is a scene; palpate train {value} makes its artifact")
        if Path(value).exists() or Path(value).suffix:
            return super().convert(value, param, ctx)
        if not named.exists():
            self.fail(f"there is neither a file {value!r} nor {named}, which palpate train writes")
        return super().convert(named, param, ctx)


class _Output(click.Path):
    """A file to write, whose name ends as its kind does."""

    def __init__(self, suffix: str) -> None:
        super().__init__(dir_okay=False, writable=True, path_type=Path)
        self._suffix = suffix

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        if Path(value).suffix != self._suffix:
            self.fail(f"{value!r} must end in {self._suffix}", param, ctx)
        return super().convert(value, param, ctx)


ARTIFACT = _Artifact(exists=True, dir_okay=False, path_type=Path)
OUTPUT = click.Path(dir_okay=False, writable=True, path_type=Path)
TABLE = click.Path(exists=True, dir_okay=False, path_type=Path)
NUMBER = Finite()
VECTOR = (NUMBER, NUMBER, NUMBER)

Report = Mapping[str, object]
Option = Callable[[Callable[..., Any]], Callable[..., Any]]

artifact_argument = click.argument("artifact", type=ARTIFACT)
artifact_option = click.option(
    "--artifact", type=ARTIFACT, help="Of the scene.  [default: artifacts/NAME.h5]"
)


UNITS = {
    "force": "mN",
    "tangent": "mN/mm",
    "contact_displacement": "mm",
    "contact.position": "mm",
    "contact.distance": "mm",
    "contact.centre": "mm",
    "contact.radius": "mm",
    "contact.depth": "mm",
    "contact.depth_limit": "mm",
    "contact.pressure": "kPa",
    "contact.pressure_limit": "kPa",
    "peak.displacement": "mm",
    "peak.von_mises": "kPa",
    "peak.von_mises_p99": "kPa",
    "timing.solve_us": "µs",
    "timing.recover_us": "µs",
    "error.displacement": "relative",
    "error.von_mises": "relative",
    "error_estimate.displacement": "relative",
    "error_estimate.von_mises": "relative",
    "error_estimate.force": "relative",
}
"""Of what `palpate solve` reports, by its name and that of its table."""


def reporting(command: Callable[..., Report]) -> Callable[..., None]:
    """Command that prints what it returns: a ``name value`` line for each number, or JSON."""

    @click.option("--json", "as_json", is_flag=True, help="Print JSON.")
    @wraps(command)
    def show(as_json: bool, **parameters: Any) -> None:
        report = command(**parameters)
        if as_json:
            click.echo(_json(report))
            return
        leaves = list(_leaves(report, ""))
        width = max(len(name) for name, _ in leaves)
        for name, value in leaves:
            unit = UNITS.get(".".join(name.split(".")[-2:]), "")
            click.echo(
                f"{name:<{width}}  {_text(value)} {unit if value is not None else ''}".rstrip()
            )

    return show


def _text(value: object) -> str:
    """A value in four digits, those of a list one after the other."""
    if isinstance(value, list | tuple):
        return ", ".join(f"({_text(v)})" if isinstance(v, list) else _text(v) for v in value) or "-"
    if value is None:
        return "-"
    return f"{value:z.4g}" if isinstance(value, float) else str(value)


def _json(report: Report) -> str:
    """JSON with null for numbers that are not finite."""
    return orjson.dumps(report, option=orjson.OPT_SERIALIZE_NUMPY).decode()


def _leaves(report: Report, prefix: str) -> Iterator[tuple[str, object]]:
    for name, value in report.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def count_option(name: str, default: int | None, help: str, least: int = 1) -> Option:
    """Option of a whole number."""
    kind = click.IntRange(min=least)
    return click.option(name, type=kind, default=default, show_default=True, help=help)


seed_option = count_option("--seed", 0, "Number that the random loads follow from.", least=0)


young_option = click.option(
    "--young", type=NUMBER, help="Young's modulus of the tissue, kPa.  [default: the scene's]"
)


def vector_option(*names: str, help: str, required: bool = False) -> Option:
    """Option of a point or a direction."""
    return click.option(*names, type=VECTOR, required=required, metavar="X Y Z", help=help)


def load_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Options of a command that presses the tissue once."""
    at = "Where to press, mm; moved to the nearest point that can be touched."
    pressure = "Pressure at the centre of the footprint, kPa."
    direction = "Direction of the load, of any length.  [default: the inward normal]"
    command = vector_option("--direction", help=direction)(command)
    command = click.option("--pressure", type=NUMBER, help=pressure)(command)
    return vector_option("--at", "--position", "position", help=at)(command)


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
@click.option("--out", type=_Output(".png"), metavar="PNG", help="Where to draw.")
def look(scene: str, out: Path | None) -> None:
    """Draw a scene before anything is trained, and say what its body is.

    The body and its mesh, what is held and what can be touched, and the endoscope to scale. SCENE
    is the name of one that comes along or a TOML file. A body from a file is meshed once, and its
    mesh stored beside the file. Draws artifacts/NAME/report/look.png if not told where.

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
    click.echo(_json(report) if as_json else "\n".join(told))


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
@click.option("--vtu", type=_Output(".vtu"), metavar="OUT.vtu", help="Write mesh and fields.")
@click.option("--csv", "table", type=TABLE, metavar="IN.csv", help="Answer every row instead.")
@click.option("--out", type=_Output(".csv"), metavar="OUT.csv", help="Where to write the rows.")
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
@click.option("--out", type=_Output(".png"), required=True, metavar="PNG", help="Where to draw.")
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


@click.group()
def study() -> None:
    """Compare methods and redo the measurements behind the choices."""


@study.command()
@click.option("--measure", metavar="PATTERN", help="Run those that match, such as 'bench *'.")
def figures(measure: str | None) -> None:
    """Write artifacts/FIGURES.md and README's figures.

    They come from the last reports of the commands that artifacts/figures.toml lists; --measure
    runs those that match PATTERN first and keeps their reports in artifacts/figures.json.
    """
    from palpate.offline.studies.figures import figures

    figures(Path("artifacts"), measure)


report_option = click.option(
    "--report", type=click.Path(file_okay=False, path_type=Path),
    help="Folder for tables and pictures.  [default: artifacts/SCENE/report]",
)  # fmt: skip


@study.command("mesh-error")
@report_option
@reporting
def mesh_error(report: Path | None) -> Report:
    """Compare elements of about 6048 DOFs with a fine mesh of the turbinate.

    Errors are fractions of its displacement; takes a few minutes.
    """
    from palpate.offline.studies.mesh_error import mesh_error

    return mesh_error(report or Path("artifacts/turbinate/report"))


@study.command()
@click.argument("scene")
@count_option("--places", 4, "Number of places.")
@report_option
@reporting
def convergence(scene: str, places: int, report: Path | None) -> Report:
    """Show how references converge: graded meshes of edges twice, once and half as long.

    At PLACES places, with 2 x 2 x 2 and with 3 x 3 x 3 points per element. The finest meshes of the
    turbinate take some minutes and 4 GB of memory.
    """
    from palpate.offline.scenes import opened_scene
    from palpate.offline.studies.convergence import convergence

    with opened_scene(scene) as found:
        return convergence(found, places, report or Path("artifacts") / found.name / "report")


@study.command()
@click.argument("scene")
@artifact_option
@count_option("--snapshots", 200, "Full solutions to learn from.", least=20)
@count_option("--queries", 100, "Number of random loads.")
@seed_option
@reporting
def chart(scene: str, artifact: Path | None, **settings: Any) -> Report:
    """Set speed and accuracy of many methods side by side.

    Some learn from full solutions of SNAPSHOTS random loads; all answer the QUERIES that palpate
    validate asks with this seed, on one core. Table and picture go to NAME/report/chart.csv and
    .png beside the artifact. Takes half an hour; a stopped run continues where it was.
    """
    from palpate.offline.scenes import default_artifact, opened_scene
    from palpate.offline.studies.chart import chart

    with opened_scene(scene) as found:
        return chart(artifact or default_artifact(found), found, **settings)


@study.command()
@click.argument("scene")
@artifact_option
@count_option("--places", 12, "Number of places.")
@seed_option
@reporting
def truth(scene: str, artifact: Path | None, places: int, seed: int) -> Report:
    """Compare answers with finite elements that no mesh is felt in.

    At PLACES places, one in four on the rim, loads and the rigid tip are solved on meshes graded
    towards each place. Errors are told apart by what makes them, mesh or reduction. The table goes
    to NAME/report/truth.csv beside the artifact. Takes 20 minutes; a stopped run continues where it
    was.
    """
    from palpate.offline.scenes import default_artifact, opened_scene
    from palpate.offline.studies.truth import truth

    with opened_scene(scene) as found:
        return truth(artifact or default_artifact(found), found, places, seed)


@study.command()
@click.argument("artifact", type=ARTIFACT, default="layer")
@reporting
def layer(artifact: Path) -> Report:
    """Compare the rigid tip on a layer with the theory of a ball.

    It presses the middle of the top of the artifact's block. The table goes to
    NAME/report/layer.csv beside the artifact.
    """
    from palpate.offline.studies.layer import layer

    return layer(artifact)


@study.command("chart-in-time")
@artifact_argument
@count_option("--histories", 20, "Histories that all methods answer.")
@count_option("--snapshots", 20, "Histories that POD learns from.")
@seed_option
@reporting
def chart_in_time(artifact: Path, histories: int, snapshots: int, seed: int) -> Report:
    """Set speed and accuracy of methods over histories side by side.

    The visco-elastic artifact, its twin without memory, the full model and Galerkin models in
    modal, Ritz and POD bases answer the HISTORIES that palpate validate asks with this seed. Table
    and picture go to NAME/report/chart_in_time.csv and .png beside the artifact.
    """
    from palpate.offline.studies.chart import chart

    return chart(artifact, None, snapshots, histories, seed)


@study.command()
@click.argument("scene")
@artifact_option
@count_option("--cases", 20, "Number of cases of each kind.")
@seed_option
@reporting
def stability(scene: str, artifact: Path | None, **settings: Any) -> Report:
    """Map which methods fail under what, and whether they say so.

    The artifact of SCENE and other methods answer CASES loads of every kind, in range and far
    beyond it, for which the full model's answer is known. The map goes to NAME/report/stability.csv
    and .png beside the artifact. A killed run goes on where it stopped.
    """
    from palpate.offline.scenes import default_artifact, opened_scene
    from palpate.offline.studies.stability import stability

    with opened_scene(scene) as found:
        return stability(artifact or default_artifact(found), found, **settings)


@study.command("stability-in-time")
@artifact_argument
@count_option("--cases", 4, "Number of cases of each kind.")
@seed_option
@count_option("--many", 100_000, "Steps of the longest history.", least=100)
@reporting
def stability_in_time(artifact: Path, **settings: Any) -> Report:
    """Map which methods fail under which histories, and whether they say so.

    The visco-elastic artifact, under footprints and its rigid tip, and other methods answer
    histories in CASES places: tiny and huge steps, long holds, sudden reversals and more. The map
    goes to NAME/report/stability_in_time.csv and .png beside the artifact. A killed run goes on
    where it stopped.
    """
    from palpate.offline.studies.stability import stability

    return stability(artifact, None, **settings)


@study.command()
@artifact_argument
@count_option("--paths", 10, "Number of paths.")
@count_option("--steps", 60, "Steps of each path.")
@seed_option
@click.option("--tip", is_flag=True, help="Glide with the rigid tip: jumps of the force on it.")
@reporting
def continuity(**settings: Any) -> Report:
    """Measure jumps in the answers of an artifact as the contact glides.

    The change over steps of 0.05 mm that the full model does not show: of displacement, largest of
    all nodes, in mm; of the force on the tip, over its largest on the path.
    """
    from palpate.offline.studies.continuity import continuity

    return continuity(**settings)


@study.command()
@click.argument("scene", type=click.Choice(["cube", "cube-visco"]), default="cube")
@report_option
@reporting
def cube(scene: str, report: Path | None) -> Report:
    """Redraw figure 1 of Radermacher & Reese.

    A cube under compression in modal, Ritz and POD bases: error at a point and ratio of CPU times
    against the number of bases, and which of the paper's claims hold. SCENE cube-visco is of
    visco-elastic tissue: pressed, held and let go.
    """
    from palpate.offline.studies.paper import figures

    return figures(scene, report or Path("artifacts", scene, "report"))


@study.command()
@click.argument(
    "scene", type=click.Choice(["turbinate-paper", "turbinate-visco"]), default="turbinate-paper"
)
@report_option
@reporting
def turbinate(scene: str, report: Path | None) -> Report:
    """Redraw figures 1, 2c and 2d of Radermacher & Reese.

    The turbinate under one footprint in modal, Ritz and POD bases, and contours of the relative
    errors in five POD bases, for which PyVista is needed: pip install 'palpate[pictures]'. SCENE
    turbinate-paper is of the size of the paper's mesh; turbinate-visco is of visco-elastic tissue,
    pressed, held and let go, without contours.
    """
    from palpate.offline.studies.paper import figures

    return figures(scene, report or Path("artifacts", scene, "report"))


@study.command()
@artifact_argument
@vector_option("--at", "position", help="Where to press, mm.  [default: the middle]")
@reporting
def relaxation(artifact: Path, position: tuple[float, float, float] | None) -> Report:
    """Press the visco-elastic tissue of an artifact, hold, release and wait.

    Force and depth over time, of the full and the reduced model, go to NAME/report/relaxation.csv
    and .png beside the artifact.
    """
    from palpate.offline.studies.relaxation import relaxation

    return relaxation(artifact, position)
