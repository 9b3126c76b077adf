"""The training pipeline: from a scene to its artifact.

1. The largest pressure at points all over the accessible surface (full model).
2. Regions: nonlinear Ritz vectors of many footprints and a common basis for them.
3. Patches: modes, cubature and first guess of every local model.
4. The reduced model, pressed everywhere, lowers the range where the tissue gives way.
5. Full solutions of random loads, which calibrate the error estimate, and others, which validate.

Every finished task is on disk before it counts; see ``run.checkpoint``.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree
from scipy.special import betaincinv
from tqdm import tqdm

from palpate.offline.fem.choose_mesh import with_mesh
from palpate.offline.fem.mesh import mesh_quality
from palpate.offline.fem.model import POINTWISE
from palpate.offline.fem.refine import MOST_DOFS, mesh_error_document
from palpate.offline.reduce.footprint_models import PatchResult, PatchTask, RegionResult
from palpate.offline.reduce.limit_points import lowered_depths, lowered_limits
from palpate.offline.reduce.ritz import Footprint
from palpate.offline.reduce.sampling import (
    area,
    centred_points,
    fewer,
    neighbours,
    random_points,
    spacing_count,
    spread_points,
)
from palpate.offline.reduce.size import Trial, TrialResult, choose, ladder
from palpate.offline.reduce.tip_models import local_tips
from palpate.offline.reduce.transfer import FOLLOWED, overlaps
from palpate.offline.reduce.transfer import neighbours as neighbouring
from palpate.offline.reduce.viscous import deviatoric_of_all
from palpate.offline.run.checkpoint import Checkpoint, content_key
from palpate.offline.run.forecast import forecast
from palpate.offline.run.streams import Stage, stream
from palpate.offline.run.workers import Tasks, resume, worker_pool
from palpate.offline.run.workshop import Load, TouchSample, Workshop, open_workshop, run
from palpate.offline.scenes import default_artifact, find_scene
from palpate.offline.validate.histories import (
    HistoryComparison,
    compare_history,
    loads_of,
    random_histories,
    summarise_histories,
)
from palpate.offline.validate.loads import (
    ESTIMATED,
    Comparison,
    calibrate,
    calibrate_by_halves,
    compare,
    random_loads,
    summarise,
    write_rows,
)
from palpate.offline.validate.moments import calibrate_moments
from palpate.offline.validate.tip import (
    QUANTITIES,
    TouchComparison,
    calibrate_touches,
    compare_touch,
    random_positions,
    summarise_touches,
)
from palpate.offline.validate.tip_histories import (
    CourseComparison,
    compare_course,
    random_courses,
    summarise_courses,
)
from palpate.shared.artifact import (
    ArtifactError,
    Dataset,
    datasets_of,
    read_artifact,
    write_artifact,
)
from palpate.shared.local_models import ESTIMATORS, Estimator, LocalModels, ViscousModels
from palpate.shared.mechanics.footprint import TIP_DEPTH
from palpate.shared.model import ReducedModel
from palpate.shared.scene import Scene, SceneError, Size, Tolerance

Array = NDArray[np.float64]


RITZ_SPACING = 0.455
"""Of the footprints whose Ritz vectors are taken, in units of the patch spacing."""

RITZ_REACH = 0.8
"""How far from its centre a local model learns from footprints, in units of the patch spacing."""

BATCH, LEAST = 60, 300
"""Full solutions between two looks at whether they suffice, and the least that calibrate at the
usual tolerance."""

CONTACTS_PER_PATCH = 400

TRIAL_PATCHES = 8

PLACES = 64
"""Where the reduced model is asked in one task."""

TIP_SAMPLES = 300
"""Full solutions under the tip that validate and calibrate."""

MOST_COURSES = 48
"""Full histories of each kind that validate and calibrate, a quarter of ``samples`` at most."""

REFINED_LOADS = 4


def train(
    scene: str | Path, out: Path | None = None, workers: int | None = None, force: bool = False
) -> Path:
    """Train a scene and write its artifact, unless it is there already.

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

    Returns
    -------
    path : Path

    Raises
    ------
    SceneError
        If the scene's element cannot be reduced.
    """
    started, untrained = time.perf_counter(), find_scene(scene)
    if untrained.geometry.element not in POINTWISE:
        raise SceneError(
            f"geometry.element: points of {untrained.geometry.element} share a dilatation, which "
            f"no cubature samples; train with {' or '.join(POINTWISE)} (hex20 does not lock)"
        )
    path, key = out or default_artifact(untrained), content_key(untrained)
    if not force and is_of(path, key):
        tqdm.write(f"{path}: up to date; --force trains it again", file=sys.stderr)
        return path
    trained, mesh_choice = with_mesh(untrained)
    path.parent.mkdir(parents=True, exist_ok=True)
    pool = worker_pool(open_workshop, trained.text, str(trained.folder), count=workers)
    checkpoint = Checkpoint(path.parent / f".{path.stem}.training", key)
    with pool:
        pipeline = Pipeline(trained, pool, checkpoint, started)
        count = workers or os.cpu_count() or 1
        tqdm.write(forecast(pipeline.workshop, count), file=sys.stderr)
        pipeline.run(path, mesh_choice)
    checkpoint.remove()
    return path


def is_of(path: Path, key: str) -> bool:
    """Whether an artifact is of the scene and code that ``content_key`` stands for."""
    try:
        return bool(read_artifact(path, ()).documents["provenance"]["content_key"] == key)
    except ArtifactError:
        return False


@dataclass(frozen=True)
class Layout:
    """Where patches, regions and Ritz vectors lie.

    Attributes
    ----------
    centres, normals : ndarray, shape (p, 3)
    region : ndarray, shape (p,), int
    ritz : ndarray, shape (r, 3), mm
    ritz_of_patch : list of ndarray
        Indices of the footprints a patch learns from.
    contacts : ndarray, shape (c, 3), mm
    contacts_of_patch : list of ndarray
    extent : float, mm
    size : Size
    """

    centres: Array
    normals: Array
    region: NDArray[np.int32]
    ritz: Array
    ritz_of_patch: list[NDArray[np.int64]]
    contacts: Array
    contacts_of_patch: list[NDArray[np.int64]]
    extent: float
    size: Size


class Pipeline:
    """One training run.

    Parameters
    ----------
    scene : Scene
    executor : Executor
        Of workers initialized by ``open_workshop``.
    checkpoint : Checkpoint
    started : float, optional
        When the clock began to run, s; now if absent.
    """

    def __init__(
        self,
        scene: Scene,
        executor: Executor,
        checkpoint: Checkpoint,
        started: float | None = None,
    ) -> None:
        self.started = time.perf_counter() if started is None else started
        self.scene = scene
        self.executor = executor
        self.checkpoint = checkpoint
        self.workshop = Workshop(scene)
        self.surface = self.workshop.surface
        self.seconds: dict[str, float] = {}
        self.provenance = self._provenance()  # now: sources may change while it runs

    def run(self, path: Path, mesh_choice: dict[str, Any] | None = None) -> None:
        """Train and write the artifact; it keeps how its mesh was chosen."""
        # beside the first stage, so that no worker waits for another's compiler
        compiled = self.executor.submit(run, Workshop.compile_query)
        limits = self._load_range()
        compiled.result()
        choice = None
        size = self.scene.training.size
        if size is None:
            scene = self.scene
            sizes = ladder(scene.tissue)
            choice = choose(
                sizes, scene.tolerance, scene.budget, lambda size: self._trial(size, limits)
            )
            size = choice.size
            tqdm.write(f"size: {size}\n{choice.why}", file=sys.stderr)
        layout = self.layout(size)
        models = self.local_models(layout, limits)
        limits = self._lowered(models, limits)
        atlas = self.workshop.untested(models, limits)
        estimators = {}
        estimators["loads"], documents, rows = self._validate(atlas)
        tip_rows: list[TouchComparison] = []
        if models.tips is not None:
            estimators["touches"], tip_rows = self._validate_tip(atlas)
            documents["validation_tip"] = summarise_touches(tip_rows)
        if 3 * len(self.workshop.mesh.nodes) <= MOST_DOFS:
            documents["mesh_error"] = self._mesh_error(limits)
        documents["training"] |= {"layout": self._describe(layout, models)}
        if choice is not None:
            documents["training"]["choice"] = choice.document
        if mesh_choice is not None:
            documents["training"]["mesh_choice"] = mesh_choice
        if models.viscous is not None:
            estimators["histories"], histories = self._validate_histories(atlas)
            documents["validation_histories"] = summarise_histories(histories)
        if models.viscous_tips is not None:
            estimators["courses"], courses = self._validate_courses(atlas)
            documents["validation_tip_histories"] = summarise_courses(courses)
        self._write(path, models, limits, estimators, documents)
        report = path.parent / path.stem / "report"
        report.mkdir(parents=True, exist_ok=True)
        write_rows(report / "validation.csv", rows)
        if tip_rows:
            write_rows(report / "validation_tip.csv", tip_rows)

    def untested_atlas(self, limits: Array, layout: Layout) -> ReducedModel:
        """An atlas without error estimate: stages 2 and 3 only."""
        return self.workshop.untested(self.local_models(layout, limits), limits)

    # --- stages --------------------------------------------------------------------------------

    def _load_range(self) -> Array:
        """Load range (v, LIMIT_FIELDS) at the vertices of the surface."""
        rng = stream(self.scene.seed, Stage.LOAD_RANGE)
        count = spacing_count(self.surface, self.scene.training.limit_spacing)
        points = spread_points(self.surface, max(count, 16), rng)
        tasks = {f"range-{i}": (Workshop.load_range, x) for i, x in enumerate(points)}
        found = self._stage("load range", tasks, lambda fields: {"fields": fields})
        fields = np.array([found[name]["fields"] for name in tasks])
        fields[:, [0, TIP_DEPTH]] = np.log(fields[:, [0, TIP_DEPTH]])
        smooth = RBFInterpolator(points, fields, neighbors=16, kernel="linear")
        at_vertices = smooth(self.surface.vertices)
        at_vertices[:, [0, TIP_DEPTH]] = np.exp(at_vertices[:, [0, TIP_DEPTH]])
        return at_vertices

    def _trial(self, size: Size, limits: Array) -> Trial:
        """Try a size on patches spread over the surface."""
        layout = self.layout(size)
        rng = stream(self.scene.seed, Stage.TRIAL_PATCHES)
        places = spread_points(self.surface, min(TRIAL_PATCHES, len(layout.centres)), rng)
        chosen = np.unique(cKDTree(layout.centres).query(places)[1])
        footprints = self._footprints(layout, limits)
        tasks = {
            f"trial-{size.modes}-{k}": (
                Workshop.trial, self._patch_task(layout, footprints, limits, int(k)),
            )
            for k in chosen
        }  # fmt: skip
        title = f"trying {size.modes} modes"
        found = self._stage(title, tasks, asdict)
        return Trial.of(size, [TrialResult(**found[name]) for name in tasks])

    def layout(self, size: Size) -> Layout:
        """Place patches, regions and Ritz vectors."""
        settings, surface = self.scene.training, self.surface
        rng = stream(self.scene.seed, Stage.LAYOUT)
        centres = centred_points(surface, spacing_count(surface, size.patch_spacing), rng)
        normals = np.array([surface.project(x)[1] for x in centres])
        seeds = centred_points(surface, spacing_count(surface, settings.region_spacing), rng)
        region = cKDTree(seeds).query(centres)[1].astype(np.int32)
        region = np.unique(region, return_inverse=True)[1].astype(np.int32)
        ritz = spread_points(
            surface, spacing_count(surface, RITZ_SPACING * size.patch_spacing), rng
        )
        contacts = np.vstack(
            [surface.vertices, random_points(surface, CONTACTS_PER_PATCH * len(centres), rng)]
        )
        near, _ = cKDTree(centres).query(contacts)
        contacts_of_patch = [
            hits[np.linalg.norm(contacts[hits] - centres[k], axis=1) < near[hits] + settings.blend]
            for k, hits in enumerate(neighbours(contacts, centres, near.max() + settings.blend))
        ]
        return Layout(
            centres=centres,
            normals=normals,
            region=region,
            ritz=ritz,
            ritz_of_patch=neighbours(ritz, centres, RITZ_REACH * size.patch_spacing),
            contacts=contacts,
            contacts_of_patch=contacts_of_patch,
            extent=1.02 * near.max() + settings.blend,
            size=size,
        )

    def _regions(
        self, layout: Layout, footprints: Sequence[Footprint]
    ) -> list[tuple[RegionResult, dict[int, int]]]:
        """Basis and Ritz vectors of each region, with the place of each footprint among them."""
        tasks, members = {}, []
        for r in range(int(layout.region.max()) + 1):
            patches = np.flatnonzero(layout.region == r)
            used = np.unique(np.concatenate([layout.ritz_of_patch[k] for k in patches]))
            tasks[f"region-{r}"] = (
                Workshop.region,
                [footprints[i] for i in used],
                layout.size.region_modes,
            )
            members.append({int(i): place for place, i in enumerate(used)})
        found = self._stage("Ritz vectors", tasks, asdict)
        results = [RegionResult(**found[name]) for name in tasks]
        # a small region may have fewer vectors to give than asked for
        modes = min(len(result.steps) for result in results)
        return list(zip([result.truncate(modes) for result in results], members, strict=True))

    def _footprints(self, layout: Layout, limits: Array) -> list[Footprint]:
        """Where Ritz vectors are taken, with the loads expected there."""
        found = []
        for point in layout.ritz:
            x, normal, _, fields = self.surface.locate(point, limits)
            found.append(Footprint(x, normal, float(fields[0])))
        return found

    def _patch_task(
        self, layout: Layout, footprints: Sequence[Footprint], limits: Array, k: int
    ) -> PatchTask:
        """Where patch k is, and the loads it answers."""
        contacts = layout.contacts[layout.contacts_of_patch[k]]
        located = [self.surface.locate(x, limits) for x in contacts]
        return PatchTask(
            centre=layout.centres[k],
            normal=layout.normals[k],
            pressure=float(self._range_at(layout.centres[[k]], limits)[0, 0]),
            footprints=[footprints[i] for i in layout.ritz_of_patch[k]],
            contacts=contacts,
            normals=np.array([normal for _, normal, _, _ in located]),
            ranges=np.array([fields for _, _, _, fields in located]),
            extent=layout.extent,
            blend=self.scene.training.blend,
            size=layout.size,
            seed=self.scene.seed + k,
        )

    def local_models(self, layout: Layout, limits: Array) -> LocalModels:
        """Stages 2 and 3."""
        footprints = self._footprints(layout, limits)
        regions = self._regions(layout, footprints)
        tasks = {}
        for k in range(len(layout.centres)):
            result, places = regions[layout.region[k]]
            chosen = [places[int(i)] for i in layout.ritz_of_patch[k]]
            tasks[f"patch-{k}"] = (
                Workshop.patch,
                replace(result, ritz=result.ritz[chosen]),
                self._patch_task(layout, footprints, limits, k),
            )
        found = self._stage("local models", tasks, PatchResult.arrays)
        results = [PatchResult.of(found[name]) for name in tasks]
        models = LocalModels(
            basis=np.stack([result.basis for result, _ in regions]),
            steps=np.stack([result.steps for result, _ in regions]),
            region=layout.region,
            centres=layout.centres,
            frames=np.stack([r.frame for r in results]),
            pressures=self._range_at(layout.centres, limits)[:, 0],
            whole=np.stack([r.whole for r in results]),
            mix=np.stack([r.mix for r in results]),
            point_from=np.concatenate([[0], np.cumsum([len(r.points) for r in results])]),
            points=np.concatenate([r.points for r in results]),
            weights=np.concatenate([r.weights for r in results]),
            defect=np.stack([r.defect for r in results]).astype(np.float32),
            guess=np.stack([r.guess for r in results]).astype(np.float32),
            directions=np.stack([r.directions for r in results]).astype(np.float32),
            change=np.stack([r.change for r in results]).astype(np.float32),
            residuals=np.stack([r.residual for r in results]),
            extent=layout.extent,
            blend=self.scene.training.blend,
            tips=None,
        )
        if self.scene.endoscope.tip:
            trained = [result.tip for result in results if result.tip is not None]
            models = replace(models, tips=local_tips(self.workshop.model, models, trained))
        if self.scene.tissue.prony:
            model, modes = self.workshop.model, models.modes
            pairs = neighbouring(models, FOLLOWED * models.extent)
            soft = deviatoric_of_all(model, models, modes)
            viscous = ViscousModels(soft, pairs, overlaps(model, models, modes, pairs))
            models = replace(models, viscous=viscous)
            if models.tips is not None:
                tips = models.tips
                soft = deviatoric_of_all(model, models, tips.modes)
                models = replace(models, tips=replace(tips, deviatoric=soft))
        return models

    def _lowered(self, models: LocalModels, limits: Array) -> Array:
        """Load range that ends before the tissue gives way, or slips off the tip."""
        ask = partial(self._ask, self.checkpoint.share("models", (models, limits)))
        patches = len(models.centres)
        rng = stream(self.scene.seed, Stage.GIVING_WAY)
        lowered = lowered_limits(self.surface, limits, self.scene, patches, ask, rng)
        _tell("giving way", lowered[:, 0] / limits[:, 0])
        if models.tips is not None:
            rng = stream(self.scene.seed, Stage.SLIPPING_OFF)
            lowered = lowered_depths(self.surface, lowered, patches, ask, rng)
            _tell("slipping off", lowered[:, TIP_DEPTH] / limits[:, TIP_DEPTH])
        return lowered

    def _validate_tip(self, atlas: ReducedModel) -> tuple[Estimator, list[TouchComparison]]:
        """Validate under the tip, and calibrate its error estimate, as ``_validate`` does."""
        rng = stream(self.scene.seed, Stage.TIP_VALIDATION)
        positions = random_positions(self.surface, atlas.limits, self.scene, TIP_SAMPLES, rng)
        answers = [atlas.touch(x) for x in positions]
        tasks = {
            f"touch-{i}": (Workshop.touch, answer.position, atlas.displacement(answer))
            for i, answer in enumerate(answers)
        }
        found = self._stage("full solutions under the tip", tasks, vars)
        rows = [
            compare_touch(self.workshop, atlas, answer, TouchSample(**found[name]))
            for name, answer in zip(tasks, answers, strict=True)
            if found[name]["displacement"].size
        ]
        return calibrate_by_halves(rows, calibrate_touches), rows

    def _validate_histories(self, atlas: ReducedModel) -> tuple[Estimator, list[HistoryComparison]]:
        """Validate over histories of loads, and calibrate their error estimate."""
        rng = stream(self.scene.seed, Stage.HISTORY_VALIDATION)
        histories = random_histories(atlas, self._courses, rng)
        tasks = {
            f"history-{i}": (Workshop.follow, *loads_of(presses))
            for i, presses in enumerate(histories)
        }
        found = self._full_histories("full histories", tasks, "us")
        rows = [
            compare_history(self.workshop, atlas, presses, own["u"], own["s"])
            for presses, own in zip(histories, found, strict=True)
            if own["u"].size
        ]
        return calibrate_by_halves(rows, partial(calibrate_moments, quantities=ESTIMATED)), rows

    def _validate_courses(self, atlas: ReducedModel) -> tuple[Estimator, list[CourseComparison]]:
        """Validate over histories of the tip, and calibrate their error estimate."""
        rng = stream(self.scene.seed, Stage.TIP_HISTORY_VALIDATION)
        courses = random_courses(self.surface, atlas.limits, self.scene, self._courses, rng)
        tasks = {f"course-{i}": (Workshop.follow_tip, *course) for i, course in enumerate(courses)}
        found = self._full_histories("full histories under the tip", tasks, "usf")
        rows = [
            compare_course(self.workshop, atlas, course, (own["u"], own["s"], own["f"]))
            for course, own in zip(courses, found, strict=True)
            if own["u"].size
        ]
        return calibrate_by_halves(rows, partial(calibrate_moments, quantities=QUANTITIES)), rows

    @property
    def _courses(self) -> int:
        return min(MOST_COURSES, self.scene.training.samples // 4)

    def _full_histories(self, title: str, tasks: Tasks, parts: str) -> list[dict[str, Array]]:
        """What the full model makes of histories, by letter; empty where it could not follow."""
        found = self._stage(
            title,
            tasks,
            lambda f: dict(zip(parts, ([],) * len(parts) if f is None else f, strict=True)),
        )
        return [found[name] for name in tasks]

    def _validate(self, atlas: ReducedModel) -> tuple[Estimator, dict[str, Any], list[Comparison]]:
        """Validate on random loads, and calibrate the error estimate with them.

        What validation says of the estimate is of one calibrated on the other half of the loads.
        """
        rng = stream(self.scene.seed, Stage.VALIDATION)
        count, least = self.scene.training.samples, fewer(LEAST, self.scene.tolerance)
        loads = random_loads(self.surface, atlas.limits, self.scene, count, rng)
        rows: list[Comparison] = []
        for start in range(0, count, BATCH):
            batch = {f"sample-{start + i}": load for i, load in enumerate(loads[start:][:BATCH])}
            tasks = {name: (Workshop.sample, load) for name, load in batch.items()}
            found = self._stage("full solutions", tasks, lambda u: {"u": [] if u is None else u})
            rows += [
                compare(self.workshop, atlas, load, found[name]["u"])
                for name, load in batch.items()
                if found[name]["u"].size
            ]
            if len(rows) >= least and _accurate(rows, self.scene.tolerance):
                break
        estimator = calibrate_by_halves(rows, calibrate)
        documents = {
            "provenance": self.provenance,
            "training": {"seconds": self.seconds, "mesh": mesh_quality(self.workshop.mesh)},
            "validation": summarise(rows),
        }
        return estimator, documents, rows

    def _mesh_error(self, limits: Array) -> dict[str, Any]:
        """Press at half the range on finer and other meshes."""
        rng = stream(self.scene.seed, Stage.MESH_ERROR)
        tasks = {}
        count = fewer(REFINED_LOADS, self.scene.tolerance)
        for i, point in enumerate(spread_points(self.surface, count, rng)):
            x, normal, _, fields = self.surface.locate(point, limits)
            tasks[f"mesh-{i}"] = Workshop.mesh_error, Load(x, -normal, float(fields[0]) / 2)
        found = self._stage(
            "mesh error", tasks, lambda r: dict(zip(("dofs", "moved"), r, strict=True))
        )
        moved = np.array([found[name]["moved"] for name in tasks])
        return mesh_error_document(self.scene, found["mesh-0"]["dofs"], moved)

    # --- pieces --------------------------------------------------------------------------------

    def _range_at(self, points: Array, limits: Array) -> Array:
        return np.array([self.surface.locate(x, limits)[3] for x in points])

    def _ask(
        self,
        path: Path,
        title: str,
        function: Callable[..., float],
        rows: Sequence[tuple[Any, ...]],
    ) -> Array:
        """Values (k,) of a function of the reduced model; see ``Workshop.ask``."""
        tasks = {
            f"{title}-{i}": (Workshop.ask, path, function, rows[i : i + PLACES])
            for i in range(0, len(rows), PLACES)
        }
        found = self._stage(title, tasks, lambda values: {"values": values})
        return np.concatenate([found[name]["values"] for name in tasks])

    def _stage(
        self,
        title: str,
        tasks: Tasks,
        pack: Callable[[Any], Mapping[str, Any]],
    ) -> dict[str, Any]:
        """Run the tasks that are not in the checkpoint yet; return all results by name."""
        started = time.perf_counter()
        results = resume(title, self.executor, self.checkpoint, tasks, pack)
        seconds = self.seconds.get(title, 0.0) + time.perf_counter() - started
        self.seconds[title] = round(seconds, 2)
        return results

    def _describe(self, layout: Layout, models: LocalModels) -> dict[str, Any]:
        points = np.diff(models.point_from)
        return {
            "area_mm2": round(area(self.surface), 1),
            "dofs": 3 * len(self.workshop.mesh.nodes),
            "patches": len(layout.centres),
            "regions": int(layout.region.max()) + 1,
            "ritz_footprints": len(layout.ritz),
            "modes": models.modes.shape[2],
            "cubature_points_median": float(np.median(points)),
            "cubature_points_max": int(points.max()),
            "quadrature_points": self.workshop.model.weights.size,
        }

    def _provenance(self) -> dict[str, Any]:
        packages = ("numpy", "scipy", "numba", "h5py", "palpate")
        try:
            commit = subprocess.run(
                ["git", "rev-parse", "HEAD"],
                cwd=Path(__file__).parent, capture_output=True, text=True, check=True,
            ).stdout.strip()  # fmt: skip
        except (OSError, subprocess.CalledProcessError):
            commit = "unknown"
        return {
            "started": datetime.now(UTC).isoformat(timespec="seconds"),
            "packages": {name: metadata.version(name) for name in packages},
            "python": platform.python_version(),
            "git_commit": commit,
            "seed": self.scene.seed,
            "content_key": self.checkpoint.key,
        }

    def _write(
        self,
        path: Path,
        models: LocalModels,
        limits: Array,
        estimators: Mapping[str, Estimator],
        documents: dict[str, Any],
    ) -> None:
        surface = self.surface
        datasets = datasets_of(self.workshop.body) | datasets_of(models)
        datasets |= {
            "surface_vertices": Dataset(surface.vertices, "mm", "accessible surface"),
            "surface_triangles": Dataset(surface.triangles, "1", "triangles of it, outward"),
            "surface_normals": Dataset(surface.normals, "1", "outward unit normals at vertices"),
            "load_range": Dataset(
                limits,
                "kPa, mm/kPa, mm",
                "at vertices: limit along the normal, compliance, depth of the tip",
            ),
        }
        datasets |= {
            ESTIMATORS[kind]: Dataset(
                estimator.coefficients,
                "1",
                "log error = c . features; rows: displacement, von Mises, under the tip force",
            )
            for kind, estimator in estimators.items()
        }
        documents["provenance"]["wall_seconds"] = round(time.perf_counter() - self.started, 1)
        write_artifact(path, self.scene.text, documents, datasets)


def _tell(title: str, share: Array) -> None:
    """Say where a search has lowered limits, and to which share of what they were."""
    tqdm.write(
        f"{title}: load range lowered on {np.mean(share < 1):.1%} of the surface, "
        f"to {share.min():.0%} of what it was",
        file=sys.stderr,
    )


def _accurate(rows: Sequence[Comparison], tolerance: Tolerance) -> bool:
    """Whether 95 % of all loads are within tolerance, with as much confidence (Clopper-Pearson)."""
    missed = sum(
        not row.converged
        or row.displacement > tolerance.displacement
        or row.von_mises > tolerance.von_mises
        for row in rows
    )
    return bool(betaincinv(missed + 1, len(rows) - missed, 0.95) <= 0.05)
