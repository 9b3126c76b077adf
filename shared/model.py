"""A trained scene in memory, ready to answer: locate, solve, recover fields, state the trust."""

import math
import time
from collections.abc import Mapping
from functools import cached_property
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from palpate.shared import many
from palpate.shared.answer import Answer, Answers, peak
from palpate.shared.arrays import Array, Field, Flags
from palpate.shared.artifact import Artifact, ArtifactError, read_artifact, values_of
from palpate.shared.errors import PalpateError, QueryError
from palpate.shared.fields import Composition, FieldRecovery
from palpate.shared.geometry.surface import Surface, SurfaceIndex, boundary_triangles
from palpate.shared.local_models import (
    Body,
    Estimators,
    LoadRange,
    LocalModels,
    Mesh,
    ViscousModels,
)
from palpate.shared.mechanics import newton
from palpate.shared.mechanics.footprint import LIMIT_FIELDS, TIP_DEPTH
from palpate.shared.mechanics.tip import EDGE_FIELD, dented, history
from palpate.shared.near_field import Contact
from palpate.shared.query import (
    check_place,
    checked_load,
    out_of_range,
    stiffness,
    tip_beyond,
    vector,
)
from palpate.shared.reduced import press, touch
from palpate.shared.reduced.features import UNFITTED, near_rim, total_errors
from palpate.shared.reduced.outcome import Outcome
from palpate.shared.reduced.past import Elastic, Remembering
from palpate.shared.reduced.transfer import LeftBehind, Local, Past, Transfer, estimate_history
from palpate.shared.reduced.workspace import Warm, Workspace
from palpate.shared.scene import Scene, parse_scene
from palpate.shared.stress_field import Peaks
from palpate.shared.tables import press_models

Region = Literal["surface", "all"]

Active = tuple[tuple[int, float, Local], ...]
Answering = list[tuple[int, int, float]]
Moves = dict[int, tuple[Mapping[int, LeftBehind], ...]]

STORED = Mesh, Surface, LoadRange, LocalModels, ViscousModels, Estimators
"""What an artifact holds."""

MOST_BEGINNINGS = 6
"""Times that a step under the tip is begun, each with the local models that the last ended at."""

_NONE, _UNKNOWN = np.zeros(3), np.full(3, np.inf)
"""Estimated errors."""


_BEYOND = 2.0
"""Share of its limit that stands for a load that is out of range in other ways: no error is known
of a history from there on."""


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
    seal : str
        SHA-256 of the artifact.
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
        seal: str = "",
    ) -> None:
        self.name = name
        self.seal = seal
        self.scene = scene
        self.info = info
        self.body = body
        self.surface = surface
        self.limits = limits.copy()
        self.models = models
        if not self.has_tip:
            self.limits[:, TIP_DEPTH] = 0.0
        self.estimators = estimators
        self.surface_nodes, self.surface_triangles = boundary_triangles(body.faces)
        self.fields = FieldRecovery(body, models, lambda: self.transfer)
        self._own = self.new_warm()
        with np.errstate(divide="ignore", invalid="ignore"):  # of triangles without an area
            contact = body.contact_fields(surface)
        if not np.isfinite(contact).all():
            raise PalpateError("surface: triangles of it have no area")
        rim = surface.rim_distance()[:, None] / body.tip.radius
        self._index: SurfaceIndex = surface.ground(np.hstack([self.limits, contact, rim]))

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Load an artifact, and make all that queries need of it.

        Raises
        ------
        ArtifactError
            Also where its contents do not fit together.
        """
        path = Path(path)
        artifact = read_artifact(path, *STORED)
        try:
            model = cls.from_artifact(artifact)
            for in_time in {False, bool(model.scene.tissue.prony)}:
                model._own.workspace(False, in_time)
            return model
        except Exception as error:  # whatever its contents lead to
            what = error if isinstance(error, PalpateError) else repr(error)
            raise ArtifactError(f"{path}: incomplete or inconsistent: {what}") from error

    @classmethod
    def from_artifact(cls, artifact: Artifact) -> Self:
        """Build from the contents of an artifact."""
        arrays, scene = artifact.arrays, parse_scene(artifact.scene)
        estimators = Estimators(**values_of(Estimators, arrays))
        mesh = Mesh(**values_of(Mesh, arrays))
        if scene.tissue.region and mesh.regions is None:
            raise PalpateError("it does not say which elements are of which region")
        if missing := estimators.missing(scene):
            raise PalpateError(f"it has no error estimates: {', '.join(missing)}")
        return cls(
            name=scene.name,
            scene=scene,
            info=artifact.documents,
            body=Body.of(mesh, scene),
            surface=Surface(**values_of(Surface, arrays)),
            limits=values_of(LoadRange, arrays)["limits"],
            models=LocalModels.of(arrays, scene),
            estimators=estimators,
            seal=artifact.seal,
        )

    @property
    def nodes(self) -> Array:
        """Nodes (n, 3) mm."""
        return self.body.nodes

    @property
    def clamped(self) -> Flags:
        """Nodes held fixed (n,)."""
        return self.body.clamped

    @property
    def has_tip(self) -> bool:
        """Whether the scene was trained for the rigid tip."""
        return self.scene.endoscope.tip

    @cached_property
    def pressure_max(self) -> float:
        """Largest trained pressure anywhere on the surface, kPa."""
        return float(self.limits[:, 0].max())

    def new_warm(self) -> Warm:
        """Working memory and warm start for one session or thread."""
        return Warm(self.workspace)

    def workspace(self, tip: bool, in_time: bool) -> Workspace:
        """Memory of one caller for loads or the tip, at once or in time.

        Raises
        ------
        QueryError
            If the scene has no tip, or its tissue no past.
        """
        if tip and not self.has_tip:
            raise QueryError(
                "position",
                f"scene {self.name!r} was trained without a tip: endoscope.tip = true adds it",
            )
        if in_time and not self.scene.tissue.prony:
            raise QueryError("time", f"scene {self.name!r} is elastic and knows none")
        past = self.transfer.new_past() if in_time else Elastic()
        coefficients = self.estimators.coefficients(tip, in_time)
        return Workspace(self.press_models, self.body.tip, self._index, coefficients, past)

    @cached_property
    def transfer(self) -> Transfer:
        """Takes the past from one local model to the next."""
        models, points = self.models.viscous, self.press_models.points.weights.shape[1]
        assert models is not None, "or there would be no past"
        prony = self.scene.tissue.prony
        return Transfer(models.deviatoric, models.pairs, models.overlap, prony, points)

    @cached_property
    def press_models(self) -> press.PressModels:
        """Tables of the local models."""
        return press_models(self.body, self.models, self.scene)

    def press(
        self,
        position: ArrayLike | None,
        pressure: float,
        direction: ArrayLike | None = None,
        radius: float | None = None,
        *,
        young: float | None = None,
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
        young : float, optional
            Young's modulus of the tissue, kPa; the scene's if absent.  Exact, since stresses of all
            laws go with it: tissue twice as stiff moves as far under twice the load.
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
        last = None if past is None else past.position
        lifted = position is None
        if position is None:
            position, pressure = self.surface.vertices[0] if last is None else last, 0.0
        ratio = stiffness(self.scene.tissue.young, young)
        at, towards, radius = checked_load(
            self.scene.endoscope, ratio * self.pressure_max, position, pressure, direction, radius
        )
        pressure = float(pressure) / ratio
        own = self._memory(False, warm, past, dt)
        press.place(own.solver, at, towards)
        check_place(self.scene.endoscope, self.surface, own.outcome)
        answering = own.answering()
        moves: Moves = {}
        if past is not None:
            own.begin_step(self.scene.tissue.prony, dt)
            moves = self.transfer.begin(own, answering, past)
        press.press(own.solver, pressure, radius)
        found = own.outcome
        outside = out_of_range(self.scene.endoscope, at, found, pressure, radius)
        after: Past | None = None
        active: Active = ()
        if past is not None:
            place = last if lifted else found.foot.copy()
            share = _BEYOND if outside else pressure / found.limit.item()
            after, active = _in_time(
                own, answering, past, dt, moves, place, share, found.displacement
            )
        parts = tuple([(k, w, own.warm.q[slot].copy()) for slot, k, w in answering])
        converged = found.status.item() == newton.CONVERGED
        unknown = bool(outside) or not converged
        reduction = _UNKNOWN if unknown else found.errors.copy()
        total, mesh = _total(reduction, self.estimators.mesh, pressure, found)
        answer = Answer(
            contact_point=found.foot.copy(),
            normal=found.upward.copy(),
            distance=found.distance.item(),
            force=found.force.copy(),
            converged=converged,
            iterations=int(found.iterations.item()),
            in_range=not outside,
            out_of_range=outside,
            error_displacement=total[0],
            error_von_mises=total[1],
            error_force=0.0,
            error_reduction=reduction,
            error_mesh=mesh,
            min_jacobian=found.min_jacobian.item(),
            pressure_limit=found.limit.item(),
            depth_limit=found.limits.item(TIP_DEPTH),
            features=found.features[: own.features].copy(),
            parts=parts,
            direction=found.direction.copy(),
            tilt=found.tilt.item(),
            pressure=pressure,
            radius=radius,
            departure=found.departure.item(),
            residual=found.residual.item(),
            contact_displacement=found.displacement.copy(),
            contact=pressure > 0.0,
            footprint=_footprint(found, radius, tip=False) if pressure > 0.0 else None,
            time=0.0 if past is None else past.time + dt,
            past=after if converged else past,
            active=active,
            solve_seconds=time.perf_counter() - started,
        )
        return answer if ratio == 1.0 else answer.stiffened(ratio)

    def touch(
        self,
        position: ArrayLike,
        *,
        young: float | None = None,
        past: Past | None = None,
        dt: float = 0.0,
        warm: Warm | None = None,
    ) -> Answer:
        """Answer a position of the rigid tip.

        One that touches nothing is answered without ``contact``: the force is zero, the surface
        nearest at ``contact_point``, at a depth of minus its distance from the tip.

        Parameters
        ----------
        position : array_like, shape (3,), mm
            Centre of the tip, outside the body.
        young, past, dt, warm
            As in ``press``; the tip moved evenly since the end of the past.

        Raises
        ------
        QueryError
            If the position is not finite, or the tip's centre lies below the surface.
        """
        started = time.perf_counter()
        ratio, at = stiffness(self.scene.tissue.young, young), vector("position", position)
        own = self._memory(True, warm, past, dt)
        touch.place(own.solver, at)
        found, radius = own.outcome, self.body.tip.radius
        depth, limit, beside = found.depth.item(), found.limit.item(), found.beside.item()
        if depth > radius:
            raise QueryError(
                "position",
                f"the tip's centre lies {depth - radius:.2f} mm below the accessible surface",
            )
        off = depth <= 0.0
        last = found.foot.copy() if past is None or past.position is None else past.position
        touch.begin(own.solver, at, last)
        if off and (past is None or past.main < 0):
            own.active.number[:] = -1
            own.active.weight[:] = 0.0
        moves: Moves = {}
        law = own.scratch.tip.contact.law
        for _ in range(MOST_BEGINNINGS):
            if past is not None and isinstance(own.past, Remembering):
                own.begin_step(self.scene.tissue.prony, dt)
                moves = self.transfer.begin(own, own.answering(), past)
                law[2], law[5] = history(self.body.tip, past.dent, own.past.time)
            touch.touch(own.solver, at)
            if found.status.item() != touch.ELSEWHERE:
                break
        answering = own.answering()
        touched = found.touched.item() > 0
        after: Past | None = None
        active: Active = ()
        if past is not None and isinstance(own.past, Remembering):
            place = past.position if off else found.foot.copy()
            force = math.sqrt(np.dot(found.force, found.force))
            dent = dented(past.dent, own.past.time, law[:4], force)
            after, active = _in_time(
                own, answering, past, dt, moves, place, depth / limit, found.force, dent
            )
        parts = tuple([(k, w, own.warm.q[slot].copy()) for slot, k, w in answering])
        converged = found.status.item() == newton.CONVERGED
        near = touched or depth > 0.0
        beyond = tip_beyond(beside, found.barred.item(), near, depth, limit)
        outside = tuple(field for field, so in beyond.items() if so)
        if not outside and converged and not touched and past is None:
            reduction, (total, mesh) = _NONE, ([0.0] * 3, _NONE)
        else:
            reduction = _UNKNOWN if outside or not converged else found.errors.copy()
            total, mesh = _total(reduction, self.estimators.mesh_tip, depth, found)
        answer = Answer(
            contact_point=found.point.copy(),
            normal=found.normal.copy(),
            distance=found.distance.item(),
            force=found.force.copy(),
            converged=converged,
            iterations=int(found.iterations.item()),
            in_range=not outside,
            out_of_range=outside,
            error_displacement=total[0],
            error_von_mises=total[1],
            error_force=total[2],
            error_reduction=reduction,
            error_mesh=mesh,
            min_jacobian=found.min_jacobian.item(),
            pressure_limit=found.limits.item(0),
            depth_limit=limit,
            features=found.features[: own.features].copy(),
            parts=parts,
            tip=True,
            position=at,
            contact=touched,
            footprint=_footprint(found, radius, tip=True) if touched else None,
            tangent=found.tangent.copy(),
            depth=depth,
            penetration=found.penetration.item(),
            energy=found.energy.item(),
            time=0.0 if past is None else past.time + dt,
            past=after if converged else past,
            active=active,
            solve_seconds=time.perf_counter() - started,
        )
        return answer if ratio == 1.0 else answer.stiffened(ratio)

    def check(
        self,
        position: ArrayLike,
        pressure: float,
        direction: ArrayLike | None = None,
        radius: float | None = None,
        young: float | None = None,
    ) -> tuple[float, tuple[str, ...]]:
        """Largest trained pressure (kPa) for a load, and its fields that are out of range.

        See ``press``, which raises the same.
        """
        ratio = stiffness(self.scene.tissue.young, young)
        at, towards, radius = checked_load(
            self.scene.endoscope, ratio * self.pressure_max, position, pressure, direction, radius
        )
        own = self._memory(False, None, None, 0.0)
        found = own.outcome
        press.place(own.solver, at, towards)
        check_place(self.scene.endoscope, self.surface, found)
        beyond = out_of_range(self.scene.endoscope, at, found, pressure / ratio, radius)
        return ratio * found.limit.item(), beyond

    def solve_many(
        self,
        positions: ArrayLike,
        pressures: ArrayLike,
        directions: ArrayLike | None = None,
        young: float | None = None,
        threads: int | None = None,
    ) -> Answers:
        """Answer many loads, each as ``press`` does from rest, on many threads; see ``many``."""
        return many.solve(self, positions, pressures, directions, young, threads)

    def touch_many(
        self, positions: ArrayLike, young: float | None = None, threads: int | None = None
    ) -> Answers:
        """Answer many positions of the tip, each as ``touch`` does from rest; see ``many``."""
        return many.touch(self, positions, young, threads)

    def doubts(self, answer: Answer) -> tuple[str, ...]:
        """Why not to trust an answer; nothing for one to be trusted.

        It has not converged, fields of the query are out of range, or quantities are estimated to
        err by more than the scene's tolerance.
        """
        if not answer.converged:
            return ("convergence",)
        errors = answer.error_displacement, answer.error_von_mises, answer.error_force
        return answer.out_of_range or self.scene.tolerance.of(answer.tip).exceeded(errors)

    def _memory(self, tip: bool, warm: Warm | None, past: Past | None, dt: float) -> Workspace:
        """Memory to answer with: the caller's, or the model's own, which knows no last answer."""
        if past is not None:
            if not 0.0 <= dt < math.inf:
                raise QueryError("time", f"steps must be >= 0 s and finite, not {dt}")
            if past.main >= 0 and past.tip is not tip:
                kinds = ("loads", "the tip")
                raise QueryError("past", f"is of {kinds[past.tip]}, the query of {kinds[tip]}")
        if warm is None:
            warm = self._own
            warm.forget()
        return warm.workspace(tip, past is not None)

    def displacement(self, answer: Answer, region: Region = "all") -> Field:
        """Nodal displacement (k, 3) mm, of all nodes or those of ``surface_nodes``."""
        displacement = self.fields.displacement(answer)
        return displacement if region == "all" else displacement[self.surface_nodes]

    def von_mises(
        self, answer: Answer, region: Region = "all", displacement: Field | None = None
    ) -> Field:
        """Nodal von Mises stress (k,) kPa; ``displacement`` of all nodes saves its recovery."""
        if displacement is None:
            displacement = self.fields.displacement(answer)
        stress = self.fields.von_mises(answer, displacement)
        return stress if region == "all" else stress[self.surface_nodes]

    def surface_modes(self, number: int) -> Field:
        """Modes (s, r, 3) mm of a local model at the s nodes of the surface."""
        return self.fields.modes(number, self.surface_nodes)

    def composition(self, answer: Answer) -> Composition:
        """What the displacement of the surface is made of."""
        return self.fields.composition(answer, self.surface_nodes)

    def peaks(self, answer: Answer, displacement: Field) -> Peaks:
        """Largest von Mises stress and its 99th percentile (kPa) outside the clamped layer.

        ``displacement`` is that of all nodes.  See ``StressField.peaks``.
        """
        return self.fields.peaks_by_region(answer, displacement)[0]

    def peak(self, answer: Answer, displacement: Field) -> dict[str, Any]:
        """Largest displacement (mm) and stresses (kPa) of an answer by name, JSON-able.

        ``displacement`` is that of all nodes; see ``answer.peak``.
        """
        regions = [region.name for region in self.scene.tissue.region]
        return peak(displacement, self.fields.peaks_by_region(answer, displacement), regions)


def _total(
    reduction: Array, fitted: Array | None, level: float, found: Outcome
) -> tuple[list[float], Array]:
    """Estimated errors of reduction and mesh together, and of the latter.

    At a pressure or depth, by its share of the limit and whether it is near the rim.
    """
    mesh, total, share = np.empty(3), np.empty(3), level / found.limit.item()
    coefficients = UNFITTED if fitted is None else fitted
    total_errors(reduction, coefficients, share, near_rim(found.limits), mesh, total)
    return total.tolist(), mesh


def _footprint(found: Outcome, radius: float, tip: bool) -> Contact | None:
    """What presses in an outcome; nothing where it covers none of the surface."""
    if found.area.item() <= 0.0:
        return None
    return Contact(
        found.foot.copy(),
        found.upward.copy(),
        found.limits[LIMIT_FIELDS : LIMIT_FIELDS + EDGE_FIELD].copy(),
        found.force / -found.area.item(),
        radius,
        tip,
    )


def _in_time(
    own: Workspace,
    answering: Answering,
    past: Past,
    dt: float,
    moves: Moves,
    position: Array | None,
    share: float,
    response: Array,
    dent: Array | None = None,
) -> tuple[Past, Active]:
    """Return the past to go on from after a step, and local models and theirs.

    What the tip's law remembers, the ``dent``, is that of the tip alone.
    """
    assert isinstance(own.past, Remembering)
    way = 0.0
    if position is not None and past.position is not None:
        way = math.dist(position.tolist(), past.position.tolist())
    estimate_history(own.solver, past.features, way, share, response)
    records, features = own.past.records, own.outcome.features[: own.features].copy()
    active = tuple(
        [(k, w, Local(records[slot].copy(), moves.get(k, ()))) for slot, k, w in answering]
    )
    main = max(answering, key=itemgetter(2))[1] if answering else -1
    known = {k: local for k, _, local in active}
    tip, kept = dent is not None, past.dent if dent is None else dent
    return Past(past.time + dt, known, main, position, features, tip, kept), active
