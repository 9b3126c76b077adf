"""The training pipeline: from a scene to its artifact.

1. The largest pressure at points all over the accessible surface.
2. Regions: windows, nonlinear Ritz vectors of many footprints and a common basis for them.
3. Patches: modes, cubature and first guess of every local model.
4. The reduced model, pressed everywhere, lowers the range where the tissue gives way.
5. Full solutions on finer meshes, for the mesh's part of the error estimate.
6. Full solutions of random queries, each half of which validates the rest of it for the other.

Every finished task is on disk before it counts; see ``run.workers``.
"""

import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree
from tqdm import tqdm

from palpate.offline.bodies.report import report
from palpate.offline.choose.mesh import as_fine, candidates, with_mesh
from palpate.offline.choose.size import Trial, choose, first_place, ladder, try_patch
from palpate.offline.doubts import doubts
from palpate.offline.fem.mesh import mesh_quality
from palpate.offline.fem.norms import statistics
from palpate.offline.fem.problem import FullProblem
from palpate.offline.info import duration
from palpate.offline.reduce.footprint_models import train_patch
from palpate.offline.reduce.join import bases_of, join
from palpate.offline.reduce.kernels import KERNELS
from palpate.offline.reduce.layout import PATCHES, RITZ_SPACING, Layout
from palpate.offline.reduce.load_range import (
    SEARCHES,
    SHALLOWEST,
    ask,
    bearable_shares,
    load_range,
    out_of_reach,
    untested,
)
from palpate.offline.reduce.ritz import region
from palpate.offline.reduce.sampling import fewer, spacing_count, spread_points, triangle_areas
from palpate.offline.reduce.window import (
    SPACING,
    BodyModes,
    body_modes,
    in_window,
    stored_modes,
    window_elements,
)
from palpate.offline.run.progress import Teller
from palpate.offline.run.streams import Stage, stream
from palpate.offline.run.workers import (
    Checkpoint,
    OnScene,
    Tasks,
    content_key,
    open_scene,
    run,
    worker_pool,
)
from palpate.offline.scenes import default_artifact, opened_scene
from palpate.offline.validate import mesh_part
from palpate.offline.validate.compare import (
    Row,
    calibrate_by_halves,
    compare,
    reference_task,
    summarise,
    write_rows,
)
from palpate.offline.validate.queries import KINDS, Kind
from palpate.shared import artifact
from palpate.shared.anatomy import FileBody
from palpate.shared.arrays import Array, Numbers
from palpate.shared.local_models import Estimators, LoadRange, LocalModels
from palpate.shared.mechanics.footprint import TIP_DEPTH
from palpate.shared.model import ReducedModel
from palpate.shared.progress import training_folder
from palpate.shared.scene import Scene, Size

MODEL, MODEL_AND_DOF, PLACE = 0.35, 1.75e-4, 4.0
"""Core seconds that training takes for a local model, and more for each degree of freedom; for a
place where errors of the mesh are looked at.  All other stages are shared out.  Measured on elastic
scenes of 1000 to 22 000 degrees of freedom, warm cache."""

TIP, TIME = 1.2, 2.0
"""How many times as long it takes for the rigid tip as well, and for visco-elastic tissue."""

TRIALS = 2
"""Sizes that are tried where a scene has none; a patch's trial takes as long as five models."""

TRIAL_PATCHES = 8

PLACES = 64
"""Where the reduced model is asked in one task."""

TIP_SAMPLES = 136
"""Full solutions under the tip that validate and calibrate: so many that of a narrow surface, half
of which is near its rim, 60 are there, as the confidence of 95 % asks for."""

MOST_HISTORIES = 48
"""Full histories of each kind that validate and calibrate, a quarter of ``samples`` at most."""

Who = Callable[[Scene, str], tuple[Executor, int]]
"""Gives those who train a scene, by it and its key, and how many processes they are."""


def train(
    scene: str | Path,
    out: Path | None = None,
    workers: int | None = None,
    force: bool = False,
    scheduler: str | None = None,
    executor: Executor | None = None,
) -> Path:
    """Train a scene and write its artifact, unless it is there already; return where.

    Parameters
    ----------
    scene : str or Path
        Shipped name or TOML file.
    out : Path, optional
        ``artifacts/NAME.h5`` if absent.
    workers : int, optional
        Processes; one per core if absent.
    force : bool
        Train although the artifact is of this very scene and of this code.
    scheduler : str, optional
        Address of a scheduler of dask.distributed, or its file: its workers train.
    executor : Executor, optional
        Of ``concurrent.futures`` or like it, which trains; its workers must be processes of one
        thread each that read files where this one does.  It is not shut down.
    """
    with opened_scene(scene) as untrained:
        return _train(untrained, out, force, partial(_workers, workers, scheduler, executor))


def _train(untrained: Scene, out: Path | None, force: bool, who: Who) -> Path:
    """Train a scene that is read; see ``train``."""
    started = time.perf_counter()
    path, key = out or default_artifact(untrained), content_key(untrained)
    if not force and is_of(path, key):
        tqdm.write(f"{path}: up to date; --force trains it again", file=sys.stderr)
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    folder = training_folder(path)
    teller = Teller(untrained.name, folder)
    with Checkpoint(folder, key, teller) as checkpoint:
        try:
            trained, mesh_choice = with_mesh(untrained)
            pool, workers = who(trained, key)
            with pool:
                pipeline = Pipeline(trained, pool, checkpoint, started)
                tqdm.write(outlook(pipeline.problem, workers), file=sys.stderr)
                pipeline.run(path, mesh_choice)
        finally:
            teller.end()
    return path


def _workers(
    count: int | None, scheduler: str | None, executor: Executor | None, scene: Scene, key: str
) -> tuple[Executor, int]:
    """Who trains a scene, and how many processes that are, as far as is known."""
    count = count or os.cpu_count() or 1
    if scheduler is not None:
        from palpate.offline.run.cluster import Cluster  # which not every installation can do

        cluster = Cluster(scheduler, scene, key)
        return cluster, cluster.workers
    if executor is not None:
        return OnScene(executor, scene, key), count
    return worker_pool(open_scene, scene.text, str(scene.folder), count=count), count


def check(scene: str | Path, workers: int | None = None) -> str:
    """Say what training a scene would make, once all that can be wrong with it is looked at.

    Raises
    ------
    SceneError
        With every field that is wrong; or else what is wrong with its files, or its mesh.
    """
    with opened_scene(scene) as found:
        content_key(found)
        coarsest = found.fineness_of_mesh is None
        meshed = as_fine(found, candidates(found)[0]) if coarsest else found
        return outlook(FullProblem(meshed), workers, coarsest)


def outlook(problem: FullProblem, workers: int | None, coarsest: bool = False) -> str:
    """What people look at before a training: its ``forecast``, and what is likely a slip."""
    slips = (f"is this meant? {doubt}" for doubt in doubts(problem.scene, problem.mesh.nodes))
    return "\n".join([forecast(problem, workers or os.cpu_count() or 1, coarsest), *slips])


def is_of(path: Path, key: str) -> bool:
    """Whether an artifact is of the scene and code that ``content_key`` stands for."""
    try:
        return bool(artifact.read_artifact(path).documents["provenance"]["content_key"] == key)
    except (artifact.ArtifactError, LookupError, TypeError):  # it is damaged, or no artifact
        return False


def forecast(problem: FullProblem, workers: int, coarsest: bool = False) -> str:
    """Mesh, number of local models and time of a training, in one line for people.

    ``coarsest`` says that the mesh is the coarsest of those that training chooses from.  Raises
    ``SceneError`` with the key of a spacing that would make too many points.
    """
    scene, tip = problem.scene, problem.scene.endoscope.tip
    dofs, size, more, tried = problem.mesh.nodes.size, scene.training.size, "", 0
    if size is None:  # the size that training tries first
        size, more = ladder(scene)[max(first_place(scene.tolerance), 0)], " or more"
        tried = 5 * TRIALS * TRIAL_PATCHES
    for key, spacing in {
        "training.limit_spacing": scene.training.limit_spacing,
        "training.region_spacing": scene.training.region_spacing,
        PATCHES: RITZ_SPACING * size.patch_spacing,
    }.items():
        spacing_count(problem.surface, spacing, key)
    models = spacing_count(problem.surface, size.patch_spacing, PATCHES)
    seconds = (models + tried) * (MODEL + MODEL_AND_DOF * dofs)
    seconds += PLACE * (mesh_part.places_of(scene, problem.surface) + tip * mesh_part.MOST)
    seconds *= (TIP if tip else 1.0) * (TIME if scene.tissue.prony else 1.0) / workers
    cores = "1 free core" if workers == 1 else f"{workers} free cores"
    about = "at least" if coarsest or more else "about"
    return (
        f"{scene.name}: {len(problem.mesh.elements)} elements {scene.geometry.element}"
        f"{' or more' if coarsest else ''}, {dofs} DOFs; about "
        f"{models}{more} local models; {about} {duration(seconds)} on {cores}, and a minute or two "
        "more the first time, while code is compiled"
    )


class Pipeline:
    """One training run, since ``started`` (s), by workers initialized with ``open_scene``."""

    def __init__(
        self, scene: Scene, executor: Executor, checkpoint: Checkpoint, started: float
    ) -> None:
        self.started = started
        self.scene = scene
        self.executor = executor
        self.checkpoint = checkpoint
        self.problem = FullProblem(scene)
        self.surface = self.problem.surface
        self.seconds: dict[str, float] = {}
        self.asked = 0
        self.provenance = _provenance(scene, checkpoint.key)  # now: sources may change meanwhile

    def run(self, path: Path, mesh_choice: dict[str, Any] | None = None) -> None:
        """Train and write the artifact; it keeps how its mesh was chosen."""
        # beside the first stage, so that no worker waits for another's compiler
        compiled = [self.executor.submit(run, kernels) for kernels in KERNELS]
        limits = self._load_range()
        for kernels in compiled:
            kernels.result()
        size = self.scene.training.size
        training: dict[str, Any] = {"mesh": mesh_quality(self.problem.mesh)}
        if isinstance(self.scene.geometry, FileBody):
            training["file"] = report(self.scene)
        if size is None:
            scene, attempt = self.scene, partial(self._trial, limits)
            sizes = ladder(scene)
            size, training["choice"] = choose(sizes, scene.tolerance, scene.budget, attempt)
            tqdm.write(f"size: {size}\n{training['choice']['why']}", file=sys.stderr)
        if mesh_choice is not None:
            training["mesh_choice"] = mesh_choice
        layout = Layout(self.scene, self.surface, limits, size)
        models = self._local_models(layout)
        limits = self._lowered(models, limits)
        model = untested(self.problem, models, limits)
        tables: dict[Kind, list[Row]] = {}
        documents: dict[str, Any] = {"provenance": self.provenance, "training": training}
        estimators, limits = self._mesh_part(model, training)
        model = untested(self.problem, models, limits, Estimators(**estimators))
        for kind in KINDS:
            if not kind.lacks(self.scene):
                fitted, tables[kind] = self._validate(kind, model)
                estimators[kind.name], confidence = fitted
                documents[kind.document] = summarise(kind, tables[kind], self.scene.tolerance)
                documents[kind.document]["confidence"] = confidence
        known = models.cubature_errors[np.isfinite(models.cubature_errors)]
        training["cubature_errors"] = {"displacement": statistics(known)}
        training |= {"seconds": self.seconds, "layout": self._describe(layout, models)}
        self.provenance["wall_seconds"] = round(time.perf_counter() - self.started, 1)
        datasets: dict[str, artifact.Dataset] = {}
        kept = model.body, model.models, model.surface, LoadRange(model.limits)
        for part in (*kept, Estimators(**estimators)):
            datasets |= artifact.datasets_of(part)
        artifact.write_artifact(path, self.scene.text, documents, datasets)
        for kind, rows in tables.items():
            write_rows(path.parent / path.stem / "report" / f"{kind.document}.csv", kind, rows)

    # --- stages --------------------------------------------------------------------------------

    def _load_range(self) -> Array:
        """Load range (v, LIMIT_FIELDS) at the vertices of the surface."""
        rng = stream(self.scene.seed, Stage.LOAD_RANGE)
        spacing = self.scene.training.limit_spacing
        count = spacing_count(self.surface, spacing, "training.limit_spacing")
        points = spread_points(self.surface, max(count, 16), rng)
        tasks = {f"range-{i}": (load_range, x) for i, x in enumerate(points)}
        fields = np.array(self._stage("load range", tasks))
        fields[:, [0, TIP_DEPTH]] = np.log(fields[:, [0, TIP_DEPTH]])
        smooth = RBFInterpolator(points, fields, neighbors=16, kernel="linear")
        at_vertices = smooth(self.surface.vertices)
        at_vertices[:, [0, TIP_DEPTH]] = np.exp(at_vertices[:, [0, TIP_DEPTH]])
        at_vertices[out_of_reach(self.problem), TIP_DEPTH] = SHALLOWEST
        return at_vertices

    def _trial(self, limits: Array, size: Size) -> Trial:
        """Try a size on patches spread over the surface."""
        layout = Layout(self.scene, self.surface, limits, size)
        rng = stream(self.scene.seed, Stage.TRIAL_PATCHES)
        places = spread_points(self.surface, min(TRIAL_PATCHES, len(layout.centres)), rng)
        chosen = np.unique(cKDTree(layout.centres).query(places)[1])
        tasks = {f"trial-{size.modes}-{k}": (try_patch, layout.patch(k), limits) for k in chosen}
        return Trial.of(size, self._stage(f"trying {size.modes} modes", tasks))

    def _local_models(self, layout: Layout) -> LocalModels:
        """Bases of the regions and local models."""
        used = [layout.footprints_of(r) for r in range(layout.region.max() + 1)]
        footprints = [[layout.footprints[i] for i in own] for own in used]
        tasks: Tasks = {f"window-{r}": (window_elements, own) for r, own in enumerate(footprints)}
        elements = self._stage("windows", tasks)
        body = self._body_modes(elements)
        windows = self.checkpoint.store("windows", (body, elements))
        tasks = {
            f"region-{r}": (in_window, windows, r, region, own, layout.size.region_modes)
            for r, own in enumerate(footprints)
        }
        regions = self._stage("Ritz vectors", tasks)
        # a small region may have fewer vectors to give than asked for
        regions = [own.truncate(min(len(other.steps) for other in regions)) for own in regions]
        tasks = {}
        for k, r in enumerate(layout.region):
            learnt = np.searchsorted(used[r], layout.learns_from[k])
            own = replace(regions[r], ritz=regions[r].ritz[learnt])
            tasks[f"patch-{k}"] = in_window, windows, int(r), train_patch, own, layout.patch(k)
        parts = self._stage("local models", tasks)
        bases = bases_of(regions, body.values, body.steps)
        return join(self.problem.model, bases, layout.region, parts)

    def _body_modes(self, windows: list[Numbers]) -> BodyModes:
        """Modes of the body outside windows of some elements; none if that is nowhere."""
        if min(map(len, windows)) == len(self.problem.mesh.elements):
            return stored_modes(self.problem, np.zeros((len(self.problem.model.free), 0)))
        spacing = SPACING * self.scene.endoscope.radius
        rng = stream(self.scene.seed, Stage.BODY_MODES)
        places = spread_points(self.surface, spacing_count(self.surface, spacing), rng)
        (found,) = self._stage("modes of the body", {"body": (body_modes, places)})
        return BodyModes(*found)

    def _lowered(self, models: LocalModels, limits: Array) -> Array:
        """Load range that ends before the tissue gives way, or slips off the tip."""
        asking = partial(self._ask, self.checkpoint.store("models", (models, limits)))
        lowered = limits.copy()
        for i, search in enumerate(SEARCHES):
            model = untested(self.problem, models, lowered)  # places are drawn in what is left
            if search.field == TIP_DEPTH and not model.has_tip:
                continue
            shares = bearable_shares(
                search, model, asking, stream(self.scene.seed, search.stage, i)
            )
            _lower(lowered, search.field, shares, search.title)
        return lowered

    def _ask(self, path: Path, title: str, function: Callable[..., float], at: list[Any]) -> Array:
        """Values (k,) of a function of the reduced model; see ``load_range.ask``."""
        tasks = {
            f"ask-{self.asked + i}": (ask, path, function, at[i : i + PLACES])
            for i in range(0, len(at), PLACES)
        }
        self.asked += len(at)
        return np.concatenate(self._stage(title, tasks))

    def _validate(self, kind: Kind, model: ReducedModel) -> tuple[tuple[Array, float], list[Row]]:
        """Calibrate the error estimate of a kind on random queries, each half for the other."""
        samples = self.scene.training.samples
        count = TIP_SAMPLES if kind.tip else fewer(samples, self.scene.tolerance)
        if kind.in_time:
            count = min(MOST_HISTORIES, samples // 4)
        queries = kind.random(model, count, stream(self.scene.seed, kind.stage))
        tasks = {
            f"{kind.name}-{i}": reference_task(model, query) for i, query in enumerate(queries)
        }
        rows = [
            compare(kind, self.problem, model, query, found)
            for query, found in zip(queries, self._stage(kind.title, tasks), strict=True)
            if found is not None
        ]
        return calibrate_by_halves([row.known for row in rows], kind.damping), rows

    def _mesh_part(
        self, model: ReducedModel, training: dict[str, Any]
    ) -> tuple[dict[str, Array], Array]:
        """Fit the mesh's part of the error estimates of loads and of the tip; tell of it.

        Also the load range, lowered where a finer mesh gives way under footprints.
        """
        rng = partial(stream, self.scene.seed, Stage.MESH_PART)
        # those under the tip first: where tissue gives way sideways one takes minutes
        touched = mesh_part.places(model, rng(), tip=True) if model.has_tip else []
        places = [*touched, *mesh_part.places(model, rng())]
        tasks = {f"mesh-{i}": (mesh_part.mesh_errors, own) for i, own in enumerate(places)}
        found, fitted = self._stage("errors of the mesh", tasks), dict[str, Array]()
        under_tip, pressed = found[: len(touched)], found[len(touched) :]
        if touched:
            fitted["mesh_tip"], training["mesh_errors_tip"] = mesh_part.fit(under_tip, tip=True)
        shares = mesh_part.borne(places[len(touched) :], pressed, self.surface)
        fitted["mesh"], training["mesh_errors"] = mesh_part.fit(pressed)
        limits = model.limits.copy()
        _lower(limits, 0, shares, "giving way on finer meshes")
        return fitted, limits

    # --- pieces --------------------------------------------------------------------------------

    def _stage(self, title: str, tasks: Tasks) -> list[Any]:
        """Run the tasks that are not in the checkpoint yet; return all results in their order."""
        started = time.perf_counter()
        results = self.checkpoint.resume(title, self.executor, tasks)
        seconds = self.seconds.get(title, 0.0) + time.perf_counter() - started
        self.seconds[title] = round(seconds, 2)
        return list(results.values())

    def _describe(self, layout: Layout, models: LocalModels) -> dict[str, Any]:
        points = np.diff(models.point_from)
        return {
            "area_mm2": round(float(triangle_areas(self.surface).sum()), 1),
            "dofs": self.problem.mesh.nodes.size,
            "patches": len(layout.centres),
            "regions": len(models.steps),
            "body_modes": len(models.body),
            "ritz_footprints": len(layout.footprints),
            "modes": models.modes.shape[2],
            "cubature_points_median": float(np.median(points)),
            "cubature_points_max": int(points.max()),
            "quadrature_points": self.problem.model.weights.size,
        }


def _lower(limits: Array, field: int, shares: Array, why: str) -> None:
    """Lower one field of the load range (v, LIMIT_FIELDS), in place, to shares of it; say so."""
    limits[:, field] *= shares
    if np.any(shares < 1):
        tqdm.write(
            f"{why}: load range lowered on {np.mean(shares < 1):.1%} of the surface, to "
            f"{shares.min():.0%} of what it was",
            file=sys.stderr,
        )


# --- the artifact ------------------------------------------------------------------------------


def _provenance(scene: Scene, key: str) -> dict[str, Any]:
    """When, with what and by which code, of content ``key``, a scene is trained."""
    try:
        commit = subprocess.run(
            ["git", "rev-parse", "HEAD"],
            cwd=Path(__file__).parent, capture_output=True, text=True, check=True,
        ).stdout.strip()  # fmt: skip
    except (OSError, subprocess.CalledProcessError):
        commit = "unknown"
    packages = "numpy", "scipy", "numba", "h5py", "palpate"
    return {
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "packages": {name: metadata.version(name) for name in packages},
        "python": platform.python_version(),
        "git_commit": commit,
        "seed": scene.seed,
        "content_key": key,
    }
