"""The commands of ``palpate study``.

Each imports what it runs when it runs, so that ``--help`` is instant.
"""

from pathlib import Path
from typing import Any

import click

from palpate.offline.options import (
    ARTIFACT,
    Report,
    artifact_argument,
    artifact_option,
    count_option,
    reporting,
    seed_option,
    vector_option,
)


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
