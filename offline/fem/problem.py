"""A scene in full order: its full model, its surface, and the loads of its endoscope."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from palpate.offline.fem.contact import SphereContact, SphereLoad
from palpate.offline.fem.mesh import accessible_surface, build_mesh
from palpate.offline.fem.model import Equilibrium, FullModel, NoEquilibrium
from palpate.offline.fem.sphere import sphere_of, sphere_surface
from palpate.offline.fem.terms import Past, TipLoad
from palpate.shared.arrays import Array, Field, Flags, Numbers
from palpate.shared.artifact import read_artifact, values_of
from palpate.shared.geometry.elements import kind_of
from palpate.shared.geometry.surface import Surface
from palpate.shared.local_models import Body, Mesh
from palpate.shared.mechanics.footprint import MEANS, footprint, means
from palpate.shared.mechanics.tip import (
    EDGE_FIELD,
    LIFTED,
    LONGEST,
    TURNED,
    VANISHED,
    bend,
    dented,
    held,
    history,
    meet_wall,
    tangents_of,
)
from palpate.shared.mechanics.viscosity import step_weights
from palpate.shared.near_field import Contact
from palpate.shared.scene import Scene, parse_scene
from palpate.shared.stress_field import StressField

MOST_PLACES = 24
"""Rounds in which the tip finds the place it touches; from the eighth on its steps are halved."""

RAMP = 8
"""Steps of the way in where the tip finds no place in one."""

SLIGHT = 1e-4
"""Force, over that which dents the tissue by about the radius, whose place does not matter."""

NEAREST = 1e-4
"""Step to the next place, in radii of the tip, and turn of the normal that are taken for none."""


@dataclass(frozen=True)
class Load:
    """A pressed footprint at the end of a time step."""

    position: Array  # (3,) mm, contact point
    direction: Array  # (3,), unit vector
    pressure: float  # kPa
    dt: float = 0.0  # s


@dataclass(frozen=True)
class TipPosition:
    """A rigid tip at the end of a time step."""

    position: Array  # (3,) mm, centre
    dt: float = 0.0  # s


Step = Load | TipPosition
"""What the endoscope does in one time step; without time, its length is zero."""


class Reference(NamedTuple):
    """Full solutions at the ends of time steps."""

    u: Field  # (t, n, 3) mm
    s: Field  # (t, n) kPa, von Mises stress
    f: Array  # (t, 3) mN, on the tool
    tangent: Array  # (t, 3, 3) mN/mm, derivative of the force in the tool's position


class FullProblem:
    """The full model of a scene, on its mesh unless another is given, and what presses it.

    The surface pressed is that of the scene's body, or of the faces of another mesh if absent.
    """

    def __init__(
        self, scene: Scene, mesh: Mesh | None = None, surface: Surface | None = None
    ) -> None:
        self.scene = scene
        self.mesh = build_mesh(scene) if mesh is None else mesh
        self.model = FullModel(self.mesh, scene.tissue)
        self.surface = surface or accessible_surface(self.mesh, scene if mesh is None else None)
        self.nodes = np.arange(len(self.mesh.nodes), dtype=np.int32)  # of the whole body
        self.elements = np.arange(len(self.mesh.elements), dtype=np.int32)
        self._nodal = np.zeros(len(self.mesh.nodes))

    @classmethod
    def of_artifact(cls, path: Path, young: float | None = None) -> FullProblem:
        """Full model on the very mesh and surface that an artifact was trained on.

        Of its tissue, or of one with another Young's modulus (kPa).
        """
        artifact = read_artifact(path, Mesh, Surface)
        arrays = artifact.arrays
        mesh, surface = Mesh(**values_of(Mesh, arrays)), Surface(**values_of(Surface, arrays))
        scene = parse_scene(artifact.scene)
        return cls(scene if young is None else scene.of_tissue(young=young), mesh, surface)

    @cached_property
    def body(self) -> Body:
        """Mesh and tissue as the reduced model sees them."""
        return Body.of(self.mesh, self.scene)

    @cached_property
    def beyond_clamped_layer(self) -> Flags:
        """Nodes (n,) at which stress is compared; see ``Body``."""
        return self.body.beyond_clamped_layer(self.mesh.nodes)

    @cached_property
    def nodal_volumes(self) -> Array:
        """Volumes (n,) mm^3 that nodes stand for: those of the elements around, shared out."""
        return self._shared_out(self.model.volumes)

    @cached_property
    def counted_volumes(self) -> Array:
        """Those by which nodal stress is compared: of no region, and beyond the clamped layer.

        A region 200 times as stiff has stress beside which that of all else would not count, and
        where it is as thin as an element, its nodes have the stress outside, on which they border.
        """
        own = self.model.volumes * (self.mesh.region == 0)
        return self._shared_out(own) * self.beyond_clamped_layer

    def _shared_out(self, volumes: Array) -> Array:
        """Volumes (e,) mm^3 of elements as shares (n,) of their nodes."""
        elements = self.mesh.elements
        shares = np.repeat(volumes / elements.shape[1], elements.shape[1])
        return np.bincount(elements.ravel(), shares, len(self.mesh.nodes)).astype(float)

    def points_in_body(self, points: Numbers) -> Numbers:
        """Numbers in the whole body of quadrature points."""
        per_element = self.model.weights.shape[1]
        element, q = np.divmod(points, per_element)
        return (self.elements[element] * per_element + q).astype(np.int32)

    # --- loads ---------------------------------------------------------------------------------

    def unit_load(self, position: Array) -> tuple[Array, Array]:
        """Nodal weights (n,) mm^2 of a unit pressure at a surface point, and the normal there."""
        x, normal, _ = self.surface.project(position)
        return self.unit_load_at(x, normal), normal

    def unit_load_at(self, x: Array, normal: Array, radius: float | None = None) -> Array:
        """The same at a contact point of another mesh, whose accessible surface ends elsewhere.

        The radius (mm) is the scene's if absent.
        """
        radius = radius or self.scene.endoscope.radius
        footprint(self.body.boundary, x, normal, radius, self._nodal)
        return self._nodal.copy()

    def load_vector(self, load: Load) -> Array:
        """Nodal forces (n, 3) mN."""
        nodal, _ = self.unit_load(load.position)
        return load.pressure * nodal[:, None] * load.direction

    @cached_property
    def _contact_fields(self) -> Array:
        return self.body.contact_fields(self.surface)

    def tip_at(
        self, place: Array, centre: Array, normal: Array, loss: float = 0.0, past: float = 0.0
    ) -> tuple[TipLoad, Array]:
        """The tip with its centre (3,) mm that touches at a place, and the surface point there.

        It pushes along ``normal`` (3,); for ``loss`` and ``past`` see ``tip.history``.
        """
        x, out, _, at = self.surface.locate(place, self._contact_fields)
        tip, tangents, bent = self.body.tip, np.empty((2, 3)), np.empty((2, 2))
        tangents_of(out, tangents)
        sharpness = bend(at, tangents, tip.radius, bent)
        beta, relief = tip.local_law(sharpness, at[EDGE_FIELD])
        law = beta, relief, loss, held(beta, past)
        nodal = np.empty((MEANS, len(self.mesh.nodes)))
        means(self.body.boundary, x, out, tangents, bent, tip.radius, nodal)
        return TipLoad(tip, nodal, tangents, bent, centre - x, normal, law, at[EDGE_FIELD:]), x

    @cached_property
    def contact(self) -> SphereContact:
        """The rigid sphere against the full model, integrated over its faces."""
        mesh, radius = self.mesh, self.scene.endoscope.radius
        surface = sphere_surface(mesh.nodes, mesh.faces, mesh.accessible, radius)
        return SphereContact(self.model, surface, sphere_of(radius, self.scene.tissue.young))

    def sphere_at(self, centre: Array) -> SphereLoad:
        """The sphere at a place (3,) mm, on the shortest way from where it does not touch."""
        normal = self.surface.project(centre)[1]
        return SphereLoad(self.contact, centre, -max(self._depth(centre), 0.0) * normal)

    # --- answers -------------------------------------------------------------------------------

    def solve(
        self, step: Step, past: Past | None = None, start: Array | None = None
    ) -> Equilibrium:
        """Full solution at the end of a time step; see ``FullModel.solve``."""
        if isinstance(step, TipPosition):
            return self._touch(step, past, start)
        return self.model.solve(self.load_vector(step), past, step.dt, start)

    def _touch(self, step: TipPosition, past: Past | None, start: Array | None) -> Equilibrium:
        """Under the tip, at once or else step by step on the way in."""
        if past is None and self.model.prony and step.dt > 0.0:
            past = self.model.at_rest
        try:
            return self._settle(step, past, start)
        except NoEquilibrium:
            way = self._depth(step.position) * self.surface.project(step.position)[1]
        for share in np.linspace(1.0, 0.0, RAMP + 1)[1:]:
            on = replace(step, position=step.position + share * way)
            found = self._settle(on, past, start)
            start = found.displacement
        return found

    def _settle(self, step: TipPosition, past: Past | None, start: Array | None) -> Equilibrium:
        """Under the tip, where the energy is stationary in the place; see ``mechanics.tip``."""
        weights = step_weights(self.model.prony, step.dt)
        time = (0.0, 0.0) if past is None else history(self.body.tip, past.dent, weights)
        known = start if start is not None or past is None else past.displacement
        radius = self.body.tip.radius
        place, normal = self._begin(step.position, known, past.foot if past else None)
        wall, last, largest = np.zeros(3), None, 0.0
        for made in range(MOST_PLACES):
            load, x = self.tip_at(place, step.position, normal, *time)
            found = self.model.solve(load, past, step.dt, start, keep=made > 0)
            if past is not None:
                dent = dented(past.dent, weights, load.law, float(np.linalg.norm(found.force)))
                found = replace(found, past=replace(found.past, dent=dent))
            if found.place is None or np.linalg.norm(found.force) < VANISHED * largest:
                if last is not None and not (past is not None and made > LIFTED):  # too far
                    place, normal = (last[0] + x) / 2, last[1]
                    continue
                if past is None and self._depth(step.position) > 0.0:
                    break
                return found
            newton, barred = found.place.step(load.tangents @ wall, TURNED * radius)
            length = max(float(np.linalg.norm(newton)), 1e-12)
            wanted = newton * min(1.0, LONGEST * radius / length) * (0.5 if made > 6 else 1.0)
            place = self.surface.project(x + wanted @ load.tangents)[0]
            moved = load.tangents @ (place - x)
            meet_wall(wanted, moved, barred)
            short = length < NEAREST * radius
            share = 1.0 if short else float(np.clip(moved @ newton / length**2, 0.0, 1.0))
            force = found.place.force(newton, share)
            turned = force / np.linalg.norm(force) - normal
            largest = max(largest, float(np.linalg.norm(force)))
            slight = largest < SLIGHT * self.body.tip.modulus * radius**2
            if slight or max(np.linalg.norm(moved) / radius, np.linalg.norm(turned)) < NEAREST:
                exact = self.model.solve(load, past, step.dt, found.displacement).place
                tangent = (exact or found.place).tangent(barred)
                return replace(found, tangent=tangent, foot=x, past=replace(found.past, foot=x))
            wall, last = barred @ load.tangents, (x, normal)
            normal, start = normal + turned, found.displacement
        raise NoEquilibrium("load: the tip finds no place to touch; lower the depth")

    def _depth(self, centre: Array) -> float:
        """How deep (mm) a tip is in the surface at rest."""
        return self.body.tip.radius - self.surface.height(centre)

    def _begin(
        self, centre: Array, displacement: Array | None, last: Array | None
    ) -> tuple[Array, Array]:
        """Where the search for a place begins, at a displacement, and the normal there.

        Where the tip touched last, or where the deformed surface is nearest to it.
        """
        place, normal, _ = self.surface.project(centre)
        near = last is not None and np.linalg.norm(last - place) < LONGEST * self.body.tip.radius
        if last is not None and displacement is not None and near:
            load, x = self.tip_at(last, centre, normal)
            return x, load.touch(displacement.ravel()).towards
        for _ in range(MOST_PLACES):
            if displacement is None:
                break
            load, x = self.tip_at(place, centre, normal)
            moved, normal = load.nearer(displacement)
            place = self.surface.project(x + moved @ load.tangents)[0]
            if np.linalg.norm(place - x) < 1e-3 * self.body.tip.radius:
                break
        return place, normal

    def press_at(
        self, x: Array, normal: Array, traction: Array, start: Array | None = None
    ) -> tuple[Array, Array]:
        """Displacement (n, 3) mm, and its mean (3,) under the footprint, at a given contact point.

        The point may be one of another mesh, whose accessible surface ends elsewhere; ``traction``
        (3,) kPa is direction times pressure at the footprint's centre.
        """
        nodal = self.unit_load_at(x, normal)
        displacement = self.model.solve(np.outer(nodal, traction), start=start).displacement
        return displacement, nodal @ displacement / nodal.sum()

    def reference(
        self, steps: Sequence[Step], start: Array | None = None, near_field: bool = True
    ) -> Reference | None:
        """What a reduced model is compared with, None where there is no equilibrium.

        The first solution is sought from a guess ``start`` (n, 3) mm.
        """
        rows, past = [], None
        for step in steps:
            try:
                found = self.solve(step, past, start)
            except NoEquilibrium:
                return None
            past, start = found.past, None
            contact = self.footprint(step, found) if near_field else None
            u = self.displaced(found, contact)
            stress = self.von_mises(u, past, contact)
            fields = u.astype(np.float32), stress.astype(np.float32)
            rows.append((*fields, found.force, found.tangent))
        return Reference(*(np.array(part) for part in zip(*rows, strict=True)))

    @cached_property
    def stress_field(self) -> StressField:
        """Recovers stress."""
        return StressField(self.body)

    def footprint(self, step: Step, found: Equilibrium | None = None) -> Contact | None:
        """What presses in a step; of the tip, by the force in what was found."""
        radius = self.scene.endoscope.radius
        if isinstance(step, Load):
            x, normal, _, at = self.surface.locate(step.position, self._contact_fields)
            traction = step.pressure * step.direction
            return Contact(x, normal, at[:EDGE_FIELD], traction, radius)
        if found is None or found.foot is None:
            return None
        x, normal, _, at = self.surface.locate(found.foot, self._contact_fields)
        traction = found.force / -self.unit_load_at(x, normal).sum()
        return Contact(x, normal, at[:EDGE_FIELD], traction, radius, tip=True)

    def displaced(self, found: Equilibrium, contact: Contact | None) -> Array:
        """Displacement (n, 3) mm of the nodes, with the dent of a tip that is not the mesh's."""
        u = found.displacement.copy()
        self.stress_field.add_dent(u, contact)
        return u

    def von_mises(
        self, displacement: Array, past: Past | None = None, contact: Contact | None = None
    ) -> Array:
        """Nodal von Mises stress (n,) kPa at a displacement (n, 3) mm, with which a past ends.

        With the near field of a contact, if that is given.
        """
        u, B = np.ascontiguousarray(displacement, dtype=float), None
        if past is not None and self.model.prony:
            shares = np.array([share for share, _ in self.model.prony])
            known = past.points[:-1, :, : kind_of(self.mesh.elements).points]
            B = np.ascontiguousarray(np.einsum("a,aeqi->eiq", shares, known))
        return self.stress_field.von_mises(u, B, contact)

    def under(self, position: Array, displacement: Array) -> Array:
        """Mean displacement (3,) under a footprint, weighted with its pressure."""
        nodal, _ = self.unit_load(position)
        return np.asarray(nodal @ displacement / nodal.sum())
