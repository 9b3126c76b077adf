"""A trained scene in memory, ready to answer: locate, solve, recover fields, state the trust."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from palpate.shared.answer import Answer
from palpate.shared.artifact import Artifact, ArtifactError, read_artifact
from palpate.shared.errors import QueryError
from palpate.shared.geometry.quadrature import stress_recovery
from palpate.shared.geometry.surface import UPRIGHT, Surface, SurfaceIndex, boundary_triangles
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.footprint import TIP_DEPTH
from palpate.shared.mechanics.sphere import tip_of
from palpate.shared.mechanics.stress import (
    nodal_von_mises,
    nodal_von_mises_after,
    remember,
    remember_linearly,
)
from palpate.shared.mechanics.tissue import lame
from palpate.shared.mechanics.viscosity import Weights, step_weights
from palpate.shared.reduced import press, touch
from palpate.shared.reduced.outcome import TOUCH_FEATURES, Outcome
from palpate.shared.reduced.past import Remembering, remembering
from palpate.shared.reduced.points import expand
from palpate.shared.reduced.terms import Elastic
from palpate.shared.reduced.transfer import LeftBehind, Local, Past, Transfer, estimate_history
from palpate.shared.reduced.workspace import (
    TouchWorkspace,
    Workspace,
    press_workspace,
    touch_workspace,
)
from palpate.shared.scene import Scene, SceneError, parse_scene
from palpate.shared.tables import (
    Body,
    Estimator,
    Estimators,
    LocalModels,
    LocalTips,
    ViscousModels,
    press_models,
    touch_models,
)

Array = NDArray[np.float64]
Field = NDArray[np.float32]
Region = Literal["surface", "all"]

Active = tuple[tuple[int, float, Local], ...]
Moves = dict[int, tuple[Mapping[int, LeftBehind], ...]]

BESIDE = 0.1
"""Millimetres beyond the rim of the surface at which the answer is not to the question any more."""

ABSURD = 10.0
"""Multiple of the largest trained pressure beyond which a load is not answered."""

_NONE, _UNKNOWN = np.zeros(3), np.full(3, np.inf)
"""Estimated errors."""

_INWARD = np.zeros(3)
"""Direction that stands for the inward normal."""


class Warm:
    """Working memory and last answers of one caller; not to be shared between threads.

    Parts for loads and for the tip, at once and in time, are made when first needed.
    """

    def __init__(self, model: ReducedModel) -> None:
        self._model = model
        self._made: dict[tuple[bool, bool], Workspace] = {}

    def press(self, in_time: bool) -> Workspace:
        """For loads."""
        return self._part(tip=False, in_time=in_time)

    def touch(self, in_time: bool) -> TouchWorkspace:
        """For the tip."""
        part = self._part(tip=True, in_time=in_time)
        assert isinstance(part, TouchWorkspace)
        return part

    def _part(self, tip: bool, in_time: bool) -> Workspace:
        if (tip, in_time) not in self._made:
            self._made[tip, in_time] = self._model.workspace(tip, in_time)
        return self._made[tip, in_time]

    def forget(self) -> None:
        """Make the next answer independent of the last."""
        for part in self._made.values():
            part.forget()

    def resume(self) -> None:
        """Start under the tip where the last search ended, which found no equilibrium."""
        for part in self._made.values():
            if isinstance(part, TouchWorkspace):
                part.resume()


class ReducedModel:
    """A trained scene that answers queries: an atlas of local models over its surface.

    Parameters
    ----------
    name : str
    scene : Scene
    info : dict
        JSON-able documents of the artifact.
    body : Body
    surface : Surface
        Accessible surface.
    limits : ndarray, shape (v, LIMIT_FIELDS)
        Load range at the surface's vertices; see ``mechanics.footprint.pressure_limit``.
    models : LocalModels
    estimators : Estimators
    """

    def __init__(
        self,
        name: str,
        scene: Scene,
        info: dict[str, Any],
        body: Body,
        surface: Surface,
        limits: Array,
        models: LocalModels,
        estimators: Estimators,
    ) -> None:
        self.name = name
        self.scene = scene
        self.info = info
        self.body = body
        self.surface = surface
        self.limits = limits
        self.models = models
        self.estimators = estimators
        self.surface_nodes, self.surface_triangles = boundary_triangles(body.faces)
        self._recovery = stress_recovery(
            body.nodes, body.elements, body.mu, body.lam, precision=np.float32
        )
        self._stress = np.zeros(len(body.nodes))
        self._own = Warm(self)
        self._index: SurfaceIndex = surface.ground(limits)
        self._last_step: tuple[float, Weights] | None = None

    @classmethod
    def load(cls, path: str | Path) -> ReducedModel:
        """Load an artifact.

        Raises
        ------
        ArtifactError
        """
        path = Path(path)
        artifact = read_artifact(path)
        try:
            return cls.from_artifact(artifact)
        except (KeyError, SceneError, ValueError, IndexError) as error:
            raise ArtifactError(f"{path}: incomplete or inconsistent: {error}") from error

    @classmethod
    def from_artifact(cls, artifact: Artifact) -> ReducedModel:
        """Build from the contents of an artifact."""
        arrays = artifact.arrays
        scene = parse_scene(artifact.scene)
        tips = _local_tips(arrays) if scene.endoscope.tip else None
        mu, lam = lame(scene.tissue.young, scene.tissue.poisson)
        count = len(arrays["elements"])
        return cls(
            name=scene.name,
            scene=scene,
            info=artifact.documents,
            body=Body(
                arrays["nodes"],
                arrays["elements"],
                arrays["faces"],
                arrays["clamped"],
                arrays["accessible"],
                np.full(count, mu),
                np.full(count, lam),
                tip_of(scene.endoscope.radius, scene.tissue.young),
            ),
            surface=Surface(
                arrays["surface_vertices"], arrays["surface_triangles"], arrays["surface_normals"]
            ),
            limits=arrays["load_range"],
            models=LocalModels(
                basis=arrays["basis"],
                steps=arrays["basis_steps"],
                region=arrays["patch_region"],
                centres=arrays["patch_centres"],
                frames=arrays["patch_frames"],
                pressures=arrays["patch_pressures"],
                whole=arrays["patch_modes"],
                mix=arrays["patch_mix"],
                point_from=arrays["cubature_from"],
                points=arrays["cubature_points"],
                weights=arrays["cubature_weights"],
                defect=arrays["patch_defect"].astype(np.float32),
                guess=arrays["patch_guess"].astype(np.float32),
                directions=arrays["patch_directions"].astype(np.float32),
                change=arrays["patch_change"].astype(np.float32),
                residuals=arrays["patch_residuals"],
                extent=float(arrays["patch_extent"]),
                blend=float(arrays["patch_blend"]),
                tips=tips,
                viscous=_viscous_models(arrays) if scene.tissue.prony else None,
                viscous_tips=_viscous_tips(arrays, tips) if scene.tissue.prony and tips else None,
            ),
            estimators=Estimators.of(arrays),
        )

    @property
    def nodes(self) -> Array:
        """Nodes (n, 3) mm."""
        return self.body.nodes

    @property
    def clamped(self) -> NDArray[np.bool_]:
        """Nodes held fixed (n,)."""
        return self.body.clamped

    @property
    def has_tip(self) -> bool:
        """Whether the scene was trained for the rigid tip."""
        return self.models.tips is not None

    @cached_property
    def pressure_max(self) -> float:
        """Largest trained pressure anywhere on the surface, kPa."""
        return float(self.limits[:, 0].max())

    def new_warm(self) -> Warm:
        """Working memory and warm start for one session or thread."""
        return Warm(self)

    def workspace(self, tip: bool, in_time: bool) -> Workspace:
        """Memory of one caller for loads or the tip, at once or in time.

        Raises
        ------
        QueryError
            If the scene has no tip, or its tissue no past.
        """
        if tip and self.models.tips is None:
            raise QueryError("position", f"scene {self.name!r} was trained without a tip")
        if in_time and not self.scene.tissue.prony:
            raise QueryError("time", f"scene {self.name!r} is elastic and knows none")
        tables = self.touch_models if tip else self.press_models
        past: Elastic | Remembering = Elastic()
        if in_time:
            viscous = self.models.viscous_tips if tip else self.models.viscous
            assert viscous is not None, "or the tissue would have no past"
            points = tables.points.weights.shape[1]
            past = remembering(viscous.deviatoric, len(self.scene.tissue.prony), points)
        if tip:
            coefficients = np.ascontiguousarray(self.estimators.touches.coefficients)
            return touch_workspace(self.touch_models, self._index, coefficients, past)
        return press_workspace(
            self.press_models, self._index, self.scene.endoscope.max_tilt,
            np.ascontiguousarray(self.estimators.loads.coefficients), past,
        )  # fmt: skip

    @cached_property
    def press_models(self) -> press.PressModels:
        """Local models of loads."""
        return press_models(self.body, self.models, self.scene)

    @cached_property
    def touch_models(self) -> touch.TouchModels:
        """Local models of the rigid tip."""
        assert self.models.tips is not None
        return touch_models(self.body, self.models, self.models.tips)

    @cached_property
    def press_transfer(self) -> Transfer:
        """Takes the past under loads from one local model to the next."""
        return self._transfer(self.models.viscous, self.press_models.points.weights.shape[1])

    @cached_property
    def touch_transfer(self) -> Transfer:
        """Takes the past under the tip from one local model to the next."""
        return self._transfer(self.models.viscous_tips, self.touch_models.points.weights.shape[1])

    def _transfer(self, models: ViscousModels | None, points: int) -> Transfer:
        assert models is not None, "or there would be no past"
        return Transfer(
            models.deviatoric, models.pairs, models.overlap, self.scene.tissue.prony, points
        )

    def press(
        self,
        position: ArrayLike | None,
        pressure: float,
        direction: ArrayLike | None = None,
        radius: float | None = None,
        *,
        past: Past | None = None,
        dt: float = 0.0,
        warm: Warm | None = None,
    ) -> Answer:
        """Answer one pressed footprint.

        Parameters
        ----------
        position : array_like, shape (3,), mm
            Contact point; projected onto the accessible surface if within the scene's reach of it.
            None lifts the load where it was last.
        pressure : float, kPa
            At the footprint's centre.
        direction : array_like, shape (3,), optional
            Of the load; the inward normal if absent.
        radius : float, optional
            Of the footprint, mm; the scene's if absent.
        past : Past, optional
            What visco-elastic tissue remembers; ``REST`` is nothing.  Without it the tissue answers
            at once.  It is not changed.
        dt : float, s
            Since the end of that past; may be 0, for a sudden change.
        warm : Warm, optional
            Where the last answers are remembered to start from; without it every answer is cold.

        Returns
        -------
        answer : Answer
            With ``answer.past`` to go on from.

        Raises
        ------
        QueryError
            If a field is not finite, out of reach or makes no sense; see its message.
        """
        started = time.perf_counter()
        if position is None:
            last = None if past is None else past.position
            position, pressure = self.surface.vertices[0] if last is None else last, 0.0
        at, towards, radius = self._checked(position, pressure, direction, radius)
        own = self._warm(warm, past, dt).press(in_time=past is not None)
        press.place(own.solver, at, towards)
        self._check_place(own.outcome.distance.item(), own.outcome.tilt.item())
        moves = self._begin(own, self.press_transfer, past, dt) if past is not None else {}
        press.press(own.solver, pressure, radius)
        if past is None:
            press.estimate(own.solver, pressure)
        found = own.result()
        parts = tuple([(k, w, own.warm.q[slot].copy()) for slot, k, w in own.answering()])
        converged = found.status == newton.CONVERGED
        out_of_range = self._out_of_range(at, found, pressure, radius)
        active: Active = ()
        features, errors, after = found.features, found.errors, None
        if past is not None:
            response = math.hypot(*found.displacement.tolist())
            features, errors, after, active = self._in_time(
                own, past, dt, moves, self.estimators.histories, found, found.foot,
                pressure / found.limit, response,
            )  # fmt: skip
        if out_of_range or not converged:
            errors = _UNKNOWN
        return Answer(
            contact_point=found.foot,
            normal=found.upward,
            distance=found.distance,
            force=found.force,
            converged=converged,
            iterations=int(found.iterations),
            in_range=not out_of_range,
            out_of_range=out_of_range,
            error_displacement=errors.item(0),
            error_von_mises=errors.item(1),
            error_force=0.0,
            min_jacobian=found.min_jacobian,
            pressure_limit=found.limit,
            depth_limit=found.limits.item(TIP_DEPTH),
            features=features,
            parts=parts,
            direction=found.direction,
            tilt=found.tilt,
            pressure=pressure,
            radius=radius,
            departure=found.departure,
            residual=found.residual,
            contact_displacement=found.displacement,
            contact=pressure > 0.0,
            time=0.0 if past is None else past.time + dt,
            past=after if converged else past,
            active=active,
            solve_seconds=time.perf_counter() - started,
        )

    def touch(
        self,
        position: ArrayLike,
        *,
        past: Past | None = None,
        dt: float = 0.0,
        warm: Warm | None = None,
        most: int = touch.MAX_ITERATIONS,
    ) -> Answer:
        """Answer a position of the rigid tip.

        Parameters
        ----------
        position : array_like, shape (3,), mm
            Centre of the tip, outside the body.
        past, dt, warm
            As in ``press``; the tip moved evenly since the end of the past.
        most : int
            Iterations in one local model. With fewer than the default, a position that is hard to
            get to is given up early: for callers that come nearer step by step.

        Raises
        ------
        QueryError
            If the position is not finite, or the tip's centre lies below the surface.
        """
        started = time.perf_counter()
        at = _vector("position", position)
        own = self._warm(warm, past, dt).touch(in_time=past is not None)
        last = at if past is None or past.position is None else past.position
        touch.place(own.solver, at, last)
        depth, radius = own.outcome.depth.item(), self.body.tip.radius
        if depth > radius:
            own.active.number[:] = -1  # no search has begun that could be resumed
            raise QueryError(
                "position",
                f"the tip's centre lies {depth - radius:.2f} mm below the accessible surface",
            )
        off = depth < -touch.SKIN * radius
        if off and (past is None or past.main < 0):
            own.active.number[:] = -1
            own.active.weight[:] = 0.0
        moves = self._begin(own, self.touch_transfer, past, dt) if past is not None else {}
        touch.touch(own.solver, at, most)
        touched = own.outcome.touched.item() > 0
        if past is None and touched:
            touch.estimate(own.solver, at)
        found = own.result()
        parts = tuple([(k, w, own.scratch.q[slot].copy()) for slot, k, w in own.answering()])
        converged = found.status == newton.CONVERGED
        out_of_range: tuple[str, ...] = ()
        active: Active = ()
        if found.beside and (touched or depth > 0.0):
            out_of_range += ("position",)
        if depth > found.limit * (1 + 1e-9):
            out_of_range += ("depth",)
        features, errors, after = found.features[:TOUCH_FEATURES], found.errors, None
        if past is not None:
            response = math.hypot(*found.force.tolist())
            features, errors, after, active = self._in_time(
                own, past, dt, moves, self.estimators.courses, found,
                past.position if off else at, depth / found.limit, response,
            )  # fmt: skip
        if out_of_range or not converged:
            errors = _UNKNOWN
        elif not touched and past is None:
            errors = _NONE
        return Answer(
            contact_point=found.point,
            normal=found.normal,
            distance=found.distance,
            force=found.force,
            converged=converged,
            iterations=int(found.iterations),
            in_range=not out_of_range,
            out_of_range=out_of_range,
            error_displacement=errors.item(0),
            error_von_mises=errors.item(1),
            error_force=errors.item(2),
            min_jacobian=found.min_jacobian,
            pressure_limit=found.limits.item(0),
            depth_limit=found.limit,
            features=features,
            parts=parts,
            tip=True,
            position=at,
            contact=touched,
            tangent=found.tangent.reshape(3, 3),
            depth=depth,
            penetration=found.penetration,
            energy=found.energy,
            time=0.0 if past is None else past.time + dt,
            past=after if converged else past,
            active=active,
            solve_seconds=time.perf_counter() - started,
        )

    def _checked(
        self,
        position: ArrayLike,
        pressure: float,
        direction: ArrayLike | None,
        radius: float | None,
    ) -> tuple[Array, Array, float]:
        """Position, direction (zero for the inward normal) and radius of a well-formed load."""
        endoscope = self.scene.endoscope
        if not (math.isfinite(pressure) and pressure >= 0):
            raise QueryError("pressure", f"must be a finite number >= 0 kPa, not {pressure}")
        if pressure > ABSURD * self.pressure_max:
            raise QueryError(
                "pressure",
                f"must be at most {ABSURD:g} times the {self.pressure_max:.3g} kPa of the "
                f"training, not {pressure:g}",
            )
        at = _vector("position", position)
        if radius is None:
            radius = endoscope.radius
        elif not endoscope.radius / 2 <= radius <= endoscope.radius:
            allowed = f"[{endoscope.radius / 2}, {endoscope.radius}] mm"
            raise QueryError("radius", f"must be in {allowed}, not {radius}")
        if direction is None:
            return at, _INWARD, radius
        towards = _vector("direction", direction)
        if not any(towards.tolist()):
            raise QueryError("direction", "must not be the zero vector")
        return at, towards, radius

    def _check_place(self, distance: float, tilt: float) -> None:
        """Raise ``QueryError`` if a load is out of reach or does not press."""
        reach = self.scene.endoscope.reach
        if distance > reach:
            raise QueryError(
                "position",
                f"{distance:.2f} mm from the accessible surface, at most {reach} mm allowed",
            )
        if not tilt < 90.0:
            raise QueryError("direction", "must point into the tissue")

    def _out_of_range(
        self, at: Array, found: Outcome, pressure: float, radius: float
    ) -> tuple[str, ...]:
        """Fields of a load that are not of the kind the model was trained for."""
        endoscope = self.scene.endoscope
        fields: tuple[str, ...] = ()
        if found.distance > BESIDE and _beside(at, found):
            fields += ("position",)
        if pressure > found.limit * (1 + 1e-9):
            fields += ("pressure",)
        if found.tilt > endoscope.max_tilt + 1e-6:
            fields += ("direction",)
        if radius != endoscope.radius:
            fields += ("radius",)
        return fields

    def _warm(self, warm: Warm | None, past: Past | None, dt: float) -> Warm:
        """Memory to answer with: the caller's, or the model's own, which knows no last answer."""
        if past is not None:
            if not self.scene.tissue.prony:
                raise QueryError("time", f"scene {self.name!r} is elastic and knows none")
            if not 0.0 <= dt < math.inf:
                raise QueryError("time", f"steps must be >= 0 s and finite, not {dt}")
        if warm is None:
            warm = self._own
            warm.forget()
        return warm

    def _begin(self, own: Workspace, transfer: Transfer, past: Past, dt: float) -> Moves:
        """Write past and time step into a workspace; return what earlier moves left behind."""
        assert isinstance(own.past, Remembering)
        if self._last_step is None or self._last_step[0] != dt:
            self._last_step = dt, step_weights(self.scene.tissue.prony, dt)
        for own_weights, weights in zip(own.past.time, self._last_step[1], strict=True):
            own_weights[:] = weights
        return transfer.begin(own, past)

    def _in_time(
        self,
        own: Workspace,
        past: Past,
        dt: float,
        moves: Moves,
        estimator: Estimator,
        found: Outcome,
        position: Array | None,
        share: float,
        response: float,
    ) -> tuple[Array, Array, Past, Active]:
        """Return features and errors of a history, the past to go on from, and active models."""
        assert isinstance(own.past, Remembering)
        records = own.past.records
        active = tuple(
            [(k, w, Local(records[slot].copy(), moves[k])) for slot, k, w in own.answering()]
        )
        travel = 0.0
        if position is not None and past.position is not None:
            travel = math.dist(position.tolist(), past.position.tolist())
        after = Past(
            time=past.time + dt,
            locals={k: local for k, _, local in active},
            main=max(active, key=lambda part: part[1])[0] if active else -1,
            position=position,
            share=max(past.share, share),
            response=max(past.response, response),
            travel=past.travel + travel,
            smallest=min(past.smallest, found.min_jacobian),
        )
        features, errors = estimate_history(
            estimator.coefficients, found.upward, after.share, after.response, after.travel,
            after.smallest,
        )  # fmt: skip
        left = after.share > 1.0 + 1e-9  # the trained range, now or before
        return features, _UNKNOWN if left else errors, after, active

    def coefficients(self, answer: Answer) -> dict[int, Field]:
        """Displacement as coefficients (M,) in the basis of each region that takes part."""
        if answer.past is None:
            return self._by_region(answer, answer.parts)
        return self._by_region(
            answer, self._transfer_of(answer).displacements(answer.time, answer.active)
        )

    def _transfer_of(self, answer: Answer) -> Transfer:
        return self.touch_transfer if answer.tip else self.press_transfer

    def _by_region(
        self, answer: Answer, parts: Sequence[tuple[int, float, Array]]
    ) -> dict[int, Field]:
        """Coefficients of states in the modes that an answer is given in."""
        modes = self.models.modes
        if answer.tip:
            assert self.models.tips is not None, "or there would be no such answer"
            modes = self.models.tips.modes
        total: dict[int, Field] = {}
        for k, weight, q in parts:
            region = int(self.models.region[k])
            share = modes[k] @ (weight * q).astype(np.float32)
            total[region] = total[region] + share if region in total else share
        return total

    def _field(self, coefficients: Mapping[int, Field]) -> Field:
        field = np.zeros(self.models.basis.shape[2], np.float32)
        for number, part in coefficients.items():
            expand(self.models.basis[number], self.models.steps[number] * part, field)
        return field.reshape(-1, 3)

    def displacement(self, answer: Answer, region: Region = "all") -> Field:
        """Nodal displacement (k, 3) mm, of all nodes or those of ``surface_nodes``."""
        displacement = self._field(self.coefficients(answer))
        return displacement if region == "all" else displacement[self.surface_nodes]

    def von_mises(
        self, answer: Answer, region: Region = "all", displacement: Field | None = None
    ) -> Field:
        """Nodal von Mises stress (k,) kPa; ``displacement`` of all nodes saves its recovery."""
        if displacement is None:
            displacement = self.displacement(answer, "all")
        if answer.past is None:
            nodal_von_mises(self._recovery, displacement, self._stress)
        else:
            B = self._remembered(answer)
            nodal_von_mises_after(self._recovery, displacement, B, self._stress)
        stress = self._stress if region == "all" else self._stress[self.surface_nodes]
        # an answer that did not converge may be beyond single precision
        with np.errstate(over="ignore"):
            return stress.astype(np.float32)

    def _remembered(self, answer: Answer) -> Array:
        """``B`` of ``mechanics.viscosity`` (e, 6, 8) at the points of all elements."""
        transfer = self._transfer_of(answer)
        B = np.zeros((len(self.body.elements), 6, 8))
        for k, share, knot in transfer.knots(answer.active):
            u = self._field(self._by_region(answer, [(k, 1.0, knot)]))
            remember(self._recovery, u, share, B)
        lasting = transfer.lasting(answer.time, answer.active)
        if lasting:
            remember_linearly(self._recovery, self._field(self._by_region(answer, lasting)), B)
        return B


def _local_tips(arrays: dict[str, NDArray[Any]]) -> LocalTips:
    return LocalTips(
        modes=arrays["tip_modes"],
        point_from=arrays["tip_from"],
        points=arrays["tip_points"],
        weights=arrays["tip_weights"],
        guess=arrays["tip_guess"].astype(np.float32),
        pairs=arrays["tip_pairs"],
        overlaps=arrays["tip_overlaps"].astype(np.float32),
        residuals=arrays["tip_residuals"],
    )


def _viscous_models(arrays: dict[str, NDArray[Any]]) -> ViscousModels:
    overlap = arrays["viscous_overlap"].astype(np.float32)
    return ViscousModels(arrays["viscous_deviatoric"], arrays["viscous_pairs"], overlap)


def _viscous_tips(arrays: dict[str, NDArray[Any]], tips: LocalTips) -> ViscousModels:
    return ViscousModels(arrays["tip_viscous_deviatoric"], tips.pairs, tips.overlaps)


def _beside(position: Array, found: Outcome) -> bool:
    """Whether a position lies rather beside the surface, beyond its rim, than above or below it."""
    return bool(abs(np.dot(position - found.foot, found.upward)) < UPRIGHT * found.distance)


def _vector(field: str, value: ArrayLike) -> Array:
    try:
        vector = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise QueryError(field, "must be three numbers") from error
    if vector.shape != (3,) or not all(map(math.isfinite, vector.tolist())):
        raise QueryError(field, "must be three finite numbers")
    return vector
