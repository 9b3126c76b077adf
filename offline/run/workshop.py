"""One process's workplace: a scene's full model with its surface, and the tasks of training on it.

A task takes and returns plain arrays, so that any executor with the ``concurrent.futures``
interface can run it; ``open_workshop`` or ``open_artifact`` is the initializer of its workers.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.offline.fem.mesh import Mesh, build_mesh, local_thickness
from palpate.offline.fem.model import Equilibrium, FullModel, History, NoEquilibrium, TipContact
from palpate.offline.fem.refine import refined, twin
from palpate.offline.fem.surface import accessible_surface
from palpate.offline.reduce.footprint_models import (
    PatchResult,
    PatchTask,
    RegionResult,
    compile_query,
    local_trainer,
    random_load,
    train_patch,
)
from palpate.offline.reduce.load_path import LoadPath, pressure_that_moves
from palpate.offline.reduce.ritz import RITZ_VECTORS, Footprint, energy_pod, ritz_vectors
from palpate.offline.reduce.size import TrialResult
from palpate.offline.run.streams import Stage, stream
from palpate.offline.validate.norms import relative
from palpate.shared.artifact import Artifact, read_artifact
from palpate.shared.geometry.quadrature import stress_recovery
from palpate.shared.geometry.surface import Surface
from palpate.shared.local_models import Body, Estimators, LocalModels
from palpate.shared.mechanics.footprint import footprint
from palpate.shared.mechanics.sphere import tip_of, tip_surface
from palpate.shared.mechanics.stress import StressRecovery, nodal_von_mises, nodal_von_mises_after
from palpate.shared.model import ReducedModel
from palpate.shared.scene import Scene, parse_scene

Array = NDArray[np.float64]

POINTS_IN_BASIS = 50
"""Footprints all of whose Ritz vectors make a region's basis; of others the linear ones do."""

DENTS = 24
"""Modes of a region's basis that the tip's dents add to those of footprints."""

TRIAL_LOADS = 10

RESOLUTION = 2e-6
"""Displacement (mm) that a step of a stored mode amounts to where the mode is at work: a mode of
small amplitude is stored in coarse steps, which compress well."""


DEEPEST = 0.8
"""Largest depth of the tip, in radii: its centre must stay outside the undeformed body."""

SHALLOWEST = 0.02
"""Millimetres that the range of depths has at least."""


@dataclass(frozen=True)
class TouchSample:
    """Full solution under the tip; empty arrays where there is no equilibrium."""

    displacement: NDArray[np.float32]  # (n, 3) mm
    force: Array  # (3,) mN
    tangent: Array  # (3, 3) mN/mm
    energy: Array  # () mN mm
    penetration: Array  # () mm


@dataclass(frozen=True)
class Load:
    """A pressed footprint: contact point, unit direction and pressure (kPa)."""

    position: Array
    direction: Array
    pressure: float


class Workshop:
    """The full model of a scene and what it needs to be pressed.

    Parameters
    ----------
    scene : Scene
    mesh : Mesh, optional
        Built from the scene if absent.
    """

    def __init__(self, scene: Scene, mesh: Mesh | None = None) -> None:
        self.scene = scene
        self.mesh = build_mesh(scene) if mesh is None else mesh
        self.model = FullModel.of(scene, self.mesh)
        self.surface: Surface = accessible_surface(self.mesh)
        self._nodal = np.zeros(len(self.mesh.nodes))
        self._asked: tuple[Path, ReducedModel] | None = None

    @classmethod
    def of_artifact(cls, artifact: Artifact) -> Workshop:
        """Full model on the very mesh that an artifact was trained on."""
        return cls(
            parse_scene(artifact.scene),
            Mesh(**{part.name: artifact.arrays[part.name] for part in fields(Mesh)}),
        )

    @cached_property
    def body(self) -> Body:
        """Mesh and tissue as the reduced model sees them."""
        parts = {part.name: getattr(self.mesh, part.name) for part in fields(Mesh)}
        tip = tip_of(self.scene.endoscope.radius, self.scene.tissue.young)
        return Body(**parts, law=self.model.law, tip=tip)

    @cached_property
    def beyond_clamped_layer(self) -> NDArray[np.bool_]:
        """Nodes of no element that touches the support, (n,)."""
        layer = self.mesh.elements[self.mesh.clamped[self.mesh.elements].any(axis=1)]
        outside = np.ones(len(self.mesh.nodes), dtype=bool)
        outside[layer] = False
        return outside

    def unit_load(self, position: Array) -> tuple[Array, Array]:
        """Nodal weights (n,) mm^2 of a unit pressure at a surface point, and the normal there."""
        x, normal, _ = self.surface.project(position)
        return self.unit_load_at(x, normal), normal

    def unit_load_at(self, x: Array, normal: Array) -> Array:
        """The same at a contact point of another mesh, whose accessible surface ends elsewhere."""
        footprint(self.body.boundary, x, normal, self.scene.endoscope.radius, self._nodal)
        return self._nodal.copy()

    def load_vector(self, load: Load) -> Array:
        """Nodal forces (n, 3) mN."""
        nodal, _ = self.unit_load(load.position)
        return load.pressure * nodal[:, None] * load.direction

    def solve(self, load: Load, start: Array | None = None) -> Equilibrium:
        """Full solution; raises ``NoEquilibrium``."""
        return self.model.solve(self.load_vector(load), start)

    @cached_property
    def _recovery(self) -> StressRecovery:
        return stress_recovery(self.mesh.nodes, self.mesh.elements, self.model.law)

    def von_mises(self, displacement: Array) -> Array:
        """Nodal von Mises stress (n,) kPa."""
        out = np.zeros(len(self.mesh.nodes))
        nodal_von_mises(self._recovery, np.ascontiguousarray(displacement, dtype=float), out)
        return out

    def von_mises_after(self, history: History) -> Array:
        """Nodal von Mises stress (n,) kPa at the end of a history."""
        shares = np.array([share for share, _ in self.model.prony])
        past = np.einsum("a,aeqi->eiq", shares, history.points[:-1])
        out = np.zeros(len(self.mesh.nodes))
        nodal_von_mises_after(self._recovery, history.displacement, np.ascontiguousarray(past), out)
        return out

    def under(self, position: Array, displacement: Array) -> Array:
        """Mean displacement (3,) under a footprint, weighted with its pressure."""
        nodal, _ = self.unit_load(position)
        return np.asarray(nodal @ displacement / nodal.sum())

    def untested(self, models: LocalModels, limits: Array) -> ReducedModel:
        """Reduced model of local models and a load range, without error estimates."""
        return ReducedModel(
            self.scene.name, self.scene, {}, self.body, self.surface, limits, models, Estimators()
        )

    # --- tasks ---------------------------------------------------------------------------------

    def ask(
        self, path: Path, function: Callable[..., float], rows: Sequence[tuple[Any, ...]]
    ) -> list[float]:
        """Values of a function of a reduced model and of each row of further arguments.

        ``path`` is a pickle of the local models and their load range; the last one is kept.
        """
        if self._asked is None or self._asked[0] != path:
            self._asked = path, self.untested(*pickle.loads(path.read_bytes()))
        return [function(self._asked[1], *row) for row in rows]

    def load_range(self, position: Array) -> Array:
        """Load range at a surface point: fields (8,) of ``mechanics.footprint.pressure_limit``.

        The limit along the normal is where the tissue moves by the scene's indentation, or beyond
        which it has no equilibrium; the depth of the tip is how far the footprint has sunk then.
        """
        model = self.model.relaxed  # for as long as it takes
        nodal, normal = self.unit_load(position)
        unit = np.einsum("n,ij->nij", nodal, np.eye(3)).reshape(-1, 3)[model.free]
        linear = model.solve_linear(unit)
        C = unit.T @ linear / nodal.sum()
        thickness = local_thickness(self.mesh, position[None], normal[None])[0]
        wanted = self.scene.load.max_indentation * thickness
        pressure = wanted / np.linalg.norm((linear @ normal).reshape(-1, 3), axis=1).max()
        path = LoadPath(model, -unit @ normal)
        # no load steps in the full model: where a jump fails, the pressure between is asked for
        near = pressure_that_moves(path.solve, wanted, pressure)

        def full(pressure: float, start: Array | None) -> Array:
            force = -pressure * nodal[:, None] * normal
            return model.solve(force, start, smallest_step=1.0).displacement

        limit, _, moved = pressure_that_moves(full, wanted, *near)
        depth = 0.0 if moved is None else -float(nodal @ moved @ normal) / nodal.sum()
        depth = min(max(depth, SHALLOWEST), DEEPEST * self.scene.endoscope.radius)
        return np.array([limit, *np.diag(C), C[0, 1], C[0, 2], C[1, 2], depth])

    def region(self, footprints: list[Footprint], modes: int) -> RegionResult:
        """Basis of a region and the Ritz vectors of footprints in it."""
        model = self.model
        vectors = np.stack([self._ritz(footprint) for footprint in footprints], axis=1)
        first = np.arange(vectors.shape[2]) % RITZ_VECTORS < 3
        apart = -(-len(footprints) // POINTS_IN_BASIS)
        linear, rest = vectors[:, :, first], vectors[:, ::apart, ~first]
        wanted = [part.reshape(len(model.free), -1) for part in (linear, rest)]
        basis, _ = energy_pod(model, np.hstack(wanted), modes)
        vectors = vectors.reshape(len(model.free), -1)
        amplitude = np.sqrt(np.mean(((model.rest_stiffness @ basis).T @ vectors) ** 2, axis=1))
        if self.scene.endoscope.tip:
            dents = self._dents(np.array([footprint.point for footprint in footprints]), basis)
            # in front, where a truncation does not reach; in the finest steps
            basis = np.hstack([dents, basis])
            amplitude = np.concatenate([np.full(dents.shape[1], np.inf), amplitude])
        largest = np.abs(basis).max(axis=0)
        steps = np.clip(RESOLUTION / amplitude, largest / np.iinfo(np.int16).max, largest / 100)
        stored = np.round(basis / steps).astype(np.int16)
        # rounding costs the modes their orthonormality: give it back by a change of coordinates
        rounded = stored * steps.astype(np.float32)
        stiff = model.rest_stiffness @ rounded
        L = np.linalg.cholesky(rounded.T @ stiff)
        full = np.zeros((len(steps), 3 * len(self.mesh.nodes)), np.int16)
        full[:, model.free] = stored.T
        ritz = np.linalg.solve(L, stiff.T @ vectors).reshape(len(steps), len(footprints), -1)
        return RegionResult(
            basis=full,
            steps=steps.astype(np.float32),
            orthonormal=np.linalg.inv(L).T.astype(np.float32),
            ritz=np.moveaxis(ritz, 1, 0).astype(np.float32),
        )

    def _dents(self, points: Array, basis: Array) -> Array:
        """What the basis lacks of the responses to forces on single nodes near the points.

        Footprints spread a load over a disc, which a rigid tip does not; (free dofs, <= DENTS).
        """
        model, radius = self.model, self.scene.endoscope.radius
        nodes = self.body.touchable[1]
        nodes = nodes[~self.mesh.clamped[nodes]]
        nodes = nodes[cKDTree(points).query(self.mesh.nodes[nodes])[0] < radius]
        loads = np.zeros((len(self.mesh.nodes), 3, len(nodes)))
        for i, node in enumerate(nodes):
            loads[node, :, i] = self.surface.project(self.mesh.nodes[node])[1]
        dents = model.solve_linear(loads.reshape(-1, len(nodes))[model.free])
        for _ in range(2):  # twice is enough for orthogonality
            dents -= basis @ ((model.rest_stiffness @ basis).T @ dents)
        return energy_pod(model, dents, DENTS)[0]

    def _ritz(self, footprint: Footprint) -> Array:
        """Nonlinear Ritz vectors, and those of the relaxed tissue if time changes it."""
        nodal, _ = self.unit_load(footprint.point)
        loads = (nodal[:, None, None] * footprint.loads.T).reshape(-1, 3)[self.model.free]
        models = [self.model, self.model.relaxed] if self.model.prony else [self.model]
        return np.hstack([ritz_vectors(model, loads) for model in models])

    def compile_query(self) -> None:
        """Compile what ``patch`` runs."""
        compile_query(self.scene, self.body, self.surface)

    def patch(self, region: RegionResult, task: PatchTask, tip: bool = True) -> PatchResult:
        """Train a local model, under the tip only if the scene has one and ``tip`` says so."""
        endoscope = self.scene.endoscope.model_copy(
            update={"tip": tip and self.scene.endoscope.tip}
        )
        scene = self.scene.model_copy(update={"endoscope": endoscope})
        return train_patch(scene, self.model, self.body, self.surface, region, task)

    def trial(self, task: PatchTask) -> TrialResult:
        """Train a local model by itself and judge it on loads it has not seen."""
        region = self.region(task.footprints, task.size.region_modes)
        result = self.patch(region, task, tip=False)
        trainer = local_trainer(self.scene, self.body, self.surface, region, task, result)
        rng = stream(task.seed, Stage.TRIAL_LOADS)
        displacement: list[float] = []
        von_mises: list[float] = []
        seconds: list[float] = []
        while len(seconds) < TRIAL_LOADS:
            load = Load(*random_load(self.scene, task, rng))
            reference = self.sample(load)
            if reference is None:
                continue
            started = time.perf_counter()
            sample = trainer.solve(load.position, load.direction, load.pressure)
            seconds.append(time.perf_counter() - started)
            errors = np.inf, np.inf
            if sample is not None:
                errors = self.errors(trainer.displacement(sample.q), reference.astype(float))
            displacement.append(errors[0])
            von_mises.append(errors[1])
        return TrialResult(np.array(displacement), np.array(von_mises), float(np.median(seconds)))

    def errors(self, displacement: Array, reference: Array) -> tuple[float, float]:
        """Relative errors of displacement and of von Mises stress beyond the clamped layer."""
        kept = self.beyond_clamped_layer
        stresses = [self.von_mises(u)[kept] for u in (displacement, reference)]
        return relative(displacement, reference), relative(*stresses)

    @cached_property
    def _others(self) -> tuple[Workshop, Workshop]:
        return Workshop(twin(self.scene)), Workshop(refined(self.scene))

    def mesh_error(self, load: Load) -> tuple[Array, Array]:
        """Degrees of freedom of the scene's mesh, its twin and a finer one, and what a load does.

        Returns
        -------
        dofs, moved : ndarray, shape (3,)
            Mean displacement under the footprint, mm.
        """
        bodies = (self, *self._others)
        x, normal, _ = self.surface.project(load.position)
        moved = []
        for body in bodies:
            nodal = body.unit_load_at(x, normal)
            force = load.pressure * nodal[:, None] * load.direction
            displacement = body.model.solve(force).displacement
            moved.append(np.linalg.norm(nodal @ displacement) / nodal.sum())
        return np.array([body.mesh.nodes.size for body in bodies]), np.array(moved)

    @cached_property
    def contact(self) -> TipContact:
        """The rigid tip against the full model."""
        mesh, tip = self.mesh, self.body.tip
        surface = tip_surface(mesh.nodes, mesh.faces, mesh.accessible, tip.radius)
        return TipContact(self.model, surface, tip)

    def touch(self, position: Array, start: Array | None = None) -> TouchSample:
        """Full solution with the tip at a position (3,) mm, from a first guess (n, 3)."""
        try:
            first = None if start is None else start.astype(float)
            found = self.model.touch(self.contact, position, self._approach(position), first)
        except NoEquilibrium:
            return TouchSample(np.empty(0, np.float32), *[np.empty(0)] * 4)
        return TouchSample(
            found.displacement.astype(np.float32),
            found.force,
            found.tangent,
            np.array(found.energy),
            np.array(found.penetration),
        )

    def _approach(self, position: Array) -> Array:
        """Shortest way (3,) mm of the tip from where it does not touch to a position."""
        foot, normal, _ = self.surface.project(position)
        out = position - foot
        depth = self.body.tip.radius - float(np.copysign(np.linalg.norm(out), out @ normal))
        return np.asarray(-max(depth, 0.0) * normal)

    def follow_tip(
        self, positions: Array, times: list[float]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], Array] | None:
        """Full solutions of a history of the tip's positions (t, 3) mm after time steps (t,) s.

        Returns
        -------
        displacements, stresses, forces : ndarray, shapes (t, n, 3) mm, (t, n) kPa, (t, 3) mN
            None where there is no equilibrium.
        """
        history, rows = self.model.at_rest, []
        try:
            for x, dt in zip(positions, times, strict=True):
                found, history = self.model.touch_step(
                    history, self.contact, x, self._approach(x), dt
                )
                stress = self.von_mises_after(history).astype(np.float32)
                rows.append((found.displacement.astype(np.float32), stress, found.force))
        except NoEquilibrium:
            return None
        u, s, f = (np.array(part) for part in zip(*rows, strict=True))
        return u, s, f

    def follow(
        self, loads: list[Load], times: list[float]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        """Full displacements (t, n, 3) mm and von Mises stresses (t, n) kPa of a history.

        None where there is no equilibrium.
        """
        history, displacements, stresses = self.model.at_rest, [], []
        try:
            for load, dt in zip(loads, times, strict=True):
                _, history = self.model.step(history, self.load_vector(load), dt)
                displacements.append(history.displacement.astype(np.float32))
                stresses.append(self.von_mises_after(history).astype(np.float32))
        except NoEquilibrium:
            return None
        return np.array(displacements), np.array(stresses)

    def sample(self, load: Load) -> NDArray[np.float32] | None:
        """Full displacement (n, 3) mm, None where there is no equilibrium."""
        try:
            return self.solve(load).displacement.astype(np.float32)
        except NoEquilibrium:
            return None


_workshop: Workshop | None = None


def _end_with_parent() -> None:
    """Stop this worker when the process that started it is killed."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def open_workshop(text: str, folder: str) -> None:
    """Initialize a worker process on a scene, given by its text and where its files lie."""
    global _workshop
    _end_with_parent()
    _workshop = Workshop(parse_scene(text, Path(folder)))


def open_artifact(path: Path) -> None:
    """Initialize a worker process on the mesh of an artifact."""
    global _workshop
    _end_with_parent()
    _workshop = Workshop.of_artifact(read_artifact(path))


def run(task: Callable[..., object], *args: object) -> object:
    """Run ``task(workshop, *args)`` in a worker."""
    return task(_workshop, *args)
