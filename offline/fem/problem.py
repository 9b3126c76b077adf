"""A scene in full order: its full model, its surface, and the loads of its endoscope."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from palpate.offline.fem.mesh import accessible_surface, build_mesh
from palpate.offline.fem.model import Equilibrium, FullModel, NoEquilibrium
from palpate.offline.fem.terms import DeadLoad, Past, TipContact, TipLoad
from palpate.shared.arrays import Array, Field, Flags
from palpate.shared.artifact import Artifact, values_of
from palpate.shared.geometry.quadrature import stress_recovery
from palpate.shared.geometry.surface import Surface
from palpate.shared.local_models import Body, Mesh
from palpate.shared.mechanics.footprint import footprint
from palpate.shared.mechanics.sphere import tip_of, tip_surface
from palpate.shared.mechanics.stress import StressRecovery, nodal_von_mises
from palpate.shared.scene import Scene, parse_scene


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
    """The full model of a scene, on its mesh unless another is given, and what presses it."""

    def __init__(self, scene: Scene, mesh: Mesh | None = None) -> None:
        self.scene = scene
        self.mesh = build_mesh(scene) if mesh is None else mesh
        self.model = FullModel(self.mesh, scene.tissue)
        self.surface: Surface = accessible_surface(self.mesh)
        self._nodal = np.zeros(len(self.mesh.nodes))

    @classmethod
    def of_artifact(cls, artifact: Artifact) -> FullProblem:
        """Full model on the very mesh that an artifact was trained on."""
        return cls(parse_scene(artifact.scene), Mesh(**values_of(Mesh, artifact.arrays)))

    @cached_property
    def body(self) -> Body:
        """Mesh and tissue as the reduced model sees them."""
        tip = tip_of(self.scene.endoscope.radius, self.scene.tissue.young)
        return Body(**vars(self.mesh), law=self.model.law, tip=tip)

    @cached_property
    def beyond_clamped_layer(self) -> Flags:
        """Nodes of no element that touches the support, (n,)."""
        layer = self.mesh.elements[self.mesh.clamped[self.mesh.elements].any(axis=1)]
        outside = np.ones(len(self.mesh.nodes), dtype=bool)
        outside[layer] = False
        return outside

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

    def load(self, step: Step) -> DeadLoad | TipLoad:
        """What the endoscope does, as a term of the potential."""
        if isinstance(step, Load):
            return DeadLoad(self.load_vector(step).reshape(-1))
        return self.tip_load(step.position)

    @cached_property
    def contact(self) -> TipContact:
        """The rigid tip against the full model."""
        mesh, tip = self.mesh, self.body.tip
        surface = tip_surface(mesh.nodes, mesh.faces, mesh.accessible, tip.radius)
        return TipContact(self.model, surface, tip)

    def tip_load(self, position: Array) -> TipLoad:
        """The tip at a place (3,) mm, on the shortest way from where it does not touch."""
        foot, normal, _ = self.surface.project(position)
        out = position - foot
        depth = self.body.tip.radius - float(np.copysign(np.linalg.norm(out), out @ normal))
        return TipLoad(self.contact, position, -max(depth, 0.0) * normal)

    # --- answers -------------------------------------------------------------------------------

    def solve(
        self, step: Step, past: Past | None = None, start: Array | None = None
    ) -> Equilibrium:
        """Full solution at the end of a time step; see ``FullModel.solve``."""
        return self.model.solve(self.load(step), past, step.dt, start)

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

    def reference(self, steps: Sequence[Step], start: Array | None = None) -> Reference | None:
        """What a reduced model is compared with, None where there is no equilibrium.

        The first solution is sought from a guess ``start`` (n, 3) mm.
        """
        rows, past = [], None
        for step in steps:
            try:
                found = self.solve(step, past, start)
            except NoEquilibrium:
                return None
            u, past, start = found.displacement, found.past, None
            fields = u.astype(np.float32), self.von_mises(u, past).astype(np.float32)
            rows.append((*fields, found.force, found.tangent))
        return Reference(*(np.array(part) for part in zip(*rows, strict=True)))

    @cached_property
    def _recovery(self) -> StressRecovery:
        return stress_recovery(self.mesh.nodes, self.mesh.elements, self.model.law)

    def von_mises(self, displacement: Array, past: Past | None = None) -> Array:
        """Nodal von Mises stress (n,) kPa at a displacement (n, 3) mm, with which a past ends."""
        out, u = np.zeros(len(self.mesh.nodes)), np.ascontiguousarray(displacement, dtype=float)
        B = None
        if past is not None and self.model.prony:
            shares = np.array([share for share, _ in self.model.prony])
            B = np.ascontiguousarray(np.einsum("a,aeqi->eiq", shares, past.points[:-1]))
        nodal_von_mises(self._recovery, u, B, out)
        return out

    def under(self, position: Array, displacement: Array) -> Array:
        """Mean displacement (3,) under a footprint, weighted with its pressure."""
        nodal, _ = self.unit_load(position)
        return np.asarray(nodal @ displacement / nodal.sum())
