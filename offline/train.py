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
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
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
from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.fem.refine import MOST_DOFS, mesh_error_document
from palpate.offline.reduce.footprint_models import compile_query, train_patch
from palpate.offline.reduce.layout import Layout
from palpate.offline.reduce.limit_points import lowered_depths, lowered_limits
from palpate.offline.reduce.load_range import load_range
from palpate.offline.reduce.patches import PatchResult, PatchTask, RegionResult, local_models
from palpate.offline.reduce.regions import region
from palpate.offline.reduce.ritz import Footprint
from palpate.offline.reduce.sampling import area, fewer, spacing_count, spread_points
from palpate.offline.reduce.size import Trial, choose, ladder
from palpate.offline.reduce.tip_models import local_tips
from palpate.offline.reduce.viscous import with_time
from palpate.offline.run import tasks as training
from palpate.offline.run.checkpoint import Checkpoint, content_key
from palpate.offline.run.forecast import forecast
from palpate.offline.run.streams import Stage, stream
from palpate.offline.run.workers import Tasks, open_scene, resume, run, worker_pool
from palpate.offline.run.writing import write_model
from palpate.offline.scenes import default_artifact, find_scene
from palpate.offline.validate.against_full import reference_task, write_rows
from palpate.offline.validate.calibrate import calibrate, calibrate_by_halves
from palpate.offline.validate.compare import Row, compare, summarise
from palpate.offline.validate.kinds import KINDS, LOADS, Kind
from palpate.shared.artifact import ArtifactError, read_artifact
from palpate.shared.local_models import Estimator, LocalModels
from palpate.shared.mechanics.footprint import TIP_DEPTH
from palpate.shared.model import ReducedModel
from palpate.shared.scene import Scene, SceneError, Size

Array = NDArray[np.float64]


BATCH, LEAST = 60, 300
"""Full solutions between two looks at whether they suffice, and the least that calibrate at the
usual tolerance."""

TRIAL_PATCHES = 8

PLACES = 64
"""Where the reduced model is asked in one task."""

TIP_SAMPLES = 300
"""Full solutions under the tip that validate and calibrate."""

MOST_HISTORIES = 48
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
    pool = worker_pool(open_scene, trained.text, str(trained.folder), count=workers)
    checkpoint = Checkpoint(path.parent / f".{path.stem}.training", key)
    with pool:
        pipeline = Pipeline(trained, pool, checkpoint, started)
        count = workers or os.cpu_count() or 1
        tqdm.write(forecast(pipeline.problem, count), file=sys.stderr)
        pipeline.run(path, mesh_choice)
    checkpoint.remove()
    return path


def is_of(path: Path, key: str) -> bool:
    """Whether an artifact is of the scene and code that ``content_key`` stands for."""
    try:
        return bool(read_artifact(path, ()).documents["provenance"]["content_key"] == key)
    except ArtifactError:
        return False


class Pipeline:
    """One training run.

    Parameters
    ----------
    scene : Scene
    executor : Executor
        Of workers initialized by ``open_scene``.
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
        self.problem = FullProblem(scene)
        self.surface = self.problem.surface
        self.seconds: dict[str, float] = {}
        self.provenance = self._provenance()  # now: sources may change while it runs

    def run(self, path: Path, mesh_choice: dict[str, Any] | None = None) -> None:
        """Train and write the artifact; it keeps how its mesh was chosen."""
        # beside the first stage, so that no worker waits for another's compiler
        compiled = self.executor.submit(run, compile_query)
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
        layout = Layout.of(self.scene, self.surface, size)
        models = self.local_models(layout, limits)
        limits = self._lowered(models, limits)
        model = training.untested(self.problem, models, limits)
        tables: dict[Kind, list[Row]] = {}
        estimators: dict[str, Estimator] = {}
        documents: dict[str, Any] = {"provenance": self.provenance}
        for kind in KINDS:
            if kind.lacks(models):
                continue
            estimators[kind.name], tables[kind] = self._validate(kind, model)
            documents[kind.document] = summarise(kind, tables[kind])
        if 3 * len(self.problem.mesh.nodes) <= MOST_DOFS:
            documents["mesh_error"] = self._mesh_error(limits)
        documents["training"] = {
            "seconds": self.seconds,
            "mesh": mesh_quality(self.problem.mesh),
            "layout": self._describe(layout, models),
        }
        if choice is not None:
            documents["training"]["choice"] = choice.document
        if mesh_choice is not None:
            documents["training"]["mesh_choice"] = mesh_choice
        self.provenance["wall_seconds"] = round(time.perf_counter() - self.started, 1)
        write_model(path, self.problem, models, limits, estimators, documents)
        report = path.parent / path.stem / "report"
        report.mkdir(parents=True, exist_ok=True)
        for kind, rows in tables.items():
            write_rows(report / f"{kind.document}.csv", kind, rows)

    # --- stages --------------------------------------------------------------------------------

    def _load_range(self) -> Array:
        """Load range (v, LIMIT_FIELDS) at the vertices of the surface."""
        rng = stream(self.scene.seed, Stage.LOAD_RANGE)
        count = spacing_count(self.surface, self.scene.training.limit_spacing)
        points = spread_points(self.surface, max(count, 16), rng)
        tasks = {f"range-{i}": (load_range, x) for i, x in enumerate(points)}
        fields = np.array(self._stage("load range", tasks))
        fields[:, [0, TIP_DEPTH]] = np.log(fields[:, [0, TIP_DEPTH]])
        smooth = RBFInterpolator(points, fields, neighbors=16, kernel="linear")
        at_vertices = smooth(self.surface.vertices)
        at_vertices[:, [0, TIP_DEPTH]] = np.exp(at_vertices[:, [0, TIP_DEPTH]])
        return at_vertices

    def _trial(self, size: Size, limits: Array) -> Trial:
        """Try a size on patches spread over the surface."""
        layout = Layout.of(self.scene, self.surface, size)
        rng = stream(self.scene.seed, Stage.TRIAL_PATCHES)
        places = spread_points(self.surface, min(TRIAL_PATCHES, len(layout.centres)), rng)
        chosen = np.unique(cKDTree(layout.centres).query(places)[1])
        footprints = self._footprints(layout, limits)
        tasks = {
            f"trial-{size.modes}-{k}": (
                training.trial, self._patch_task(layout, footprints, limits, int(k)),
            )
            for k in chosen
        }  # fmt: skip
        title = f"trying {size.modes} modes"
        return Trial.of(size, self._stage(title, tasks))

    def _regions(
        self, layout: Layout, footprints: Sequence[Footprint]
    ) -> list[tuple[RegionResult, dict[int, int]]]:
        """Basis and Ritz vectors of each region, with the place of each footprint among them."""
        tasks, members = {}, []
        for r in range(int(layout.region.max()) + 1):
            patches = np.flatnonzero(layout.region == r)
            used = np.unique(np.concatenate([layout.ritz_of_patch[k] for k in patches]))
            tasks[f"region-{r}"] = (
                region,
                [footprints[i] for i in used],
                layout.size.region_modes,
            )
            members.append({int(i): place for place, i in enumerate(used)})
        results: list[RegionResult] = self._stage("Ritz vectors", tasks)
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
                train_patch,
                replace(result, ritz=result.ritz[chosen]),
                self._patch_task(layout, footprints, limits, k),
            )
        results: list[PatchResult] = self._stage("local models", tasks)
        bases, model = [basis for basis, _ in regions], self.problem.model
        own = layout.region, layout.centres, self._range_at(layout.centres, limits)[:, 0]
        models = local_models(bases, *own, results, layout.extent, self.scene.training.blend)
        trained = [result.tip for result in results if result.tip is not None]
        if trained:
            models = replace(models, tips=local_tips(model, models, trained))
        return with_time(model, models)

    def _lowered(self, models: LocalModels, limits: Array) -> Array:
        """Load range that ends before the tissue gives way, or slips off the tip."""
        ask = partial(self._ask, self.checkpoint.store("models", (models, limits)))
        patches = len(models.centres)
        rng = stream(self.scene.seed, Stage.GIVING_WAY)
        lowered = lowered_limits(self.surface, limits, self.scene, patches, ask, rng)
        _tell("giving way", lowered[:, 0] / limits[:, 0])
        if models.tips is not None:
            rng = stream(self.scene.seed, Stage.SLIPPING_OFF)
            lowered = lowered_depths(self.surface, lowered, patches, ask, rng)
            _tell("slipping off", lowered[:, TIP_DEPTH] / limits[:, TIP_DEPTH])
        return lowered

    def _validate(self, kind: Kind, model: ReducedModel) -> tuple[Estimator, list[Row]]:
        """Validate on random queries of a kind, and calibrate its error estimate with them.

        What validation says of the estimate is of one calibrated on the other half of the queries.
        """
        rng = stream(self.scene.seed, kind.stage)
        queries = kind.random(model, self._queries(kind), rng)
        rows: list[Row] = []
        size = BATCH if kind is LOADS else len(queries)
        for start in range(0, len(queries), size):
            batch = queries[start:][:size]
            tasks = {
                f"{kind.name}-{start + i}": reference_task(model, query)
                for i, query in enumerate(batch)
            }
            rows += [
                compare(kind, self.problem, model, query, found)
                for query, found in zip(batch, self._stage(kind.title, tasks), strict=True)
                if found is not None
            ]
            if kind is LOADS and self._suffice(rows):
                break
        fit = partial(calibrate, share=kind.coverage, damping=kind.damping)
        return calibrate_by_halves([row.known for row in rows], fit), rows

    def _queries(self, kind: Kind) -> int:
        """How many full solutions, or histories of them, validate and calibrate at most."""
        if kind.in_time:
            return min(MOST_HISTORIES, self.scene.training.samples // 4)
        return TIP_SAMPLES if kind.tip else self.scene.training.samples

    def _suffice(self, rows: Sequence[Row]) -> bool:
        """Whether 95 % of all loads are within tolerance, with as much confidence.

        The bound on the share of others is that of Clopper and Pearson.
        """
        tolerance = self.scene.tolerance
        missed = sum(
            not row.table["converged"]
            or row.table["displacement"] > tolerance.displacement
            or row.table["von_mises"] > tolerance.von_mises
            for row in rows
        )
        enough = len(rows) >= fewer(LEAST, tolerance)
        return bool(enough and betaincinv(missed + 1, len(rows) - missed, 0.95) <= 0.05)

    def _mesh_error(self, limits: Array) -> dict[str, Any]:
        """Press at half the range on finer and other meshes."""
        rng = stream(self.scene.seed, Stage.MESH_ERROR)
        tasks = {}
        count = fewer(REFINED_LOADS, self.scene.tolerance)
        for i, point in enumerate(spread_points(self.surface, count, rng)):
            x, normal, _, fields = self.surface.locate(point, limits)
            tasks[f"mesh-{i}"] = training.mesh_error, Load(x, -normal, float(fields[0]) / 2)
        dofs, moved = zip(*self._stage("mesh error", tasks), strict=True)
        return mesh_error_document(self.scene, dofs[0], np.array(moved))

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
        """Values (k,) of a function of the reduced model; see ``run.tasks.ask``."""
        tasks = {
            f"{title}-{i}": (training.ask, path, function, rows[i : i + PLACES])
            for i in range(0, len(rows), PLACES)
        }
        return np.concatenate(self._stage(title, tasks))

    def _stage(self, title: str, tasks: Tasks) -> list[Any]:
        """Run the tasks that are not in the checkpoint yet; return all results in their order."""
        started = time.perf_counter()
        results = resume(title, self.executor, self.checkpoint, tasks)
        seconds = self.seconds.get(title, 0.0) + time.perf_counter() - started
        self.seconds[title] = round(seconds, 2)
        return list(results.values())

    def _describe(self, layout: Layout, models: LocalModels) -> dict[str, Any]:
        points = np.diff(models.point_from)
        return {
            "area_mm2": round(area(self.surface), 1),
            "dofs": 3 * len(self.problem.mesh.nodes),
            "patches": len(layout.centres),
            "regions": int(layout.region.max()) + 1,
            "ritz_footprints": len(layout.ritz),
            "modes": models.modes.shape[2],
            "cubature_points_median": float(np.median(points)),
            "cubature_points_max": int(points.max()),
            "quadrature_points": self.problem.model.weights.size,
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


def _tell(title: str, share: Array) -> None:
    """Say where a search has lowered limits, and to which share of what they were."""
    tqdm.write(
        f"{title}: load range lowered on {np.mean(share < 1):.1%} of the surface, "
        f"to {share.min():.0%} of what it was",
        file=sys.stderr,
    )
